"""Rasterizers for CPU and GPU.

To add one, implement `base.Rasterizer` in a module and list the class in `RASTERIZERS`.
"""

from typing import Any

import torch

from sgsst_core.constants import NEAR, RASTER_TILE
from sgsst_core.errors import SettingsError
from sgsst_core.rasterizer.base import Color, Rasterizer
from sgsst_core.rasterizer.cpu import CpuRasterizer
from sgsst_core.rasterizer.triton import CachedRasterizer, TritonRasterizer
from sgsst_core.scene.camera import Camera
from sgsst_core.scene.gaussians import Scene

__all__ = ["RASTERIZERS", "Rasterizer", "drawing_problem", "make_rasterizer", "rasterizer_for"]

#: All rasterizers by name.
RASTERIZERS: dict[str, type[Rasterizer]] = {
    kind.name: kind for kind in (TritonRasterizer, CpuRasterizer, CachedRasterizer)
}


def make_rasterizer(
    name: str,
    scene: Scene,
    *,
    background: Color = (0.0, 0.0, 0.0),
    near: float = NEAR,
    device: torch.device | str | None = None,
    memory: int | None = None,
    **options: Any,
) -> Rasterizer:
    """Create the rasterizer of a given name for a scene.

    Args:
        name: `cpu` computes blend weights in every call; `cached` stores them (its options are `precision`, `max_bytes`
            and `uncached`); `triton` runs on GPUs.
        scene, background: As in `Rasterizer`.
        device: Device for `cached` and `triton`. None selects the CPU for `cached` (or the device of its option
            `uncached`), and the current GPU for `triton`.
        memory: Memory budget in bytes for tile intersections and cached blend weights; None for the default.
        options: Further arguments of the implementation's constructor.

    Raises:
        SettingsError: If the name is unknown, or the rasterizer cannot use the device.

    Example:
        >>> scene = load_scene("scene.ply").scene
        >>> camera = load_cameras("cameras.json")[0]
        >>> make_rasterizer("cpu", scene).render(scene.sh_dc, camera).shape
        torch.Size([48, 64, 3])
    """
    if name not in RASTERIZERS:
        *names, last = RASTERIZERS
        raise SettingsError(f"no rasterizer is called {name!r}: choose {', '.join(names)} or {last}")
    kind = RASTERIZERS[name]
    if memory is not None:
        options = kind.options(memory) | options
    return kind(scene, background=background, near=near, device=device, **options)


def rasterizer_for(device: str, problem: str | None) -> str:
    """Return the name of the rasterizer that computes blend weights: on a GPU `triton`, if it works.

    Args:
        device: Type of the job's device, "cpu" or "cuda".
        problem: Reason why `triton` does not work; None if it works.
    """
    return TritonRasterizer.name if torch.device(device).type != "cpu" and problem is None else CpuRasterizer.name


def drawing_problem(name: str, device: torch.device | str = "cuda") -> str | None:
    """Return the reason why a rasterizer cannot render a single Gaussian on a device; None if it can.

    Errors of kernels appear when they are first used, which would otherwise be in the middle of a job. Takes up to
    minutes if kernels have to be compiled; they are cached.
    """
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
        gradient = rasterizer.color_gradient(torch.ones_like(image), camera)
        drawn = float(image.sum()) > 0 and float(gradient.sum()) > 0
    except Exception as error:  # whatever the exception, the rasterizer is unusable
        return (str(error).strip().splitlines() or [type(error).__name__])[0]
    return None if drawn else "it draws nothing"
