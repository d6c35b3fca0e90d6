"""Estimate of the remaining time of a job from its measured steps; for a phase without steps yet, from the plan.

The first visit of a view in a phase takes longer than later ones, because its tile intersections, coverage and content
features are computed then. Steps are therefore counted separately by phase, and first visits separately from others.
After a resume, caches are empty, so every view has a first visit again.

As long as a phase has no steps, or only steps with first visits, the plan's predictions replace what is unknown. They
are scaled by the ratio of measured to predicted times, as far as that is known.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from statistics import median

#: Number of latest steps of each phase that are used, separately with and without first visits.
_LATEST = 101


@dataclass(frozen=True)
class ExpectedPhase:
    """Predicted values of a phase.

    Attributes:
        stage: Name of the phase.
        steps: Number of steps.
        seconds: Time in seconds of a step whose views have all been visited before; 0 if unknown.
        first_visit: Additional time in seconds of each view's first visit.
    """

    stage: str
    steps: int
    seconds: float = 0.0
    first_visit: float = 0.0


@dataclass(frozen=True)
class _FirstVisits:
    """Step that visited some of its views for the first time."""

    seconds: float
    views: int
    prepared: float  # portion of `seconds` known to be spent on first visits


class _Phase:
    """Predicted values and latest steps of a phase."""

    def __init__(self, expected: ExpectedPhase) -> None:
        self.expected = expected
        self.visited: set[int] = set()
        self.later = deque[float](maxlen=_LATEST)
        self.first = deque[_FirstVisits](maxlen=_LATEST)

    def add(self, views: Collection[int], seconds: float, prepared: float) -> None:
        """Record a step."""
        fresh = len(set(views) - self.visited)
        self.visited.update(views)
        if fresh:
            self.first.append(_FirstVisits(seconds, fresh, prepared))
        else:
            self.later.append(seconds)

    @property
    def seconds(self) -> list[float]:
        """Time in seconds of each step."""
        return [*self.later, *(step.seconds for step in self.first)]

    def later_seconds(self, ratio: float) -> float:
        """Return the time in seconds of a step without first visits, once the phase has any step.

        Args:
            ratio: Ratio of measured to predicted times.
        """
        if self.later:
            return median(self.later)
        most = median(step.seconds - step.prepared for step in self.first)
        return min(self.expected.seconds * ratio, most) if self.expected.seconds else most

    def first_visit_seconds(self, ratio: float) -> float:
        """Return the additional time in seconds of a first visit, once the phase has a step with one."""
        later = self.later_seconds(ratio)
        return max(median((step.seconds - later) / step.views for step in self.first), 0.0)


class SecondsLeft:
    """Estimator of the remaining time.

    Args:
        phases: Phases of the schedule.
        views: Views in use, each of which is visited once per round.
        views_per_step: Number of views per step.
    """

    def __init__(
        self,
        phases: Sequence[ExpectedPhase],
        views: Collection[int],
        views_per_step: int = 1,
    ) -> None:
        self._phases = {phase.stage: _Phase(phase) for phase in phases}
        self._views = frozenset(views)
        self._views_per_step = views_per_step
        #: Total seconds of steps, and of checkpoints and previews, which are assumed to stay in proportion to the
        #: steps.
        self._seconds = self._beside = 0.0

    def add_step(self, stage: str, views: Collection[int], seconds: float, prepared: float = 0.0) -> None:
        """Record a step. `prepared` is the portion of `seconds` known to be spent on first visits."""
        self._phases[stage].add(views, seconds, prepared)
        self._seconds += seconds

    def resume(self) -> None:
        """Assign all steps so far to an earlier session of the job.

        Their times are still used, but every view has a first visit again.
        """
        for phase in self._phases.values():
            phase.visited = set()
        self._seconds = self._beside = 0.0

    def add_beside(self, seconds: float) -> None:
        """Record time that is neither a step nor a measurement: a checkpoint or a preview."""
        self._beside += seconds

    def left(self, step: int, queue: Sequence[int], *, measuring: float = 0.0, limit: float | None = None) -> float:
        """Return the remaining time of the job in seconds.

        Args:
            step: Number of steps completed in all sessions.
            queue: Remaining views of this round, next one first.
            measuring: Remaining seconds of measurements.
            limit: Upper bound on the remaining step time in seconds; None for no bound.
        """
        seconds, start = 0.0, 0
        for phase in self._phases.values():
            total = phase.expected.steps
            steps = total - min(max(step - start, 0), total)
            if steps:
                later, first = self._prices(phase)
                coming = queue if step >= start else ()
                seconds += steps * later + self._first_visits(phase, coming, steps) * first
            start += total
        if limit is not None:
            seconds = min(seconds, max(limit, 0.0))
        beside = self._beside / self._seconds if self._seconds else 0.0
        return seconds * (1 + beside) + measuring

    def _first_visits(self, phase: _Phase, queue: Sequence[int], steps: int) -> float:
        """Return the number of first visits in the next steps of a phase.

        Visits after those in the queue count with their probability, because their order is random.
        """
        visits = steps * self._views_per_step
        unknown = self._views - phase.visited
        soon = set(queue[:visits])
        later = min((visits - min(visits, len(queue))) / max(len(self._views), 1), 1.0)
        return len(unknown & soon) + len(unknown - soon) * later

    def _prices(self, phase: _Phase) -> tuple[float, float]:
        """Return the time in seconds of a step of a phase, and the additional time of each first visit."""
        ratio, expected = self._ratio(), phase.expected
        if phase.first:
            return phase.later_seconds(ratio), phase.first_visit_seconds(ratio)
        if phase.later:
            return phase.later_seconds(ratio), expected.first_visit * self._first_visit_ratio(ratio)
        every = [seconds for other in self._phases.values() for seconds in other.seconds]
        later = expected.seconds * ratio or (median(every) if every else 0.0)
        return later, expected.first_visit * self._first_visit_ratio(ratio)

    def _ratio(self) -> float:
        """Return the ratio of measured to predicted step times, from the latest phase with a step without first visits.

        If there is no such step yet, the ratio is 1. Predictions are based on measurements on this machine, whereas the
        additional time of first visits is only a guess.
        """
        for phase in reversed(self._phases.values()):
            if phase.later and phase.expected.seconds:
                return median(phase.later) / phase.expected.seconds
        return 1.0

    def _first_visit_ratio(self, ratio: float) -> float:
        """Return the ratio of measured to predicted first-visit times; if unknown, that of step times (`ratio`)."""
        for phase in reversed(self._phases.values()):
            if phase.first and phase.expected.first_visit:
                return phase.first_visit_seconds(ratio) / phase.expected.first_visit
        return ratio
