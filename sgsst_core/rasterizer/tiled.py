"""Base class of rasterizers that cache the tile intersections of views under a memory budget."""

from __future__ import annotations

import threading
from abc import abstractmethod
from collections.abc import Callable
from typing import Any, ClassVar, Generic, Protocol, Self, TypeVar
from weakref import WeakSet

from sgsst_core.constants import ALPHA_MAX
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


class ViewCache(Generic[L]):
    """Cache of per-view data. Once its memory budget is used up, it stores only the latest view's data in addition.

    No data are evicted to store those of other views: views are visited in rounds, so evicting the least recently used
    view would evict every view just before it is needed again.

    Args:
        build: Function that computes the data of a view.
        max_bytes: Memory budget in bytes, including the data that remain in `previous`.
        previous: Earlier cache. At the first use of a view, its data are moved from there instead of being built. Data
            that remain there count toward the budget.
        adapt: Function applied to data from `previous`; must not make them larger.
        host: Cache whose budget is shared, instead of using `max_bytes`. The host has priority: it removes entries from
            this cache if it needs the space.
    """

    def __init__(
        self,
        build: Callable[[Camera], L],
        max_bytes: int,
        previous: ViewCache[L] | None = None,
        adapt: Callable[[L], L] = lambda data: data,
        host: ViewCache[Any] | None = None,
    ) -> None:
        self._build = build
        self._max_bytes = max_bytes
        self._previous = previous
        self._adapt = adapt
        self._host = host
        self._guests: WeakSet[ViewCache[Any]] = WeakSet()
        if host is not None:
            host._guests.add(self)
        self._cached: dict[CameraKey, L] = {}
        self._latest: tuple[CameraKey, L] | None = None
        self._cached_bytes = 0
        self._lock = threading.Lock()

    @property
    def cached_bytes(self) -> int:
        """Size in bytes of the data within the budget, including those in `previous`."""
        return self._cached_bytes + (self._previous.cached_bytes if self._previous else 0)

    def of(self, camera: Camera) -> L:
        """Return the data of a view, cached or newly built. Exceptions of `build` propagate."""
        key = camera_key(camera)
        with self._lock:
            if key in self._cached:
                return self._cached[key]
            if self._latest is not None and self._latest[0] == key:
                return self._latest[1]
            self._latest = None  # free its memory before the next one is built
            moved = self._previous.take(camera) if self._previous else None
            data = self._build(camera) if moved is None else self._adapt(moved)
            if self.cached_bytes + data.nbytes <= self._budget():
                self._cached[key] = data
                self._cached_bytes += data.nbytes
                self._evict_guests()
            else:
                self._latest = (key, data)
            return data

    def holds(self, camera: Camera) -> bool:
        """Return whether the data of a view are cached, so they need not be built."""
        key = camera_key(camera)
        return key in self._cached or (self._previous is not None and self._previous.holds(camera))

    def take(self, camera: Camera) -> L | None:
        """Remove the data of a view from the cache and return them; None if they are not cached.

        Data of the latest view that are stored beyond the budget are dropped, even if `camera` is another view.
        """
        with self._lock:
            latest, self._latest = self._latest, None
            key = camera_key(camera)
            if latest is not None and latest[0] == key:
                return latest[1]
            data = self._cached.pop(key, None)
            if data is not None:
                self._cached_bytes -= data.nbytes
                return data
            return self._previous.take(camera) if self._previous else None

    def clear(self) -> None:
        """Remove the data of all views, including those in `previous`."""
        with self._lock:
            self._previous = self._latest = None
            self._cached.clear()
            self._cached_bytes = 0

    def limit(self, max_bytes: int) -> None:
        """Set the memory budget, and evict the most recent entries until the rest fits."""
        with self._lock:
            self._max_bytes = max_bytes
            self._evict(max_bytes)
            self._evict_guests()

    def _evict(self, max_bytes: int) -> None:
        if self._previous is not None:
            self._previous.limit(max(max_bytes - self._cached_bytes, 0))
        while self._cached_bytes > max_bytes:
            self._cached_bytes -= self._cached.popitem()[1].nbytes

    def _budget(self) -> int:
        """Return the current budget in bytes.

        If there is a host, return the host's budget minus the data of the host and of other caches that share it.
        """
        if self._host is None:
            return self._max_bytes
        others = sum(guest.cached_bytes for guest in self._host._guests if guest is not self)
        return self._host._max_bytes - self._host.cached_bytes - others

    def _evict_guests(self) -> None:
        """Remove entries of caches that share this cache's budget until they fit in the rest of it."""
        for guest in list(self._guests):
            with guest._lock:
                guest._evict(max(guest._budget(), 0))


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
