"""Tests of the choice of a time budget, with given costs."""

from __future__ import annotations

from itertools import pairwise

import pytest

from sgsst_core.planning.time_budget import TimeChoice, ViewCost, choosable, choose, pixels_of, seconds_left
from sgsst_core.scene.camera import resized
from sgsst_core.settings import Settings, make_settings
from tests.small_scenes import cameras

#: 97 views of 1280 pixels, and a cost in proportion to the pixels: 0.1 s per step at 160 pixels.
VIEWS = [resized(cameras(1)[0], 1280)] * 97
COST = ViewCost(pixels_of(VIEWS, 160, make_settings())[0], 0.1, 0.05, 0.01)


def chosen(seconds: float, settings: Settings | None = None) -> TimeChoice:
    return choose(VIEWS, settings or make_settings(within=seconds), COST, seconds, 2.0)


def test_more_time_never_brings_less() -> None:
    choices = [chosen(2.0**power) for power in range(16)]
    for less, more in pairwise(choices):
        steps, more_steps = (each.steps_coarse + each.steps_sos for each in (less, more))
        assert (less.resolution, steps) <= (more.resolution, more_steps)
        assert more_steps >= steps or more.resolution > less.resolution
        assert more.seconds <= 2.0 * 2.0**15
    assert choices[0].resolution == 96
    assert (choices[-1].resolution, choices[-1].steps_sos) == (1280, 240)
    assert "; in " not in choices[-1].decision(2.0**15, 240).reason


@pytest.mark.parametrize("seconds", [20, 60, 300, 1200])
def test_choice_fits_the_budget_and_nearly_uses_it(seconds: float) -> None:
    choice = chosen(seconds)
    assert 0.7 * seconds < choice.seconds <= seconds


def test_resolution_falls_before_steps_do_and_then_again() -> None:
    whole, fewer, small = chosen(300), chosen(70), chosen(20)
    assert whole.resolution > 256
    assert (whole.steps_coarse, whole.steps_sos) == (0, 240)
    assert fewer.resolution == 256
    assert 0.2 * 240 - 2 <= fewer.steps_coarse + fewer.steps_sos < 240
    assert small.resolution < 256
    assert small.steps_sos >= 0.2 * 240 - 1 or small.resolution == 96
    assert "; in 20 min 00 s: " in whole.decision(300, 240).reason


def test_what_more_time_brings_is_more_than_the_steps_after_their_correction() -> None:
    choice = chosen(20)
    more = f"; in 1 min 20 s: {choice.longer_resolution} px"
    assert choice.decision(20, choice.steps_sos).reason.endswith(f"{more}, {choice.longer_steps} steps")
    assert choice.decision(20, choice.longer_steps).reason.endswith(more)
    assert "; in " not in choice.decision(None, choice.steps_sos).reason


def test_steps_of_more_time_leave_out_a_phase_on_the_only_scale() -> None:
    choice = chosen(20, make_settings("preview", within=20))
    assert choice.longer_resolution < 511
    assert choice.longer_steps == 60


def test_budget_that_nothing_fits_is_said_to_be_exceeded() -> None:
    assert "more than the 1 s given" in chosen(1).decision(1, 1).reason
    assert "more than" not in chosen(20).decision(20, 1).reason


def test_given_options_stay() -> None:
    settings = make_settings(within=20, steps_sos=150, max_resolution=1280)
    assert settings.fixed == ("max_resolution", "steps_sos")
    assert not choosable(settings)
    settings = make_settings(within=20, steps_sos=150)
    choice = chosen(20, settings)
    assert choice.steps_sos == 150
    assert choice.resolution < 256
    settings = make_settings(within=60, max_resolution=1280)
    assert chosen(60, settings).resolution == 1280
    every = make_settings(within=5).model_copy(update={"fixed": ("views",)})
    assert len(chosen(5, every).views) == 97
    assert len(chosen(5).views) == chosen(5).steps_sos < 97


def test_settings_take_the_choice_and_a_higher_last_learning_rate() -> None:
    settings, choice = make_settings(within=10), TimeChoice(256, (0,), 50, 100, 9.0)
    applied = choice.applied(settings)
    assert (applied.max_resolution, applied.steps_coarse, applied.steps_sos) == (256, 50, 100)
    assert settings.learning_rate_end < applied.learning_rate_end < settings.learning_rate
    given = make_settings(within=10, learning_rate=0.1)
    assert choice.applied(given).learning_rate_end == 0.1


def test_steps_are_corrected_by_what_they_really_take() -> None:
    choice, settings = TimeChoice(256, (0,), 50, 100, 9.0), make_settings(within=100, measure=0.0)
    slower = choice.corrected(settings, 160.0, 10.0, 99.0)
    assert (slower.steps_coarse, slower.steps_sos) == (0, 120)
    faster = choice.corrected(settings, 40.0, 10.0, 99.0)
    assert (faster.steps_coarse, faster.steps_sos) == (0, 240)
    hopeless = choice.corrected(settings, 1e6, 10.0, 5.0)
    assert (hopeless.steps_coarse, hopeless.steps_sos) == (0, 1)


def test_cost_is_in_proportion_to_pixels() -> None:
    assert ViewCost(10_000, 0.1, 0.05, 0.01).at(40_000, 2) == ViewCost(40_000, 0.4, 0.2, 0.04, 2)


def test_budget_counts_from_the_given_start(monkeypatch: pytest.MonkeyPatch) -> None:
    now = [1000.0]
    monkeypatch.setattr("time.time", lambda: 5e9 + now[0])
    monkeypatch.setattr("time.monotonic", lambda: now[0])
    assert seconds_left(None) is None
    left = seconds_left(60.0, 5e9 + 980.0)
    assert left is not None
    assert left() == 40.0
    now[0] += 50
    assert left() == -10.0
