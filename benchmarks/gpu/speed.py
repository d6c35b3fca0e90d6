"""Time and memory of SOS steps, by part and kernel and beside the plan, and time of the rasterizer."""

import statistics

import torch

from benchmarks.gpu.part import (
    QUICK,
    Findings,
    Sizes,
    device,
    forget_peak,
    kernel_times,
    network_weights,
    peak_bytes,
    reserved_bytes,
    seconds,
    waited_seconds,
)
from sgsst_core.bench.device_checks import surface_scene, texture, views
from sgsst_core.rasterizer import Rasterizer, make_rasterizer
from sgsst_core.rasterizer.triton import TritonRasterizer
from sgsst_core.scene.camera import Camera
from sgsst_core.scene.gaussians import Scene
from sgsst_core.settings import PlannedPrecision, make_settings
from sgsst_core.stylizing.job import estimate
from sgsst_core.stylizing.loop import Callbacks
from sgsst_core.stylizing.loop import run as run_steps
from sgsst_core.stylizing.stylizer import Stylizer

#: Warm-up steps, in which views are prepared and libraries choose their algorithms.
_WARM = 2
#: Zoom with which the ball covers whole views, as a captured room does.
ZOOM = 2.1


def step(sizes: Sizes, findings: Findings) -> None:
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
        weights=network_weights(sizes),
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
    findings.add(f"{place}/rasterizer", stylizer.job.plan.rasterizer)
    findings.add(f"{place}/seconds", statistics.median(taken))
    findings.add(f"{place}/seconds_in_loop", in_loop)
    findings.add(f"{place}/seconds_by_part", parts)
    if device().type == "cuda":
        milliseconds, kernels = kernel_times(stylizer.run_step)
        findings.add(f"{place}/milliseconds_of_kernels", milliseconds)
        findings.add(f"{place}/kernels", kernels)
    findings.add(f"{place}/planned_seconds", estimate(stylizer.job).seconds)
    findings.add(f"{place}/device_allocated_bytes", peak_bytes(device()))
    findings.add(f"{place}/device_reserved_bytes", reserved_bytes(device()))
    findings.add(f"{place}/planned_device_bytes", stylizer.job.plan.device_bytes)


def raster(sizes: Sizes, findings: Findings) -> None:
    """Measure all sizes; measurements with cached weights come last, because they may exceed the time limit."""
    findings.add("view", sizes.view)
    cameras = views(2, *sizes.view)
    for count in sizes.gaussians:
        _uncached(surface_scene(count), cameras, f"{count}", sizes.repeats, findings)
    for count in sizes.gaussians:
        forget_peak(device())
        rasterizer = make_rasterizer("cached", surface_scene(count), device=device())
        _passes(rasterizer, cameras[0], f"{count}/cached_weights", sizes.repeats, findings)


def _uncached(scene: Scene, cameras: list[Camera], prefix: str, repeats: int, findings: Findings) -> None:
    """Measure tile intersections, forward and backward pass without cached weights."""
    rasterizer = TritonRasterizer(scene, device=device(), max_intersection_bytes=0)  # caches the last view only
    both = seconds(lambda: [rasterizer.intersections(camera) for camera in cameras], device(), repeats)
    findings.add(f"{prefix}/lists_seconds", both / len(cameras))
    _passes(rasterizer, cameras[0], prefix, repeats, findings)


def _passes(rasterizer: Rasterizer, camera: Camera, prefix: str, repeats: int, findings: Findings) -> None:
    """Measure the forward and the backward pass of a view."""
    generator = torch.Generator().manual_seed(2)
    colors = torch.rand((len(rasterizer.scene), 3), generator=generator).to(rasterizer.device)
    pixels = torch.randn((camera.height, camera.width, 3), generator=generator).to(rasterizer.device)
    findings.add(f"{prefix}/forward_seconds", seconds(lambda: rasterizer.render(colors, camera), device(), repeats))
    backward = seconds(lambda: rasterizer.color_gradient(pixels, camera), device(), repeats)
    findings.add(f"{prefix}/backward_seconds", backward)
