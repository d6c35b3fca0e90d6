"""Sizes and findings of the benchmark's parts, and what they measure with."""

import json
import math
import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from sgsst_core.bench.device_checks import random_weights
from sgsst_core.devices import wait_for
from sgsst_core.errors import WeightsError
from sgsst_core.features.network_weights import BackboneWeights, load_network_weights


@dataclass(frozen=True)
class Sizes:
    """Sizes of all measurements.

    Attributes:
        gaussians: Numbers of Gaussians of the synthetic scenes, in ascending order.
        view: (width, height) of their views.
        steps: (width, height, Gaussians) for timed SOS steps.
        step_repeats: Number of timed steps.
        jobs: (views, width, height, Gaussians) of whole jobs.
        rank_steps: Number of steps after which two ranks are compared with one.
        parity: (Gaussians, width, height) for the comparison with `reference`.
        bits: Repetitions that must be bit-identical.
        curve: (steps, longer side in pixels) of the job that runs on both GPU and CPU.
        repeats: Repetitions of each timed call.
    """

    gaussians: tuple[int, ...] = (1_000_000, 3_000_000, 6_000_000)
    view: tuple[int, int] = (980, 545)
    steps: tuple[tuple[int, int, int], ...] = ((980, 545, 2_500_000), (5187, 3361, 5_800_000))
    step_repeats: int = 5
    jobs: tuple[tuple[int, int, int, int], ...] = ((300, 980, 545, 1_000_000), (185, 5187, 3361, 5_800_000))
    rank_steps: int = 3
    parity: tuple[int, int, int] = (20_000, 320, 200)
    bits: int = 100
    curve: tuple[int, int] = (60, 128)
    repeats: int = 20


#: Sizes that take seconds in the interpreter.
QUICK = Sizes(
    gaussians=(60, 120),
    view=(32, 16),
    steps=((32, 32, 60),),
    step_repeats=1,
    jobs=((3, 32, 32, 60),),
    rank_steps=1,
    parity=(120, 40, 33),
    bits=2,
    curve=(2, 32),
    repeats=1,
)


def device() -> torch.device:
    """Return the GPU, or the CPU (with Triton's interpreter) if there is none."""
    return torch.device("cuda", torch.cuda.current_device()) if torch.cuda.is_available() else torch.device("cpu")


class Findings:
    """Findings of a part, printed and written to a file one by one, so that none are lost if the part is killed.

    Args:
        path: Path of the JSON file.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self.entries: dict[str, Any] = {}
        self.broken: list[str] = []
        self._write()

    def add(self, name: str, value: Any) -> None:
        """Add a JSON-serializable value; with the name "a/b", it is entry `b` of the object `a`."""
        *groups, last = name.split("/")
        entries = self.entries
        for group in groups:
            entries = entries.setdefault(group, {})
        entries[last] = value
        self._write()
        print(f"  {name:<58}{value!s:.200}", flush=True)

    def check(self, name: str, error: float, bound: float) -> None:
        """Add an error with its bound. If it exceeds the bound, the part continues, but counts as failed."""
        passed = math.isfinite(error) and error <= bound
        self.add(name, {"error": error if math.isfinite(error) else str(error), "bound": bound, "passed": passed})
        if not passed:
            self.broken.append(f"{name}: {error:.3g} exceeds {bound:.3g}")

    def end(self, status: dict[str, str]) -> None:
        """Record how the part ended, after all findings."""
        self.entries["_ended"] = status
        self._write()

    def _write(self) -> None:
        self._path.write_text(json.dumps(self.entries), encoding="utf-8")


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


def network_weights(sizes: Sizes) -> BackboneWeights:
    """Return the installed weights of VGG19 or VGG16, otherwise random ones of VGG19, which take the same time.

    For `QUICK`, return random weights of VGG16's layers with 16 channels each, small enough for the interpreter.
    """
    if sizes == QUICK:
        return random_weights("vgg16", (16,) * 5)
    try:
        return load_network_weights("auto")
    except WeightsError:
        return random_weights()
