"""Pinhole cameras: the type, and making new ones from old ones or from nothing but the scene."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
import torch
from scipy.spatial.transform import Rotation, Slerp
from torch import Tensor

from sgsst_core.errors import CameraError, SettingsError
from sgsst_core.scene.gaussians import Scene

if TYPE_CHECKING:
    from sgsst_core.settings import Settings

#: Focal length of an orbit's cameras in widths: a field of view of 49 degrees, about that of a phone's main camera.
ORBIT_FOCAL = 1.1
#: Points that place an orbit. A few ten thousand give its distance to well under a percent.
_ORBIT_SAMPLE = 20_000
#: Directions from which the framing is tried at most: one each 10 degrees, so that long orbits cost no more.
_ORBIT_TRIALS = 36
#: Share of the scene's weight that an orbit's framing looks at: the rest are floaters.
_ORBIT_QUANTILE = 0.99
#: A point farther from the centre than this many weighted median distances is background. An object's own points lie
#: within 3 (a long thin stick reaches 2); a room or a sky behind an object reaches 10 to 1000.
_ORBIT_REACH = 4.0
#: Room left around the framed points, because Gaussians have an extent and pictures a margin.
_ORBIT_MARGIN = 1.1


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


def resized(camera: Camera, longer_side: int) -> Camera:
    """The same camera with another number of pixels; the field of view stays exactly the same.

    Sizes are integers, so that the aspect changes by up to half a pixel; each axis' intrinsics scale with its own
    ratio, which stretches the pixels by as much and leaves the picture's content where it was.

    Args:
        camera: any camera.
        longer_side: pixels, at least 1; larger than the camera's own is allowed.

    Raises:
        SettingsError: longer_side below 1.
    """
    if longer_side < 1:
        raise SettingsError(f"The resolution is {longer_side} pixels; give at least 1 for the longer side.")
    scale = longer_side / max(camera.width, camera.height)
    width, height = (max(1, round(side * scale)) for side in (camera.width, camera.height))
    x, y = width / camera.width, height / camera.height
    return replace(
        camera, width=width, height=height, fx=camera.fx * x, fy=camera.fy * y, cx=camera.cx * x, cy=camera.cy * y
    )


def fit_cameras(cameras: Sequence[Camera], settings: Settings) -> list[Camera]:
    """The cameras, those with more pixels than `settings.max_resolution` on their longer side brought down to it."""
    limit = settings.max_resolution
    return [
        resized(camera, limit) if limit and max(camera.width, camera.height) > limit else camera for camera in cameras
    ]


def spread(cameras: Sequence[Camera], count: int) -> list[Camera]:
    """`count` of the cameras, evenly spread over the list, in its order; all where there are no more than that.

    Each is the middle of one of `count` equal parts, so that neither a path's ends nor the seam of a ring are favoured.

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
    """The camera halfway between two: its centre is their midpoint, its rotation the spherical mean of theirs.

    Size and intrinsics are the first's. The mean turns by half of the shortest rotation from one to the other (slerp,
    Shoemake 1985); of the two shortest ones at 180 degrees, either.
    """
    ends = np.stack([camera.world_to_camera[:3, :3].double().numpy() for camera in (first, second)])
    rotation = torch.from_numpy(Slerp([0, 1], Rotation.from_matrix(ends))(0.5).as_matrix())
    world_to_camera = torch.eye(4, dtype=torch.float64)
    world_to_camera[:3, :3] = rotation
    world_to_camera[:3, 3] = -rotation @ ((first.centre + second.centre) / 2)
    return replace(first, name=f"{first.name}–{second.name}", world_to_camera=world_to_camera)


def look_at(
    name: str, position: Tensor, target: Tensor, up: Tensor, *, width: int, height: int, focal: float
) -> Camera:
    """A camera at `position` [3] that looks at `target` [3], `up` [3] towards its upper edge.

    Args:
        name: the camera's name.
        position, target, up: [3]; `up` need not be a unit vector, and must not point along the view.
        width, height: pixels.
        focal: pixels, both axes; the principal point is the middle.

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
    return Camera(name, width, height, focal, focal, width / 2, height / 2, world_to_camera)


def orbit(
    scene: Scene,
    count: int,
    *,
    width: int = 1024,
    height: int = 768,
    up: Sequence[float] = (0.0, -1.0, 0.0),
    elevation: float = 10.0,
    near: float = 0.2,
) -> list[Camera]:
    """A ring of cameras around the scene's robust centre, all of the same distance, with the object in full view.

    The centre and the distance weigh every Gaussian with its opacity and leave floaters and background out: see
    the constants above. The distance is the smallest at which every camera of the ring sees what is left, and a margin.

    Args:
        scene: what to look at.
        count: number of cameras, evenly spaced.
        width, height: pixels.
        up: world direction of up; captures processed by COLMAP have y pointing down, so that -y is up.
        elevation: degrees above the scene's horizon, below 90.
        near: near plane of the rasterizer, world units: the cameras stay that far from the object.

    Raises:
        SettingsError: count or size below 1, `up` without direction, elevation out of range.
    """
    axis = torch.tensor(up, dtype=torch.float64)
    if count < 1 or width < 1 or height < 1:
        raise SettingsError(
            f"An orbit of {count} views of {width} x {height} pixels is empty; give at least 1 of each."
        )
    if not (bool(torch.isfinite(axis).all()) and axis.norm() > 0 and abs(elevation) < 90):
        raise SettingsError(f"An orbit with up = {list(up)} and elevation = {elevation} degrees has no direction.")
    axis = axis / axis.norm()
    centre, offsets = _robust_points(scene)
    tilt = math.radians(elevation)
    focal = ORBIT_FOCAL * width
    origin = torch.zeros(3, dtype=torch.float64)
    distance = 0.0
    for direction in _ring(min(count, _ORBIT_TRIALS), axis, tilt):
        turned = look_at("", direction, origin, axis, width=width, height=height, focal=focal).world_to_camera[:3, :3]
        x, y, z = (offsets @ turned.T).unbind(1)
        # in view: |x| focal <= (distance + z) width / 2, and the same for y; in front: distance + z >= near
        needed = torch.stack([x.abs() * 2 * focal / width, y.abs() * 2 * focal / height, torch.full_like(z, near)])
        distance = max(distance, float((_ORBIT_MARGIN * needed.amax(0) - z).max()))
    return [
        look_at(f"orbit_{i:04d}", centre + distance * d, centre, axis, width=width, height=height, focal=focal)
        for i, d in enumerate(_ring(count, axis, tilt))
    ]


def _ring(count: int, axis: Tensor, elevation: float) -> list[Tensor]:
    """Unit vectors [3] from the centre to the cameras."""
    start = torch.zeros(3, dtype=torch.float64)
    start[2 if abs(float(axis[2])) < 0.9 else 0] = 1.0  # any direction that is not (nearly) up
    start = start - (start @ axis) * axis
    start = start / start.norm()
    side = torch.linalg.cross(axis, start)
    angles = [2 * math.pi * i / count for i in range(count)]
    return [
        math.cos(elevation) * (math.cos(a) * start + math.sin(a) * side) + math.sin(elevation) * axis for a in angles
    ]


def _robust_points(scene: Scene) -> tuple[Tensor, Tensor]:
    """The scene's robust centre [3] and its points [P, 3] relative to it, floaters and background left out; float64."""
    step = max(1, len(scene) // _ORBIT_SAMPLE)
    points = scene.means[::step].to(torch.float64)
    weights = torch.sigmoid(scene.opacities[::step].to(torch.float64))
    # a scene of which all Gaussians are invisible (weights 0) is still looked at
    weights = weights + 1e-12
    median = torch.stack([_quantile(points[:, i], weights, 0.5) for i in range(3)])
    distances = (points - median).norm(dim=1)
    reach = min(
        float(_quantile(distances, weights, _ORBIT_QUANTILE)),
        _ORBIT_REACH * float(_quantile(distances, weights, 0.5)),
    )
    near_points = points[distances <= reach]
    # framing: the middle of the box, because the median of a standing figure is not its middle
    centre = (near_points.amin(0) + near_points.amax(0)) / 2
    return centre, near_points - centre


def _quantile(values: Tensor, weights: Tensor, share: float) -> Tensor:
    """The smallest of `values` [P] at which the running sum of `weights` [P] reaches `share` of the whole."""
    ordered, order = values.sort()
    running = weights[order].cumsum(0)
    index = torch.searchsorted(running, share * running[-1])
    return ordered[index.clamp(max=len(values) - 1)]
