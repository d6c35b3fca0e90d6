"""Pinhole cameras."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor


@dataclass(frozen=True)
class Camera:
    """A pinhole camera; pixel centres lie at +0.5, x points right, y down, z forward.

    Attributes:
        name: what the camera is called in its file (image name where there is one).
        width, height: pixels.
        fx, fy, cx, cy: pixels.
        world_to_camera: [4, 4] float64 rigid transform.
    """

    name: str
    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    world_to_camera: Tensor  # [4, 4] float64

    @property
    def centre(self) -> Tensor:
        """[3] float64: the camera's position in the world."""
        rotation = self.world_to_camera[:3, :3]
        return -rotation.T @ self.world_to_camera[:3, 3]
