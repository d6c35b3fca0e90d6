"""Smooth camera path through given cameras, for videos."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from statistics import mode

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation, Slerp
from torch import Tensor

from sgsst_core.errors import CameraError
from sgsst_core.scene.camera import Camera, resized

#: Rotation between two cameras beyond which they are not neighbors: about the field of view of a photo. A view halfway
#: between such cameras may show nothing that either of them sees.
LARGEST_ROTATION = math.radians(60)
#: Tolerance for the rounding of rotations in camera files.
_COSINE_ROUNDING = 1e-6
#: The order of the file is replaced by a walk to nearest cameras if that is shorter than this fraction of it.
_SHORTER = 0.5
#: Rotation, and change of the focal length's logarithm, that take as long as the median distance of two cameras.
_UNIT_ROTATION, _UNIT_ZOOM = math.radians(30), math.log(1.5)
#: Distances between cameras at or below this fraction of their mean are jitter of a camera that stands.
_JITTER = 0.1
#: Rounding of positions, relative to the largest coordinate.
_POSITION_ROUNDING = 1e-9
#: Smaller changes between two cameras, in these units, are rounding: the cameras coincide.
_NO_CHANGE = 1e-9


class CameraPath:
    """Smooth path through cameras in a given order.

    Positions follow a centripetal Catmull-Rom spline, whose segments have neither cusps nor loops. Rotations are
    interpolated by slerp, and logarithms of focal lengths linearly. Between two cameras, the path parameter grows by
    the square root of the distance, or of the rotation or zoom where the camera hardly moves. Consecutive cameras that
    coincide count as one.

    All cameras of the path have the most frequent size of the given ones. Cameras of another size keep their focal
    length relative to the square root of their area, and the relative position of their principal point.

    Args:
        cameras: Cameras in the order of the path, at least one.

    Attributes:
        cameras: Cameras that the path passes through, without repetitions.
        knots: [n] float64, path parameter of each of them, ascending from 0.

    Raises:
        CameraError: If there are no cameras.

    Example:
        >>> path = CameraPath(load_cameras("cameras.json"))
        >>> len(path.at(path.knots)) == len(path.cameras)
        True
    """

    def __init__(self, cameras: Sequence[Camera]) -> None:
        if not cameras:
            raise CameraError("A camera path needs at least one camera. Give some.")
        self._width, self._height = mode((camera.width, camera.height) for camera in cameras)
        changes = _changes(cameras)
        distinct = [0, *(index + 1 for index, change in enumerate(changes) if change > _NO_CHANGE)]
        self.cameras = [cameras[index] for index in distinct]
        self.knots: NDArray[np.float64] = np.concatenate(
            [[0.0], np.cumsum(np.sqrt([changes[index - 1] for index in distinct[1:]]))]
        )
        self._intrinsics = np.stack([_relative_intrinsics(camera) for camera in self.cameras])
        if len(distinct) > 1:
            from scipy.interpolate import CubicHermiteSpline  # takes a quarter of a second to import

            centers = _centers(self.cameras)
            self._positions = CubicHermiteSpline(self.knots, centers, catmull_rom_tangents(self.knots, centers))
            self._rotations = Slerp(self.knots, Rotation.from_matrix(_rotations(self.cameras)))

    def evenly(self, count: int) -> list[Camera]:
        """Return `count` cameras from the first to the last, at even steps of the path parameter."""
        return self.at(np.linspace(0.0, self.knots[-1], count))

    def at(self, times: NDArray[np.float64]) -> list[Camera]:
        """Return the cameras at path parameters [m] between 0 and the last knot."""
        if len(self.cameras) == 1:
            positions, rotations = _centers(self.cameras), _rotations(self.cameras)
            positions, rotations = (np.repeat(values, len(times), 0) for values in (positions, rotations))
        else:
            positions, rotations = self._positions(times), self._rotations(times).as_matrix()
        intrinsics = np.stack([np.interp(times, self.knots, column) for column in self._intrinsics.T], axis=1)
        cameras = []
        for index, (position, rotation, relative) in enumerate(zip(positions, rotations, intrinsics, strict=True)):
            pose = torch.eye(4, dtype=torch.float64)
            pose[:3, :3] = torch.from_numpy(rotation)
            pose[:3, 3] = torch.from_numpy(-rotation @ position)
            fx, fy = (math.sqrt(self._width * self._height) * np.exp(relative[:2])).tolist()
            cx, cy = self._width * float(relative[2]), self._height * float(relative[3])
            cameras.append(Camera(f"frame_{index:05d}", self._width, self._height, fx, fy, cx, cy, pose))
        return cameras


def catmull_rom_tangents(knots: NDArray[np.float64], points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the derivatives [n, d] of a Catmull-Rom spline at its knots [n], given its points [n, d], n > 1.

    They are those of the parabolas through three consecutive points (Barry and Goldman 1988). The first and last
    tangents are the slopes of the end segments, so that a path through two points is straight.
    """
    steps = np.diff(knots)[:, None]
    slopes = np.diff(points, axis=0) / steps
    inner = (slopes[:-1] * steps[1:] + slopes[1:] * steps[:-1]) / (steps[:-1] + steps[1:])
    return np.concatenate([slopes[:1], inner, slopes[-1:]])


def in_path_order(cameras: Sequence[Camera]) -> list[Camera]:
    """Return cameras in the order of a path: that of the sequence, unless it jumps back and forth.

    It jumps if a greedy walk to the nearest remaining camera is less than half as long.
    """
    if len(cameras) < 3:
        return list(cameras)
    centers = torch.from_numpy(_centers(cameras))
    rotations = torch.from_numpy(_rotations(cameras))
    walk = nearest_walk(centers, rotations)

    def length(order: Sequence[int]) -> float:
        return float((centers[order[1:]] - centers[order[:-1]]).norm(dim=1).sum())

    shorter = length(walk) < _SHORTER * length(range(len(cameras)))
    return [cameras[index] for index in walk] if shorter else list(cameras)


def nearest_walk(centers: Tensor, rotations: Tensor) -> list[int]:
    """Return the indices of cameras along a greedy walk from the first one to the nearest remaining camera.

    Cameras with a similar rotation take precedence.

    Args:
        centers: Camera centers [n, 3].
        rotations: Camera rotations [n, 3, 3].
    """
    left = torch.ones(len(centers), dtype=torch.bool)
    left[0] = False
    order = [0]
    while bool(left.any()):
        here = order[-1]
        similar = left & similarly_rotated(rotations, rotations[here])
        candidates = (similar if bool(similar.any()) else left).nonzero()[:, 0]
        order.append(int(candidates[(centers[candidates] - centers[here]).norm(dim=1).argmin()]))
        left[order[-1]] = False
    return order


def similarly_rotated(rotations: Tensor, rotation: Tensor) -> Tensor:
    """Return whether rotations [..., 3, 3] differ from a given one by at most `LARGEST_ROTATION`, as [...] bool."""
    cosine = ((rotations * rotation).sum(dim=(-2, -1)) - 1) / 2  # trace(A B^T) = 1 + 2 cos(angle)
    return cosine >= math.cos(LARGEST_ROTATION) - _COSINE_ROUNDING


def moved(distances: NDArray[np.float64], centers: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Return for which distances [n] between some of the camera centers [m, 3] a camera has moved, as [n] bool.

    Rounding of the coordinates and jitter of cameras at one station do not count.
    """
    jitter = _JITTER * distances.sum() / max(len(distances), 1)
    mask: NDArray[np.bool_] = distances > max(jitter, _POSITION_ROUNDING * np.abs(centers).max())
    return mask


def framed(camera: Camera, side: int | None, *, even: bool) -> Camera:
    """Return a camera of a video at another size, cropped by at most one pixel per axis to even sides.

    Args:
        side: Length of the longer side in pixels; None keeps the camera's.
        even: Whether width and height must be even, as for video with chroma subsampling. Sides of one pixel stay.
    """
    camera = replace(camera, resolution=None)
    if side is not None:
        camera = resized(camera, side)
    if even:
        width, height = (length - length % 2 or 1 for length in (camera.width, camera.height))
        camera = replace(camera, width=width, height=height)
    return camera


def _changes(cameras: Sequence[Camera]) -> NDArray[np.float64]:
    """Return the change [n - 1] between consecutive cameras, where 1 is the median distance of those that moved.

    If none moved, it is that of the rotation and zoom.
    """
    centers = _centers(cameras)
    distances = np.linalg.norm(np.diff(centers, axis=0), axis=1)
    moves = distances[moved(distances, centers)]
    rotations = Rotation.from_matrix(_rotations(cameras))
    angles = (rotations[:-1].inv() * rotations[1:]).magnitude() if len(cameras) > 1 else np.zeros(0)
    zooms = np.abs(np.diff([_relative_intrinsics(camera)[:2] for camera in cameras], axis=0)).max(axis=1, initial=0.0)
    relative = distances / np.median(moves) if len(moves) else np.zeros_like(distances)
    changes: NDArray[np.float64] = np.max([relative, angles / _UNIT_ROTATION, zooms / _UNIT_ZOOM], axis=0)
    return changes


def _centers(cameras: Sequence[Camera]) -> NDArray[np.float64]:
    centers: NDArray[np.float64] = np.stack([camera.center.double().numpy() for camera in cameras])
    return centers


def _rotations(cameras: Sequence[Camera]) -> NDArray[np.float64]:
    rotations: NDArray[np.float64] = np.stack([camera.world_to_camera[:3, :3].double().numpy() for camera in cameras])
    return rotations


def _relative_intrinsics(camera: Camera) -> NDArray[np.float64]:
    """Return the logarithms of fx and fy relative to the square root of the area, and the relative principal point."""
    unit = math.sqrt(camera.width * camera.height)
    focal = math.log(camera.fx / unit), math.log(camera.fy / unit)
    return np.array([*focal, camera.cx / camera.width, camera.cy / camera.height])
