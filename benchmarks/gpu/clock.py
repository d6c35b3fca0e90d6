"""Time and memory measurements on a device."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable

import torch

from sgsst_core.devices import wait_for


def seconds(action: Callable[[], object], device: torch.device, repeats: int) -> float:
    """Return the median time of `repeats` calls after a warm-up call, measured by CUDA events or the CPU's clock."""
    action()
    return statistics.median(_once(action, device) for _ in range(repeats))


def _once(action: Callable[[], object], device: torch.device) -> float:
    if device.type != "cuda":
        started = time.perf_counter()
        action()
        return time.perf_counter() - started
    start, end = torch.cuda.Event(enable_timing=True), torch.cuda.Event(enable_timing=True)
    start.record()
    action()
    end.record()
    end.synchronize()
    milliseconds: float = start.elapsed_time(end)
    return milliseconds / 1e3


def waited_seconds(action: Callable[[], object], device: torch.device) -> float:
    """Return the wall-clock seconds from the start of a call until the device has finished its work."""
    wait_for(device)
    started = time.perf_counter()
    action()
    wait_for(device)
    return time.perf_counter() - started


def kernel_times(action: Callable[[], object], most: int = 20) -> tuple[float, dict[str, dict[str, float]]]:
    """Return the milliseconds of all kernels of a call on the GPU, and milliseconds and launches of the slowest."""
    from torch.profiler import ProfilerActivity, profile

    with profile(activities=[ProfilerActivity.CUDA]) as profiled:
        action()
        torch.cuda.synchronize()
    events = [event for event in profiled.key_averages() if event.self_device_time_total]
    events.sort(key=lambda event: -event.self_device_time_total)
    return sum(event.self_device_time_total for event in events) / 1e3, {
        event.key[:100]: {"milliseconds": event.self_device_time_total / 1e3, "launches": event.count}
        for event in events[:most]
    }


def forget_peak(device: torch.device) -> None:
    """Free unused memory, and reset the memory peak."""
    if device.type == "cuda":
        torch.cuda.empty_cache()
        torch.cuda.reset_peak_memory_stats(device)


def reserved_bytes(device: torch.device) -> int | None:
    """Return the peak of device memory in bytes that the allocator held, or None on a CPU."""
    return torch.cuda.max_memory_reserved(device) if device.type == "cuda" else None


def peak_bytes(device: torch.device) -> int | None:
    """Return the peak of allocated device memory in bytes, or None on a CPU."""
    return torch.cuda.max_memory_allocated(device) if device.type == "cuda" else None
