"""ComfyUI node that stylizes a 3DGS scene with an image of the workflow.

Copy this file as `__init__.py`, and sgsst_rest.py, to `ComfyUI/custom_nodes/sgsst`. ComfyUI has all other packages.
"""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image

from .sgsst_rest import Service


class StylizeSplats:
    """Node with a scene and a style as inputs, and the stylized scene and an image of it as outputs."""

    CATEGORY = "3d"
    FUNCTION = "stylize"
    RETURN_TYPES = ("STRING", "IMAGE")
    RETURN_NAMES = ("stylized_ply", "preview")

    @classmethod
    def INPUT_TYPES(cls) -> dict[str, Any]:
        """Return the inputs of the node."""
        return {
            "required": {
                "scene": ("STRING", {"default": "scene.ply", "tooltip": "Path of a 3DGS scene"}),
                "style": ("IMAGE",),
                "out": ("STRING", {"default": "stylized.ply", "tooltip": "Path of the PLY to write"}),
                "preset": (["preview", "standard", "paper"],),
            },
            "optional": {
                "cameras": ("STRING", {"default": "", "tooltip": "Path of a cameras.json; empty for an orbit"}),
                "orbit": ("INT", {"default": 24, "min": 3, "max": 200, "tooltip": "Views around the scene"}),
                "url": ("STRING", {"default": "http://127.0.0.1:8000"}),
            },
        }

    def stylize(
        self,
        scene: str,
        style: torch.Tensor,
        out: str,
        preset: str,
        cameras: str = "",
        orbit: int = 24,
        url: str | None = None,
    ) -> tuple[str, torch.Tensor]:
        """Run the job, and return the path of the stylized scene and an image, [1, height, width, 3] in 0..1."""
        service = Service(url)
        views: dict[str, Any] = {"cameras": [Path(cameras)]} if cameras else {"orbit": orbit}
        with tempfile.TemporaryDirectory() as folder:
            picture, preview = Path(folder) / "style.png", Path(folder) / "preview.jpg"
            Image.fromarray((255 * style[0].cpu().numpy()).round().clip(0, 255).astype(np.uint8)).save(picture)
            job_id = service.stylize(Path(scene), picture, Path(out), preset=preset, **views)
            service.download(job_id, "previews/thumbnail.jpg", preview)
            image = np.asarray(Image.open(preview).convert("RGB"), dtype=np.float32) / 255
        return out, torch.from_numpy(image)[None]


NODE_CLASS_MAPPINGS = {"SgsstStylizeSplats": StylizeSplats}
NODE_DISPLAY_NAME_MAPPINGS = {"SgsstStylizeSplats": "Stylize 3D Gaussian Splats"}
