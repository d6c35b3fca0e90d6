"""Tests of the predicted remaining time, on simulated jobs whose steps take known times."""

from __future__ import annotations

import random
from dataclasses import dataclass, replace

import pytest

from sgsst_core.stylizing.seconds_left import Pace, SecondsLeft

VIEWS = 12


@dataclass(frozen=True)
class ExpectedPhase:
    """Actual or predicted times of a phase."""

    stage: str
    steps: int
    seconds: float = 0.0
    first_visit: float = 0.0


def estimator_of(phases: list[ExpectedPhase], views: range, views_per_step: int = 1) -> SecondsLeft:
    paces = {phase.stage: Pace(phase.steps, phase.seconds, phase.first_visit) for phase in phases}
    return SecondsLeft(paces, views, views_per_step)


#: Actual times of the steps; their sums are exact in binary.
COARSE = ExpectedPhase("coarse", 30, 1.0, 8.0)
SOS = ExpectedPhase("sos", 60, 4.5, 2.25)


@dataclass(frozen=True)
class Estimate:
    """Predicted and actual remaining time after a step."""

    stage: str
    number: int  # counts the phase's steps in this session from 1
    left: float
    truth: float


def session(
    phases: list[ExpectedPhase], expected: list[ExpectedPhase], start: int = 0, views_per_step: int = 1, seed: int = 0
) -> list[Estimate]:
    """Simulate the steps of a job from step `start` on, in rounds over all views.

    Each view's cached data are computed at its first visit after `start`, as after resuming.
    """
    chance = random.Random(seed)
    estimator = estimator_of(expected, range(VIEWS), views_per_step)
    queue: list[int] = []
    order = [phase for phase in phases for _ in range(phase.steps)]
    visited: dict[str, set[int]] = {phase.stage: set() for phase in phases}
    prices: list[float] = []
    estimates: list[Estimate] = []
    for step, phase in enumerate(order, start=1):
        views = []
        for _ in range(views_per_step):
            queue = queue or chance.sample(range(VIEWS), VIEWS)
            views.append(queue.pop(0))
        if step <= start:  # an earlier session
            prices.append(0.0)
            continue
        fresh = len(set(views) - visited[phase.stage])
        visited[phase.stage].update(views)
        prices.append(phase.seconds + fresh * phase.first_visit)
        estimator.add_step(phase.stage, views, prices[-1])
        number = sum(entry.stage == phase.stage for entry in estimates) + 1
        estimates.append(Estimate(phase.stage, number, estimator.left(step), 0.0))
    return [replace(entry, truth=sum(prices[start + index + 1 :])) for index, entry in enumerate(estimates)]


@pytest.mark.parametrize("start", [0, 7, 30, 40])
@pytest.mark.parametrize("views_per_step", [1, 3])
def test_estimate_is_exact_if_steps_take_the_predicted_time(start: int, views_per_step: int) -> None:
    """The prediction is exact in both phases, also after resuming in the middle of a phase."""
    estimates = session([COARSE, SOS], [COARSE, SOS], start, views_per_step)
    assert len(estimates) == 90 - start
    for entry in estimates:
        assert entry.left == entry.truth, entry


@pytest.mark.parametrize("factor", [0.25, 1.0, 4.0])
@pytest.mark.parametrize("start", [0, 40])
def test_predictions_are_scaled_once_views_are_visited_again(factor: float, start: int) -> None:
    slower = [replace(p, seconds=p.seconds * factor, first_visit=p.first_visit * factor) for p in (COARSE, SOS)]
    for entry in session(slower, [COARSE, SOS], start)[VIEWS:]:
        assert entry.left == pytest.approx(entry.truth, rel=1e-12), entry


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize(("known", "first"), [(1.0, 4.0), (1.25, 0.25), (0.8, 0.0), (1.25, 6.0)])
def test_estimate_is_within_a_quarter_after_five_steps_of_the_last_phase(known: float, first: float, seed: int) -> None:
    """Steps and first visits are off by different factors, and the first five steps are all first visits."""
    real = [replace(p, seconds=p.seconds * known, first_visit=p.first_visit * first) for p in (COARSE, SOS)]
    for start in (0, 40):
        for entry in session(real, [COARSE, SOS], start, seed=seed):
            if entry.stage == "sos" and entry.number >= 5:
                assert entry.left == pytest.approx(entry.truth, rel=0.25), entry


def test_first_visits_are_at_most_the_visits_left() -> None:
    """Nine of twelve views have been visited, and four or two steps are left."""
    phase = ExpectedPhase("sos", 20, 1.0, 6.0)
    estimator = estimator_of([phase], range(VIEWS))
    for view in range(9):
        estimator.add_step("sos", [view], 7.0)
    estimator.add_step("sos", [1], 1.0)
    assert estimator.left(16) == 4 * 1.0 + 3 * 6.0
    assert estimator.left(18) == 2 * 1.0 + 2 * 6.0


def test_estimate_includes_checkpoints_and_time_limit() -> None:
    """Checkpoints keep taking a quarter of the steps' time; the time limit applies to steps alone."""
    estimator = estimator_of([ExpectedPhase("sos", 10)], range(1))
    estimator.add_step("sos", [0], 3.0)
    estimator.add_step("sos", [0], 1.0)
    estimator.add_beside(1.0)
    assert estimator.left(2) == 8 * 1.0 * 1.25
    assert estimator.left(2, limit=4.0) == 4.0 * 1.25
    assert estimator.left(2, limit=-1.0) == 0.0
    assert estimator.left(10) == 0.0
