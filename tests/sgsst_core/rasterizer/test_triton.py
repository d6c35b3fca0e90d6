"""Tests of the rasterizers `triton` and `cached` on a GPU or in Triton's interpreter, against `reference` and `cpu`.

The interpreter executes the kernels' source on CPU tensors. `triton_targets` compiles them for real targets, and needs
no GPU either. Tests that hold with cached and with recomputed weights run with both.
"""

import json
import os
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from sgsst_core.errors import SettingsError, TooManyIntersectionsError
from sgsst_core.features.network_weights import BackboneWeights
from sgsst_core.rasterizer import Rasterizer, drawing_problem, make_rasterizer
from sgsst_core.rasterizer.base import Precision
from sgsst_core.rasterizer.cpu import build_tile_intersections
from sgsst_core.rasterizer.triton import CachedRasterizer, TritonRasterizer
from sgsst_core.scene.camera import Camera
from sgsst_core.scene.gaussians import Scene
from sgsst_core.scene.rendering import Rendering
from tests.sgsst_core.rasterizer.references import assert_background, assert_close_outside_band, relative_error
from tests.sgsst_core.rasterizer.splat_reference import ReferenceRasterizer
from tests.sgsst_core.splat_scenes import (
    camera,
    cloud,
    colors_of,
    displaced,
    is_cached,
    needles,
    pixels_like,
    rotated_pose,
)

pytest.importorskip("triton")
ROOT = Path(__file__).resolve().parents[3]
DEVICE = "cuda" if torch.cuda.is_available() else "cpu"
pytestmark = [pytest.mark.usefixtures("one_thread"), *([pytest.mark.gpu] if DEVICE == "cuda" else [])]
BACKGROUND = (1.0, 0.25, 0.5)
#: Relative distance from a cutoff within which float32 rounding may change the decision.
CLOSE = 2e-5


def opaque() -> Scene:
    """Return nearly opaque Gaussians, a few of which terminate the blending of each pixel.

    A backward pass that divides by 1 - alpha would fail for them.
    """
    return replace(cloud(120, seed=2, log_scale=-1.5), opacities=torch.full((120,), 7.0))


def far_away() -> tuple[Scene, Camera]:
    """Return a scene and a camera a million units from the origin, where float32 has a resolution of 1/16."""
    scene = cloud(80, seed=12)
    offset = torch.tensor([1e6, -2e6, 1.5e6])
    return displaced(replace(scene, means=scene.means.round()), camera(33, 17), offset)


CASES: dict[str, Callable[[], tuple[Scene, Camera]]] = {
    "rotated": lambda: (cloud(100, seed=1), camera(33, 20, pose=rotated_pose())),
    "opaque": lambda: (opaque(), camera(20, 18)),
    "needles": lambda: (needles(60), camera(33, 20)),
    "huge": lambda: (cloud(40, seed=3, log_scale=3.0), camera(20, 15)),
    "tiny, most tiles empty": lambda: (cloud(12, seed=4, log_scale=-7.0), camera(65, 35)),
    "faint": lambda: (replace(cloud(150, seed=5), opacities=torch.linspace(-5.6, -5.4, 150)), camera(33, 33)),
    "one pixel": lambda: (cloud(100, seed=6), camera(1, 1)),
    "one row": lambda: (cloud(60, seed=7), camera(85, 1)),
    "close by": lambda: (cloud(100, seed=8, depth=0.3), camera(33, 20)),
    "far from the origin": far_away,
    "antialiased": lambda: (
        replace(cloud(120, seed=14, log_scale=-4.0), rendering=Rendering("antialiased")),
        camera(33, 20),
    ),
    "antialiased needles": lambda: (replace(needles(60), rendering=Rendering("antialiased", 0.1)), camera(33, 20)),
}


#: Cases that the fast tests run; the kernels are slow in the interpreter.
FAST = ("rotated", "opaque", "one pixel", "antialiased")


@pytest.fixture(params=[name if name in FAST else pytest.param(name, marks=pytest.mark.slow) for name in CASES])
def case(request: pytest.FixtureRequest) -> tuple[Scene, Camera]:
    return CASES[request.param]()


def on_device(scene: Scene, **options: float) -> TritonRasterizer:
    return TritonRasterizer(scene, background=BACKGROUND, device=DEVICE, **options)  # type: ignore[arg-type]


def test_images_and_gradients_agree_with_reference(case: tuple[Scene, Camera]) -> None:
    scene, view = case
    reference, fast = ReferenceRasterizer(scene, background=BACKGROUND), on_device(scene)
    band = reference.near_cutoff(view, CLOSE)
    colors, pixels = colors_of(scene), pixels_like(view)
    pixels[band] = 0
    image, coverage = fast.render(colors, view).cpu(), fast.coverage(view).cpu()
    assert_close_outside_band(image, reference.render(colors, view), band, tolerance=1e-5)
    assert_close_outside_band(coverage, reference.coverage(view), band, tolerance=1e-5)
    gradient = fast.color_gradient(pixels, view).cpu()
    assert relative_error(gradient, reference.color_gradient(pixels, view)) < 5e-6


def test_tile_intersections_equal_those_of_the_cpu(case: tuple[Scene, Camera]) -> None:
    scene, view = case
    isects, expected = on_device(scene).intersections(view), build_tile_intersections(scene, view)
    assert np.array_equal(isects.gaussians.cpu().numpy(), expected.projection.gaussians)
    for name in ("first_slots", "starts", "ranks", "slots"):
        assert np.array_equal(getattr(isects, name).cpu().numpy(), getattr(expected, name)), name
    assert np.allclose(isects.values.cpu().numpy(), expected.projection.values, rtol=1e-9, atol=1e-9)


def test_invalid_gaussians_are_dropped_as_by_reference() -> None:
    scene = cloud(80, seed=16)
    quats, scales = scene.quats.clone(), scene.scales.clone()
    quats[3] = 0
    scales[5] = 800.0
    broken, view = replace(scene, quats=quats, scales=scales), camera(33, 20)
    expected = ReferenceRasterizer(broken, background=BACKGROUND).render(colors_of(scene), view)
    assert float((on_device(broken).render(colors_of(scene), view).cpu() - expected).abs().max()) < 1e-5


def test_too_many_intersections_are_refused_before_allocation(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sgsst_core.rasterizer.cpu.MAX_INTERSECTIONS", 10)
    with pytest.raises(TooManyIntersectionsError, match="raster tiles"):
        on_device(cloud(200)).intersections(camera())


def test_trial_render_returns_the_reason_of_a_failure(monkeypatch: pytest.MonkeyPatch) -> None:
    assert drawing_problem("triton", DEVICE) is None
    monkeypatch.setattr(TritonRasterizer, "render", lambda *arguments: torch.zeros(16, 16, 3))
    assert drawing_problem("triton", DEVICE) == "it draws nothing"
    assert "no rasterizer is called 'none'" in str(drawing_problem("none"))  # type: ignore[arg-type]


@pytest.mark.slow
@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a GPU")
def test_error_without_a_gpu_gives_advice() -> None:
    with pytest.raises(SettingsError, match="PyTorch sees no GPU"):
        make_rasterizer("triton", cloud(10), device="cuda")
    code = (
        "import torch\nfrom tests.sgsst_core.splat_scenes import cloud\n"
        "from sgsst_core.rasterizer import make_rasterizer\nmake_rasterizer('triton', cloud(3), device='cpu')\n"
    )
    environment = {**os.environ, "TRITON_INTERPRET": "0"}
    ended = subprocess.run([sys.executable, "-c", code], env=environment, cwd=ROOT, capture_output=True, text=True)
    assert "set TRITON_INTERPRET=1" in ended.stderr


@pytest.mark.slow
def test_kernels_compile_for_gpus_within_their_registers() -> None:
    """Spilled registers cost memory traffic in the innermost loop: none are allowed on NVIDIA, few on AMD."""
    environment = {key: value for key, value in os.environ.items() if key != "TRITON_INTERPRET"}
    environment["TRITON_ALWAYS_COMPILE"] = "1"
    command = [sys.executable, "-m", "tests.sgsst_core.rasterizer.triton_targets"]
    ended = subprocess.run(command, env=environment, cwd=ROOT, capture_output=True, text=True)
    assert ended.returncode == 0, ended.stderr
    compiled = json.loads(ended.stdout)
    assert len(compiled) == 33
    for kernel, targets in compiled.items():
        for target, used in targets.items():
            assert used["registers"] <= 256, (kernel, target)
            assert used["spilled"] <= (128 if target.startswith("gfx") else 0), (kernel, target)
    for kernel, most in (("render", 21), ("slot_gradients", 23), ("count_pieces", 24)):
        assert compiled[kernel]["sm_90"]["warps"] >= 20, kernel
        assert compiled[kernel]["sm_90"]["pixel_instructions"] <= most, kernel


#: Relative errors of images and gradients. Weights in half precision are off by at most 2^-11 each.
ERRORS: dict[Precision, float] = {"float32": 5e-6, "half": 2**-11}

CACHED_CASES: dict[str, Callable[[], tuple[Scene, Camera]]] = {
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
    params=[
        name if name in ("opaque", "one pixel") else pytest.param(name, marks=pytest.mark.slow) for name in CACHED_CASES
    ]
)
def cached_case(request: pytest.FixtureRequest) -> tuple[Scene, Camera]:
    return CACHED_CASES[request.param]()


def with_weights(scene: Scene, precision: Precision | None) -> Rasterizer:
    """Return a rasterizer that caches weights in this precision, or recomputes them if it is None."""
    plain = on_device(scene)
    return plain if precision is None else CachedRasterizer(scene, uncached=plain, precision=precision)


@pytest.fixture(params=[None, *ERRORS])
def precision(request: pytest.FixtureRequest) -> Precision | None:
    return request.param  # type: ignore[no-any-return]


def test_cached_images_and_gradients_agree_with_reference(cached_case: tuple[Scene, Camera]) -> None:
    scene, view = cached_case
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


@pytest.mark.parametrize("scene", [cloud(0), replace(cloud(20), means=torch.full((20, 3), -5.0))])
def test_view_without_gaussians_is_background(scene: Scene, precision: Precision | None) -> None:
    assert_background(with_weights(scene, precision), scene, camera(20, 18), BACKGROUND)


@pytest.mark.slow
def test_weights_beyond_the_budget_are_recomputed_on_the_device() -> None:
    scene = cloud(100, seed=20)
    views = [camera(20, 17), camera(20, 17, pose=rotated_pose(0.1)), camera(17, 20, pose=rotated_pose(0.2))]
    colors, uncached = colors_of(scene), on_device(scene)
    for precision in ERRORS:
        sizes = [uncached.count_weights(view).nbytes(precision) for view in views[:2]]
        budget = sum(sizes)
        cached = CachedRasterizer(scene, precision=precision, uncached=uncached, max_bytes=budget)
        for view in views:
            cached.coverage(view)
        assert [is_cached(cached, view) for view in views] == [True, True, False]
        assert cached.caches["weights"].used == budget
    assert torch.equal(cached.render(colors, views[2]), uncached.render(colors, views[2]))
    gradient = cached.color_gradient(pixels_like(views[2]), views[2])
    assert torch.equal(gradient, uncached.color_gradient(pixels_like(views[2]), views[2]))


@pytest.mark.slow
def test_job_uses_the_requested_rasterizer(tiny_weights: BackboneWeights) -> None:
    from sgsst_core.quality.measure import approximations
    from sgsst_core.settings import make_settings
    from sgsst_core.style import Style
    from sgsst_core.stylizing.job import JobInputs, plan_job, prepare_job
    from sgsst_core.stylizing.stylizer import Stylizer
    from tests.small_scenes import ball, cameras, style

    scene, losses = ball(60), {}
    settings = make_settings("preview", steps_coarse=0, steps_sos=1, cached_weights="half", precision="float32")
    for name, used_name in (("cpu", "cpu"), ("triton", "cached")):
        inputs = (scene, cameras(2, 32, 24)[:1], Style.of(style()), settings)
        job = plan_job(JobInputs(*inputs, weights=tiny_weights, rasterizer=name))
        used, resumed = Stylizer(job), Stylizer(prepare_job(job.plan, JobInputs(*inputs, weights=tiny_weights)))
        for stylizer in (used, resumed):
            rasterizer = stylizer.job.views.rasterizer
            assert (rasterizer.name, rasterizer.uncached.name) == (used_name, name)
            assert approximations(stylizer) == ["half-precision blend weights"] * (name == "triton")
        losses[name] = used.run_step().loss
    assert losses["triton"] == pytest.approx(losses["cpu"], rel=1e-3)
