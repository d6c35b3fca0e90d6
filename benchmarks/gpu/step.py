"""SOS steps on small and very large views: seconds by part and kernel, and peak memory beside the plan."""

from __future__ import annotations

import statistics

from benchmarks.gpu.clock import forget_peak, kernel_times, peak_bytes, reserved_bytes, waited_seconds
from benchmarks.gpu.inputs import network_weights, small_weights
from benchmarks.gpu.part import QUICK, Findings, Sizes, device
from sgsst_core.bench.synthetic import surface_scene, texture, views
from sgsst_core.budget import peak_memory
from sgsst_core.scene.gaussians import Scene
from sgsst_core.settings import PlannedPrecision, make_settings
from sgsst_core.stylizing.loop import Callbacks
from sgsst_core.stylizing.loop import run as run_steps
from sgsst_core.stylizing.planner import estimate
from sgsst_core.stylizing.stylizer import Stylizer

#: Warm-up steps, in which views are prepared and libraries choose their algorithms.
_WARM = 2
#: Zoom with which the ball covers whole views, as a captured room does.
ZOOM = 2.1


def run(sizes: Sizes, findings: Findings) -> None:
    """Measure all sizes; on a GPU in all precisions, the fastest first."""
    every: tuple[PlannedPrecision, ...] = ("bfloat16", "float16", "float32", "tf32")
    precisions = every if device().type == "cuda" else ("float32",)
    for width, height, gaussians in sizes.steps:
        scene = surface_scene(gaussians, degree=3)
        for precision in precisions:
            _measure(sizes, scene, (width, height), precision, findings)


def _measure(
    sizes: Sizes, scene: Scene, size: tuple[int, int], precision: PlannedPrecision, findings: Findings
) -> None:
    width, height = size
    place = f"{width}x{height}/{precision}"
    forget_peak(device())
    quick = sizes == QUICK
    settings = make_settings(
        "standard", steps_sos=1000, scale_sampling=1, early_stop=False, precision=precision,
        coarsest_side=24 if quick else None, cached_weights="none" if quick else None,
    )  # fmt: skip
    stylizer = Stylizer.planned(
        scene,
        views(_WARM, width, height, ZOOM),
        texture(height, height, seed=3),
        settings,
        weights=small_weights() if quick else network_weights(),
        rasterizer=None if device().type == "cuda" else "triton",
    )
    for _ in range(_WARM):
        stylizer.run_step()
    end = stylizer.step + 2 * sizes.step_repeats
    callbacks = Callbacks(progress=lambda progress: None, stop=lambda: stylizer.step == end)
    in_loop = waited_seconds(lambda: run_steps(stylizer, callbacks), device()) / (2 * sizes.step_repeats)
    taken = [waited_seconds(stylizer.run_step, device()) for _ in range(sizes.step_repeats)]
    records = stylizer.history[-sizes.step_repeats :]
    names = {name for record in records for name in record.parts}
    parts = {name: statistics.median(record.parts.get(name, 0.0) for record in records) for name in sorted(names)}
    plan, expected = stylizer.job.plan, estimate(stylizer.job)
    findings.add(f"{place}/gaussians", len(scene))
    findings.add(f"{place}/rasterizer", stylizer.job.plan.rasterizer)
    findings.add(f"{place}/precision", stylizer.job.plan.precision)
    findings.add(f"{place}/seconds", statistics.median(taken))
    findings.add(f"{place}/seconds_in_loop", in_loop)
    findings.add(f"{place}/seconds_by_part", parts)
    if device().type == "cuda":
        milliseconds, kernels = kernel_times(stylizer.run_step)
        findings.add(f"{place}/milliseconds_of_kernels", milliseconds)
        findings.add(f"{place}/kernels", kernels)
    findings.add(f"{place}/planned_seconds", expected.seconds)
    findings.add(f"{place}/device_allocated_bytes", peak_bytes(device()))
    findings.add(f"{place}/device_reserved_bytes", reserved_bytes(device()))
    findings.add(f"{place}/planned_device_bytes", plan.device_bytes)
    findings.add(f"{place}/process_peak_bytes", peak_memory())
    findings.add(f"{place}/planned_process_bytes", plan.peak_bytes)
