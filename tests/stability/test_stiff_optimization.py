"""Tests of hard cases of the optimizer: gradients of all magnitudes, too large or too many steps, resuming."""

from __future__ import annotations

import pytest
import torch

from benchmarks.stability import Case
from benchmarks.stability import optimization_cases as optimization
from sgsst_core.errors import DivergedError
from tests.stability.hard_cases import check

pytestmark = pytest.mark.usefixtures("one_thread", "vgg16_weights")


#: Cases that the fast tests run; the others take up to ten seconds each.
FAST = ("stopped and resumed in the middle",)
CASES = [
    pytest.param(case, id=case.name, marks=[] if case.name in FAST else [pytest.mark.slow])
    for case in optimization.cases()
]


@pytest.mark.parametrize("case", CASES)
def test_stays_within_its_bound(case: Case) -> None:
    check(case)


def test_barely_visible_gaussians_move_as_fast_as_others() -> None:
    """Adam's steps do not depend on the magnitude of the gradient, which is why such colors diverge."""
    stylizer = optimization._stylizer(
        optimization._walls((2.0, 5), (3.0, 1), (2.0, 5), (1.0, 5)), 3, learning_rate=0.05, bounded=False
    )
    weights = stylizer.job.plan.survey.total_blend_weights[stylizer.job.plan.seen]
    before = stylizer.sh_dc.detach().clone()
    stylizer.run_step()
    change = (stylizer.sh_dc.detach() - before).abs().amax(1)
    assert float(weights.min()) < 1e-2 < 1 < float(weights.max())
    assert change[weights < 1e-2].tolist() == pytest.approx([0.05] * int((weights < 1e-2).sum()), rel=1e-3)


def test_diverged_step_gives_advice_and_leaves_colors_unchanged() -> None:
    stylizer = optimization._stylizer(optimization._walls((2.0, 5)), 3)
    with torch.no_grad():
        stylizer.sh_dc.copy_(stylizer.sh_dc.abs() * 1e8)
    before = stylizer.state()
    with pytest.raises(DivergedError, match=r"Step 1: the color gradient has grown to .* --learning-rate than 0.2,"):
        stylizer.run_step()
    assert torch.equal(stylizer.sh_dc.detach(), before.sh_dc)
    assert stylizer.step == 0
