"""Lens distortion of photos, and its removal.

Views are pinholes. A lens maps the direction of a pinhole's ray to a position in the photo, so an undistorted photo is
sampled from the original in one pass, and no inverse is needed. Coordinates are those of the image plane at distance 1.
The formulas are OpenCV's ("Camera Calibration and 3D Reconstruction" and "Fisheye camera model" of its documentation),
which COLMAP and nerfstudio share.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Literal

import torch
from torch import Tensor

from sgsst_core.errors import CameraError

if TYPE_CHECKING:
    from sgsst_core.scene.camera import Camera

#: Nodes per side of the grid on which a frame is checked for borders and folds.
_NODES = 65
#: Smallest fraction of a photo's width that an undistorted frame may keep.
_LEAST_FRAME = 0.1


@dataclass(frozen=True)
class Lens:
    """Lens that took the photos of a camera.

    Attributes:
        model: Name of the camera model in the camera file.
        kind: Formula: "radial" for the rational model, "fisheye" for the equidistant one; None if the model is not
            implemented, so photos cannot be undistorted.
        coefficients: Coefficients in OpenCV's order: k1, k2, p1, p2, k3, k4, k5, k6, or k1 to k4 for a fisheye.
        width, height: Size of the photos in pixels.
        fx, fy, cx, cy: Intrinsics of the photos in pixels.
    """

    model: str
    kind: Literal["radial", "fisheye"] | None
    coefficients: tuple[float, ...]
    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float

    @property
    def distorts(self) -> bool:
        """Whether photos differ from those of a pinhole."""
        return self.kind != "radial" or any(self.coefficients)

    def positions(self, x: Tensor, y: Tensor) -> tuple[Tensor, Tensor]:
        """Return where rays hit the photo, as fractions of its width and height.

        Args:
            x: First coordinates of points (x, y, 1) on the rays, any shape, float64.
            y: Second coordinates.
        """
        x, y = self._distorted(x, y)
        return (self.fx * x + self.cx) / self.width, (self.fy * y + self.cy) / self.height

    def _distorted(self, x: Tensor, y: Tensor) -> tuple[Tensor, Tensor]:
        if self.kind == "fisheye":
            k1, k2, k3, k4 = self.coefficients
            radius = torch.hypot(x, y)
            angle = torch.atan(radius)
            square = angle * angle
            bent = angle * (1 + square * (k1 + square * (k2 + square * (k3 + square * k4))))
            factor = torch.where(radius > 1e-12, bent / radius.clamp_min(1e-12), 1.0)
            return x * factor, y * factor
        assert self.kind == "radial"
        k1, k2, p1, p2, k3, k4, k5, k6 = self.coefficients
        square = x * x + y * y
        factor = (1 + square * (k1 + square * (k2 + square * k3))) / (1 + square * (k4 + square * (k5 + square * k6)))
        return (
            x * factor + 2 * p1 * x * y + p2 * (square + 2 * x * x),
            y * factor + p1 * (square + 2 * y * y) + 2 * p2 * x * y,
        )


def radial_lens(
    model: str, values: tuple[float, ...], size: tuple[int, int], pinhole: tuple[float, float, float, float]
) -> Lens:
    """Return a lens with up to 8 coefficients in OpenCV's order; missing ones are 0."""
    return Lens(model, "radial", (*values, *[0.0] * (8 - len(values))), *size, *pinhole)


def fisheye_lens(
    model: str, values: tuple[float, ...], size: tuple[int, int], pinhole: tuple[float, float, float, float]
) -> Lens:
    """Return a fisheye lens with up to 4 coefficients; missing ones are 0."""
    return Lens(model, "fisheye", (*values, *[0.0] * (4 - len(values))), *size, *pinhole)


def other_lens(model: str, size: tuple[int, int], pinhole: tuple[float, float, float, float]) -> Lens:
    """Return a lens of a model that is not implemented, so its photos cannot be undistorted."""
    return Lens(model, None, (), *size, *pinhole)


def undistorted(camera: Camera) -> Camera:
    """Return the pinhole camera that undistorted photos fill without black borders.

    Focal lengths do not change, so pixels keep their size in the photo's center, as in COLMAP's `image_undistorter`.
    The frame is cropped around the principal point with its aspect ratio. It is never enlarged.

    Raises:
        CameraError: If the lens model is not implemented, or less than a tenth of the frame remains.
    """
    lens = camera.lens
    if lens is None:
        return camera
    if lens.kind is None:
        raise CameraError(
            f"Camera {camera.name!r}: photos of the camera model {lens.model} cannot be undistorted here. Undistort "
            "them with `colmap image_undistorter` and give its cameras and images, or leave the photos out."
        )
    intrinsics = (camera.fx, camera.fy, camera.cx, camera.cy)
    scale = _largest_scale(lens, (camera.width, camera.height), intrinsics)
    if scale < _LEAST_FRAME:
        raise CameraError(
            f"Camera {camera.name!r}: its distortion ({lens.model} {', '.join(f'{k:g}' for k in lens.coefficients)}) "
            "leaves no image. Check the coefficients, or leave the photos out."
        )
    width, height = (max(1, int(side * scale)) for side in (camera.width, camera.height))
    x, y = width / camera.width, height / camera.height
    return replace(camera, width=width, height=height, cx=camera.cx * x, cy=camera.cy * y)


@functools.lru_cache(maxsize=1024)  # most cameras of a capture share their lens
def _largest_scale(lens: Lens, size: tuple[int, int], intrinsics: tuple[float, float, float, float]) -> float:
    """Return the largest factor, at most 1, by which a cropped frame lies inside the photo."""
    low, high = 0.0, 1.0
    if _fills(lens, size, intrinsics, high):
        return high
    while high - low > 1e-4:
        middle = (low + high) / 2
        low, high = (middle, high) if _fills(lens, size, intrinsics, middle) else (low, middle)
    return low


def _fills(lens: Lens, size: tuple[int, int], intrinsics: tuple[float, float, float, float], scale: float) -> bool:
    """Return whether a frame scaled by a factor lies inside the photo, and the distortion has no fold there."""
    fx, fy, cx, cy = intrinsics
    along = torch.linspace(0, 1, _NODES, dtype=torch.float64)
    x, y = scale * (along * size[0] - cx) / fx, scale * (along * size[1] - cy) / fy
    u, v = lens.positions(*torch.meshgrid(x, y, indexing="xy"))
    right, down = (u.diff(dim=1)[:-1], v.diff(dim=1)[:-1]), (u.diff(dim=0)[:, :-1], v.diff(dim=0)[:, :-1])
    upright = right[0] * down[1] - right[1] * down[0] > 0
    inside = (u >= -1e-9) & (u <= 1 + 1e-9) & (v >= -1e-9) & (v <= 1 + 1e-9)
    return bool(upright.all()) and bool(inside.all())


def undistort(photo: Tensor, camera: Camera) -> Tensor:
    """Return a photo as the pinhole camera would have taken it, by one bilinear sampling: [height, width, 3] float32.

    A photo with more pixels than the camera is reduced first, so that sampling does not alias.

    Args:
        photo: Original photo [H, W, 3] float32, of the lens's aspect ratio.
        camera: Camera with a lens.
    """
    lens = camera.lens
    assert lens is not None
    planes = photo.permute(2, 0, 1)[None]
    density = min(1.0, camera.fx / lens.fx * lens.width / photo.shape[1])
    if density < 1:
        size = [max(1, round(side * density)) for side in photo.shape[:2]]
        planes = torch.nn.functional.interpolate(planes, size, mode="bicubic", antialias=True, align_corners=False)
    x = (torch.arange(camera.width, dtype=torch.float64) + 0.5 - camera.cx) / camera.fx
    y = (torch.arange(camera.height, dtype=torch.float64) + 0.5 - camera.cy) / camera.fy
    u, v = lens.positions(*torch.meshgrid(x, y, indexing="xy"))
    grid = (2 * torch.stack([u, v], dim=2) - 1).float()[None]
    sampled = torch.nn.functional.grid_sample(planes, grid, "bilinear", "border", align_corners=False)
    return sampled[0].permute(1, 2, 0).clamp(0, 1).contiguous()
