"""Backfilling: short jobs run on capacity that is reserved for a large job, until that job can start.

Capacity is reserved for a job that needs more of a machine than is free, because otherwise smaller jobs would overtake
it forever. Without backfilling, the capacity that is already free would be idle until the last of the preceding jobs
ends: one GPU in ten on a fully loaded fleet. Jobs that are expected to end by then are therefore started (EASY
backfilling: D. Lifka, "The ANL/IBM SP scheduling system", 1995). The duration of a job is estimated from its record and
scaled by the measured pace of this machine; nothing is backfilled before a pace is known.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from statistics import median

from service.scheduling.job_size import estimated_seconds
from service.scheduling.packing import Grant, Room
from service.store.tables import JobRow

#: Safety factor on the estimated duration: jobs of equal size differ by a third (standard deviation).
_CAUTION = 1.5
#: Minimum gap in seconds that is worth backfilling: no job starts, plans and ends in less time.
_LEAST_GAP = 20.0


@dataclass(frozen=True)
class Holding:
    """Capacity that a running job occupies, and its expected end.

    Attributes:
        grant: Capacity that the job occupies.
        until: Expected end by the store's clock; None if unknown.
        pace: Actual duration divided by the estimated one; None if unknown.
    """

    grant: Grant
    until: float | None = None
    pace: float | None = None


class Backfill:
    """Selection of the jobs that may run before the one that capacity is reserved for.

    Args:
        room: Capacity of the machine.
    """

    def __init__(self, room: Room) -> None:
        self._room = room
        self._pace: float | None = None
        self._kept, self._begins = "", -math.inf

    def learn(self, held: Sequence[Holding]) -> None:
        """Update the pace of jobs on this machine from the running jobs."""
        if paces := [each.pace for each in held if each.pace is not None]:
            self._pace = median(paces)

    def is_near(self, job: JobRow, held: Sequence[Holding], waiting: int, now: float) -> bool:
        """Return whether to reserve capacity here for a job that may fit on another machine sooner.

        Dispatchers do not know each other's forecasts. Capacity is therefore reserved only once the job has already
        waited for at least as long as it would still have to wait here. The machine with the shortest wait is thus the
        first to reserve capacity.
        """
        begins = self._foreseen(job, held, waiting)
        return job.id == self._kept or begins is None or begins - now <= now - job.queued_at

    def before(
        self, kept: JobRow, held: Sequence[Holding], waiting: int, now: float
    ) -> Callable[[JobRow], Grant | None] | None:
        """Return a function that grants capacity to jobs expected to end before `kept` can start; None if no job would.

        If the forecast of that start changes, the earliest one is used. The `kept` job is thus delayed only by jobs
        that exceed their estimates by far.

        Args:
            held: Capacity of running jobs.
            waiting: Number of jobs that this machine could start now.
            now: Current time by the store's clock.
        """
        begins, pace = self._foreseen(kept, held, waiting), self._pace
        if pace is None or begins is None:
            return None
        self._begins = min(begins, self._begins) if kept.id == self._kept else begins
        self._kept = kept.id
        gap = self._begins - now
        if gap < _LEAST_GAP:
            return None

        def grant(job: JobRow) -> Grant | None:
            found = self._room.grant(job, [each.grant for each in held], waiting)
            if found is None:
                return None
            seconds = _CAUTION * pace * estimated_seconds(job.parameters, job.inputs, found.ranks)
            return found if seconds <= gap else None

        return grant

    def _foreseen(self, kept: JobRow, held: Sequence[Holding], waiting: int) -> float | None:
        """Return when enough running jobs will have ended for `kept` to start; None if unknown.

        Jobs with unknown ends count as the first to end.
        """
        by_end = sorted(held, key=_end)
        for number, each in enumerate(by_end, 1):
            left = [later.grant for later in by_end[number:]]
            if self._room.grant(kept, left, waiting) is not None:
                return each.until
        return None


def _end(holding: Holding) -> float:
    return -math.inf if holding.until is None else holding.until
