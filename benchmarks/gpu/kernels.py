"""Every Triton kernel of a step: launches, seconds, achieved GB/s, and seconds until its first launch has returned.

The bytes of a launch are those of its tensors, as if each were read or written once.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any
from unittest import mock

import torch
import triton
from torch import Tensor
from torch.utils._pytree import tree_leaves

from benchmarks.gpu.clock import waited_seconds
from benchmarks.gpu.inputs import network_weights, small_weights
from benchmarks.gpu.part import QUICK, Findings, Sizes, device
from sgsst_core.bench.synthetic import surface_scene, texture, views
from sgsst_core.rasterizer import make_rasterizer
from sgsst_core.rasterizer.cached import CachedRasterizer
from sgsst_core.scene.gaussians import Scene
from sgsst_core.settings import Precision, make_settings
from sgsst_core.stylizing.stylizer import Stylizer

#: Steps that are recorded after the first.
_STEPS = 3


@dataclass
class _Kernel:
    """Launches of one kernel.

    Attributes:
        first: Seconds of the first launch, with compilation.
        seconds: Seconds of each later launch.
        bytes: Bytes of the tensors of each later launch.
    """

    first: float
    seconds: list[float] = field(default_factory=list)
    bytes: list[int] = field(default_factory=list)


class Launches:
    """Recorder of Triton launches, each of which waits for the device."""

    def __init__(self) -> None:
        self.kernels: dict[str, _Kernel] = {}

    def forget(self) -> None:
        """Discard all launches, except the seconds of the first ones."""
        for kernel in self.kernels.values():
            kernel.seconds.clear()
            kernel.bytes.clear()

    @contextmanager
    def recorded(self) -> Iterator[None]:
        """Record launches inside a `with` block."""
        if triton.knobs.runtime.interpret:
            from triton.runtime.interpreter import GridExecutor

            owner, method = GridExecutor, "__call__"
        else:
            owner, method = triton.runtime.jit.JITFunction, "run"
        original: Callable[..., Any] = getattr(owner, method)

        def run(kernel: Any, *args: Any, **options: Any) -> Any:
            result: list[Any] = []
            taken = waited_seconds(lambda: result.append(original(kernel, *args, **options)), device())
            self._add(
                kernel.fn.__name__, taken, [leaf for leaf in tree_leaves((args, options)) if isinstance(leaf, Tensor)]
            )
            return result[0]

        with mock.patch.object(owner, method, run):
            yield

    def _add(self, name: str, taken: float, tensors: list[Tensor]) -> None:
        if name not in self.kernels:
            self.kernels[name] = _Kernel(taken)
            return
        self.kernels[name].seconds.append(taken)
        self.kernels[name].bytes.append(sum({tensor.data_ptr(): tensor.nbytes for tensor in tensors}.values()))


def run(sizes: Sizes, findings: Findings) -> None:
    """Record the kernels of steps, on a GPU in the default precision too, then those of cached blend weights."""
    launches, (width, height) = Launches(), sizes.view
    scene = surface_scene(sizes.gaussians[0], degree=3)
    precisions: tuple[Precision, ...] = ("auto", "float32") if device().type == "cuda" else ("float32",)
    for precision in precisions:
        stylizer = _record_steps(sizes, scene, precision, launches)
        place = "step" if precision == "float32" else f"step_{stylizer.job.plan.precision}"
        report(launches, place, findings, _STEPS)
        if device().type == "cuda":
            findings.add(f"{place}/all_launches", _all_launches(stylizer))
        launches.forget()
    rasterizer = CachedRasterizer(scene, uncached=make_rasterizer("triton", scene))
    colors, camera = torch.full((len(scene), 3), 0.5, device=device()), views(1, width, height)[0]
    with launches.recorded():
        for _ in range(2):
            rasterizer.color_gradient(rasterizer.render(colors, camera), camera)
    report(launches, "cached_weights", findings, 1)
    findings.add("first_launch_seconds", {name: kernel.first for name, kernel in sorted(launches.kernels.items())})


def _record_steps(sizes: Sizes, scene: Scene, precision: Precision, launches: Launches) -> Stylizer:
    """Record the kernels of some steps after the first, and return their stylizer."""
    quick, (width, height) = sizes == QUICK, sizes.view
    settings = make_settings(
        "standard", steps_sos=10, scale_sampling=1, early_stop=False, cached_weights="none",
        coarsest_side=24 if quick else None, position_weights="on", precision=precision,
    )  # fmt: skip
    with launches.recorded():
        stylizer = Stylizer.planned(
            scene, views(1, width, height), texture(height, height, seed=3), settings,
            weights=small_weights() if quick else network_weights(), rasterizer="triton",
        )  # fmt: skip
        stylizer.run_step()
        launches.forget()
        for _ in range(_STEPS):
            stylizer.run_step()
    return stylizer


def report(launches: Launches, prefix: str, findings: Findings, rounds: int) -> None:
    """Add a row for each kernel, slowest first."""
    for name, kernel in sorted(launches.kernels.items(), key=lambda item: -sum(item[1].seconds)):
        if kernel.seconds:
            total = sum(kernel.seconds)
            row = {
                "launches": len(kernel.seconds) / rounds,
                "microseconds": 1e6 * total / len(kernel.seconds),
                "gigabytes_per_second": sum(kernel.bytes) / total / 1e9,
            }
            findings.add(f"{prefix}/{name}", row)


def _all_launches(stylizer: Stylizer) -> dict[str, int]:
    """Return how often a step calls each function of the CUDA runtime that launches, copies or waits."""
    from torch.profiler import ProfilerActivity, profile

    with profile(activities=[ProfilerActivity.CPU, ProfilerActivity.CUDA]) as profiled:
        stylizer.run_step()
    wanted = ("Launch", "Memcpy", "Memset", "Synchronize")
    return {event.key: event.count for event in profiled.key_averages() if any(part in event.key for part in wanted)}
