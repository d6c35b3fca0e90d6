"""Time and memory of the rasterizer and of evaluating spherical harmonics, by number of Gaussians."""

from __future__ import annotations

import torch
from torch import Tensor

from benchmarks.gpu.clock import forget_peak, peak_bytes, seconds, waited_seconds
from benchmarks.gpu.part import Findings, Sizes, device
from sgsst_core.bench.synthetic import surface_scene, views
from sgsst_core.planning.survey import survey_views
from sgsst_core.rasterizer import Rasterizer, make_rasterizer
from sgsst_core.rasterizer.triton import TritonRasterizer
from sgsst_core.scene.camera import Camera
from sgsst_core.scene.gaussians import Scene
from sgsst_core.scene.spherical_harmonics import kernel_rest_colors
from sgsst_core.scene.stored_harmonics import held

DEGREE = 3


def run(sizes: Sizes, findings: Findings) -> None:
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
