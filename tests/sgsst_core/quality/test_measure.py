"""Tests of quality measurements: before and after the steps, and without effect on them."""

from __future__ import annotations

from typing import Any

import pytest
import torch

from sgsst_core import Stylizer, make_settings, run
from sgsst_core.features.network_weights import BackboneWeights
from sgsst_core.quality.measure import Measurements
from sgsst_core.style import Style
from sgsst_core.stylizing.loop import Callbacks
from sgsst_core.stylizing.planner import plan_job
from tests.small_scenes import cameras, style, wall

pytestmark = pytest.mark.usefixtures("one_thread")
STEPS = 8


def make(weights: BackboneWeights, measure: float = 0.75, **values: Any) -> Stylizer:
    settings = make_settings(steps_sos=STEPS, steps_coarse=0, measure=measure, precision="float32", **values)
    return Stylizer(plan_job(wall(), cameras(5), Style.of(style()), settings, weights=weights, measured=True))


def measured(stylizer: Stylizer, stop: Any = None) -> list[int]:
    """Run a job, measure it at its end, and return the numbers of steps in the entries."""
    run(stylizer, Callbacks(stop=stop))
    assert stylizer.measured == [], "nothing is measured between steps"
    Measurements(stylizer).at_the_end()
    return [entry["step"] for entry in stylizer.measured]


def test_start_and_end_are_measured_once_without_effect(tiny_weights: BackboneWeights) -> None:
    stylizer, nothing = make(tiny_weights), make(tiny_weights, measure=0.0)
    assert measured(nothing) == []
    assert measured(stylizer) == [0, STEPS]
    first, last = stylizer.measured
    assert len(first["novel_view_names"]) == stylizer.job.plan.novel_views == 1
    assert first["novel_views"]["gram_relative"] == 1 > last["novel_views"]["gram_relative"]
    assert all(value > 0 for value in last["novel_views"]["gram"].values())
    assert stylizer.seconds_by_part["measuring"] > 0
    assert torch.equal(nothing.stylized(), stylizer.stylized())
    Measurements(stylizer).at_the_end()
    assert len(stylizer.measured) == 2


def test_interrupted_job_is_measured_after_its_last_step(tiny_weights: BackboneWeights) -> None:
    stylizer = make(tiny_weights)
    assert measured(stylizer, lambda: stylizer.step == 3) == [0, 3]


def test_measured_views_are_shown(tiny_weights: BackboneWeights) -> None:
    stylizer, shown = make(tiny_weights, measure=1.0), list[tuple[int, int]]()
    measure = Measurements(stylizer, lambda done, total: shown.append((done, total)))
    measure.at_the_end()
    novel = stylizer.job.plan.novel_views
    assert shown == [(done, novel) for done in range(novel)] * 2
    shown.clear()
    measure.evaluate(unstylized=True)
    views = len(stylizer.job.evaluation_views)
    assert shown == [(done, views) for done in range(views)]
    assert (novel, views) == (2, 4)


@pytest.mark.parametrize("style_loss", ["nnfm", "mixed"])
def test_other_style_losses_are_measured_by_the_same_statistics(tiny_weights: BackboneWeights, style_loss: str) -> None:
    usual, other = (make(tiny_weights, style_loss=each) for each in ("sos", style_loss))
    other.run_step()
    for stylizer in (usual, other):
        Measurements(stylizer).at_the_end()
    start, same = (stylizer.measured[0]["novel_views"]["gram"] for stylizer in (other, usual))
    assert start == pytest.approx(same, rel=1e-6)
    assert all(terms["nearest"] > 0 for terms in other.history[-1].terms.values())
