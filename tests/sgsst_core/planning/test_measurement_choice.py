"""Tests of the choice of quality measurements between the steps."""

from __future__ import annotations

import itertools
from dataclasses import replace

import pytest

from sgsst_core.planning.measurement_choice import (
    LEVELS,
    NOTHING,
    Prices,
    allowed_seconds,
    choose_level,
    choose_loss_views,
    novel_view_seconds,
)
from sgsst_core.planning.plan import Prediction
from sgsst_core.settings import make_settings


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
    costs = [17.25, 12.75, 6.75, 5.5, 3.0, 2.25, 0.0]
    assert [prices.of(level, len(level.moments(300))) for level in LEVELS] == costs
    for level, cost in enumerate(costs):
        assert choose_level(prices, cost, 300) == level
        assert choose_level(prices, cost - 0.01, 300) == min(level + 1, NOTHING)
    assert choose_level(prices, 1e9, 300, first=3) == 3  # the plan's level is the minimum


def test_measuring_may_take_its_fraction_of_the_steps_or_half_of_short_ones() -> None:
    for seconds, allowed in ((0.0, 5.0), (5.0, 5.0), (20.0, 10.0), (60.0, 30.0), (300.0, 30.0), (1000.0, 100.0)):
        assert allowed_seconds(make_settings(), seconds) == allowed
    steps = Prediction(1.0, 1.0, 0, losses=3.0, measuring=50.0, job=1050.0)
    assert novel_view_seconds(make_settings(measure=0.1), steps) == 80.0 - 3.0
    assert novel_view_seconds(make_settings(measure=0.001), steps) == 0.8 * 30.0 - 3.0
    assert novel_view_seconds(make_settings(measure=0.001), replace(steps, losses=32.0)) == 0.0
    assert novel_view_seconds(make_settings(measure=0.0), steps) == 0.0


def test_loss_gets_half_of_the_allowed_time_and_at_least_one_view() -> None:
    for steps, price, views in ((60.0, 3.0, 4), (60.0, 3.01, 2), (60.0, 6.0, 2), (60.0, 6.01, 1), (0.0, 1e9, 1)):
        assert choose_loss_views(make_settings(measure=0.1), steps, price, 97) == views
    assert choose_loss_views(make_settings(measure=0.1), 3000.0, 6.01, 97) == 4
    assert choose_loss_views(make_settings(measure=0.1), 60.0, 4.0, 3) == 3  # there are only three views
    assert choose_loss_views(make_settings(measure=0.0), 3000.0, 3.0, 97) == 4
