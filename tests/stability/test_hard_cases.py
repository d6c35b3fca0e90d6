"""Tests of the hard cases of `make stability` on CPUs: their small versions stay within their bounds."""

from __future__ import annotations

import math

import pytest
import torch

from benchmarks.stability import (
    Case,
    CaseResult,
    format_cases,
    gaussian_cases,
    image_cases,
    job_cases,
    optimization_cases,
    precision_cases,
    view_cases,
)
from benchmarks.stability.case import camera
from sgsst_core.errors import DivergedError
from sgsst_core.rasterizer.projection import project
from sgsst_core.rasterizer.reference import splat
from tests.stability.hard_cases import check, parameters

pytestmark = pytest.mark.usefixtures("one_thread", "vgg16_weights")

MODULES = (format_cases, gaussian_cases, image_cases, job_cases, precision_cases, view_cases)
#: Cases of the optimizer take up to ten seconds each; the first one here is fast.
OPTIMIZATION = sorted(optimization_cases.cases(), key=lambda case: case.name != "stopped and resumed in the middle")
CASES = [
    *(case for module in MODULES for case in parameters(module.cases())),
    OPTIMIZATION[0],
    *(pytest.param(case, marks=pytest.mark.slow) for case in OPTIMIZATION[1:]),
]


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.name)
def test_stays_within_its_bound(case: Case) -> None:
    check(case)


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


def test_gaussians_without_projection_are_dropped() -> None:
    scene = gaussian_cases._scales()
    assert len(project(scene, camera()).gaussians) == len(scene) - 3 == 5


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
