"""Pinhole cameras: the type, and making new ones from old ones."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
import torch
from scipy.spatial.transform import Rotation, Slerp
from torch import Tensor

from sgsst_core.errors import CameraError, SettingsError

if TYPE_CHECKING:
    from sgsst_core.settings import Settings


@dataclass(frozen=True)
class Camera:
    """A pinhole camera; pixel centers lie at +0.5, x points right, y down, z forward.

    Attributes:
        name: what the camera is called in its file (image name where there is one).
        width, height: pixels.
        fx, fy, cx, cy: pixels.
        world_to_camera: [4, 4] float64 rigid transform.
        resolution: of a camera whose shape was chosen for what it shows, the longer side of the 4:3 view with as many
            pixels; None for the camera's own longer side.
    """

    name: str
    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    world_to_camera: Tensor  # [4, 4] float64
    resolution: int | None = None

    @property
    def side(self) -> int:
        """What a resolution is compared with: `resolution`, or the longer side."""
        return self.resolution or max(self.width, self.height)

    @property
    def center(self) -> Tensor:
        """[3] float64: the camera's position in the world."""
        rotation = self.world_to_camera[:3, :3]
        return -rotation.T @ self.world_to_camera[:3, 3]


def resized(camera: Camera, side: int) -> Camera:
    """The same camera with another number of pixels; the field of view stays exactly the same.

    Sizes are integers, so that the aspect changes by up to half a pixel; each axis' intrinsics scale with its own
    ratio, which stretches the pixels by as much and leaves the picture's content where it was.

    Args:
        camera: any camera.
        side: pixels of the longer side, or the new `Camera.resolution` of a camera that has one; at least 1. Larger
            than the camera's own is allowed.

    Raises:
        SettingsError: side below 1.
    """
    if side < 1:
        raise SettingsError(f"The resolution is {side} pixels; give at least 1 for the longer side.")
    scale = side / camera.side
    width, height = (max(1, round(side * scale)) for side in (camera.width, camera.height))
    x, y = width / camera.width, height / camera.height
    return replace(
        camera,
        width=width,
        height=height,
        fx=camera.fx * x,
        fy=camera.fy * y,
        cx=camera.cx * x,
        cy=camera.cy * y,
        resolution=side if camera.resolution else None,
    )


def fit_cameras(cameras: Sequence[Camera], settings: Settings) -> list[Camera]:
    """The cameras, those with more pixels than `settings.max_resolution` on their longer side brought down to it."""
    limit = settings.max_resolution
    return [resized(camera, limit) if limit and camera.side > limit else camera for camera in cameras]


def spread(cameras: Sequence[Camera], count: int) -> list[Camera]:
    """`count` of the cameras, evenly spread over the list, in its order; all where there are no more than that.

    Each is the middle of one of `count` equal parts, so that neither a path's ends nor the seam of a ring are favored.

    Raises:
        SettingsError: count below 1.
    """
    if count < 1:
        raise SettingsError(f"The number of views is {count}; give at least 1.")
    total = len(cameras)
    if count >= total:
        return list(cameras)
    return [cameras[(2 * part + 1) * total // (2 * count)] for part in range(count)]


def between(first: Camera, second: Camera) -> Camera:
    """The camera halfway between two: its center is their midpoint, its rotation the spherical mean of theirs.

    Size and intrinsics are the first's. The mean turns by half of the shortest rotation from one to the other (slerp,
    Shoemake 1985); of the two shortest ones at 180 degrees, either.
    """
    ends = np.stack([camera.world_to_camera[:3, :3].double().numpy() for camera in (first, second)])
    rotation = torch.from_numpy(Slerp([0, 1], Rotation.from_matrix(ends))(0.5).as_matrix())
    world_to_camera = torch.eye(4, dtype=torch.float64)
    world_to_camera[:3, :3] = rotation
    world_to_camera[:3, 3] = -rotation @ ((first.center + second.center) / 2)
    return replace(first, name=f"{first.name}–{second.name}", world_to_camera=world_to_camera)


def look_at(
    name: str,
    position: Tensor,
    target: Tensor,
    up: Tensor,
    *,
    width: int,
    height: int,
    focal: float,
    resolution: int | None = None,
) -> Camera:
    """A camera at `position` [3] that looks at `target` [3], `up` [3] toward its upper edge.

    Args:
        name: the camera's name.
        position, target, up: [3]; `up` need not be a unit vector, and must not point along the view.
        width, height: pixels.
        focal: pixels, both axes; the principal point is the middle.
        resolution: see `Camera`.

    Raises:
        CameraError: position and target coincide, or `up` points along the view.
    """
    up = up.to(torch.float64)
    forward = target.to(torch.float64) - position.to(torch.float64)
    right = torch.linalg.cross(forward, up)
    if not bool(right.norm() > 1e-9 * forward.norm() * up.norm()):
        raise CameraError(f"Camera {name!r} looks along its own up direction {up.tolist()}. Give another one.")
    down = torch.linalg.cross(forward, right)
    rotation = torch.stack([axis / axis.norm() for axis in (right, down, forward)])
    world_to_camera = torch.eye(4, dtype=torch.float64)
    world_to_camera[:3, :3] = rotation
    world_to_camera[:3, 3] = -rotation @ position.to(torch.float64)
    return Camera(name, width, height, focal, focal, width / 2, height / 2, world_to_camera, resolution)
