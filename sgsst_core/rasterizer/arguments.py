"""What all rasterizers check about their arguments, and how they tell cameras apart."""

from __future__ import annotations

import torch
from torch import Tensor

from sgsst_core.scene.camera import Camera

Rows = tuple[int, int]

#: Equal keys mean equal pictures: everything about a camera that rendering depends on; its name is not part of it.
CameraKey = tuple[int, int, float, float, float, float, bytes]


def camera_key(camera: Camera) -> CameraKey:
    """A hashable key with the content of a camera."""
    pose = camera.world_to_camera.detach().cpu().double().contiguous().numpy().tobytes()
    return camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy, pose


def check_rows(camera: Camera, rows: Rows | None) -> Rows:
    """The band as (start, stop); None is the whole view.

    Raises:
        ValueError: the band is empty or reaches beyond the view.
    """
    start, stop = (0, camera.height) if rows is None else rows
    if not 0 <= start < stop <= camera.height:
        raise ValueError(f"rows {start} to {stop}: a band of view {camera.name!r} lies within 0 to {camera.height}")
    return start, stop


def check_colors(colors: Tensor, gaussians: int, dtype: torch.dtype, device: torch.device) -> Tensor:
    """`colors` [N, 3], contiguous, in the dtype and on the device of the rasterizer.

    Raises:
        ValueError: not one color for each Gaussian of the scene.
    """
    if tuple(colors.shape) != (gaussians, 3):
        raise ValueError(f"colors of shape {tuple(colors.shape)}: the scene needs {(gaussians, 3)}")
    return colors.detach().to(device=device, dtype=dtype).contiguous()


def check_image_gradient(
    image_gradient: Tensor, camera: Camera, rows: Rows, dtype: torch.dtype, device: torch.device
) -> Tensor:
    """`image_gradient` [h, width, 3] of a band, contiguous, in the dtype and on the device of the rasterizer.

    Raises:
        ValueError: not the shape of the band.
    """
    expected = (rows[1] - rows[0], camera.width, 3)
    if tuple(image_gradient.shape) != expected:
        raise ValueError(f"image gradient of shape {tuple(image_gradient.shape)}: the band needs {expected}")
    return image_gradient.detach().to(device=device, dtype=dtype).contiguous()
