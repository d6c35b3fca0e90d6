"""Estimate of the remaining time of a job, from its steps so far and the plan's predictions for later steps.

The first visit of a view in a phase takes longer than later ones, because its tile intersections, coverage and content
features are computed then. Steps are therefore counted separately by phase, and first visits separately from others.
After a resume, caches are empty, so every view has a first visit again.
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


class _Stage:
    """Latest steps of a phase."""

    def __init__(self) -> None:
        self.known: deque[float] = deque(maxlen=_LATEST)
        self.first: deque[_FirstVisits] = deque(maxlen=_LATEST)

    def seconds(self) -> list[float]:
        """Return the time in seconds of each step."""
        return [*self.known, *(step.seconds for step in self.first)]

    def extra(self, known: float) -> float:
        """Return the additional time in seconds of a first visit, given the time of a step without first visits."""
        return max(median((step.seconds - known) / step.views for step in self.first), 0.0)


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
        self._phases = phases
        self._views = frozenset(views)
        self._views_per_step = views_per_step
        self._steps = {phase.stage: _Stage() for phase in phases}
        self._visited: dict[str, set[int]] = {phase.stage: set() for phase in phases}
        #: Total seconds of steps, and of checkpoints and previews, which are assumed to stay in proportion to the
        #: steps.
        self._seconds = self._beside = 0.0

    def add_step(self, stage: str, views: Collection[int], seconds: float, prepared: float = 0.0) -> None:
        """Record a step. `prepared` is the portion of `seconds` known to be spent on first visits."""
        fresh = len(set(views) - self._visited[stage])
        self._visited[stage].update(views)
        if fresh:
            self._steps[stage].first.append(_FirstVisits(seconds, fresh, prepared))
        else:
            self._steps[stage].known.append(seconds)
        self._seconds += seconds

    def resume(self) -> None:
        """Assign all steps so far to an earlier session of the job.

        Their times are still used, but every view has a first visit again.
        """
        self._visited = {phase.stage: set() for phase in self._phases}
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
        for phase in self._phases:
            steps = phase.steps - min(max(step - start, 0), phase.steps)
            if steps:
                known, first = self._prices(phase)
                coming = queue if step >= start else ()
                seconds += steps * known + self._first_visits(phase.stage, coming, steps) * first
            start += phase.steps
        if limit is not None:
            seconds = min(seconds, max(limit, 0.0))
        beside = self._beside / self._seconds if self._seconds else 0.0
        return seconds * (1 + beside) + measuring

    def _first_visits(self, stage: str, queue: Sequence[int], steps: int) -> float:
        """Return the number of first visits in the next steps of a phase.

        Visits after those in the queue count with their probability, because their order is random.
        """
        visits = steps * self._views_per_step
        unknown = self._views - self._visited[stage]
        soon = set(queue[:visits])
        later = min((visits - min(visits, len(queue))) / max(len(self._views), 1), 1.0)
        return len(unknown & soon) + len(unknown - soon) * later

    def _prices(self, phase: ExpectedPhase) -> tuple[float, float]:
        """Return the time in seconds of a step of a phase, and the additional time of each first visit."""
        steps = self._steps[phase.stage]
        if not steps.seconds():
            ratio = self._ratio()
            return phase.seconds * ratio or self._any_step(), phase.first_visit * self._first_ratio(ratio)
        known = self._known(phase)
        if steps.first:
            return known, steps.extra(known)
        return known, phase.first_visit * self._first_ratio(self._ratio())

    def _known(self, phase: ExpectedPhase) -> float:
        """Return the time in seconds of a step without first visits, for a phase that has already started."""
        steps = self._steps[phase.stage]
        if steps.known:
            return median(steps.known)
        most = median(step.seconds - step.prepared for step in steps.first)
        return min(phase.seconds * self._ratio(), most) if phase.seconds else most

    def _ratio(self) -> float:
        """Return the ratio of measured to predicted step times, from the latest phase with a step without first visits.

        If there is no such step yet, the ratio is 1. Predictions are based on measurements on this machine, whereas the
        additional time of first visits is only a guess.
        """
        for phase in reversed(self._phases):
            known = self._steps[phase.stage].known
            if known and phase.seconds:
                return median(known) / phase.seconds
        return 1.0

    def _first_ratio(self, otherwise: float) -> float:
        """Return the ratio of measured to predicted first-visit times; `otherwise` if it is unknown."""
        for phase in reversed(self._phases):
            steps = self._steps[phase.stage]
            if steps.first and phase.first_visit:
                return steps.extra(self._known(phase)) / phase.first_visit
        return otherwise

    def _any_step(self) -> float:
        """Return the median seconds of all steps so far, for phases without predictions."""
        seconds = [seconds for steps in self._steps.values() for seconds in steps.seconds()]
        return median(seconds) if seconds else 0.0
