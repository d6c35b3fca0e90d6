"""Tests of whole jobs with scale weights."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest
import torch

from sgsst_core.errors import SettingsError
from sgsst_core.features.network_weights import BackboneWeights
from sgsst_core.quality.measure import Float32Reference, Measurements
from sgsst_core.settings import make_settings
from sgsst_core.stylizing.loop import run
from sgsst_core.stylizing.steps import mean_loss
from sgsst_core.stylizing.stylizer import Stylizer
from tests.small_scenes import cameras, style, wall

pytestmark = pytest.mark.usefixtures("one_thread")


def make(weights: BackboneWeights, steps_coarse: int = 2, **values: Any) -> Stylizer:
    settings = make_settings(
        **({"steps_coarse": steps_coarse, "steps_sos": 3, "coarsest_side": 16, "scale_sampling": 1} | values)
    )
    return Stylizer.planned(wall(), cameras(), style(), settings, weights=weights)


def line(stylizer: Stylizer, item: str) -> str:
    return next((each.decision for each in stylizer.job.plan.decisions if each.item == item), "")


def test_phase_1_uses_the_coarsest_weighted_scale(tiny_weights: BackboneWeights) -> None:
    stylizer = make(tiny_weights, scales=(1.0, 0.5))
    run(stylizer)
    assert [sorted(record.terms) for record in stylizer.history] == [[1], [1], [0, 1], [0, 1], [0, 1]]
    record = stylizer.history[-1]
    assert record.loss == pytest.approx((record.terms[0].total + 0.5 * record.terms[1].total) / 1.5)
    assert line(stylizer, "weights of scales") == "scale 0 1, scale 1 0.5; 1 of 3 scales are not computed"


def test_evaluated_loss_covers_the_weighted_scales(tiny_weights: BackboneWeights) -> None:
    stylizer = make(tiny_weights, scales=(1.0, 0.0, 0.5), warm_start=False)
    evaluation = stylizer.evaluate([0, 1])
    assert sorted(evaluation) == [0, 2]
    weights = stylizer.job.loss.weights
    assert mean_loss(evaluation, weights) == pytest.approx((evaluation[0].total + 0.5 * evaluation[2].total) / 1.5)
    reference = Float32Reference(stylizer).evaluate([0, 1], stylizer.job.scene.sh_dc)
    assert mean_loss(reference, weights) == pytest.approx(mean_loss(evaluation, weights), rel=1e-5)
    run(stylizer)
    stylizer.job = replace(stylizer.job, plan=replace(stylizer.job.plan, novel_views=1))
    Measurements(stylizer).at_the_end()
    assert set(map(int, stylizer.measured[-1]["novel_views"]["gram"])) == {0, 2}


def test_single_scale_skips_phase_1(tiny_weights: BackboneWeights) -> None:
    stylizer = make(tiny_weights, scales=(0.0, 1.0))
    assert stylizer.job.plan.steps_coarse == 0
    assert "skipped" in line(stylizer, "phase 1")
    record = stylizer.run_step()
    assert list(record.terms) == [1]


def test_equal_weights_are_bit_identical_to_none(tiny_weights: BackboneWeights) -> None:
    jobs = [make(tiny_weights), make(tiny_weights, scales=(1.0, 1.0, 1.0))]
    for job in jobs:
        run(job)
    assert torch.equal(jobs[0].stylized(), jobs[1].stylized())


def test_plan_counts_only_computed_scales(tiny_weights: BackboneWeights) -> None:
    whole, coarse = make(tiny_weights, steps_coarse=0), make(tiny_weights, steps_coarse=0, scales=(0.0, 0.0, 1.0))
    assert whole.job.plan.work.sos == (16 + 4 + 1) * coarse.job.plan.work.sos


def test_missing_scales_are_refused_before_the_survey(tiny_weights: BackboneWeights) -> None:
    with pytest.raises(SettingsError, match="the views have 3 scales"):
        make(tiny_weights, scales=(1.0, 0.0, 0.0, 1.0))


def test_drawn_scales_are_the_same_after_a_resume_and_losses_cover_all(tiny_weights: BackboneWeights) -> None:
    """Each of three views shows the finer scales once in two and four visits."""
    values = {"steps_coarse": 0, "steps_sos": 12, "scale_sampling": 2, "early_stop": False}
    whole, first, second = (make(tiny_weights, **values) for _ in range(3))
    run(whole)
    for _ in range(7):
        first.run_step()
    second.load_state(first.state())
    run(second)
    assert torch.equal(second.stylized(), whole.stylized())
    assert [record.terms for record in second.history] == [record.terms for record in whole.history]
    for view in range(3):
        visits = [len(record.evaluated) for record in whole.history if record.view == view]
        assert sorted(visits) == [1, 1, 2, 3]
    known: set[int] = set()
    for record in whole.history:
        known |= set(record.evaluated)
        assert set(record.terms) == known
        assert record.loss == pytest.approx(sum(terms.total for terms in record.terms.values()) / len(known))


def test_losses_of_scales_that_were_not_drawn_follow_the_coarsest(tiny_weights: BackboneWeights) -> None:
    stylizer = make(tiny_weights, steps_coarse=0, steps_sos=9, scale_sampling=3, scales=(1.0, 1.0))
    run(stylizer)
    ratios: dict[int, float] = {}
    for record in stylizer.history:
        if 0 in record.terms:
            ratio = record.terms[0].total / record.terms[1].total
            if record.evaluated == (0, 1):
                ratios[record.view] = ratio
            assert ratio == pytest.approx(ratios.get(record.view, ratio))
    assert len(ratios) == 3


@pytest.mark.slow
def test_runs_are_bit_identical_and_reduce_the_loss(tiny_weights: BackboneWeights) -> None:
    first, second = (make(tiny_weights, steps_sos=30, scales=(0.0, 1.0, 2.0), early_stop=False) for _ in range(2))
    start = mean_loss(first.start(), first.job.loss.weights)
    run(first)
    run(second)
    assert torch.equal(first.stylized(), second.stylized())
    assert mean_loss(first.evaluate(first.job.evaluation_views), first.job.loss.weights) < 0.5 * start
