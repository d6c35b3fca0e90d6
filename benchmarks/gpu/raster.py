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


def run(sizes: Sizes, found: Findings) -> None:
    """Measure all sizes; measurements with cached weights come last, because they may exceed the time limit."""
    found.add("view", sizes.view)
    cameras = views(2, *sizes.view)
    for count in sizes.gaussians:
        scene = surface_scene(count, DEGREE)
        forget_peak(device())
        _anew(scene, cameras, f"{count}", sizes.repeats, found)
        _harmonics(scene, cameras[0], f"{count}/spherical_harmonics", sizes.repeats, found)
        found.add(f"{count}/device_peak_bytes", peak_bytes(device()))
    for count in sizes.gaussians:
        _kept(surface_scene(count), cameras[0], f"{count}/cached_weights", sizes.repeats, found)


def _anew(scene: Scene, cameras: list[Camera], place: str, repeats: int, found: Findings) -> None:
    """Measure survey, tile intersections, forward and backward pass without cached weights."""
    rasterizer = TritonRasterizer(scene, device=device(), max_intersection_bytes=0)  # caches the last view only
    survey_views(scene, cameras, rasterizer)  # compilation
    surveying = waited_seconds(lambda: survey_views(scene, cameras, rasterizer), device())
    found.add(f"{place}/survey_seconds_a_view", surveying / len(cameras))
    both = seconds(lambda: [rasterizer.intersections(camera) for camera in cameras], device(), repeats)
    isects = rasterizer.intersections(cameras[0])
    found.add(f"{place}/lists_seconds", both / len(cameras))
    found.add(f"{place}/lists_bytes", isects.nbytes)
    found.add(f"{place}/visible", len(isects.gaussians))
    found.add(f"{place}/pairs", len(isects.ranks))
    _passes(rasterizer, cameras[0], place, repeats, found)


def _passes(rasterizer: Rasterizer, camera: Camera, place: str, repeats: int, found: Findings) -> None:
    colors, pixels = _operands(rasterizer, camera)
    found.add(f"{place}/forward_seconds", seconds(lambda: rasterizer.render(colors, camera), device(), repeats))
    backward = seconds(lambda: rasterizer.color_gradient(pixels, camera), device(), repeats)
    found.add(f"{place}/backward_seconds", backward)


def _operands(rasterizer: Rasterizer, camera: Camera) -> tuple[Tensor, Tensor]:
    generator = torch.Generator().manual_seed(2)
    scene: Scene = rasterizer.scene  # type: ignore[attr-defined]  # every rasterizer has a scene
    colors = torch.rand((len(scene), 3), generator=generator)
    pixels = torch.randn((camera.height, camera.width, 3), generator=generator)
    return colors.to(rasterizer.device), pixels.to(rasterizer.device)


def _harmonics(scene: Scene, camera: Camera, place: str, repeats: int, found: Findings) -> None:
    """Measure the Triton kernel for spherical harmonics, which is not the default in the interpreter."""
    sh_rest, means = held(scene.sh_rest).to(device()), scene.means.to(device())
    taken = seconds(lambda: kernel_rest_colors(sh_rest, means, camera, DEGREE), device(), repeats)
    found.add(f"{place}/seconds", taken)
    found.add(f"{place}/gigabytes_per_second", (sh_rest.nbytes + 2 * means.nbytes) / taken / 1e9)


def _kept(scene: Scene, camera: Camera, place: str, repeats: int, found: Findings) -> None:
    """Measure the computation of a view's blend weights, and forward and backward pass with cached weights."""
    forget_peak(device())
    rasterizer = make_rasterizer("cached", scene, device=device())
    colors, _ = _operands(rasterizer, camera)
    first = waited_seconds(lambda: rasterizer.render(colors, camera), device())
    found.add(f"{place}/first_render_seconds", first)
    found.add(f"{place}/bytes", rasterizer.cached_bytes)  # type: ignore[attr-defined]  # `cached` counts them
    _passes(rasterizer, camera, place, repeats, found)
    found.add(f"{place}/device_peak_bytes", peak_bytes(device()))
