"""Progress of a survey, which takes minutes for large scenes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass


@dataclass(frozen=True)
class PlanningProgress:
    """Progress of a survey.

    Attributes:
        done: Views surveyed by all ranks together.
        total: Views to survey.
        seconds_left: Remaining seconds of the survey at the current rate; None before the first view is done.
    """

    done: int
    total: int
    seconds_left: float | None = None

    @property
    def fraction(self) -> float:
        """Fraction of the views, 0 to 1."""
        return self.done / max(self.total, 1)


ShowPlanning = Callable[[PlanningProgress], None]


def progress_of(own: int, total: int, ranks: int, seconds: float) -> PlanningProgress:
    """Return the progress of all ranks, assuming that they are as fast as this one.

    Args:
        own: Number of views that this rank has surveyed.
        total: Number of views that all ranks survey.
        ranks: Number of ranks.
        seconds: Seconds since the survey started.
    """
    done = min(total, own * ranks)
    return PlanningProgress(done, total, seconds * (total - done) / done if done else None)
