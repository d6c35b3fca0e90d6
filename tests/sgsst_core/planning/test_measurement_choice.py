"""Tests of planned quality measurements: how many of them a plan leaves out, and how it explains that."""

from __future__ import annotations

import itertools
import re
from dataclasses import replace
from typing import Any

import pytest

from sgsst_core.number_format import duration
from sgsst_core.planning.decide import decide
from sgsst_core.planning.facts import RasterCost
from sgsst_core.planning.measurement_choice import (
    LEAST_ALLOWED,
    LEVELS,
    NOTHING,
    Prices,
    choose_level,
    choose_loss_views,
    novel_view_seconds,
)
from sgsst_core.planning.plan import Plan, Prediction
from sgsst_core.settings import make_settings
from tests.sgsst_core.planning.test_decide import probe, text_of

#: Cost for 4 million Gaussians: every first visit of a view takes long.
SLOW = RasterCost(2.0, 1.0, 10**9, 10**9 // 2, first_seconds=5.0)
VERY_SLOW = RasterCost(100.0, first_seconds=200.0)


def plan_of(raster: RasterCost, **values: Any) -> Plan:
    settings = make_settings(**{"steps_coarse": 8, "steps_sos": 16, "position_weights": "off", **values})
    return decide(probe(raster=raster), settings, measured=True)


def expected(plan: Plan) -> Prediction:
    assert plan.prediction is not None
    return plan.prediction


@pytest.mark.parametrize("total", [1, 2, 3, 24, 300, 20_000])
def test_levels_measure_the_end_and_decrease_in_cost(total: int) -> None:
    prices = Prices(3.0, 0.5, 0.25)
    costs = [prices.of(level, len(level.moments(total))) for level in LEVELS]
    assert all(level.moments(total)[-1] == total for level in LEVELS[:NOTHING])
    assert LEVELS[NOTHING].moments(total) == []
    assert costs[NOTHING] == 0
    assert costs == sorted(costs, reverse=True)
    for richer, poorer in itertools.pairwise(LEVELS):
        assert set(poorer.moments(total)) <= set(richer.moments(total))
        assert poorer.views <= richer.views


def test_first_allowed_level_is_chosen() -> None:
    """Over 300 steps, a view costs 1 s to prepare and 0.5 s per moment and for the judgment, and a moment 0.25 s."""
    prices = Prices(1.0, 0.5, 0.25)
    costs = [21.75, 15.0, 8.0, 5.5, 3.0, 2.25, 0.0]
    assert [prices.of(level, len(level.moments(300))) for level in LEVELS] == costs
    for level, cost in enumerate(costs):
        assert choose_level(prices, cost, 300) == level
        assert choose_level(prices, cost - 0.01, 300) == min(level + 1, NOTHING)
    assert choose_level(prices, 1e9, 300, first=3) == 3  # the plan's level is the minimum


def test_measuring_may_take_half_a_minute_or_its_fraction_of_the_steps() -> None:
    steps = Prediction(1.0, 1.0, 0, losses=3.0, measuring=50.0, job=1050.0)
    assert novel_view_seconds(0.1, steps) == 80.0 - 3.0
    assert novel_view_seconds(0.001, steps) == 0.8 * LEAST_ALLOWED - 3.0
    assert novel_view_seconds(0.001, replace(steps, losses=32.0)) == 0.0
    assert novel_view_seconds(0.0, steps) == 0.0


def test_loss_gets_half_of_the_allowed_time_and_at_least_one_view() -> None:
    for steps, price, views in ((0.0, 3.0, 4), (0.0, 3.01, 2), (0.0, 6.0, 2), (0.0, 6.01, 1), (0.0, 1e9, 1)):
        assert choose_loss_views(0.1, steps, price, 97) == views
    assert choose_loss_views(0.1, 3000.0, 6.01, 97) == 4
    assert choose_loss_views(0.1, 0.0, 4.0, 3) == 3  # there are only three views
    assert choose_loss_views(0.0, 3000.0, 3.0, 97) == 4


def test_target_loss_fixes_the_loss_views_regardless_of_timings() -> None:
    assert plan_of(VERY_SLOW, steps_sos=4).loss_views == 1
    assert plan_of(VERY_SLOW, steps_sos=4, target_loss=0.1).loss_views == 4


def test_unvisited_views_make_the_loss_more_expensive() -> None:
    """Two steps visit two of four views."""
    all_, half = (expected(plan_of(RasterCost(0.1, first_seconds=0.4), steps_sos=steps)) for steps in (4, 2))
    assert all_.losses == all_.evaluation
    assert half.losses == pytest.approx(half.evaluation + 4 * half.first_visit / 2)


def test_planned_measuring_stays_within_the_allowed_time() -> None:
    for steps in (16, 200, 2000, 20_000):
        plan = plan_of(SLOW, steps_sos=steps)
        prediction = expected(plan)
        allowed = max(LEAST_ALLOWED, 0.1 * (prediction.job - prediction.measuring))
        assert prediction.measuring <= allowed
        text = text_of(plan, "measuring")
        assert f"{duration(prediction.measuring, ' ')} in addition to" in text
        assert not re.search(r"\de[+-]\d|\d{4} s", text), "seconds are given in minutes or hours where they are many"
    assert [plan_of(SLOW, steps_sos=steps).measuring for steps in (16, 20_000)] == [NOTHING, 0]
    assert text_of(plan_of(SLOW), "measuring").startswith("the initial loss on 4 views only: about ")
    least = expected(plan_of(VERY_SLOW, steps_sos=4))
    assert least.measuring == least.losses > LEAST_ALLOWED
    assert "at 7 moments up to 4 novel views" in text_of(plan_of(RasterCost(0.01), steps_sos=300), "measuring")


def test_zero_fraction_measures_no_novel_views() -> None:
    plan = plan_of(SLOW, measure=0.0)
    assert text_of(plan, "measuring").startswith("the initial loss on 4 views only: requested")
    assert expected(plan).measuring == expected(plan).losses == expected(plan).evaluation > 0


def test_job_time_adds_steps_first_visits_and_measuring() -> None:
    """All four views are visited in each phase.

    The first visits compute cached weights and use the survey's intersections.
    """
    prediction = expected(plan_of(SLOW))
    steps = 8 * prediction.seconds_coarse + 16 * prediction.seconds + prediction.style
    assert prediction.job == pytest.approx(
        steps + 4 * (prediction.first_visit_coarse + prediction.first_visit) + prediction.measuring
    )
    restricted = 0.25 * SLOW.first_seconds
    assert prediction.first_visit_coarse > restricted + SLOW.seconds
    assert 0 < prediction.first_visit < prediction.first_visit_coarse
    alone = expected(plan_of(SLOW, steps_coarse=0))
    assert alone.first_visit == pytest.approx(restricted + prediction.first_visit)
    limited = expected(plan_of(SLOW, max_seconds=5.0))
    assert limited.job - limited.measuring == pytest.approx(5.0)


def test_iteration_time_is_proportional_to_its_views() -> None:
    one, three = (expected(plan_of(SLOW, views_per_step=views)) for views in (1, 3))
    assert (three.seconds, three.seconds_coarse) == pytest.approx((3 * one.seconds, 3 * one.seconds_coarse))
