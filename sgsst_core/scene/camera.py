"""Pinhole cameras, and functions that derive new cameras from existing ones."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, TypeVar

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation, Slerp
from torch import Tensor

from sgsst_core.constants import FRUSTUM_MARGIN
from sgsst_core.errors import CameraError, SettingsError
from sgsst_core.scene.lens import Lens, largest_scale
from sgsst_core.scene.rotations import exact_rotation

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
    try:
        matrix = np.asarray(values.detach().cpu() if isinstance(values, Tensor) else values, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise CameraError(f"{name}: `{argument}` is not a matrix of numbers. Give a tensor or array.") from error
    if matrix.shape not in shapes:
        wanted = " or ".join(str(list(shape)) for shape in shapes)
        raise CameraError(
            f"{name}: `{argument}` has shape {list(matrix.shape)}. Give {wanted}, for one camera at a time."
        )
    if not np.isfinite(matrix).all():
        raise CameraError(f"{name}: `{argument}` holds NaN or infinite values. Use other values.")
    return matrix


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
    checked = []
    for camera in cameras:
        transform = camera.world_to_camera
        if not isinstance(transform, Tensor) or transform.shape != (4, 4):
            raise CameraError(f"{camera.name}: its transform is not a [4, 4] tensor. Use `Camera.from_matrix`.")
        exact = transform.to("cpu", torch.float64)
        checked.append(camera if exact is transform else replace(camera, world_to_camera=exact))
    return checked


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
