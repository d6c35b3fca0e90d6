"""Tests of the number of quality measurements in a job: as planned, fewer for slow views, the same after resuming."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest
import torch

from sgsst_core import Stylizer, make_settings, run
from sgsst_core.features.network_weights import BackboneWeights
from sgsst_core.planning.measurement_choice import NOTHING
from sgsst_core.planning.plan import Prediction
from sgsst_core.quality.measure import Measurements
from sgsst_core.stylizing.loop import Callbacks
from tests.small_scenes import cameras, style, wall

pytestmark = pytest.mark.usefixtures("one_thread")
STEPS = 16
#: Prediction of steps that take hours, so that any measurement is cheap in comparison.
LONG = Prediction(1e3, 1e3, 0, job=1e6)
#: Prediction in which the loss alone takes more time than is allowed.
EXPENSIVE = Prediction(1e3, 1e3, 0, losses=1e6, job=1e6)


def make(
    weights: BackboneWeights,
    prediction: Prediction | None = LONG,
    level: int = 0,
    measure: float = 0.1,
    **values: Any,
) -> Stylizer:
    settings = make_settings(steps_sos=STEPS, steps_coarse=0, measure=measure, **values)
    stylizer = Stylizer.planned(wall(), cameras(5), style(), settings, weights=weights)
    stylizer.job = replace(stylizer.job, plan=replace(stylizer.job.plan, prediction=prediction, measuring=level))
    return stylizer


def measured(stylizer: Stylizer) -> list[int]:
    """Run a job to its end, and return the steps after which quality was measured."""
    measure = Measurements(stylizer)
    run(stylizer, Callbacks(measure=measure))
    measure.at_the_end()
    return [entry["step"] for entry in stylizer.measured]


def test_cheap_measurements_cover_all_moments(tiny_weights: BackboneWeights) -> None:
    stylizer = make(tiny_weights)
    assert measured(stylizer) == [0, 2, 4, 8, 16]
    first = stylizer.measured[0]
    assert first["level"] == 0
    assert len(first["novel_view_names"]) == 3  # first views of the pairs of four views
    assert first["again"] > 0 < first["seconds"]
    assert stylizer.seconds_by_part["measuring"] >= sum(entry["seconds"] for entry in stylizer.measured)


def test_checked_views_are_shown(tiny_weights: BackboneWeights) -> None:
    stylizer, checked = make(tiny_weights, level=NOTHING - 1), list[tuple[int, int]]()
    measure = Measurements(stylizer, lambda done, total: checked.append((done, total)))
    run(stylizer)
    measure.at_the_end()
    novel = len(stylizer.measured[0]["novel_view_names"])
    assert checked == [(done, novel) for done in range(novel)]
    checked.clear()
    measure.evaluate(unstylized=True)
    views = len(stylizer.job.evaluation_views)
    assert checked == [(done, views) for done in range(views)]


@pytest.mark.parametrize("style_loss", ["nnfm", "mixed"])
def test_other_style_losses_are_measured_by_the_same_statistics(tiny_weights: BackboneWeights, style_loss: str) -> None:
    usual, other = (make(tiny_weights, level=NOTHING - 2, style_loss=each) for each in ("sos", style_loss))
    measured(usual)
    measured(other)
    assert other.measured[0]["step"] == usual.measured[0]["step"] == 0
    start, same = (stylizer.measured[0]["novel_views"]["gram"] for stylizer in (other, usual))
    assert start == pytest.approx(same, rel=1e-6)
    assert all(terms["nearest"] > 0 for terms in other.history[-1].terms.values())


def test_expensive_measurements_are_reduced_to_start_and_end(tiny_weights: BackboneWeights) -> None:
    """No time is allowed for measurements, so only the start, which is already measured, and the end are measured."""
    stylizer = make(tiny_weights, EXPENSIVE)
    assert measured(stylizer) == [0, 16]
    assert stylizer.measured[0]["level"] == NOTHING - 1
    start, end = (entry["novel_views"]["gram_relative"] for entry in stylizer.measured)
    assert start == 1 > end
    assert len(stylizer.measured[0]["novel_view_names"]) == 1


def test_final_measurement_alone_has_no_relative_value(tiny_weights: BackboneWeights) -> None:
    stylizer = make(tiny_weights, level=NOTHING - 1)
    assert measured(stylizer) == [16]
    moment = stylizer.measured[0]["novel_views"]
    assert moment["gram_relative"] is None
    assert all(value > 0 for value in moment["gram"].values())


def test_nothing_is_measured_at_the_lowest_level(tiny_weights: BackboneWeights) -> None:
    assert measured(make(tiny_weights, level=NOTHING)) == []


def test_initial_quality_is_measured_with_the_first_moment(tiny_weights: BackboneWeights) -> None:
    """The initial quality is measured after a tenth of the steps from the initial colors, with the same result."""
    before, late = make(tiny_weights), make(tiny_weights)
    Measurements(before)(before)
    measure = Measurements(late)
    assert not measure.due(0)
    late.run_step()
    assert not measure.due(1)
    late.run_step()
    colors = late.stylized()
    assert measure.due(2)
    measure(late)
    assert torch.equal(late.stylized(), colors)
    assert [entry["step"] for entry in late.measured] == [0, 2]
    assert before.measured[0]["novel_views"] == late.measured[0]["novel_views"]


@pytest.mark.slow
def test_interrupted_job_is_measured_at_its_start_and_end(tiny_weights: BackboneWeights) -> None:
    stylizer = make(tiny_weights, level=2)  # moments 0, 4 and 16
    asked = iter([True])
    measure = Measurements(stylizer)
    run(stylizer, Callbacks(measure=measure, stop=asked.__next__))
    measure.at_the_end()
    assert [entry["step"] for entry in stylizer.measured] == [0]
    stylizer = make(tiny_weights, level=3)
    measure = Measurements(stylizer)
    asked = iter([False, False, True])
    run(stylizer, Callbacks(measure=measure, stop=asked.__next__))
    measure.at_the_end()
    assert [entry["step"] for entry in stylizer.measured] == [0, 2]


@pytest.mark.slow
def test_measuring_can_be_disabled_and_does_not_change_colors(tiny_weights: BackboneWeights) -> None:
    nothing, everything, least = (
        make(tiny_weights, measure=0.0),
        make(tiny_weights),
        make(tiny_weights, EXPENSIVE),
    )
    assert measured(nothing) == []
    measured(everything)
    measured(least)
    for other in (everything, least):
        assert torch.equal(nothing.stylized(), other.stylized())


@pytest.mark.slow
def test_resumed_job_keeps_its_moments(tiny_weights: BackboneWeights) -> None:
    """A new plan or other measured costs do not change the number of measurements that was decided initially."""
    for prediction, steps in ((LONG, [0, 2, 4, 8, 16]), (EXPENSIVE, [0, 16])):
        stopped = make(tiny_weights, prediction)
        measure = Measurements(stopped)
        asked = iter([False, False, False, True])
        run(stopped, Callbacks(measure=measure, stop=asked.__next__))
        before = list(stopped.measured)
        resumed = make(tiny_weights, LONG, level=2)
        continued = Measurements(resumed)
        resumed.load_state(stopped.state())
        assert continued.moments == measure.moments
        run(resumed, Callbacks(measure=continued))
        assert [entry["step"] for entry in resumed.measured] == steps
        assert resumed.measured[: len(before)] == before


def test_remaining_measuring_time_is_predicted(tiny_weights: BackboneWeights) -> None:
    """A moment's time is first the plan's, then the measured time of a repeated view, then the median of past moments.

    The final loss is added.
    """
    stylizer = make(tiny_weights, Prediction(1.0, 1.0, 0, losses=3.0, measuring=15.0, job=100.0))
    measure = Measurements(stylizer)
    assert measure.seconds_left(0) == 5 * 2.4 + 3.0  # 12 s of 5 moments
    assert measure.seconds_left(3, ends=True) == 2 * 2.4 + 3.0  # the start and the end
    stylizer.measured = [{"step": 0, "level": 0, "again": 1.5, "seconds": 9.0}]
    assert measure.seconds_left(0) == 4 * 1.5 + 3.0
    stylizer.measured += [{"step": step, "seconds": seconds} for step, seconds in ((2, 5.0), (3, 0.5), (4, 1.0))]
    assert measure.seconds_left(4) == 2 * 1.0 + 3.0
    assert measure.seconds_left(5, ends=True) == 1.0 + 3.0
    assert measure.seconds_left(8) == 2 * 1.0 + 3.0  # the moment of step 8 is still due
    stylizer.measured += [{"step": step, "seconds": 1.0} for step in (8, STEPS)]
    assert measure.seconds_left(STEPS) == measure.seconds_left(STEPS, ends=True) == 3.0
