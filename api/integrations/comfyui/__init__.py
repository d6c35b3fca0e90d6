"""Nodes of ComfyUI: stylize a Gaussian splat on a service of sgsst, and blend two."""

import io
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import torch
from comfy import model_management
from comfy.utils import ProgressBar
from comfy_api.latest import IO, ComfyExtension, Types
from comfy_extras.nodes_gaussian_splat import File3DToSplat, SplatToFile3D
from PIL import Image

from .sgsst_rest import Service, fraction, orbit_options

_CATEGORY = "3d/splat"
#: Steps of the progress bar.
_STEPS = 1000


def _real_count(splat: Any) -> int:
    """Return the number of Gaussians of a single splat without padding.

    Raises:
        ValueError: If there are several splats.
    """
    if len(splat.positions) > 1:
        raise ValueError(f"The input is a batch of {len(splat.positions)} splats. Stylize or blend one at a time.")
    return int(splat.counts[0]) if splat.counts is not None else int(splat.positions.shape[1])


def _with_colors(splat: Any, sh: torch.Tensor) -> Any:
    """Return a single splat with other spherical harmonics, [1, N, K, 3]."""
    parts = [each[:, : sh.shape[1]] for each in (splat.positions, splat.scales, splat.rotations, splat.opacities)]
    return Types.SPLAT(*parts, sh)


class Stylize(IO.ComfyNode):
    """Node that stylizes a splat with an image."""

    @classmethod
    def define_schema(cls) -> Any:
        """Return inputs and outputs of the node."""
        return IO.Schema(
            node_id="SgsstStylize",
            display_name="Stylize Splat (SGSST)",
            category=_CATEGORY,
            description="Paint a Gaussian splat in the style of an image. Only its colors change.",
            inputs=[
                IO.Splat.Input("splat"),
                IO.Image.Input("style", tooltip="Painting; of a batch, the first image."),
                IO.Combo.Input("preset", options=["preview", "standard", "paper"], default="standard"),
                IO.Float.Input(
                    "minutes",
                    default=10.0,
                    min=0.0,
                    max=1440.0,
                    step=0.5,
                    tooltip="Time budget, which chooses resolution, views and steps; 0 for no limit.",
                ),
                IO.Int.Input("views", default=0, min=0, max=200, tooltip="Views around the splat; 0 for automatic."),
                IO.Combo.Input(
                    "up",
                    options=["-y", "y", "-z", "z", "-x", "x", "auto"],
                    default="-y",
                    tooltip="Up axis of the splat; ComfyUI's own splats have -y.",
                ),
                IO.String.Input(
                    "service",
                    default="",
                    optional=True,
                    advanced=True,
                    tooltip="Address of the service; empty for SGSST_URL, or http://127.0.0.1:8000. The key in "
                    "SGSST_KEY is only sent to the service of SGSST_URL.",
                ),
            ],
            outputs=[
                IO.Splat.Output(display_name="stylized"),
                IO.Image.Output(display_name="preview"),
                IO.String.Output(display_name="job"),
            ],
        )

    @classmethod
    def execute(
        cls, splat: Any, style: torch.Tensor, preset: str, minutes: float, views: int, up: str, service: str = ""
    ) -> Any:
        """Run the job; return the stylized splat, an image of it, and the job's id."""
        count = _real_count(splat)
        connection = Service(service)
        options = orbit_options(preset, views, up, minutes)
        with tempfile.TemporaryDirectory() as folder:
            scene, style_file, out = (Path(folder) / name for name in ("splat.ply", "style.png", "stylized.ply"))
            SplatToFile3D.execute(splat, "ply")[0].save_to(str(scene))
            pixels = (255 * style[0, ..., :3].cpu().numpy()).round().clip(0, 255)
            Image.fromarray(pixels.astype(np.uint8)).save(style_file)
            job_id = connection.submit(scene, style_file, **options)
            preview = _follow(connection, job_id)
            connection.download(job_id, "stylized.ply", out)
            result = File3DToSplat.execute(Types.File3D(str(out), "ply"))[0]
        if result.positions.shape[1] == count:  # else, Gaussians without effect were dropped
            result = _with_colors(splat, result.sh)
        return IO.NodeOutput(result, preview, job_id)


def _follow(connection: Service, job_id: str) -> torch.Tensor:
    """Wait until a job has succeeded, show its progress and newest image, and return the last image.

    It is an image of ComfyUI, [1, height, width, 3] float32 in 0..1.

    Raises:
        comfy.model_management.InterruptProcessingException: If the user interrupts, which cancels the job.
    """
    bar, shown, image = ProgressBar(_STEPS), None, None
    try:
        for job in connection.watch(job_id):
            model_management.throw_exception_if_processing_interrupted()
            if job["preview"] not in (None, shown):
                shown = job["preview"]
                with connection.request("GET", f"/v1/jobs/{job_id}/artifacts/{shown}") as answer:
                    image = Image.open(io.BytesIO(answer.read()))
                bar.update_absolute(int(_STEPS * fraction(job)), _STEPS, ("JPEG", image.convert("RGB"), None))
            else:
                bar.update_absolute(int(_STEPS * fraction(job)))
    except model_management.InterruptProcessingException:
        connection.cancel(job_id)
        raise
    assert image is not None
    return torch.from_numpy(np.asarray(image.convert("RGB"), dtype=np.float32) / 255)[None]


class Blend(IO.ComfyNode):
    """Node that blends the colors of two splats of one scene."""

    @classmethod
    def define_schema(cls) -> Any:
        """Return inputs and outputs of the node."""
        return IO.Schema(
            node_id="SgsstBlend",
            display_name="Blend Splats (SGSST)",
            category=_CATEGORY,
            description="Blend the colors of a splat and its stylized version, or of two stylized versions.",
            inputs=[
                IO.Splat.Input("original"),
                IO.Splat.Input("stylized"),
                IO.Float.Input(
                    "weight",
                    default=0.7,
                    min=-1.0,
                    max=2.0,
                    step=0.05,
                    tooltip="0 is the original, 1 the stylized splat; 1.5 exaggerates the style by half.",
                ),
            ],
            outputs=[IO.Splat.Output(display_name="blend")],
        )

    @classmethod
    def execute(cls, original: Any, stylized: Any, weight: float) -> Any:
        """Return the original with blended colors."""
        first, second = (each.sh[:, : _real_count(each)] for each in (original, stylized))
        if first.shape != second.shape:
            raise ValueError(
                f"The splats have {first.shape[1]:,} and {second.shape[1]:,} Gaussians with {first.shape[2]} and "
                f"{second.shape[2]} coefficients. Blend versions of the same splat."
            )
        return IO.NodeOutput(_with_colors(original, torch.lerp(first, second.to(first), weight)))


class Extension(ComfyExtension):
    """Nodes of this package."""

    async def get_node_list(self) -> list[type[Any]]:
        """Return the classes of all nodes."""
        return [Stylize, Blend]


async def comfy_entrypoint() -> Extension:
    """Return the extension to ComfyUI."""
    return Extension()
