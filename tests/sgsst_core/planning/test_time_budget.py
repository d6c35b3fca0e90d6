"""Tests of the choice of a time budget at a given pace, and of repeating what a job made of it."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from sgsst_core.devices import seconds_left
from sgsst_core.features.network_weights import BackboneWeights
from sgsst_core.planning.facts import evaluated_pixels
from sgsst_core.planning.time_budget import Pace, TimeChoice, choosable, choose
from sgsst_core.report.document import repeating_options
from sgsst_core.scene.camera import resized, spread
from sgsst_core.settings import PresetName, Settings, make_settings
from sgsst_core.stylizing.loop import Callbacks, run
from sgsst_core.stylizing.stylizer import Stylizer
from tests.small_scenes import cameras, style, wall

#: 97 views of 1280 pixels, and a pace of 0.1 s per step at 160 pixels.
VIEWS = [resized(cameras(1)[0], 1280)] * 97
PACE = Pace(evaluated_pixels([resized(VIEWS[0], 160)], make_settings())[0] / 0.08, 0.01, 160 * 120)


def chosen(seconds: float, settings: Settings | None = None) -> TimeChoice:
    return choose(VIEWS, settings or make_settings(within=seconds), PACE, seconds, 100)


def test_more_time_never_brings_less() -> None:
    choices = [chosen(2.0**power) for power in range(16)]
    for less, more in pairwise(choices):
        steps, more_steps = (each.steps_coarse + each.steps_sos for each in (less, more))
        assert (less.resolution, steps) <= (more.resolution, more_steps)
        assert more_steps >= steps or more.resolution > less.resolution
    assert choices[0].resolution == 96
    assert (choices[-1].resolution, choices[-1].steps_sos) == (1280, 240)
    assert "; in " not in choices[-1].decision(2.0**15, 240).reason


@pytest.mark.parametrize("seconds", [20, 60, 300])
def test_choice_fits_the_budget_and_nearly_uses_it(seconds: float) -> None:
    choice = chosen(seconds)
    assert 0.8 * seconds < choice.seconds <= seconds


def test_resolution_falls_before_steps_do_and_then_again() -> None:
    whole, fewer, small = chosen(300), chosen(34), chosen(10)
    assert whole.resolution > 256
    assert (whole.steps_coarse, whole.steps_sos) == (0, 240)
    assert fewer.resolution == 256
    assert 0.2 * 240 - 2 <= fewer.steps_coarse + fewer.steps_sos < 240
    assert small.resolution < 256
    assert small.steps_sos >= 0.2 * 240 - 1 or small.resolution == 96
    assert "; in 20 min 00 s: " in whole.decision(300, 240).reason


def test_what_more_time_brings_is_more_than_the_steps() -> None:
    choice = chosen(12)
    more = f"; in 48 s: {choice.longer_resolution} px"
    assert choice.decision(12, choice.longer_steps - 1).reason.endswith(f"{more}, {choice.longer_steps} steps")
    assert choice.decision(12, choice.longer_steps).reason.endswith(more)
    assert "; in " not in choice.decision(None, choice.steps_sos).reason
    preview = chosen(10, make_settings("preview", within=10))
    assert (preview.longer_resolution < 511, preview.longer_steps) == (True, 60), "there is one scale, so one phase"


def test_budget_that_nothing_fits_is_said_to_be_exceeded() -> None:
    assert "more than the 1 s given" in chosen(1).decision(1, 1).reason
    assert "more than" not in chosen(20).decision(20, 1).reason


def test_given_options_stay() -> None:
    settings = make_settings(within=20, steps_sos=150, max_resolution=1280)
    assert settings.fixed == ("max_resolution", "steps_sos")
    assert not choosable(settings)
    choice = chosen(10, make_settings(within=10, steps_sos=150))
    assert (choice.steps_sos, choice.most_steps) == (150, None)
    assert choice.resolution < 256
    assert chosen(60, make_settings(within=60, max_resolution=1280)).resolution == 1280
    every = make_settings(within=5).model_copy(update={"fixed": ("views",)})
    assert len(chosen(5, every).views) == 97
    assert len(chosen(5).views) == chosen(5).steps_sos < 97


@pytest.mark.parametrize(
    ("values", "most"),
    [({}, 240), ({"learning_rate": 0.1}, 240), ({"learning_rate_end": 0.01}, None), ({"steps_sos": 240}, None)],
)
def test_pace_decides_the_steps_unless_they_or_a_falling_learning_rate_are_given(
    values: dict[str, Any], most: int | None
) -> None:
    assert chosen(20, make_settings(within=20, **values)).most_steps == most


@pytest.mark.parametrize("preset", ["preview", "standard", "paper"])
@pytest.mark.parametrize("total", [3, 109, 240, 777])
def test_learning_rate_of_a_step_does_not_depend_on_the_number_of_steps(preset: PresetName, total: int) -> None:
    whole = make_settings(preset)
    before = whole.steps_coarse + whole.steps_sos
    twice = whole.with_steps(1, total).with_steps(0, total)
    for settings in (whole.with_steps(0, total), twice):
        for step in range(0, min(total, before), 7):
            rates = whole.learning_rate_at(step / (before - 1)), settings.learning_rate_at(step / (total - 1))
            assert np.float32(rates[0]) == np.float32(rates[1])
    given = make_settings(preset, learning_rate_end=0.01)
    assert given.with_steps(0, total).learning_rate_end == 0.01


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


@pytest.mark.usefixtures("one_thread")
@pytest.mark.parametrize(("preset", "enough"), [("preview", 3), ("preview", 4), ("preview", 8), ("standard", 9)])
def test_printed_options_repeat_a_steered_job_bit_for_bit(
    tiny_weights: BackboneWeights, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, preset: PresetName, enough: int
) -> None:
    """There is time for more steps than the five that were chosen, until there have been enough of them."""
    monkeypatch.setenv("SGSST_CACHE", str(tmp_path))
    scene, views, settings = wall(10, 8), cameras(4, 32, 24), make_settings(preset, within=1e6, early_stop=False)
    steered = Stylizer.planned(scene, views, style(), settings, weights=tiny_weights, left=lambda: 1e6)
    steered.job = replace(steered.job, settings=steered.job.settings.with_steps(0, 5))
    assert run(steered, Callbacks(left=lambda: 1e6 if steered.step < enough else 0.0)) == "within"
    assert steered.step == enough
    assert (steered.job.total_steps == enough) == (enough in (4, 9)), "steered to what has been done"
    options = repeating_options(steered)
    assert options is not None
    words = options.split()
    given = {name[2:].replace("-", "_"): value for name, value in zip(words[::2], words[1::2], strict=True)}
    some = spread(views, int(given.pop("views")))
    own: dict[str, Any] = {"early_stop": False, **{name: int(value) for name, value in given.items()}}
    again = Stylizer.planned(scene, some, style(), make_settings(preset, **own), weights=tiny_weights)
    assert repeating_options(again) is None
    assert run(again) == "finished"
    assert again.step == enough
    assert torch.equal(again.stylized(), steered.stylized())
