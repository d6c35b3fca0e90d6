"""Remaining time of a job: measured steps, or those that the plan predicts, times the steps left.

The first visit of a view in a phase takes longer than later ones, so steps with and without first visits are counted
separately. What no step has shown yet is taken from the plan, scaled by the ratio of measured to predicted steps.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Collection
from dataclasses import dataclass, field
from statistics import fmean

#: Number of latest steps of each phase that are used, separately with and without first visits.
_LATEST = 101


@dataclass
class Pace:
    """Predicted values and latest steps of a phase.

    Attributes:
        expected: Predicted seconds of a step whose views have all been visited before.
        expected_first: Predicted additional seconds of each view's first visit.
        visited: Views that the phase has visited in this session; caches are empty after a resume.
        later: Seconds of the latest steps without first visits.
        first: Seconds and number of first visits of the latest steps with first visits.
    """

    steps: int
    expected: float = 0.0
    expected_first: float = 0.0
    visited: set[int] = field(default_factory=set)
    later: deque[float] = field(default_factory=lambda: deque(maxlen=_LATEST))
    first: deque[tuple[float, int]] = field(default_factory=lambda: deque(maxlen=_LATEST))

    def prices(self, ratio: float) -> tuple[float, float]:
        """Return the seconds of a step, and the additional seconds of each first visit.

        Args:
            ratio: Ratio of measured to predicted seconds of steps of any phase.
        """
        step = fmean(self.later) if self.later else min([self.expected * ratio, *(own for own, _ in self.first)])
        if not self.first:
            return step, self.expected_first * ratio
        return step, max(fmean((seconds - step) / views for seconds, views in self.first), 0.0)


class SecondsLeft:
    """Estimator of the remaining time.

    Args:
        phases: Phases of the schedule by name, in their order.
        views: Views in use, each of which is visited once per round.
    """

    def __init__(self, phases: dict[str, Pace], views: Collection[int], views_per_step: int = 1) -> None:
        self._phases = phases
        self._views = frozenset(views)
        self._views_per_step = views_per_step
        #: Seconds of steps, and of checkpoints and previews, which are assumed to stay in proportion to the steps.
        self._seconds = self._beside = 0.0

    def add_step(self, stage: str, views: Collection[int], seconds: float) -> None:
        """Record a step."""
        phase = self._phases[stage]
        fresh = len(set(views) - phase.visited)
        phase.visited.update(views)
        if fresh:
            phase.first.append((seconds, fresh))
        else:
            phase.later.append(seconds)
        self._seconds += seconds

    def add_beside(self, seconds: float) -> None:
        """Record time that is neither a step nor a measurement: a checkpoint or a preview."""
        self._beside += seconds

    def left(self, step: int, *, limit: float | None = None) -> float:
        """Return the remaining seconds of the steps, and of what happens between them except for measurements.

        Args:
            step: Number of steps completed in all sessions.
            limit: Upper bound on the remaining seconds of steps; None for no bound.
        """
        phases, seconds, start = list(self._phases.values()), 0.0, 0
        ratios = [fmean(phase.later) / phase.expected for phase in phases if phase.later and phase.expected]
        for phase in phases:
            steps = phase.steps - min(max(step - start, 0), phase.steps)
            later, first = phase.prices(ratios[-1] if ratios else 1.0)
            unvisited = len(self._views - phase.visited)  # each round visits all of them
            seconds += steps * later + min(unvisited, steps * self._views_per_step) * first
            start += phase.steps
        beside = self._beside / self._seconds if self._seconds else 0.0
        return (seconds if limit is None else min(seconds, max(limit, 0.0))) * (1 + beside)
