"""Time and memory of SOS steps, by part and kernel and beside the plan, and of the rasterizer and harmonics."""

from __future__ import annotations

import statistics

import torch
from torch import Tensor

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
from sgsst_core.budget import peak_memory
from sgsst_core.planning.survey import survey_views
from sgsst_core.rasterizer import Rasterizer, make_rasterizer
from sgsst_core.rasterizer.triton import TritonRasterizer
from sgsst_core.scene.camera import Camera
from sgsst_core.scene.gaussians import Scene
from sgsst_core.scene.spherical_harmonics import kernel_rest_colors
from sgsst_core.scene.stored_harmonics import held
from sgsst_core.settings import PlannedPrecision, make_settings
from sgsst_core.stylizing.loop import Callbacks
from sgsst_core.stylizing.loop import run as run_steps
from sgsst_core.stylizing.planner import estimate
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


DEGREE = 3


def raster(sizes: Sizes, findings: Findings) -> None:
    """Measure all sizes; measurements with cached weights come last, because they may exceed the time limit."""
    findings.add("view", sizes.view)
    cameras = views(2, *sizes.view)
    for count in sizes.gaussians:
        scene = surface_scene(count, DEGREE)
        forget_peak(device())
        _uncached(scene, cameras, f"{count}", sizes.repeats, findings)
        _harmonics(scene, cameras[0], f"{count}/spherical_harmonics", sizes.repeats, findings)
        findings.add(f"{count}/device_peak_bytes", peak_bytes(device()))
    for count in sizes.gaussians:
        _cached(surface_scene(count), cameras[0], f"{count}/cached_weights", sizes.repeats, findings)


def _uncached(scene: Scene, cameras: list[Camera], prefix: str, repeats: int, findings: Findings) -> None:
    """Measure survey, tile intersections, forward and backward pass without cached weights."""
    rasterizer = TritonRasterizer(scene, device=device(), max_intersection_bytes=0)  # caches the last view only
    survey_views(scene, cameras, rasterizer)  # compilation
    surveying = waited_seconds(lambda: survey_views(scene, cameras, rasterizer), device())
    findings.add(f"{prefix}/survey_seconds_a_view", surveying / len(cameras))
    both = seconds(lambda: [rasterizer.intersections(camera) for camera in cameras], device(), repeats)
    isects = rasterizer.intersections(cameras[0])
    findings.add(f"{prefix}/lists_seconds", both / len(cameras))
    findings.add(f"{prefix}/lists_bytes", isects.nbytes)
    findings.add(f"{prefix}/visible", len(isects.gaussians))
    findings.add(f"{prefix}/pairs", len(isects.ranks))
    _passes(rasterizer, cameras[0], prefix, repeats, findings)


def _passes(rasterizer: Rasterizer, camera: Camera, prefix: str, repeats: int, findings: Findings) -> None:
    colors, pixels = _operands(rasterizer, camera)
    findings.add(f"{prefix}/forward_seconds", seconds(lambda: rasterizer.render(colors, camera), device(), repeats))
    backward = seconds(lambda: rasterizer.color_gradient(pixels, camera), device(), repeats)
    findings.add(f"{prefix}/backward_seconds", backward)


def _operands(rasterizer: Rasterizer, camera: Camera) -> tuple[Tensor, Tensor]:
    generator = torch.Generator().manual_seed(2)
    scene: Scene = rasterizer.scene  # type: ignore[attr-defined]  # every rasterizer has a scene
    colors = torch.rand((len(scene), 3), generator=generator)
    pixels = torch.randn((camera.height, camera.width, 3), generator=generator)
    return colors.to(rasterizer.device), pixels.to(rasterizer.device)


def _harmonics(scene: Scene, camera: Camera, prefix: str, repeats: int, findings: Findings) -> None:
    """Measure the Triton kernel for spherical harmonics, which is not the default in the interpreter."""
    sh_rest, means = held(scene.sh_rest).to(device()), scene.means.to(device())
    taken = seconds(lambda: kernel_rest_colors(sh_rest, means, camera, DEGREE), device(), repeats)
    findings.add(f"{prefix}/seconds", taken)
    findings.add(f"{prefix}/gigabytes_per_second", (sh_rest.nbytes + 2 * means.nbytes) / taken / 1e9)


def _cached(scene: Scene, camera: Camera, prefix: str, repeats: int, findings: Findings) -> None:
    """Measure the computation of a view's blend weights, and forward and backward pass with cached weights."""
    forget_peak(device())
    rasterizer = make_rasterizer("cached", scene, device=device())
    colors, _ = _operands(rasterizer, camera)
    first = waited_seconds(lambda: rasterizer.render(colors, camera), device())
    findings.add(f"{prefix}/first_render_seconds", first)
    findings.add(f"{prefix}/bytes", rasterizer.cached_bytes)  # type: ignore[attr-defined]  # `cached` counts them
    _passes(rasterizer, camera, prefix, repeats, findings)
    findings.add(f"{prefix}/device_peak_bytes", peak_bytes(device()))
