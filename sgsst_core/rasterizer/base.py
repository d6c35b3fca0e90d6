"""Base classes of rasterizers: of all, and of those that cache the tile intersections of views.

Geometry is frozen, so the image of a view is linear in the colors c: image = W c + T_final * background, where W are
the blend weights and T_final is the final transmittance. The gradient with respect to the colors is W^T dL/dimage.
"""

from abc import ABC, abstractmethod
from typing import TYPE_CHECKING, Any, ClassVar, Generic, Literal, Self, TypeVar

import torch
from torch import Tensor

from sgsst_core.budget import Cache
from sgsst_core.constants import NEAR
from sgsst_core.errors import SettingsError
from sgsst_core.scene.camera import Camera
from sgsst_core.scene.gaussians import Scene

if TYPE_CHECKING:
    from sgsst_core.rasterizer.triton import CountedPieces

Color = tuple[float, float, float]
#: Precision of cached blend weights. `half` stores weights times a power of two as float16, with a relative error of at
#: most 2^-11 per weight.
Precision = Literal["float32", "half"]

#: Cache key of a camera. It contains everything that rendering depends on, so cameras with equal keys render equal
#: images. The camera's name is not part of it.
CameraKey = tuple[int, int, tuple[float, ...], bytes]


def camera_key(camera: Camera) -> CameraKey:
    """Return the cache key of a camera."""
    pose = camera.world_to_camera.detach().cpu().double().contiguous().numpy().tobytes()
    intrinsics = (camera.fx, camera.fy, camera.cx, camera.cy, *camera.slope_limits)
    return camera.width, camera.height, intrinsics, pose


class Rasterizer(ABC):
    """Renderer of a scene with frozen geometry and arbitrary colors.

    A new rasterizer implements `_render`, `coverage` and `_color_gradient` and is listed in
    `sgsst_core.rasterizer.RASTERIZERS`; everything else has a default. Public methods accept colors and image gradients
    of any floating dtype on any device. Results are on `device`, in `dtype`. A wrong shape raises ValueError.

    Args:
        scene: Scene, whose geometry must not change during the rasterizer's lifetime.
        background: RGB color behind pixels that Gaussians leave uncovered.
        device: Device of the results; None for the rasterizer's default.
        options: Other arguments of the subclass's constructor, which `for_scene` passes on.

    Attributes:
        title: Name in texts for users.
        can_cache: Whether `CachedRasterizer` can cache its blend weights, with `count_weights`.
    """

    name: ClassVar[str]
    title: ClassVar[str]
    on_gpu: ClassVar[bool] = False
    can_cache: ClassVar[bool] = False
    dtype: torch.dtype = torch.float32

    def __init__(
        self,
        scene: Scene,
        *,
        background: Color = (0.0, 0.0, 0.0),
        near: float = NEAR,
        device: torch.device | str | None = None,
        **options: Any,
    ) -> None:
        if not near > 0:
            raise ValueError(f"near plane {near}: must be positive")
        self.scene = scene
        self.near = near
        self.device = self.usable_device(device)
        self.background = torch.tensor(background, dtype=self.dtype, device=self.device)
        self._options = {"background": background, "near": near, "device": device, **options}

    @classmethod
    def usable_device(cls, device: torch.device | str | None) -> torch.device:
        """Validate a device and return it, or the default device for None.

        Raises:
            SettingsError: If the rasterizer cannot run on the device.
        """
        if device is not None and torch.device(device).type != "cpu":
            raise SettingsError(f"rasterizer {cls.name!r} runs on the CPU, not on {device}: choose 'triton'")
        return torch.device("cpu")

    def render(self, colors: Tensor, camera: Camera) -> Tensor:
        """Return the image [h, w, 3] of colors [N, 3] over the background.

        Args:
            colors: Colors of one view, after spherical harmonics and clamping.
            camera: Camera of the view, or of a rectangle of it (`Camera.cropped`).
        """
        expected = (len(self.scene), 3)
        if tuple(colors.shape) != expected:
            raise ValueError(f"colors of shape {tuple(colors.shape)}: the scene needs {expected}")
        return self._render(self._converted(colors), camera)

    @abstractmethod
    def coverage(self, camera: Camera) -> Tensor:
        """Return 1 - T_final, [h, w] in [0, 1]: how much of each pixel the Gaussians cover."""

    def color_gradient(self, image_gradient: Tensor, camera: Camera) -> Tensor:
        """Return W^T dL/dimage, [N, 3], given the image gradient [h, w, 3]."""
        expected = (camera.height, camera.width, 3)
        if tuple(image_gradient.shape) != expected:
            raise ValueError(f"image gradient of shape {tuple(image_gradient.shape)}: the view needs {expected}")
        return self._color_gradient(self._converted(image_gradient), camera)

    def survey(self, camera: Camera) -> tuple[Tensor, Tensor]:
        """Return coverage [h, w], and each Gaussian's blend weight summed over all pixels [N].

        The latter is a column of the color gradient for an image gradient of ones.
        """
        coverage = self.coverage(camera)
        ones = torch.ones((*coverage.shape, 3), dtype=self.dtype, device=coverage.device)
        return coverage, self.color_gradient(ones, camera)[:, 0]

    @abstractmethod
    def _render(self, colors: Tensor, camera: Camera) -> Tensor:
        """Implement `render` for valid arguments on the rasterizer's device, in its dtype."""

    @abstractmethod
    def _color_gradient(self, image_gradient: Tensor, camera: Camera) -> Tensor:
        """Implement `color_gradient` for valid arguments on the rasterizer's device, in its dtype."""

    def _converted(self, values: Tensor) -> Tensor:
        return values.detach().to(device=self.device, dtype=self.dtype).contiguous()

    # --- other scenes ---

    @classmethod
    def options(cls, memory: int) -> dict[str, Any]:
        """Return constructor options for a memory budget in bytes."""
        return {}

    def for_scene(self, scene: Scene, **options: Any) -> Self:
        """Return a rasterizer of another scene with the same options, apart from those given."""
        return type(self)(scene, **(self._options | options))

    # --- cached blend weights ---

    @property
    def uncached(self) -> "Rasterizer":
        """Rasterizer that computes blend weights in every call, so that images do not depend on what is cached."""
        return self

    def count_weights(self, camera: Camera) -> "CountedPieces":
        """Count a view's weights without storing them; takes about as long as one render.

        Raises:
            NotImplementedError: If `can_cache` is False.
        """
        raise NotImplementedError(f"rasterizer {self.name!r} cannot cache the blend weights of {camera.name!r}")

    def cache_weights(self, camera: Camera) -> None:
        """Cache a view's weights if possible."""

    def release_view(self, camera: Camera, budget: int) -> None:
        """Drop the prepared data of a view whose weights are now cached; limit that of all others to `budget` bytes.

        Only rasterizers whose data share a memory budget with cached weights need this.
        """

    @property
    def caches(self) -> dict[str, Cache[CameraKey, Any]]:
        """Caches of data of views: "weights" and "intersections", if there are any."""
        return {}

    def forget_views(self) -> None:
        """Drop all cached data of views, because other views or other rectangles of them are rendered from now on."""


L = TypeVar("L")


class TiledRasterizer(Rasterizer, Generic[L]):
    """Rasterizer whose tile intersections, of type L, are cached within a budget, besides those of the latest view.

    Args:
        scene, background, near, device: As in `Rasterizer`.
        max_intersection_bytes: Memory budget for tile intersections in bytes; None for the rasterizer's default.
    """

    default_intersection_bytes: ClassVar[int]

    def __init__(self, scene: Scene, *, max_intersection_bytes: int | None = None, **common: Any) -> None:
        super().__init__(scene, max_intersection_bytes=max_intersection_bytes, **common)
        budget = self.default_intersection_bytes if max_intersection_bytes is None else max_intersection_bytes
        self._intersections: Cache[CameraKey, L] = Cache(budget, holds_latest=True)

    @classmethod
    def options(cls, memory: int) -> dict[str, Any]:
        """Return constructor options for a memory budget in bytes, which cached weights share."""
        return {"max_intersection_bytes": memory}

    def intersections(self, camera: Camera) -> L:
        """Return the tile intersections of a view, cached or newly built.

        Raises:
            TooManyIntersectionsError: If there are more pairs of Gaussian and tile than 32-bit positions can address.
        """
        return self._intersections.get(camera_key(camera), lambda: self._build(camera))

    def release_view(self, camera: Camera, budget: int) -> None:
        """Drop the view's tile intersections, and set the budget for those of all other views to `budget` bytes."""
        self._intersections.drop(camera_key(camera))
        self._intersections.limit(budget)

    @property
    def caches(self) -> dict[str, Cache[CameraKey, Any]]:
        """Cache of tile intersections, "intersections"."""
        return {"intersections": self._intersections}

    def forget_views(self) -> None:
        """Drop the tile intersections of all views."""
        self._intersections.clear()

    @abstractmethod
    def _build(self, camera: Camera) -> L:
        """Compute the tile intersections of a view."""
