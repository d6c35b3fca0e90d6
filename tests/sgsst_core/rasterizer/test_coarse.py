"""Tests of the rasterizer `coarse` against the float64 reference followed by a box average, including edge cases."""

from __future__ import annotations

import math
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from sgsst_core.rasterizer.cached import CachedRasterizer
from sgsst_core.rasterizer.coarse import CoarseRasterizer
from sgsst_core.rasterizer.cpu import CpuRasterizer
from sgsst_core.rasterizer.reference import ReferenceRasterizer
from sgsst_core.scene.camera import Camera
from sgsst_core.scene.gaussians import Scene
from sgsst_core.scene.pyramid import add_upscaled_, downscale
from tests.sgsst_core.rasterizer.boundary_band import assert_close_outside_band, relative_error
from tests.sgsst_core.splat_scenes import camera, cloud, colors_of, empty_scene, pixels_like, single, turned_pose

#: Relative distance from a cutoff within which float32 rounding may change the decision.
CLOSE = 2e-5
SCALES = [1, 2, 3, 4, 5]
BACKGROUND = (1.0, 0.25, 0.5)

#: Sizes whose sides are no multiples of 16, except for the last, which is divisible by the squares of all scales.
CASES: dict[str, Callable[[], tuple[Scene, Camera]]] = {
    "cloud": lambda: (cloud(), camera()),
    "turned": lambda: (cloud(600, seed=1), camera(73, 39, pose=turned_pose())),
    "crowded": lambda: (
        replace(cloud(1500, seed=2, log_scale=-1.5), opacities=torch.full((1500,), 3.0)),
        camera(40, 33),
    ),
    "huge": lambda: (cloud(60, seed=3, log_scale=3.0), camera(50, 35)),
    "tiny": lambda: (cloud(3000, seed=4, log_scale=-7.0), camera(81, 47)),
    "whole squares": lambda: (cloud(seed=6), camera(64, 96)),
}


def coarse_pixels(view: Camera, scale: int, seed: int = 6) -> Tensor:
    """Return a random gradient [H >> scale, W >> scale, 3] of a coarse image, float32."""
    generator = torch.Generator().manual_seed(seed)
    return torch.randn(view.height >> scale, view.width >> scale, 3, generator=generator)


def upscaled(gradient: Tensor, view: Camera, scale: int) -> Tensor:
    """Return the gradient [H, W, 3] of the full-size view, by the adjoint of the box average."""
    whole = torch.zeros(view.height, view.width, 3, dtype=gradient.dtype)
    add_upscaled_(whole, gradient, scale)
    return whole


@pytest.mark.parametrize("name", CASES)
def test_agrees_with_the_average_of_the_reference(name: str) -> None:
    scene, view = CASES[name]()
    colors = colors_of(scene)
    reference = ReferenceRasterizer(scene, background=BACKGROUND)
    image, band = reference.render(colors, view), reference.near_cutoff(view, CLOSE)
    coarse = CoarseRasterizer(CpuRasterizer(scene, background=BACKGROUND))
    for scale in SCALES:
        coarse = coarse.at(scale)
        close = downscale(band.double(), scale) > 0
        actual = coarse.render(colors, view)
        assert actual.dtype == torch.float32
        assert_close_outside_band(actual, downscale(image, scale), close, tolerance=3e-6, largest_share=0.01)
        pixels = coarse_pixels(view, scale)
        pixels[close] = 0
        gradient = coarse.color_gradient(pixels, view)
        assert gradient.dtype == torch.float32
        assert relative_error(gradient, reference.color_gradient(upscaled(pixels.double(), view, scale), view)) < 1e-6
        assert coarse.is_cached(view)


@pytest.mark.parametrize("scale", SCALES)
def test_gradient_is_the_transpose(scale: int) -> None:
    scene, view = cloud(seed=11), camera(107, 77)
    coarse = CoarseRasterizer(CpuRasterizer(scene, background=BACKGROUND), scale)
    colors, pixels = colors_of(scene), coarse_pixels(view, scale)
    black = coarse.render(torch.zeros_like(colors), view).double()
    forward = (coarse.render(colors, view).double() - black) * pixels
    backward = coarse.color_gradient(pixels, view).double() * colors
    assert float(backward.sum()) == pytest.approx(float(forward.sum()), abs=1e-6 * float(forward.abs().sum()))


@pytest.mark.parametrize("scale", SCALES)
def test_what_fills_no_square_does_not_count(scale: int) -> None:
    """The Gaussian covers only the last pixel of the last row, which no coarse pixel includes, so nothing is cached."""
    side = 1 << scale
    view = camera(3 * side + 1, 2 * side + 1)
    corner = ((view.width - 0.5 - view.cx) / view.fx, (view.height - 0.5 - view.cy) / view.fy, 1.0)
    cpu = CpuRasterizer(single(corner, scales=(1e-3,) * 3, opacity=0.0045))
    assert torch.nonzero(cpu.coverage(view)).tolist() == [[2 * side, 3 * side]]
    coarse = CoarseRasterizer(cpu, scale)
    image = coarse.render(torch.ones(1, 3), view)
    assert image.shape == (2, 3, 3)
    assert not image.any()
    assert not coarse.color_gradient(torch.ones(2, 3, 3), view).any()
    (operator,) = coarse._operators.values.values()
    assert operator is not None
    assert len(operator.pieces.slots) == 0


def test_small_views_have_the_scales_whose_squares_they_hold() -> None:
    scene, view = cloud(seed=12), camera(15, 17)
    coarse, colors = CoarseRasterizer(CpuRasterizer(scene)), colors_of(scene)
    assert [tuple(coarse.at(scale).render(colors, view).shape) for scale in (1, 2, 3)] == [
        (8, 7, 3),
        (4, 3, 3),
        (2, 1, 3),
    ]
    for use in (
        lambda: coarse.at(4).render(colors, view),
        lambda: coarse.at(4).color_gradient(torch.zeros(1, 0, 3), view),
        lambda: coarse.at(4).operator_bytes(view),
    ):
        with pytest.raises(ValueError, match="view 'test': 15x17 pixels hold no square of 16 pixels a side"):
            use()
    with pytest.raises(ValueError, match="1x1 pixels hold no square of 2 pixels"):
        coarse.render(colors, camera(1, 1))


def test_arguments_are_checked_before_any_work() -> None:
    scene, view = cloud(10), camera()
    coarse = CoarseRasterizer(CpuRasterizer(scene))
    for scale in (0, -1):
        with pytest.raises(ValueError, match="for scale 1 or more; use `cached`"):
            coarse.at(scale)
    for rows in ((0, 0), (3, 2), (0, 23), (-1, 4)):
        with pytest.raises(ValueError, match="at scale 1 lies within 0 to 22"):
            coarse.render(colors_of(scene), view, rows)
    with pytest.raises(ValueError, match="colors of shape"):
        coarse.render(torch.zeros(9, 3), view)
    with pytest.raises(
        ValueError, match=r"gradient of shape \(45, 70, 3\): scale 1 of view 'test' needs \(22, 35, 3\)"
    ):
        coarse.color_gradient(pixels_like(view), view)
    assert coarse.cached_bytes == 0


@pytest.mark.parametrize(
    "scene",
    [empty_scene(), single((0, 0, -3.0)), single((1e6, 0, 1.0)), single((0, 0, 3.0), opacity=0.003)],
    ids=["empty", "behind", "beside", "faint"],
)
def test_a_view_without_gaussians_is_background(scene: Scene) -> None:
    view = camera()
    coarse = CoarseRasterizer(CpuRasterizer(scene, background=(0.5, 0.25, 0.125)))
    for scale in SCALES:
        image = coarse.at(scale).render(colors_of(scene), view)
        assert image.shape == (view.height >> scale, view.width >> scale, 3)
        assert torch.equal(image.flatten(0, 1).unique(dim=0), torch.tensor([[0.5, 0.25, 0.125]]))
        gradient = coarse.at(scale).color_gradient(coarse_pixels(view, scale), view)
        assert not coarse.at(scale).coverage(view).any()
        assert gradient.shape == (len(scene), 3)
        assert not gradient.any()


def test_background_fills_what_is_not_covered() -> None:
    scene, view = cloud(100, seed=15), camera()
    cpu, black = CpuRasterizer(scene, background=BACKGROUND), CpuRasterizer(scene)
    left = 1 - cpu.coverage(view)
    assert 0 < float(left.min()) < float(left.max()) == 1
    for scale in SCALES:
        expected = CoarseRasterizer(black, scale).render(colors_of(scene), view)
        expected = expected + downscale(left, scale)[..., None] * torch.tensor(BACKGROUND)
        assert torch.allclose(CoarseRasterizer(cpu, scale).render(colors_of(scene), view), expected, atol=1e-6)


def test_many_gaussians_in_a_pixel_lose_no_digits() -> None:
    """One coarse pixel sees 17,000 Gaussians.

    A single float32 sum over all of them is wrong by 1e-6; separate sums per pixel, as in `cpu`, are not.
    """
    count, view = 20_000, camera(16, 16, focal=16.0)
    generator = torch.Generator().manual_seed(2)
    scene = replace(
        cloud(count),
        means=torch.cat([torch.rand(count, 2, generator=generator) - 0.5, torch.ones(count, 1)], dim=1),
        scales=torch.full((count, 3), -9.0),
        opacities=torch.full((count,), math.log(0.008 / 0.992)),
    )
    colors, cpu = 1 + colors_of(scene), CpuRasterizer(scene)
    expected = downscale(cpu.render(colors, view).double(), 4)
    assert relative_error(CoarseRasterizer(cpu, 4).render(colors, view), expected) < 2e-7


def test_what_does_not_fit_the_budget_is_recomputed() -> None:
    scene = cloud(800, seed=20)
    views = [camera(), camera(pose=turned_pose(0.1)), camera(pose=turned_pose(0.2))]
    colors, cpu = colors_of(scene), CpuRasterizer(scene, background=BACKGROUND)
    for scale in SCALES:
        pixels = coarse_pixels(views[0], scale)
        sizes = [CoarseRasterizer(cpu, scale).operator_bytes(view) for view in views]
        budget, whole = sizes[0] + sizes[1], CoarseRasterizer(cpu, scale)
        coarse = CoarseRasterizer(cpu, scale, max_bytes=budget)
        for _ in range(2):
            for view in views:
                image = downscale(cpu.render(colors, view), scale)
                gradient = cpu.color_gradient(upscaled(pixels, view, scale), view)
                for one in (coarse, whole):
                    assert torch.allclose(one.render(colors, view), image, atol=1e-6)
                    assert relative_error(one.color_gradient(pixels, view), gradient) < 1e-6
        assert [coarse.is_cached(view) for view in views] == [True, True, False]
        assert coarse.cached_bytes == budget
        assert sum(operator.nbytes for operator in coarse._operators.values.values()) == budget
        assert whole.cached_bytes == sum(sizes)


def test_operators_are_far_smaller_than_the_weights_at_full_size() -> None:
    scene, view = cloud(2000, seed=13), camera(200, 120)
    coarse = CoarseRasterizer(CpuRasterizer(scene))
    sizes = [CachedRasterizer(scene).operator_bytes(view)] + [coarse.at(s).operator_bytes(view) for s in (1, 2, 3, 4)]
    assert sizes[1] < 0.6 * sizes[0]
    assert sizes[2] < 0.2 * sizes[0]
    assert sizes == sorted(sizes, reverse=True)
    assert coarse.cached_bytes == 0
    assert not coarse.is_cached(view)


def test_an_operator_belongs_to_a_camera_and_a_scale() -> None:
    scene, view = cloud(seed=14), camera()
    coarse = CoarseRasterizer(CpuRasterizer(scene), 2)
    coarse.render(colors_of(scene), view)
    assert coarse.is_cached(replace(view, name="another name"))
    assert not coarse.at(1).is_cached(view)
    assert not coarse.is_cached(replace(view, fx=view.fx * 1.01))


def test_scales_share_one_budget() -> None:
    scene, view = cloud(seed=14), camera()
    cpu, colors = CpuRasterizer(scene), colors_of(scene)
    coarse = CoarseRasterizer(cpu, 2, max_bytes=CoarseRasterizer(cpu, 2).operator_bytes(view))
    coarse.render(colors, view)
    coarse.at(3).render(colors, view)
    assert coarse.at(2).is_cached(view)
    assert not coarse.at(3).is_cached(view)


@pytest.mark.parametrize("scale", SCALES)
@pytest.mark.parametrize("max_bytes", [None, 0], ids=["kept", "not kept"])
def test_bands_put_together_are_the_whole_view(scale: int, max_bytes: int | None) -> None:
    scene, view = cloud(seed=16), camera(107, 141)
    coarse = CoarseRasterizer(CpuRasterizer(scene, background=BACKGROUND), scale, max_bytes)
    colors, pixels = colors_of(scene), coarse_pixels(view, scale)
    height = view.height >> scale
    bands = [(0, 1), (1, height // 2), (height // 2, height)]
    for method in (coarse.coverage, lambda *where: coarse.render(colors, *where)):
        assert torch.equal(torch.cat([method(view, band) for band in bands]), method(view))  # type: ignore[operator]
    parts = [coarse.color_gradient(pixels[slice(*band)], view, band) for band in bands]
    assert relative_error(sum(parts), coarse.color_gradient(pixels, view)) < 1e-6  # type: ignore[arg-type]
    assert torch.allclose(coarse.coverage(view), downscale(CpuRasterizer(scene).coverage(view), scale), atol=1e-6)
    coverage, weights = coarse.survey(view)
    assert torch.equal(coverage, coarse.coverage(view))
    assert relative_error(weights.sum(), coverage.sum()) < 1e-5


def test_results_do_not_depend_on_the_number_of_threads() -> None:
    scene, view = cloud(2000, seed=13), camera(203, 125)
    colors, before = colors_of(scene), torch.get_num_threads()
    results = []
    try:
        for threads in (1, 2, 2):
            torch.set_num_threads(threads)
            coarse = CoarseRasterizer(CpuRasterizer(scene, background=BACKGROUND))
            for scale in SCALES:
                image = coarse.at(scale).render(colors, view)
                results.append((image, coarse.at(scale).color_gradient(coarse_pixels(view, scale), view)))
    finally:
        torch.set_num_threads(before)
    once, count = results[: len(SCALES)], len(SCALES)
    assert all(
        torch.equal(a, b) for i, other in enumerate(results) for a, b in zip(once[i % count], other, strict=True)
    )


def test_python_threads_can_share_a_rasterizer() -> None:
    scene, view = cloud(500, seed=14), camera()
    colors, pixels = colors_of(scene), coarse_pixels(view, 2)
    alone = CoarseRasterizer(CpuRasterizer(scene), 2)
    image, gradient = alone.render(colors, view), alone.color_gradient(pixels, view)
    shared = CoarseRasterizer(CpuRasterizer(scene), 2)
    with ThreadPoolExecutor(4) as pool:
        images = [pool.submit(shared.render, colors, view) for _ in range(8)]
        gradients = [pool.submit(shared.color_gradient, pixels, view) for _ in range(8)]
    assert all(torch.equal(f.result(), image) for f in images)
    assert all(torch.equal(f.result(), gradient) for f in gradients)
    assert shared.cached_bytes == alone.cached_bytes
