"""A memory budget: how much there is, and shelves that keep what fits."""

from __future__ import annotations

from collections.abc import Callable, Hashable
from typing import Generic, TypeVar

import psutil
import torch

K = TypeVar("K", bound=Hashable)
V = TypeVar("V")

#: Shares of all memory and of the free memory that a job plans with at most; the rest is left to its buffers and to
#: other programs. The first rules as long as half of the memory is free, so that the same job on the same machine makes
#: the same plan, and rounds the same, whatever else happens to run.
TOTAL_SHARE, FREE_SHARE = 0.4, 0.8
#: Of all memory of a GPU, which a job has to itself.
GPU_SHARE = 0.7
#: Of the memory limit: activations of one iteration, view targets and colors, and the rasterizer's lists or weights.
MEMORY_SHARES = {"activations": 0.5, "views": 0.25, "rasterizer": 0.25}
#: One part in so many of the memory limit, of the views' share, is left to raster lists where blend weights are kept:
#: views whose weights do not fit are rendered from these.
LISTS_BESIDE_WEIGHTS = 16


def measuring_memory(memory: int) -> int:
    """Bytes that what is kept of novel views may take, and the exact twin's views: of a rank's memory."""
    return memory // 16


def default_memory_limit(device: torch.device | None = None) -> int:
    """Bytes that a job may plan with on this machine, now; those of a GPU where it computes on one."""
    if device is not None and device.type == "cuda":
        free, total = torch.cuda.mem_get_info(device)
        return int(min(total * GPU_SHARE, free * FREE_SHARE))
    memory = psutil.virtual_memory()
    return int(min(memory.total * TOTAL_SHARE, memory.available * FREE_SHARE))


def forget_device_peak(device: torch.device | str) -> None:
    """Let `device_peak` count from here."""
    if torch.device(device).type == "cuda":
        torch.cuda.reset_peak_memory_stats(device)


def device_peak(device: torch.device | str) -> int | None:
    """Most bytes of a GPU's memory that tensors have held, since `forget_device_peak`; None for a CPU."""
    return torch.cuda.max_memory_allocated(device) if torch.device(device).type == "cuda" else None


class Shelf(Generic[K, V]):
    """Keeps values by key as long as they fit a number of bytes; what does not fit is made anew at each use.

    Nothing is ever evicted: views come round in turn, and evicting one would only trade it for another.
    """

    def __init__(self, capacity: int, size: Callable[[V], int] | None = None) -> None:
        self.used = 0
        self._capacity = capacity
        self._size = size
        self._kept: dict[K, V] = {}

    def get(self, key: K, make: Callable[[], V], size: int | None = None) -> V:
        """The value of a key: kept, or made and kept if it fits. `size` takes the place of the shelf's own."""
        if key in self._kept:
            return self._kept[key]
        value = make()
        if size is None:
            assert self._size is not None
            size = self._size(value)
        if self.used + size <= self._capacity:
            self._kept[key] = value
            self.used += size
        return value

    def __contains__(self, key: K) -> bool:
        """Whether the value of a key is kept."""
        return key in self._kept

    def holds(self, key: K, size: int) -> bool:
        """Whether the value of a key is kept, or would be: there is room for so many bytes."""
        return key in self._kept or self.used + size <= self._capacity

    def clear(self) -> None:
        """Keep nothing of what is there."""
        self._kept.clear()
        self.used = 0
