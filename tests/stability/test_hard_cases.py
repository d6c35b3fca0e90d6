"""Tests of the hard cases of `make stability` on CPUs: their small versions stay within their bounds."""

import math
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from benchmarks.stability import (
    Case,
    CaseResult,
    all_cases,
    case,
    format_cases,
    gaussian_cases,
    image_cases,
    job_cases,
    optimization_cases,
    precision_cases,
    search,
    view_cases,
)
from benchmarks.stability.case import FLOAT32, PRECISIONS, camera, small_network, texture
from benchmarks.stability.figure import compute_images, write_figure
from sgsst_core.errors import DivergedError
from sgsst_core.features.vgg import FeatureNetwork
from sgsst_core.rasterizer.cpu import project
from tests.sgsst_core.rasterizer.splat_reference import splat
from tests.stability.hard_cases import check, parameters

pytestmark = pytest.mark.usefixtures("one_thread", "vgg16_weights")

MODULES = (format_cases, gaussian_cases, image_cases, job_cases, precision_cases, search, view_cases)
#: Cases of the optimizer take up to ten seconds each; the first one here is fast.
OPTIMIZATION = sorted(optimization_cases.cases(), key=lambda case: case.name != "stopped and resumed in the middle")
CASES = [*(case for module in MODULES for case in parameters(module.cases())), *parameters(OPTIMIZATION)]


@pytest.mark.parametrize("hard_case", CASES, ids=lambda hard_case: f"{hard_case.name}, {hard_case.way}")
def test_stays_within_its_bound(hard_case: Case) -> None:
    check(hard_case)


def test_each_case_has_a_name_of_its_own() -> None:
    names = [(case.name, case.way) for case in all_cases()]
    assert len(names) == len(set(names))
    assert {way for _, way in names} == {way.name for way in (*job_cases.WAYS, job_cases.RANKS)}


def test_precisions_round_as_much_as_they_say() -> None:
    """The network really computes in each precision: its features differ from float64's by about that many bits."""
    weights, image = small_network(64), texture(32, 40, 1)
    exact = FeatureNetwork(weights, dtype=torch.float64).forward(image, cache=False).features["relu3_1"]
    for way in PRECISIONS:
        network = way.network(weights)
        assert network.precision == way.precision
        actual = network.forward(image, cache=False).features["relu3_1"].double() * network.feature_unit
        error = float((actual - exact).norm() / exact.norm())
        assert 2.0 ** -(way.bits + 6) < error < 2.0 ** -(way.bits - 2), way.name


def test_search_reports_violated_bounds_and_unexpected_errors(monkeypatch: pytest.MonkeyPatch) -> None:
    settings = {"steps_coarse": 0, "steps_sos": 1, "content_weight": 0}  # content has a bound of its own
    situation = job_cases.Situation(job_cases.crowd(20), texture(30, 26, 1), settings)
    assert search.outcome(situation, FLOAT32) == ("within its bounds", None)
    with monkeypatch.context() as context:
        context.setattr(job_cases, "REFERENCE_BOUND", 0.0)
        context.setattr(case, "SAFETY", 0.0)
        how, problem = search.outcome(situation, FLOAT32)
    assert how == "broken"
    assert "bound 0" in str(problem)
    how, problem = search.outcome(replace(situation, scene=None), FLOAT32)  # type: ignore[arg-type]
    assert how == "broken"
    assert "Error" in str(problem)


@pytest.mark.slow
def test_figure_shows_where_published_formulas_fail(tmp_path: Path) -> None:
    """The results here are finite, and differ visibly from the published ones."""
    images = compute_images()
    for name, (_, published, ours) in images.items():
        assert bool(torch.isfinite(ours).all()), name
        off = (published - ours).abs().clamp(max=1).nan_to_num(1)
        assert float((off > 0.02).double().mean()) > 0.02, name
    path = tmp_path / "stability.jpg"
    write_figure(path, images)
    assert path.stat().st_size < 300_000


def test_non_finite_errors_do_not_pass() -> None:
    assert CaseResult(1e-6, 1e-6).passed
    for error in (math.nan, math.inf, 2e-6):
        assert not CaseResult(error, 1e-6).passed


def test_opacity_cutoff_is_exact_to_one_ulp() -> None:
    """The fast projection and the reference both skip an opacity one ulp below 1/255, and draw one an ulp above."""
    scene = gaussian_cases._opacities_at_the_cutoff()
    for index, visible in ((0, 0), (2, 1), (3, 1)):
        one = scene.subset(torch.tensor([index]))
        assert len(project(one, camera()).gaussians) == visible
        assert len(splat(one, camera()).gaussians) == visible


def test_barely_visible_gaussians_move_as_fast_as_others() -> None:
    """Adam's steps do not depend on the magnitude of the gradient, which is why such colors diverge."""
    walls = optimization_cases._walls((2.0, 5), (3.0, 1), (2.0, 5), (1.0, 5))
    stylizer = optimization_cases._stylizer(walls, 3, learning_rate=0.05, bounded=False)
    weights = stylizer.job.plan.survey.total_blend_weights[stylizer.job.plan.seen]
    before = stylizer.sh_dc.detach().clone()
    stylizer.run_step()
    change = (stylizer.sh_dc.detach() - before).abs().amax(1)
    assert float(weights.min()) < 1e-2 < 1 < float(weights.max())
    assert change[weights < 1e-2].tolist() == pytest.approx([0.05] * int((weights < 1e-2).sum()), rel=1e-3)


def test_diverged_step_gives_advice_and_leaves_colors_unchanged() -> None:
    stylizer = optimization_cases._stylizer(optimization_cases._walls((2.0, 5)), 3)
    with torch.no_grad():
        stylizer.sh_dc.copy_(stylizer.sh_dc.abs() * 1e8)
    before = stylizer.state()
    with pytest.raises(DivergedError, match=r"Step 1: the color gradient has grown to .* --learning-rate than 0.2,"):
        stylizer.run_step()
    assert torch.equal(stylizer.sh_dc.detach(), before.sh_dc)
    assert stylizer.step == 0


def test_one_pass_variance_fails_on_a_hard_case() -> None:
    """Show that the case is hard: the usual one-pass formula gives NaN where ours stays within its bound."""
    result = image_cases._ratio(4, False)
    assert result.passed
    assert int(result.note.split("NaN in ")[1].split()[0]) > 0


def test_too_many_intersections_error_names_view_and_remedy() -> None:
    result = next(case for case in view_cases.cases() if "2^31" in case.name).run(False)
    for expected in ("'hard case' (16384x16384)", "2,202,009,600 times", "lower resolution"):
        assert expected in result.note
