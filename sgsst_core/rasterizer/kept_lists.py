"""Lists of views, kept between calls as far as they fit a number of bytes."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Generic, Protocol, TypeVar

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
        max_bytes: of all that is kept.
    """

    def __init__(self, build: Callable[[Camera], L], max_bytes: int) -> None:
        self._build = build
        self._max_bytes = max_bytes
        self._kept: dict[CameraKey, L] = {}
        self._latest: tuple[CameraKey, L] | None = None
        self._kept_bytes = 0
        self._lock = threading.Lock()

    def of(self, camera: Camera) -> L:
        """The view's lists, kept or new; raises what `build` raises."""
        key = camera_key(camera)
        with self._lock:
            if key in self._kept:
                return self._kept[key]
            if self._latest is not None and self._latest[0] == key:
                return self._latest[1]
            self._latest = None  # free its memory before the next one is built
            lists = self._build(camera)
            if self._kept_bytes + lists.nbytes <= self._max_bytes:
                self._kept[key] = lists
                self._kept_bytes += lists.nbytes
            else:
                self._latest = (key, lists)
            return lists
