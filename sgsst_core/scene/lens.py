"""Lens distortion of photos, and its removal.

Views are pinholes. A lens maps the direction of a pinhole's ray to a position in the photo, so an undistorted photo is
sampled from the original in one pass, and no inverse is needed. Coordinates are those of the image plane at distance 1.
The formulas are OpenCV's ("Camera Calibration and 3D Reconstruction" and "Fisheye camera model" of its documentation),
which COLMAP and nerfstudio share.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor

#: Nodes per side of the grid on which a frame is checked for borders and folds.
_NODES = 65
#: Formulas of camera models of COLMAP and nerfstudio; photos of other models cannot be undistorted here.
FORMULAS: dict[str, Literal["radial", "fisheye"]] = {
    **dict.fromkeys(("", "PINHOLE", "SIMPLE_PINHOLE", "PERSPECTIVE", "SIMPLE_RADIAL", "RADIAL"), "radial"),
    **dict.fromkeys(("OPENCV", "FULL_OPENCV"), "radial"),
    **dict.fromkeys(("SIMPLE_FISHEYE", "FISHEYE", "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE"), "fisheye"),
    "OPENCV_FISHEYE": "fisheye",
}
#: Coefficients by formula, in OpenCV's order.
COEFFICIENTS: dict[str | None, tuple[str, ...]] = {
    "radial": ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"),
    "fisheye": ("k1", "k2", "k3", "k4"),
    None: (),
}


@dataclass(frozen=True)
class Lens:
    """Lens that took the photos of a camera.

    Attributes:
        model: Name of the camera model in the camera file.
        kind: Formula: "radial" for the rational model, "fisheye" for the equidistant one; None if the model is not
            implemented, so photos cannot be undistorted.
        coefficients: Values of `COEFFICIENTS`.
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

    @staticmethod
    def of(
        model: str, values: Sequence[float], size: tuple[int, int], pinhole: tuple[float, float, float, float]
    ) -> Lens:
        """Return the lens of a camera model, with its first coefficients; others are 0."""
        kind = FORMULAS.get(model)
        count = len(COEFFICIENTS[kind])
        coefficients = (*values, *[0.0] * count)[:count]
        return Lens(model[:40] or "OPENCV", kind, coefficients, *size, *pinhole)

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
        if self.kind == "fisheye":
            k1, k2, k3, k4 = self.coefficients
            radius = torch.hypot(x, y)
            angle = torch.atan(radius)
            square = angle * angle
            bent = angle * (1 + square * (k1 + square * (k2 + square * (k3 + square * k4))))
            factor = torch.where(radius > 1e-12, bent / radius.clamp_min(1e-12), 1.0)
            u, v = x * factor, y * factor
        else:
            assert self.kind == "radial"
            k1, k2, p1, p2, k3, k4, k5, k6 = self.coefficients
            square = x * x + y * y
            above, below = square * (k1 + square * (k2 + square * k3)), square * (k4 + square * (k5 + square * k6))
            factor = (1 + above) / (1 + below)
            u = x * factor + 2 * p1 * x * y + p2 * (square + 2 * x * x)
            v = y * factor + p1 * (square + 2 * y * y) + 2 * p2 * x * y
        return (self.fx * u + self.cx) / self.width, (self.fy * v + self.cy) / self.height


@functools.lru_cache(maxsize=1024)  # most cameras of a capture share their lens
def largest_scale(lens: Lens, size: tuple[int, int], intrinsics: tuple[float, float, float, float]) -> float:
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
