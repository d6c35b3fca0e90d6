"""How far a survey has come: on large scenes it takes minutes, and somebody waits for it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass


@dataclass(frozen=True)
class PlanningProgress:
    """Views looked at.

    Attributes:
        done: by all ranks together.
        total: to look at.
        seconds_left: until the survey ends, at the pace so far; None before the first view is done.
    """

    done: int
    total: int
    seconds_left: float | None = None

    @property
    def fraction(self) -> float:
        """0 to 1."""
        return self.done / max(self.total, 1)


ShowPlanning = Callable[[PlanningProgress], None]


def progress_of(own: int, total: int, ranks: int, seconds: float) -> PlanningProgress:
    """After so many views of this rank: the others are taken to be as far."""
    done = min(total, own * ranks)
    return PlanningProgress(done, total, seconds * (total - done) / done if done else None)
