"""PSNR between renders of two scenes, or of one scene in two render modes."""

from __future__ import annotations

from collections.abc import Sequence

from sgsst_core.loss.gradient_error import psnr
from sgsst_core.rasterizer import make_rasterizer
from sgsst_core.scene.camera import Camera
from sgsst_core.scene.gaussians import Scene
from sgsst_core.scene.spherical_harmonics import scene_colors


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
        first: Scene to compare.
        second: Scene to compare it with.
        cameras: Cameras of the views, at least one.
        background: Background color.
        near: Distance of the near plane in world units.

    Returns:
        PSNR; None if all renders are identical.
    """
    pairs = [(make_rasterizer("cpu", each, background=background, near=near), each) for each in (first, second)]
    squares = values = 0.0
    for camera in cameras:
        one, other = (
            rasterizer.render(scene_colors(each, camera), camera).clamp(0, 1).double() for rasterizer, each in pairs
        )
        squares += float((one - other).square().sum())
        values += one.numel()
    return psnr(squares / values) if squares else None
