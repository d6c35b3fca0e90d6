"""Argument checks shared by all rasterizers, and cache keys of cameras."""

from __future__ import annotations

import torch
from torch import Tensor

from sgsst_core.scene.camera import Camera

Rows = tuple[int, int]

#: Cache key of a camera. It contains everything that rendering depends on, so cameras with equal keys render equal
#: images. The camera's name is not part of it.
CameraKey = tuple[int, int, float, float, float, float, bytes]


def camera_key(camera: Camera) -> CameraKey:
    """Return the cache key of a camera."""
    pose = camera.world_to_camera.detach().cpu().double().contiguous().numpy().tobytes()
    return camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy, pose


def check_rows(camera: Camera, rows: Rows | None) -> Rows:
    """Validate a band of rows and return it as (start, stop); None stands for the whole view.

    Raises:
        ValueError: If the band is empty or extends beyond the view.
    """
    start, stop = (0, camera.height) if rows is None else rows
    if not 0 <= start < stop <= camera.height:
        raise ValueError(f"rows {start} to {stop}: a band of view {camera.name!r} lies within 0 to {camera.height}")
    return start, stop


def check_colors(colors: Tensor, gaussians: int, dtype: torch.dtype, device: torch.device) -> Tensor:
    """Validate `colors` [N, 3] and return them contiguous, in the given dtype and on the given device.

    Raises:
        ValueError: If there is not exactly one color per Gaussian.
    """
    if tuple(colors.shape) != (gaussians, 3):
        raise ValueError(f"colors of shape {tuple(colors.shape)}: the scene needs {(gaussians, 3)}")
    return colors.detach().to(device=device, dtype=dtype).contiguous()


def check_image_gradient(
    image_gradient: Tensor, camera: Camera, rows: Rows, dtype: torch.dtype, device: torch.device
) -> Tensor:
    """Validate `image_gradient` [h, width, 3] of a band and return it contiguous, in the given dtype and on the device.

    Raises:
        ValueError: If the shape does not match the band.
    """
    expected = (rows[1] - rows[0], camera.width, 3)
    if tuple(image_gradient.shape) != expected:
        raise ValueError(f"image gradient of shape {tuple(image_gradient.shape)}: the band needs {expected}")
    return image_gradient.detach().to(device=device, dtype=dtype).contiguous()
