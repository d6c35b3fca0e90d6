"""PSNR between renders of two scenes, of one scene in two render modes, or of a converted file and its original."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from torch import Tensor

from sgsst_core.files.formats import by_name
from sgsst_core.files.scene_file import losses, read_scene
from sgsst_core.loss.gradient_error import psnr
from sgsst_core.rasterizer import make_rasterizer
from sgsst_core.scene.camera import Camera, resized, spread
from sgsst_core.scene.gaussians import Scene
from sgsst_core.scene.spherical_harmonics import scene_colors

#: PSNR in dB below which the loss of a converted file is large. Real scenes have 47 or more.
_LARGE_LOSS = 35.0
#: Number of views in which a converted file is compared, and their longer side in pixels.
_VIEWS, _SIDE = 3, 256


def scene_psnr(
    first: Scene,
    second: Scene,
    cameras: Sequence[Camera],
    *,
    background: tuple[float, float, float] = (0.0, 0.0, 0.0),
    near: float,
) -> float | None:
    """Return the PSNR in dB of CPU renders of two scenes over all views, with colors clamped to 0 to 1.

    Args:
        cameras: Cameras of the views, at least one.

    Returns:
        PSNR; None if all renders are identical.
    """

    def renders(scene: Scene) -> Iterator[Tensor]:
        rasterizer = make_rasterizer("cpu", scene, background=background, near=near, memory=0)
        for camera in cameras:
            yield rasterizer.render(scene_colors(scene, camera), camera).clamp(0, 1)

    squares = values = 0.0
    for one, other in zip([*renders(first)], renders(second), strict=True):  # one rasterizer at a time
        squares += float((one.double() - other.double()).square().sum())
        values += one.numel()
    return psnr(squares / values) if squares else None


@dataclass(frozen=True)
class CompressionLoss:
    """Quality loss of a compressed file relative to the original scene.

    Attributes:
        psnr: PSNR in dB of these views against those of the original scene, with colors clamped to 0 to 1; None if all
            are identical.
        lost_mode: How the file is read if it cannot state the scene's render mode; empty if it can.
        warnings: Losses that the format causes.
    """

    name: str
    format: str
    size: int
    views: list[str]
    psnr: float | None
    lost_mode: str = ""
    warnings: tuple[str, ...] = ()

    def as_dict(self) -> dict[str, Any]:
        """Return the values for the JSON report."""
        psnr = None if self.psnr is None else round(self.psnr, 2)
        values = {"name": self.name, "format": self.format, "bytes": self.size, "views": self.views, "psnr_db": psnr}
        more = {"lost_mode": self.lost_mode, "warnings": list(self.warnings)}
        return values | {name: value for name, value in more.items() if value}

    def text(self, original: str) -> str:
        """Return a description of the result in one line, given that of the original file."""
        psnr = "renders identical to" if self.psnr is None else f"{self.psnr:.1f} dB PSNR against"
        lost = "".join(
            f"; {each}" for each in (self.lost_mode, *(f"warning: {each}" for each in self.warnings)) if each
        )
        return f"{self.format}, {self.size / 1e6:.1f} MB, {psnr} {original}{lost}"


def measure_compression(
    path: Path,
    scene: Scene,
    cameras: Sequence[Camera],
    *,
    background: tuple[float, float, float] = (0.0, 0.0, 0.0),
    near: float,
    axes: str = "rub",
) -> CompressionLoss:
    """Read a compressed file back, and compare small CPU renders of some views with the original scene.

    Args:
        cameras: Cameras to choose views from, at least one.
        axes: Axes that an SPZ was written with.

    Raises:
        SceneError: If the file cannot be read.
    """
    back = read_scene(path, spz_axes="rdf" if axes == "rdf" else "auto")
    chosen = [resized(camera, min(_SIDE, max(camera.width, camera.height))) for camera in spread(cameras, _VIEWS)]
    loss = scene_psnr(scene, back.scene, chosen, background=background, near=near)
    names, read_as = [camera.name for camera in chosen], back.scene.rendering
    lost = "" if read_as == scene.rendering else f"read as {read_as.text}, since it cannot state {scene.rendering.text}"
    warnings = losses(scene, by_name(back.format))
    if loss is not None and loss < _LARGE_LOSS:
        warnings += ("the loss is large",)
    return CompressionLoss(path.name, back.format, path.stat().st_size, names, loss, lost, warnings)
