"""Progress of a survey, which takes minutes for large scenes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass


@dataclass(frozen=True)
class PlanningProgress:
    """Number of surveyed views.

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
    """Return the progress after this many views on this rank, assuming that the other ranks are equally fast."""
    done = min(total, own * ranks)
    return PlanningProgress(done, total, seconds * (total - done) / done if done else None)
