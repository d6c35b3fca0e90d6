"""Memory budgets: how much memory is available, and caches that respect a limit."""

from __future__ import annotations

import threading
from collections.abc import Callable, Hashable
from typing import Generic, Literal, TypeVar

import psutil
import torch
from torch import Tensor

K = TypeVar("K", bound=Hashable)
V = TypeVar("V")

#: Maximum fractions of the total and of the free memory that a job plans with; the rest is for its buffers and for
#: other programs. As long as half of the memory is free, the first limit is the smaller one, so the same job on the
#: same machine gets the same plan, with the same rounding, whatever else is running.
TOTAL_SHARE, FREE_SHARE = 0.4, 0.8
#: Maximum fraction of a GPU's total memory that a job plans with; a job does not share its GPU.
GPU_SHARE = 0.7
#: Fractions of the memory limit by use, which add up to 1: see `memory_for`.
_FRACTIONS = {"activations": 0.5, "views": 0.25, "rasterizer": 0.25}


def memory_for(use: Literal["activations", "views", "rasterizer"], memory: int) -> int:
    """Return the portion of a rank's memory limit, in bytes, that is reserved for one use.

    Args:
        use: "activations" for those of one iteration; "views" for view targets and colors, and for the two caches below
            that a job may need; "rasterizer" for tile intersections and cached blend weights.
        memory: Memory limit of the rank in bytes.
    """
    return int(memory * _FRACTIONS[use])


def content_fraction(device: str, *, weighted: bool, has_maps: bool) -> float:
    """Return the fraction of the memory for data of views that content may use.

    A quarter is for colors, one for coverage and one for region maps. On a GPU, content also uses the quarter for
    coverage if there are no position weights.

    Args:
        device: "cpu" or "cuda".
        weighted: Whether statistics are weighted by rendered coverage.
        has_maps: Whether the scene has regions.
    """
    return 0.5 - 0.25 * has_maps + 0.25 * (device != "cpu" and not weighted)


def least_intersection_memory(memory: int) -> int:
    """Return the memory in bytes reserved for tile intersections if blend weights are cached too, given a rank's limit.

    Views whose blend weights do not fit are rendered from their tile intersections. The memory is taken from the budget
    for views.
    """
    return memory // 16


def measuring_memory(memory: int) -> int:
    """Return the cache size in bytes for novel views, given a rank's memory limit.

    The float32 reference has a cache of the same size. Both are taken from the budget for views.
    """
    return memory // 16


def default_memory_limit(device: torch.device | None = None) -> int:
    """Return the default memory budget of a job in bytes, given the memory that is free now.

    For a GPU, it is GPU memory; for a CPU or None, it is memory of the machine.
    """
    if device is not None and device.type == "cuda":
        free, total = torch.cuda.mem_get_info(device)
        return int(min(total * GPU_SHARE, free * FREE_SHARE))
    memory = psutil.virtual_memory()
    return int(min(memory.total * TOTAL_SHARE, memory.available * FREE_SHARE))


def forget_device_peak(device: torch.device | str) -> None:
    """Reset the peak that `device_peak` returns."""
    if torch.device(device).type == "cuda":
        torch.cuda.reset_peak_memory_stats(device)


def device_peak(device: torch.device | str) -> int | None:
    """Return the peak GPU memory held by tensors since `forget_device_peak`, in bytes; None for a CPU."""
    return torch.cuda.max_memory_allocated(device) if torch.device(device).type == "cuda" else None


def tensor_bytes(tensor: Tensor) -> int:
    """Return the size of a tensor's values in bytes."""
    return tensor.numel() * tensor.element_size()


class Cache(Generic[K, V]):
    """Cache with a memory budget; values that do not fit are recomputed at each use.

    Values are never evicted: views are visited in rounds, so a value that replaces another one is not needed any
    sooner.

    Args:
        capacity: Memory budget in bytes; None for no limit.
        size: Function that returns the size of a value in bytes; None if every call passes the size.

    Attributes:
        values: Cached values by key, oldest first.
        used: Size of all cached values in bytes.
    """

    def __init__(self, capacity: int | None, size: Callable[[V], int] | None = None) -> None:
        self.used = 0
        self._capacity = capacity
        self._size = size
        self.values: dict[K, V] = {}
        self._decided: set[K] = set()
        self._lock = threading.Lock()

    def get(self, key: K, make: Callable[[], V], size: int | None = None) -> V:
        """Return the value of a key, from the cache or computed, and cache it if it fits.

        Args:
            key: Key of the value.
            make: Function that computes the value.
            size: Size of the value in bytes; None to use the cache's own `size` function.
        """
        if key in self.values:
            return self.values[key]
        value = make()
        if size is None:
            assert self._size is not None
            size = self._size(value)
        if self._fits(size):
            self.values[key] = value
            self.used += size
        return value

    def add(self, key: K, count: Callable[[], tuple[int, Callable[[], V]]]) -> None:
        """Compute and cache the value of a key if it fits; only the first call for a key has an effect.

        Args:
            key: Key of the value.
            count: Function that returns the size of the value in bytes, and a function that computes the value.
        """
        with self._lock:
            if key not in self._decided:
                size, make = count()
                if self._fits(size):
                    self.values[key] = make()
                    self.used += size
                self._decided.add(key)

    def __contains__(self, key: K) -> bool:
        """Return whether the value of a key is cached."""
        return key in self.values

    def holds(self, key: K, size: int) -> bool:
        """Return whether the value of a key is cached, or a value of `size` bytes would still fit."""
        return key in self.values or self._fits(size)

    def clear(self) -> None:
        """Remove all values."""
        self.values.clear()
        self._decided.clear()
        self.used = 0

    def _fits(self, size: int) -> bool:
        return self._capacity is None or self.used + size <= self._capacity
