"""Lists of views, kept between calls as far as they fit a number of bytes."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Any, Generic, Protocol, TypeVar
from weakref import WeakSet

from sgsst_core.rasterizer.arguments import CameraKey, camera_key
from sgsst_core.scene.camera import Camera


class Sized(Protocol):
    """What takes memory."""

    @property
    def nbytes(self) -> int:
        """Bytes."""
        ...


L = TypeVar("L", bound=Sized)


class KeptLists(Generic[L]):
    """Builds what a view needs, and keeps it until the bytes are reached; of the views beyond only the last is held.

    Views come round in turn, and evicting the least recently used would evict each just before it is needed.

    Args:
        build: makes the lists of a view.
        max_bytes: of all that is kept, what is still to be taken over included.
        before: lists of the same views, which are taken over, one view at a time when it first comes, in place of
            building: they count among the bytes until then.
        adapt: what becomes of lists that are taken over; it makes them no larger.
        host: lists in whose bytes these are kept, in place of `max_bytes`, as far as they leave any: they come first,
            and have these go where they need the room.
    """

    def __init__(
        self,
        build: Callable[[Camera], L],
        max_bytes: int,
        before: KeptLists[L] | None = None,
        adapt: Callable[[L], L] = lambda lists: lists,
        host: KeptLists[Any] | None = None,
    ) -> None:
        self._build = build
        self._max_bytes = max_bytes
        self._before = before
        self._adapt = adapt
        self._host = host
        self._guests: WeakSet[KeptLists[Any]] = WeakSet()
        if host is not None:
            host._guests.add(self)
        self._kept: dict[CameraKey, L] = {}
        self._latest: tuple[CameraKey, L] | None = None
        self._kept_bytes = 0
        self._lock = threading.Lock()

    @property
    def kept_bytes(self) -> int:
        """Bytes of all that is kept, but for the last view beyond the limit."""
        return self._kept_bytes + (self._before.kept_bytes if self._before else 0)

    def of(self, camera: Camera) -> L:
        """The view's lists, kept or new; raises what `build` raises."""
        key = camera_key(camera)
        with self._lock:
            if key in self._kept:
                return self._kept[key]
            if self._latest is not None and self._latest[0] == key:
                return self._latest[1]
            self._latest = None  # free its memory before the next one is built
            given = self._before.take(camera) if self._before else None
            lists = self._build(camera) if given is None else self._adapt(given)
            if self.kept_bytes + lists.nbytes <= self._bound():
                self._kept[key] = lists
                self._kept_bytes += lists.nbytes
                self._make_room()
            else:
                self._latest = (key, lists)
            return lists

    def holds(self, camera: Camera) -> bool:
        """Whether the view's lists need not be built."""
        key = camera_key(camera)
        return key in self._kept or (self._before is not None and self._before.holds(camera))

    def take(self, camera: Camera) -> L | None:
        """The view's lists, which are no longer kept here; None where they are not. The latest ones are let go."""
        with self._lock:
            latest, self._latest = self._latest, None
            key = camera_key(camera)
            if latest is not None and latest[0] == key:
                return latest[1]
            lists = self._kept.pop(key, None)
            if lists is not None:
                self._kept_bytes -= lists.nbytes
                return lists
            return self._before.take(camera) if self._before else None

    def limit(self, max_bytes: int) -> None:
        """Keep no more than so many bytes from now on: views that came last are let go first."""
        with self._lock:
            self._max_bytes = max_bytes
            self._let_go(max_bytes)
            self._make_room()

    def _let_go(self, max_bytes: int) -> None:
        if self._before is not None:
            self._before.limit(max(max_bytes - self._kept_bytes, 0))
        while self._kept_bytes > max_bytes:
            self._kept_bytes -= self._kept.popitem()[1].nbytes

    def _bound(self) -> int:
        """Bytes that may be kept now: with a host, what it and its other guests leave."""
        if self._host is None:
            return self._max_bytes
        others = sum(guest.kept_bytes for guest in self._host._guests if guest is not self)
        return self._host._max_bytes - self._host.kept_bytes - others

    def _make_room(self) -> None:
        """Have guests keep no more than is left."""
        for guest in list(self._guests):
            with guest._lock:
                guest._let_go(max(guest._bound(), 0))
