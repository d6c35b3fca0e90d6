"""Pinhole cameras, cameras derived from others, lens distortion of photos, camera paths, and 360-degree panoramas.

Views are pinholes. A lens maps the direction of a pinhole's ray to a position in the photo, so an undistorted photo is
sampled from the original in one pass, and no inverse is needed. Coordinates are those of the image plane at distance 1.
The formulas are OpenCV's ("Camera Calibration and 3D Reconstruction" and "Fisheye camera model" of its documentation),
which COLMAP and nerfstudio share.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from statistics import mode
from typing import TYPE_CHECKING, Literal, TypeVar

import numpy as np
import scipy  # imports its modules at first use
import torch
from numpy.typing import ArrayLike, NDArray
from torch import Tensor

from sgsst_core.constants import FRUSTUM_MARGIN
from sgsst_core.errors import CameraError, SettingsError
from sgsst_core.scene.gaussians import exact_rotation

if TYPE_CHECKING:
    from sgsst_core.settings import Settings

V = TypeVar("V")

#: Smallest fraction of a photo's width that an undistorted frame may keep.
_MIN_FRAME = 0.1


@dataclass(frozen=True)
class Camera:
    """Pinhole camera. Pixel centers are at +0.5; x points right, y down, z forward.

    Attributes:
        name: Name in the camera file (the image name if there is one).
        width, height: Size in pixels.
        fx, fy, cx, cy: Intrinsics in pixels.
        world_to_camera: [4, 4] float64 rigid transform.
        resolution: Longer side in pixels of the 4:3 view with the same number of pixels, for cameras whose aspect ratio
            was fitted to the content. None if resolutions refer to the camera's own longer side.
        lens: Lens that took the camera's photos; None if they are those of a pinhole. Renders never have distortion.
            Cube faces have that of their panorama.
        whole: Camera of the whole view, if this is the camera of a rectangle of it (`cropped`); None otherwise.

    Example:
        >>> camera = Camera("front", 640, 480, 500.0, 500.0, 320.0, 240.0, torch.eye(4, dtype=torch.float64))
        >>> camera.side, camera.center.tolist()
        (640, [0.0, 0.0, 0.0])
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
    lens: Lens | None = None
    whole: Camera | None = None

    @staticmethod
    def from_matrix(
        viewmat: Tensor | ArrayLike, K: Tensor | ArrayLike, width: int, height: int, name: str = "camera"
    ) -> Camera:
        """Return the camera of a view matrix and an intrinsic matrix, as gsplat's `rasterization` takes them.

        Args:
            viewmat: [4, 4] or [3, 4], world-to-camera transform; its 3x3 matrix must be a rotation within 1e-3.
            K: [3, 3], rows (fx, 0, cx), (0, fy, cy), (0, 0, 1), in pixels.

        Raises:
            CameraError: If a shape or value is wrong.

        Example:
            >>> K = [[500.0, 0.0, 320.0], [0.0, 500.0, 240.0], [0.0, 0.0, 1.0]]
            >>> Camera.from_matrix(torch.eye(4), K, 640, 480).fx
            500.0
        """
        pose = np.eye(4)
        given = _matrix(name, "viewmat", viewmat, (4, 4), (3, 4))
        pose[: len(given)] = given
        if not np.array_equal(pose[3], (0, 0, 0, 1)):
            raise CameraError(
                f"{name}: the last row of `viewmat` is {pose[3].tolist()}, not [0, 0, 0, 1]. Give the world-to-camera "
                "matrix of column vectors; transpose one of row vectors."
            )
        intrinsics = _matrix(name, "K", K, (3, 3))
        (fx, skew, cx), (below, fy, cy) = intrinsics[:2].tolist()
        if skew or below or not np.array_equal(intrinsics[2], (0, 0, 1)) or not (fx > 0 and fy > 0):
            raise CameraError(
                f"{name}: `K` is {intrinsics.tolist()}. Give [[fx, 0, cx], [0, fy, cy], [0, 0, 1]] in pixels, with "
                "fx and fy above 0; undistort images of cameras with skew."
            )
        for side, value in (("width", width), ("height", height)):
            if not (math.isfinite(value) and value > 0 and value == int(value)):
                raise CameraError(f"{name}: `{side}` must be a positive number of whole pixels, not {value}.")
        rigid = torch.from_numpy(exact_rotation(name, pose))
        return Camera(name, int(width), int(height), fx, fy, cx, cy, rigid)

    @property
    def side(self) -> int:
        """Length in pixels that resolution limits apply to: `resolution`, or the longer side if that is None."""
        return self.resolution or max(self.width, self.height)

    @property
    def center(self) -> Tensor:
        """Camera position in the world, [3] float64."""
        rotation = self.world_to_camera[:3, :3]
        return -rotation.T @ self.world_to_camera[:3, 3]

    @property
    def panorama(self) -> str | None:
        """Name of the panorama of which this is a cube face; None for any other camera."""
        return self.name.rpartition(".")[0] if self.lens and self.lens.kind == "equirectangular" else None

    @property
    def slope_limits(self) -> tuple[float, float, float, float]:
        """Limits (left, right, top, bottom) to which projections clamp slopes: the whole view plus a margin."""
        view = self.whole or self
        margin_x = FRUSTUM_MARGIN * 0.5 * view.width / view.fx
        margin_y = FRUSTUM_MARGIN * 0.5 * view.height / view.fy
        return (
            -view.cx / view.fx - margin_x,
            (view.width - view.cx) / view.fx + margin_x,
            -view.cy / view.fy - margin_y,
            (view.height - view.cy) / view.fy + margin_y,
        )

    def cropped(self, top: int, left: int, bottom: int, right: int) -> Camera:
        """Return the camera of a rectangle of the view; its image is that part of the view's image.

        Raises:
            ValueError: If the rectangle is empty or extends beyond the view.
        """
        if not (0 <= top < bottom <= self.height and 0 <= left < right <= self.width):
            raise ValueError(
                f"rows {top} to {bottom}, columns {left} to {right}: not a rectangle of view {self.name!r} "
                f"({self.width}x{self.height})"
            )
        if (top, left, bottom, right) == (0, 0, self.height, self.width):
            return self
        return replace(
            self, width=right - left, height=bottom - top, cx=self.cx - left, cy=self.cy - top, whole=self.whole or self
        )


def _matrix(name: str, argument: str, values: Tensor | ArrayLike, *shapes: tuple[int, ...]) -> NDArray[np.float64]:
    """Return an argument as a finite float64 matrix of one of the shapes."""
    wanted = " or ".join(str(list(shape)) for shape in shapes)
    try:
        matrix = np.asarray(values.detach().cpu() if isinstance(values, Tensor) else values, dtype=np.float64)
        if matrix.shape in shapes and np.isfinite(matrix).all():
            return matrix
        problem = f"has shape {list(matrix.shape)}, or NaN or infinite values"
    except (TypeError, ValueError) as error:
        problem = f"is not a matrix of numbers ({error})"
    raise CameraError(f"{name}: `{argument}` {problem}. Give finite numbers {wanted}, for one camera at a time.")


def checked_cameras(cameras: Sequence[Camera]) -> list[Camera]:
    """Check cameras that a caller of the library passes, and move their transforms to float64 on the CPU.

    Raises:
        CameraError: If there is anything but cameras, or a transform is not a [4, 4] tensor.
    """
    if not isinstance(cameras, Sequence) or not all(isinstance(camera, Camera) for camera in cameras):
        raise CameraError(
            f"The cameras are a {type(cameras).__name__}, not a list of `Camera`. Read them with `load_cameras`, or "
            "make each with `Camera.from_matrix`."
        )
    for camera in cameras:
        if not isinstance(camera.world_to_camera, Tensor) or camera.world_to_camera.shape != (4, 4):
            raise CameraError(f"{camera.name}: its transform is not a [4, 4] tensor. Use `Camera.from_matrix`.")
    return [replace(camera, world_to_camera=camera.world_to_camera.to("cpu", torch.float64)) for camera in cameras]


def resized(camera: Camera, side: int) -> Camera:
    """Return the camera with another number of pixels and exactly the same field of view.

    Width and height are rounded to integers, so the aspect ratio may change slightly. Each axis's intrinsics are scaled
    by that axis's own ratio, so the image content stays in place.

    Args:
        side: Longer side in pixels, or the new `Camera.resolution` if the camera has one; at least 1. It may be larger
            than the camera's own.

    Raises:
        SettingsError: If the side is below 1.
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


def undistorted(camera: Camera) -> Camera:
    """Return the pinhole camera that undistorted photos fill without black borders.

    Focal lengths do not change, so pixels keep their size in the photo's center, as in COLMAP's `image_undistorter`.
    The frame is cropped around the principal point with its aspect ratio. It is never enlarged. A panorama fills its
    cube faces.

    Raises:
        CameraError: If the lens model is not implemented, or less than a tenth of the frame remains.
    """
    lens = camera.lens
    if lens is None or camera.panorama is not None:
        return camera
    if lens.kind is None:
        raise CameraError(
            f"Camera {camera.name!r}: photos of the camera model {lens.model} cannot be undistorted here. Undistort "
            "them with `colmap image_undistorter` and give its cameras and images, or leave the photos out."
        )
    intrinsics = (camera.fx, camera.fy, camera.cx, camera.cy)
    scale = largest_scale(lens, (camera.width, camera.height), intrinsics)
    if scale < _MIN_FRAME:
        raise CameraError(
            f"Camera {camera.name!r}: its distortion ({lens.model} {', '.join(f'{k:g}' for k in lens.coefficients)}) "
            "leaves no image. Check the coefficients, or leave the photos out."
        )
    width, height = (max(1, int(side * scale)) for side in (camera.width, camera.height))
    x, y = width / camera.width, height / camera.height
    return replace(camera, width=width, height=height, cx=camera.cx * x, cy=camera.cy * y)


def fit_cameras(cameras: Sequence[Camera], settings: Settings) -> list[Camera]:
    """Return the cameras, downscaled to `settings.max_resolution` if their longer side exceeds it."""
    limit = settings.max_resolution
    return [resized(camera, limit) if limit and camera.side > limit else camera for camera in cameras]


def spread(views: Sequence[V], count: int) -> list[V]:
    """Return `count` views that are evenly spread over a sequence, in its order, or all if there are at most `count`.

    The sequence is divided into `count` equal sections, and the middle view of each is taken. This favors neither the
    ends of a camera path nor the start of a ring.

    Raises:
        SettingsError: If the count is below 1.
    """
    if count < 1:
        raise SettingsError(f"The number of views is {count}; give at least 1.")
    total, sections = len(views), min(count, len(views))
    return [views[(2 * section + 1) * total // (2 * sections)] for section in range(sections)]


def between(first: Camera, second: Camera) -> Camera:
    """Return the camera halfway between two: at their midpoint, with the spherical mean of their rotations.

    Size and intrinsics are the first camera's. The mean is halfway along the shortest rotation between the two (slerp,
    Shoemake 1985). If they differ by 180 degrees, it is halfway along either of the two shortest rotations.
    """
    ends = np.stack([camera.world_to_camera[:3, :3].double().numpy() for camera in (first, second)])
    rotation = torch.from_numpy(
        scipy.spatial.transform.Slerp([0, 1], scipy.spatial.transform.Rotation.from_matrix(ends))(0.5).as_matrix()
    )
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
    """Return a camera at `position` that looks at `target`.

    Args:
        target: [3], point at the center of the view.
        up: [3], direction toward the upper edge; need not be a unit vector, but must not be parallel to the viewing
            direction.
        focal: Focal length in pixels for both axes; the principal point is the image center.
        resolution: See `Camera`.

    Raises:
        CameraError: If position and target coincide, or `up` is parallel to the viewing direction.
    """
    up = up.to(torch.float64)
    forward = target.to(torch.float64) - position.to(torch.float64)
    right = torch.linalg.cross(forward, up)
    if not bool(right.norm() > 1e-9 * forward.norm() * up.norm()):
        raise CameraError(f"Camera {name!r} looks along its up direction {up.tolist()}. Give another up direction.")
    down = torch.linalg.cross(forward, right)
    rotation = torch.stack([axis / axis.norm() for axis in (right, down, forward)])
    world_to_camera = torch.eye(4, dtype=torch.float64)
    world_to_camera[:3, :3] = rotation
    world_to_camera[:3, 3] = -rotation @ position.to(torch.float64)
    return Camera(name, width, height, focal, focal, width / 2, height / 2, world_to_camera, resolution)


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
        kind: Formula: "radial" for the rational model, "fisheye" for the equidistant one, "equirectangular" for a cube
            face of a panorama; None if the model is not implemented, so photos cannot be undistorted.
        coefficients: Values of `COEFFICIENTS`; for a cube face, its axes in those of the panorama (`FACES`).
        width, height: Size of the photos in pixels.
        fx, fy, cx, cy: Intrinsics of the photos in pixels; those of a panorama apply to longitude and latitude.
    """

    model: str
    kind: Literal["radial", "fisheye", "equirectangular"] | None
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
        elif self.kind == "equirectangular":
            axes = torch.tensor(self.coefficients, dtype=torch.float64).view(3, 3)
            across, down, forward = (torch.stack([x, y, torch.ones_like(x)], dim=-1) @ axes).unbind(-1)
            u, v = torch.atan2(across, forward), torch.atan2(down, torch.hypot(across, forward))
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
            self._rotations = scipy.spatial.transform.Slerp(
                self.knots, scipy.spatial.transform.Rotation.from_matrix(_rotations(self.cameras))
            )

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
    rotations = scipy.spatial.transform.Rotation.from_matrix(_rotations(cameras))
    angles = (rotations[:-1].inv() * rotations[1:]).magnitude() if len(cameras) > 1 else np.zeros(0)
    zooms = np.abs(np.diff([_relative_intrinsics(camera)[:2] for camera in cameras], axis=0)).max(axis=1, initial=0.0)
    relative = distances / np.median(moves) if len(moves) else np.zeros_like(distances)
    changes: NDArray[np.float64] = np.max([relative, angles / _UNIT_ROTATION, zooms / _UNIT_ZOOM], axis=0)
    return changes


def _centers(cameras: Sequence[Camera]) -> NDArray[np.float64]:
    return np.stack([camera.center.double().numpy() for camera in cameras])


def _rotations(cameras: Sequence[Camera]) -> NDArray[np.float64]:
    return np.stack([camera.world_to_camera[:3, :3].double().numpy() for camera in cameras])


def _relative_intrinsics(camera: Camera) -> NDArray[np.float64]:
    """Return the logarithms of fx and fy relative to the square root of the area, and the relative principal point."""
    unit = math.sqrt(camera.width * camera.height)
    focal = math.log(camera.fx / unit), math.log(camera.fy / unit)
    return np.array([*focal, camera.cx / camera.width, camera.cy / camera.height])


# A panorama is an equirectangular image: longitude grows by 360 degrees from its left to its right edge, latitude falls
# by 180 degrees from its upper to its lower edge, and its middle lies in the direction of the z axis. Pixel centers are
# at half-integers. This is the model EQUIRECTANGULAR of COLMAP ("Camera Models" of its documentation) and, with
# the axes of OpenGL, of nerfstudio. Cube faces stand for a panorama as views, and renders of its faces make a panorama.

#: Axes of the faces (right, down, forward) in those of the panorama. Names are as seen from inside.
FACES: dict[str, tuple[float, ...]] = {
    "front": (1, 0, 0, 0, 1, 0, 0, 0, 1),
    "right": (0, 0, -1, 0, 1, 0, 1, 0, 0),
    "back": (-1, 0, 0, 0, 1, 0, 0, 0, -1),
    "left": (0, 0, 1, 0, 1, 0, -1, 0, 0),
    "up": (1, 0, 0, 0, 0, 1, 0, -1, 0),
    "down": (1, 0, 0, 0, 0, -1, 0, 1, 0),
}
#: Slope beyond the edge of a face up to which it is rendered and fades into its neighbors. Large Gaussians differ
#: between two faces, because they are projected linearly and blended in the order of their depth on each.
OVERLAP = 0.25
#: Rows of a panorama that are sampled at once.
_ROWS = 64


def cube_faces(name: str, width: int, height: int, world_to_camera: Tensor) -> list[Camera]:
    """Return the cameras of a panorama's cube faces, of 90 degrees each, in the order of `FACES`.

    Their side is width / pi, rounded up: in its middle, a face has as many pixels per degree as the panorama.

    Args:
        name: Name of the panorama; those of the faces are NAME.front and so on.
        width, height: Size of the panorama in pixels.
        world_to_camera: Pose of the panorama, [4, 4] float64.
    """
    side = math.ceil(width / math.pi)
    middle = side / 2
    whole = width / (2 * math.pi), height / math.pi, width / 2, height / 2
    faces = []
    for face, axes in FACES.items():
        rotation = torch.eye(4, dtype=torch.float64)
        rotation[:3, :3] = torch.tensor(axes, dtype=torch.float64).view(3, 3)
        lens = Lens("EQUIRECTANGULAR", "equirectangular", axes, width, height, *whole)
        pose = rotation @ world_to_camera
        faces.append(Camera(f"{name}.{face}", side, side, middle, middle, middle, middle, pose, lens=lens))
    return faces


def level(camera: Camera, up: Tensor) -> Tensor:
    """Return the pose of a level panorama at a camera's position, with the camera's heading in its middle.

    Args:
        up: [3], direction toward the upper edge; need not be a unit vector.

    Returns:
        World-to-camera transform, [4, 4] float64.

    Raises:
        CameraError: If the camera looks along `up`.
    """
    forward = camera.center + camera.world_to_camera[2, :3]
    pose = look_at(camera.name, camera.center, forward, up, width=1, height=1, focal=1.0).world_to_camera.clone()
    down = -up / up.norm()
    pose[1:3, :3] = torch.stack([down, torch.linalg.cross(pose[0, :3], down)])
    pose[:3, 3] = -pose[:3, :3] @ camera.center
    return pose


def faces_to_render(world_to_camera: Tensor, width: int) -> list[Camera]:
    """Return the cameras whose images `join_faces` takes, for a panorama of this pose and even width in pixels."""
    faces = cube_faces("panorama", width, width // 2, world_to_camera)
    border = math.ceil(OVERLAP * faces[0].fx) + 1
    side, middle = faces[0].width + 2 * border, faces[0].cx + border
    return [replace(face, width=side, height=side, cx=middle, cy=middle) for face in faces]


def join_faces(images: Sequence[Tensor], width: int) -> Tensor:
    """Return the panorama [width / 2, width, 3] float32 of six images, sampled bilinearly.

    A face has the weight max(0, 1 + OVERLAP - max(|x|, |y|)) at a point (x, y, 1) before its camera, relative to the
    sum over all faces.

    Args:
        images: Images [side, side, 3] float32 of the cameras of `faces_to_render`.
        width: Width of the panorama in pixels, even.
    """
    axes = torch.tensor(list(FACES.values()), dtype=torch.float64).view(6, 3, 3)
    longitude = ((torch.arange(width, dtype=torch.float64) + 0.5) / width - 0.5) * 2 * math.pi
    panorama = torch.zeros(width // 2, width, 3)
    scale = math.ceil(width / math.pi) / images[0].shape[0]
    for top, rows in enumerate(panorama.split(_ROWS)):
        latitude = 0.5 - (top * _ROWS + torch.arange(len(rows), dtype=torch.float64) + 0.5) / (width // 2)
        phi, theta = torch.meshgrid(latitude * math.pi, longitude, indexing="ij")
        rays = torch.stack([phi.cos() * theta.sin(), -phi.sin(), phi.cos() * theta.cos()], dim=-1)
        local = torch.einsum("fij,rwj->frwi", axes, rays)
        slopes = local[..., :2] / local[..., 2:]
        weights = torch.where(local[..., 2] > 0, (1 + OVERLAP - slopes.abs().amax(dim=-1)).clamp_min(0), 0.0)
        weights /= weights.sum(dim=0)
        for image, slope, weight in zip(images, slopes, weights, strict=True):
            seen = weight > 0
            planes, grid = image.permute(2, 0, 1)[None], (scale * slope[seen]).float()[None, None]
            sampled = torch.nn.functional.grid_sample(planes, grid, "bilinear", "border", align_corners=False)
            rows[seen] += weight[seen, None].float() * sampled[0, :, 0].T
    return panorama
