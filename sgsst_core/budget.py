"""A memory budget: how much there is, and shelves that keep what fits."""

from __future__ import annotations

from collections.abc import Callable, Hashable
from typing import Generic, TypeVar

import psutil

K = TypeVar("K", bound=Hashable)
V = TypeVar("V")

#: Share of the free memory that a job plans with; the rest is left to its buffers and to other programs.
FREE_SHARE = 0.6


def default_memory_limit() -> int:
    """Bytes that a job may plan with on this machine, now."""
    return int(psutil.virtual_memory().available * FREE_SHARE)


class Shelf(Generic[K, V]):
    """Keeps values by key as long as they fit a number of bytes; what does not fit is made anew at each use.

    Nothing is ever evicted: views come round in turn, and evicting one would only trade it for another.
    """

    def __init__(self, capacity: int, size: Callable[[V], int]) -> None:
        self.used = 0
        self._capacity = capacity
        self._size = size
        self._kept: dict[K, V] = {}

    def get(self, key: K, make: Callable[[], V]) -> V:
        """The value of a key: kept, or made and kept if it fits."""
        if key in self._kept:
            return self._kept[key]
        value = make()
        size = self._size(value)
        if self.used + size <= self._capacity:
            self._kept[key] = value
            self.used += size
        return value
