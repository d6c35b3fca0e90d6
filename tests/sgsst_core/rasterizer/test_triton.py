"""Tests of the rasterizer `triton` on a GPU or in Triton's interpreter, against `reference` and `cpu`.

The interpreter executes the kernels' source on CPU tensors. `triton_targets` compiles them for real targets, and needs
no GPU either.
"""

import json
import math
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
from sgsst_core.rasterizer.projection import build_tile_intersections
from sgsst_core.rasterizer.reference import ReferenceRasterizer
from sgsst_core.rasterizer.triton import TritonRasterizer
from sgsst_core.scene.camera import Camera
from sgsst_core.scene.gaussians import Scene
from sgsst_core.scene.rendering import Rendering
from tests.sgsst_core.rasterizer.references import assert_close_outside_band, relative_error
from tests.sgsst_core.splat_scenes import camera, cloud, colors_of, displaced, needles, pixels_like, rotated_pose

pytest.importorskip("triton")
ROOT = Path(__file__).resolve().parents[3]
DEVICE = "cuda" if torch.cuda.is_available() else "cpu"
pytestmark = [pytest.mark.gpu] if DEVICE == "cuda" else []
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


def test_images_and_gradients_agree_with_reference(case: tuple[Scene, Camera], one_thread: None) -> None:
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


def test_survey_equals_coverage_and_gradient_of_ones(case: tuple[Scene, Camera], one_thread: None) -> None:
    scene, view = case
    rasterizer = on_device(scene)
    coverage, weights = rasterizer.survey(view)
    plain, gradient = Rasterizer.survey(rasterizer, view)
    assert torch.equal(coverage, plain)
    if DEVICE == "cpu":
        assert torch.equal(weights, gradient)
    reference = ReferenceRasterizer(scene)
    band = reference.near_cutoff(view, CLOSE)
    expected, summed = reference.survey(view)
    assert_close_outside_band(coverage.cpu(), expected, band, tolerance=1e-5)
    # At a pixel where a cutoff flips, a weight of at most 1 moves from one Gaussian to others.
    assert float((weights.cpu() - summed).abs().max()) <= 1e-5 * float(summed.max()) + 2 * int(band.sum())
    assert relative_error(weights, gradient) < 1e-6


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
    monkeypatch.setattr("sgsst_core.rasterizer.projection.MAX_INTERSECTIONS", 10)
    with pytest.raises(TooManyIntersectionsError, match="raster tiles"):
        on_device(cloud(200)).intersections(camera())


def test_trial_render_returns_the_reason_of_a_failure(monkeypatch: pytest.MonkeyPatch) -> None:
    assert drawing_problem("triton", DEVICE) is None
    monkeypatch.setattr(TritonRasterizer, "render", lambda *arguments: torch.zeros(16, 16, 3))
    assert drawing_problem("triton", DEVICE) == "it draws nothing"
    assert "no rasterizer is called 'none'" in str(drawing_problem("none"))  # type: ignore[arg-type]


@pytest.mark.slow
def test_steps_of_a_job_agree_with_the_cpu(tiny_weights: BackboneWeights, one_thread: None) -> None:
    """The whole job uses the rasterizer's protocol: survey, plan, both phases."""
    # The other tests do not even need pydantic, so they run on a bare machine with a GPU.
    from sgsst_core.settings import make_settings
    from sgsst_core.stylizing.stylizer import Stylizer
    from tests.small_scenes import cameras, style, wall

    settings = make_settings("preview", steps_coarse=1, steps_sos=2, coarsest_side=16)
    views = cameras(2, 32, 32)  # so small that a step in the interpreter takes only seconds
    losses = {}
    for name in ("cpu", "triton"):
        stylizer = Stylizer.planned(wall(), views, style(), settings, weights=tiny_weights, rasterizer=name)
        assert stylizer.job.views.rasterizer.name == stylizer.job.plan.rasterizer == name
        losses[name] = [stylizer.run_step().loss for _ in range(3)]
    assert losses["triton"] == pytest.approx(losses["cpu"], rel=1e-4)


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
    for kernel, most in (("render", 21), ("slot_gradients", 23), ("survey", 19), ("count_pieces", 24)):
        assert compiled[kernel]["sm_90"]["warps"] >= 20, kernel
        assert compiled[kernel]["sm_90"]["pixel_instructions"] <= most, kernel
