"""Base class of rasterizers that cache the tile intersections of views under a memory budget."""

from __future__ import annotations

from abc import abstractmethod
from typing import Any, ClassVar, Generic, Protocol, Self, TypeVar

from sgsst_core.budget import Cache
from sgsst_core.rasterizer.base import CameraKey, Rasterizer, camera_key
from sgsst_core.scene.camera import Camera
from sgsst_core.scene.gaussians import Scene


class Sized(Protocol):
    """Object with a known memory use."""

    @property
    def nbytes(self) -> int:
        """Memory use in bytes."""
        ...


L = TypeVar("L", bound=Sized)


def cache_of_intersections(capacity: int, **options: Any) -> Cache[CameraKey, Any]:
    """Return a cache of tile intersections, which also stores those of the latest view; `options` as in `Cache`."""
    return Cache(capacity, lambda isects: isects.nbytes, holds_latest=True, **options)


class TiledRasterizer(Rasterizer, Generic[L]):
    """Rasterizer whose tile intersections are cached within a budget.

    Args:
        scene, background, near, device: As in `Rasterizer`.
        max_intersection_bytes: Memory budget for tile intersections in bytes; None for the rasterizer's default.
    """

    default_intersection_bytes: ClassVar[int]

    def __init__(self, scene: Scene, *, max_intersection_bytes: int | None = None, **common: Any) -> None:
        super().__init__(scene, max_intersection_bytes=max_intersection_bytes, **common)
        budget = self.default_intersection_bytes if max_intersection_bytes is None else max_intersection_bytes
        self._intersections: Cache[CameraKey, L] = cache_of_intersections(budget)

    @classmethod
    def options(cls, memory: int) -> dict[str, Any]:
        """Return constructor options for a memory budget in bytes, which cached weights share."""
        return {"max_intersection_bytes": memory}

    def beside(self, scene: Scene) -> Self:
        """Return a rasterizer of another scene that shares the budget for tile intersections, with lower priority."""
        other = self.for_scene(scene)
        other._intersections = cache_of_intersections(0, host=self._intersections)
        return other

    def intersections(self, camera: Camera) -> L:
        """Return the tile intersections of a view, cached or newly built.

        Raises:
            TooManyIntersectionsError: If there are more pairs of Gaussian and tile than 32-bit positions can address.
        """
        return self._intersections.get(camera_key(camera), lambda: self._build(camera))

    def release_view(self, camera: Camera, budget: int) -> None:
        """Drop the view's tile intersections, and set the budget for those of all other views to `budget` bytes."""
        self._intersections.take(camera_key(camera))
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
