"""Memory budgets: how much memory is available, and caches that respect a limit."""

import sys
import threading
from collections.abc import Callable, Hashable
from operator import attrgetter
from typing import Generic, Literal, TypeVar

import psutil
import torch

from sgsst_core import container

K = TypeVar("K", bound=Hashable)
V = TypeVar("V")

#: Maximum fractions of the total and of the free memory that a job plans with; the rest is for its buffers and for
#: other programs. As long as half of the memory is free, the first limit is the smaller one, so the same job on the
#: same machine gets the same plan, with the same rounding, whatever else is running.
TOTAL_SHARE, FREE_SHARE = 0.4, 0.8
#: Maximum fraction of a GPU's total memory that a job plans with; a job does not share its GPU.
GPU_SHARE = 0.7
#: Fractions of the memory limit by use. The first three add up to 1; the others are taken from that of views.
_FRACTIONS = {"activations": 1 / 2, "views": 1 / 4, "rasterizer": 1 / 4, "intersections": 1 / 16, "measuring": 1 / 16}
MemoryUse = Literal["activations", "views", "rasterizer", "intersections", "measuring"]


def memory_for(use: MemoryUse, memory: int) -> int:
    """Return the portion of a rank's memory limit, in bytes, that is reserved for one use.

    Args:
        use: "activations" for those of one iteration; "views" for view targets and colors; "rasterizer" for tile
            intersections and cached blend weights. If a job needs them, "intersections" of the views whose blend
            weights are not cached, and "measuring" novel views; the float32 reference takes as much again.
        memory: Memory limit of the rank in bytes.
    """
    return int(memory * _FRACTIONS[use])


def default_memory_limit(device: torch.device | None = None) -> int:
    """Return the default memory budget of a job in bytes, given the memory that is free now.

    For a GPU, it is GPU memory; for a CPU or None, it is memory of the machine or of this process's container.
    """
    if device is not None and device.type == "cuda":
        free, total = torch.cuda.mem_get_info(device)
        return int(min(total * GPU_SHARE, free * FREE_SHARE))
    total, available = container.memory()
    return int(min(total * TOTAL_SHARE, available * FREE_SHARE))


def peak_memory() -> int:
    """Return the peak physical memory of this process so far, in bytes."""
    if sys.platform == "win32":
        return int(psutil.Process().memory_info().peak_wset)
    import resource

    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak if sys.platform == "darwin" else peak * 1024  # kilobytes everywhere except on macOS


def forget_device_peak(device: torch.device | str) -> None:
    """Reset the peak that `device_peak` returns."""
    if torch.device(device).type == "cuda":
        torch.cuda.reset_peak_memory_stats(device)


def device_peak(device: torch.device | str) -> int | None:
    """Return the peak GPU memory held by tensors since `forget_device_peak`, in bytes; None for a CPU."""
    return torch.cuda.max_memory_allocated(device) if torch.device(device).type == "cuda" else None


class Cache(Generic[K, V]):
    """Cache with a memory budget; values that do not fit are recomputed at each use.

    Values are never evicted to store others: views are visited in rounds, so a value that replaces another one is not
    needed any sooner. Only one thread at a time computes a value.

    Args:
        capacity: Memory budget in bytes; None for no limit.
        size: Function that returns the size of a value in bytes; its `nbytes` by default.
        holds_latest: Whether to store the latest value in addition, if it does not fit.

    Attributes:
        values: Cached values by key, oldest first.
        used: Size in bytes of the values within the budget.
        sizes: Size in bytes of each value that has been computed, by key.
    """

    def __init__(
        self, capacity: int | None, size: Callable[[V], int] = attrgetter("nbytes"), *, holds_latest: bool = False
    ) -> None:
        self.capacity = capacity
        self.values: dict[K, V] = {}
        self.used = 0
        self.sizes: dict[K, int] = {}
        self._size = size
        self._holds_latest = holds_latest
        self._latest: tuple[K, V] | None = None
        self._decided: set[K] = set()
        self._lock = threading.RLock()

    def get(self, key: K, make: Callable[[], V], size: int | None = None) -> V:
        """Return the value of a key, from the cache or computed, and cache it if it fits.

        Args:
            make: Function that computes the value. Its exceptions propagate.
            size: Size of the value in bytes; None to use the cache's own `size` function.
        """
        if key in self.values:
            return self.values[key]
        with self._lock:
            if self._latest is not None and self._latest[0] == key:
                return self._latest[1]
            self._latest = None  # free its memory before the next one is computed
            value = make()
            size = self._size(value) if size is None else size
            self.sizes[key] = size
            if self.has_space(size):
                self._store(key, value, size)
            elif self._holds_latest:
                self._latest = key, value
            return value

    def add(self, key: K, count: Callable[[], tuple[int, Callable[[], V]]]) -> None:
        """Compute and cache the value of a key if it fits; only the first call for a key has an effect.

        Args:
            count: Function that returns the size of the value in bytes, and a function that computes the value.
        """
        with self._lock:
            if key not in self._decided:
                size, make = count()
                if self.has_space(size):
                    self.sizes[key] = size
                    self._store(key, make(), size)
                self._decided.add(key)

    def has_space(self, size: int) -> bool:
        """Return whether a value of `size` bytes would still fit."""
        return self.capacity is None or self.used + size <= self.capacity

    def drop(self, key: K) -> None:
        """Remove the value of a key, and the latest value that is stored beyond the budget."""
        with self._lock:
            self._latest = None
            if self.values.pop(key, None) is not None:
                self.used -= self.sizes[key]

    def clear(self) -> None:
        """Remove all values."""
        with self._lock:
            self._latest = None
            for record in (self.values, self.sizes, self._decided):
                record.clear()
            self.used = 0

    def limit(self, capacity: int) -> None:
        """Set the memory budget, and remove the most recent values until the rest fits."""
        with self._lock:
            self.capacity = capacity
            while self.used > capacity:
                key, _ = self.values.popitem()
                self.used -= self.sizes[key]

    def _store(self, key: K, value: V, size: int) -> None:
        self.values[key] = value
        self.used += size
