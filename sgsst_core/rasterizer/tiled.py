"""Base class of rasterizers that cache the tile intersections of views."""

from __future__ import annotations

from abc import abstractmethod
from typing import Any, ClassVar, Generic, Self

from sgsst_core.constants import ALPHA_MAX
from sgsst_core.rasterizer.base import Rasterizer
from sgsst_core.rasterizer.view_cache import L, ViewCache
from sgsst_core.scene.camera import Camera
from sgsst_core.scene.gaussians import Scene


class TiledRasterizer(Rasterizer, Generic[L]):
    """Rasterizer whose tile intersections are cached within a budget (`ViewCache`).

    Args:
        scene, background, near, device: As in `Rasterizer`.
        alpha_max: Upper limit of alpha.
        max_intersection_bytes: Memory budget for tile intersections in bytes; None for the rasterizer's default.

    Attributes:
        default_intersection_bytes: Default budget for tile intersections in bytes.
    """

    can_cache = True
    default_intersection_bytes: ClassVar[int]

    def __init__(
        self, scene: Scene, *, alpha_max: float = ALPHA_MAX, max_intersection_bytes: int | None = None, **common: Any
    ) -> None:
        super().__init__(scene, alpha_max=alpha_max, max_intersection_bytes=max_intersection_bytes, **common)
        self.alpha_max = alpha_max
        budget = self.default_intersection_bytes if max_intersection_bytes is None else max_intersection_bytes
        self._intersections: ViewCache[L] = ViewCache(self._build, budget)

    @classmethod
    def options(cls, memory: int) -> dict[str, Any]:
        """Return constructor options for a memory budget in bytes, which cached weights share."""
        return {"max_intersection_bytes": memory}

    def beside(self, scene: Scene) -> Self:
        """Return a rasterizer of another scene that shares the budget for tile intersections, with lower priority."""
        other = self.for_scene(scene)
        other._intersections = ViewCache(other._build, 0, host=self._intersections)
        return other

    def intersections(self, camera: Camera) -> L:
        """Return the tile intersections of a view, cached or newly built.

        Raises:
            TooManyIntersectionsError: If there are more pairs of Gaussian and tile than 32-bit positions can address.
        """
        return self._intersections.of(camera)

    def has_intersections(self, camera: Camera) -> bool:
        """Return whether the view's tile intersections are cached, so it needs no projection and no sorting."""
        return self._intersections.holds(camera)

    def release_view(self, camera: Camera, budget: int) -> None:
        """Drop the view's tile intersections, and set the budget for those of all other views to `budget` bytes."""
        self._intersections.take(camera)
        self._intersections.limit(budget)

    def forget_views(self) -> None:
        """Drop the tile intersections of all views."""
        self._intersections.clear()

    @abstractmethod
    def _build(self, camera: Camera) -> L:
        """Compute the tile intersections of a view."""
