"""Whether a GPU rasterizer works here: one Gaussian is drawn to see.

A package that can be imported may still lack its compiled kernels, or have those of another CUDA, which shows at their
first use: in the middle of a job, if nobody has tried before.
"""

from __future__ import annotations

import torch

from sgsst_core.constants import RASTER_TILE
from sgsst_core.rasterizer import RasterizerName, make_rasterizer
from sgsst_core.scene.camera import Camera
from sgsst_core.scene.gaussians import Scene


def drawing_problem(name: RasterizerName, device: torch.device | str = "cuda") -> str | None:
    """Why a rasterizer cannot draw on a device, in a few words; None where it can."""
    gaussian = Scene(
        torch.tensor([[0.0, 0.0, 2.0]]),
        torch.tensor([[1.0, 0.0, 0.0, 0.0]]),
        torch.zeros(1, 3),
        torch.zeros(1),
        torch.zeros(1, 3),
        torch.zeros(1, 0, 3),
    )
    camera = Camera("trial", RASTER_TILE, RASTER_TILE, 16.0, 16.0, 8.0, 8.0, torch.eye(4, dtype=torch.float64))
    try:
        rasterizer = make_rasterizer(name, gaussian, device=device)
        image = rasterizer.render(torch.ones(1, 3), camera)
        gradient = rasterizer.colour_gradient(torch.ones_like(image), camera)
        drawn = float(image.sum()) > 0 and float(gradient.sum()) > 0
    except Exception as error:  # whatever it is, it cannot be used
        return (str(error).strip().splitlines() or [type(error).__name__])[0]
    return None if drawn else "it draws nothing"
