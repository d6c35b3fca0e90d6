"""Tests of cached blend weights on a GPU or in Triton's interpreter, against `reference` and `triton`.

Tests that hold for both run with recomputed weights too.
"""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import pytest
import torch

from sgsst_core.features.network_weights import BackboneWeights
from sgsst_core.quality.measure import approximations
from sgsst_core.rasterizer.base import Precision, Rasterizer
from sgsst_core.rasterizer.reference import ReferenceRasterizer
from sgsst_core.rasterizer.triton import CachedRasterizer, TritonRasterizer
from sgsst_core.scene.camera import Camera
from sgsst_core.scene.gaussians import Scene
from sgsst_core.settings import make_settings
from sgsst_core.style import Style
from sgsst_core.stylizing.job import JobInputs, prepare_job
from sgsst_core.stylizing.planner import plan_job
from sgsst_core.stylizing.stylizer import Stylizer
from tests.sgsst_core.rasterizer.references import assert_background, assert_close_outside_band, relative_error
from tests.sgsst_core.splat_scenes import camera, cloud, colors_of, empty_scene, is_cached, pixels_like, rotated_pose
from tests.small_scenes import ball, cameras, style

pytest.importorskip("triton")
DEVICE = "cuda" if torch.cuda.is_available() else "cpu"
pytestmark = [pytest.mark.usefixtures("one_thread"), *([pytest.mark.gpu] if DEVICE == "cuda" else [])]
BACKGROUND = (1.0, 0.25, 0.5)
#: Relative distance from a cutoff within which float32 rounding may change the decision.
CLOSE = 2e-5
#: Relative errors of images and gradients. Weights in half precision are off by at most 2^-11 each.
ERRORS: dict[Precision, float] = {"float32": 5e-6, "half": 2**-11}

CASES: dict[str, Callable[[], tuple[Scene, Camera]]] = {
    "rotated": lambda: (cloud(80, seed=1), camera(20, 19, pose=rotated_pose())),
    "opaque": lambda: (
        replace(cloud(100, seed=2, log_scale=-1.5), opacities=torch.full((100,), 7.0)),
        camera(18, 11),
    ),
    "thin": lambda: (replace(cloud(90, seed=5, log_scale=-1.0), opacities=torch.full((90,), -4.0)), camera(20, 10)),
    "huge": lambda: (cloud(36, seed=3, log_scale=3.0), camera(18, 13)),
    "most tiles empty": lambda: (cloud(10, seed=4, log_scale=-7.0), camera(45, 33)),
    "one pixel": lambda: (cloud(60, seed=6), camera(1, 1)),
}


@pytest.fixture(
    params=[name if name in ("opaque", "one pixel") else pytest.param(name, marks=pytest.mark.slow) for name in CASES]
)
def case(request: pytest.FixtureRequest) -> tuple[Scene, Camera]:
    return CASES[request.param]()


def on_device(scene: Scene) -> TritonRasterizer:
    return TritonRasterizer(scene, background=BACKGROUND, device=DEVICE)


def cached_on_device(scene: Scene, **options: Any) -> CachedRasterizer:
    return CachedRasterizer(scene, uncached=on_device(scene), **options)


def with_weights(scene: Scene, precision: Precision | None) -> Rasterizer:
    """Return a rasterizer that caches weights in this precision, or recomputes them if it is None."""
    return on_device(scene) if precision is None else cached_on_device(scene, precision=precision)


@pytest.fixture(params=[None, *ERRORS])
def precision(request: pytest.FixtureRequest) -> Precision | None:
    return request.param  # type: ignore[no-any-return]


def test_images_and_gradients_agree_with_reference(case: tuple[Scene, Camera]) -> None:
    scene, view = case
    reference, uncached = ReferenceRasterizer(scene, background=BACKGROUND), on_device(scene)
    band = reference.near_cutoff(view, CLOSE)
    colors, pixels = colors_of(scene), pixels_like(view)
    pixels[band] = 0
    image, coverage = reference.render(colors, view), reference.coverage(view)
    gradient = reference.color_gradient(pixels, view)
    for precision, error in ERRORS.items():
        cached = CachedRasterizer(scene, precision=precision, uncached=uncached)
        assert_close_outside_band(cached.render(colors, view).cpu(), image, band, tolerance=2 * error + 1e-5)
        assert_close_outside_band(cached.coverage(view).cpu(), coverage, band, tolerance=1e-5)
        assert relative_error(cached.color_gradient(pixels, view).cpu(), gradient) < error + 5e-6
        assert is_cached(cached, view)


def test_gradient_is_transpose_and_reproducible(precision: Precision | None) -> None:
    scene, view = cloud(60, seed=15), camera(20, 17)
    rasterizer, colors, pixels = with_weights(scene, precision), colors_of(scene), pixels_like(view)
    gradient = rasterizer.color_gradient(pixels, view)
    black = rasterizer.render(torch.zeros_like(colors), view).cpu().double()
    image = rasterizer.render(colors, view).cpu().double() - black
    assert float((image * pixels).sum()) == pytest.approx(float((gradient.cpu().double() * colors).sum()), rel=1e-5)
    assert torch.equal(rasterizer.color_gradient(pixels, view), gradient)
    assert torch.equal(with_weights(scene, precision).color_gradient(pixels, view), gradient)


def test_crops_of_a_view_make_up_the_whole_view(precision: Precision | None) -> None:
    scene, view = cloud(60, seed=14), camera(12, 35)
    colors, pixels, rasterizer = colors_of(scene), pixels_like(view), with_weights(scene, precision)
    image, gradient = rasterizer.render(colors, view), rasterizer.color_gradient(pixels, view)
    rows = [(0, 16), (16, 21), (21, 35)]
    crops = [view.cropped(start, 0, stop, 12) for start, stop in rows]
    # A block that the border of a crop divides may have fewer pieces, which are then summed in other groups.
    assert float((torch.cat([rasterizer.render(colors, crop) for crop in crops]) - image).abs().max()) < 1e-6
    coverage = torch.cat([rasterizer.coverage(crop) for crop in crops])
    assert torch.allclose(coverage, rasterizer.coverage(view), atol=1e-6)
    own = [rasterizer.color_gradient(pixels[start:stop], crop) for (start, stop), crop in zip(rows, crops, strict=True)]
    assert relative_error(torch.stack(own).sum(0), gradient) < 1e-6


@pytest.mark.parametrize("scene", [empty_scene(), replace(cloud(20), means=torch.full((20, 3), -5.0))])
def test_view_without_gaussians_is_background(scene: Scene, precision: Precision | None) -> None:
    assert_background(with_weights(scene, precision), scene, camera(20, 18), BACKGROUND)


@pytest.mark.slow
def test_weights_beyond_the_budget_are_recomputed_on_the_device() -> None:
    scene = cloud(100, seed=20)
    views = [camera(20, 17), camera(20, 17, pose=rotated_pose(0.1)), camera(17, 20, pose=rotated_pose(0.2))]
    colors, pixels, uncached = colors_of(scene), pixels_like(views[0]), on_device(scene)
    for precision in ERRORS:
        sizes = [uncached.count_weights(view).nbytes(precision) for view in views[:2]]
        budget = sum(sizes)
        cached = CachedRasterizer(scene, precision=precision, uncached=uncached, max_bytes=budget)
        for view in views:
            cached.coverage(view)
        assert [is_cached(cached, view) for view in views] == [True, True, False]
        assert cached.cached_bytes == budget
    assert torch.equal(cached.render(colors, views[2]), uncached.render(colors, views[2]))
    gradient = cached.color_gradient(pixels_like(views[2]), views[2])
    assert torch.equal(gradient, uncached.color_gradient(pixels_like(views[2]), views[2]))
    crop = views[2].cropped(3, 0, 16, 17)
    assert cached.count_weights(crop).nbytes(precision) < cached.count_weights(views[2]).nbytes(precision)
    alone = CachedRasterizer(scene, uncached=uncached)
    alone.color_gradient(pixels[3:16, :17], crop)
    assert alone.cached_bytes == alone.count_weights(crop).nbytes(alone.precision)


# --- plan and job --------------------------------------------------------------------------------------------------


#: So small that a step in the interpreter takes only seconds.
VIEWS = cameras(2, 32, 24)


@pytest.mark.slow
def test_job_uses_the_requested_rasterizer(tiny_weights: BackboneWeights) -> None:
    scene, losses = ball(60), {}
    settings = make_settings("preview", steps_coarse=0, steps_sos=1, cached_weights="half", precision="float32")
    for name, used_name in (("cpu", "cpu"), ("triton", "cached")):
        inputs = (scene, VIEWS[:1], Style.of(style()), settings)
        job = plan_job(JobInputs(*inputs, weights=tiny_weights, rasterizer=name))
        used, resumed = Stylizer(job), Stylizer(prepare_job(job.plan, JobInputs(*inputs, weights=tiny_weights)))
        for stylizer in (used, resumed):
            rasterizer = stylizer.job.views.rasterizer
            assert (rasterizer.name, rasterizer.uncached.name) == (used_name, name)
            assert approximations(stylizer) == ["half-precision blend weights"] * (name == "triton")
        losses[name] = used.run_step().loss
    assert losses["triton"] == pytest.approx(losses["cpu"], rel=1e-3)
