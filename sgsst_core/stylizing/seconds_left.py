"""How long a job will still take, from what its steps have taken and what the plan expects of the others.

A view's first visit in a phase is dearer than later ones: its lists, coverage and content features are made then. Steps
are therefore counted apart by phase, and first visits apart from the rest. After a resume every view is visited anew.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from statistics import median

#: Of each kind of step in a phase, the latest so many count.
_LATEST = 101


@dataclass(frozen=True)
class ExpectedPhase:
    """What the plan expects of a phase.

    Attributes:
        stage: its name.
        steps: how many.
        seconds: of a step whose views have all been visited; 0 where nothing is known.
        first_visit: seconds that each view's first visit takes beside them.
    """

    stage: str
    steps: int
    seconds: float = 0.0
    first_visit: float = 0.0


@dataclass(frozen=True)
class _FirstVisits:
    """A step with views that it visited for the first time."""

    seconds: float
    views: int
    prepared: float  # of the seconds, known to be theirs


class _Stage:
    """The latest steps of a phase."""

    def __init__(self) -> None:
        self.known: deque[float] = deque(maxlen=_LATEST)
        self.first: deque[_FirstVisits] = deque(maxlen=_LATEST)

    def seconds(self) -> list[float]:
        """Of all of them."""
        return [*self.known, *(step.seconds for step in self.first)]

    def extra(self, known: float) -> float:
        """Seconds of a first visit, where a step without any takes `known`."""
        return max(median((step.seconds - known) / step.views for step in self.first), 0.0)


class SecondsLeft:
    """Keeps what steps have taken, and tells what the rest will take.

    Args:
        phases: of the schedule.
        views: that are visited, each once before any comes again.
        views_per_step: how many a step takes.
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
        #: Seconds of all steps, and of checkpoints and the like, which come as often for as long as there are steps.
        self._seconds = self._beside = 0.0

    def add_step(self, stage: str, views: Collection[int], seconds: float, prepared: float = 0.0) -> None:
        """Count a step of some views; prepared: those of its seconds that are known to be first visits' alone."""
        fresh = len(set(views) - self._visited[stage])
        self._visited[stage].update(views)
        if fresh:
            self._steps[stage].first.append(_FirstVisits(seconds, fresh, prepared))
        else:
            self._steps[stage].known.append(seconds)
        self._seconds += seconds

    def resume(self) -> None:
        """The steps so far were another session's: their prices hold, and every view is to be visited anew."""
        self._visited = {phase.stage: set() for phase in self._phases}
        self._seconds = self._beside = 0.0

    def add_beside(self, seconds: float) -> None:
        """Count what is neither a step nor a measurement: a checkpoint, a preview."""
        self._beside += seconds

    def left(self, step: int, queue: Sequence[int], *, measuring: float = 0.0, limit: float | None = None) -> float:
        """Seconds that the job will still take after so many steps of all sessions.

        Args:
            queue: views left in this round, the next one first.
            measuring: seconds of it.
            limit: most seconds that the steps may take; None for any.
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
        """How many views the next steps of a phase visit for the first time; a mean where only chance knows."""
        visits = steps * self._views_per_step
        unknown = self._views - self._visited[stage]
        soon = set(queue[:visits])
        later = min((visits - min(visits, len(queue))) / max(len(self._views), 1), 1.0)
        return len(unknown & soon) + len(unknown - soon) * later

    def _prices(self, phase: ExpectedPhase) -> tuple[float, float]:
        """Seconds of a step of a phase, and of each first visit beside it."""
        steps = self._steps[phase.stage]
        if not steps.seconds():
            ratio = self._ratio()
            return phase.seconds * ratio or self._any_step(), phase.first_visit * self._first_ratio(ratio)
        known = self._known(phase)
        if steps.first:
            return known, steps.extra(known)
        return known, phase.first_visit * self._first_ratio(self._ratio())

    def _known(self, phase: ExpectedPhase) -> float:
        """Seconds of a step of a phase, of which some have been made, whose views have all been visited."""
        steps = self._steps[phase.stage]
        if steps.known:
            return median(steps.known)
        most = median(step.seconds - step.prepared for step in steps.first)
        return min(phase.seconds * self._ratio(), most) if phase.seconds else most

    def _ratio(self) -> float:
        """Seconds of steps over what was expected, in the latest phase that has come to views visited before.

        Until then the expectation stands: it was timed on this machine, while first visits are a guess.
        """
        for phase in reversed(self._phases):
            known = self._steps[phase.stage].known
            if known and phase.seconds:
                return median(known) / phase.seconds
        return 1.0

    def _first_ratio(self, otherwise: float) -> float:
        """The same of first visits."""
        for phase in reversed(self._phases):
            steps = self._steps[phase.stage]
            if steps.first and phase.first_visit:
                return steps.extra(self._known(phase)) / phase.first_visit
        return otherwise

    def _any_step(self) -> float:
        """Seconds of a step where nothing is expected: those of the phases so far."""
        seconds = [seconds for steps in self._steps.values() for seconds in steps.seconds()]
        return median(seconds) if seconds else 0.0
