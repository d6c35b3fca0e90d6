"""What may run in the room that is kept for a big job, until that job can begin.

A job that needs more of a machine than is free has room kept for it, or smaller ones would overtake it for ever. Until
the last of those before it ends, what is free already would stand idle: on a fleet that is asked for all it has, one
GPU in ten. So jobs that will have ended by then are let in (EASY backfilling: D. Lifka, "The ANL/IBM SP scheduling
system", 1995). How long a job takes is an estimate from its record, times the pace at which this machine does such
jobs; nothing is let in before a pace is known.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from statistics import median

from service.scheduling.job_size import estimated_seconds
from service.scheduling.packing import Grant, Room
from service.store.tables import JobRow

#: What a job is expected to take at most, over its estimate: jobs of one size differ by a third (standard deviation).
_CAUTION = 1.5
#: Seconds that are not worth a look at the queue: no job is started, planned and ended in fewer.
_LEAST_GAP = 20.0


@dataclass(frozen=True)
class Holding:
    """What a running job has of a machine, and until when.

    Attributes:
        grant: what it has.
        until: when it is expected to end, by the store's clock; None where it does not tell.
        pace: seconds that it takes over those estimated; None where it does not tell.
    """

    grant: Grant
    until: float | None = None
    pace: float | None = None


class Backfill:
    """Decides which jobs may go before the one that room is kept for.

    Args:
        room: of the machine.
    """

    def __init__(self, room: Room) -> None:
        self._room = room
        self._pace: float | None = None
        self._kept, self._begins = "", -math.inf

    def learn(self, held: Sequence[Holding]) -> None:
        """Take in how fast jobs are on this machine."""
        if paces := [each.pace for each in held if each.pace is not None]:
            self._pace = median(paces)

    def is_near(self, job: JobRow, held: Sequence[Holding], waiting: int, now: float) -> bool:
        """Whether room is to be kept here for a job that other machines might have room for sooner.

        Nobody knows what the others foresee. So a job has to have waited for as long as it would have to wait here: the
        machine that has room first is the first to keep it.
        """
        begins = self._foreseen(job, held, waiting)
        return job.id == self._kept or begins is None or begins - now <= now - job.queued_at

    def before(
        self, kept: JobRow, held: Sequence[Holding], waiting: int, now: float
    ) -> Callable[[JobRow], Grant | None] | None:
        """What a job gets that would have ended before the `kept` one can begin; None where none would.

        The moment that was foreseen first counts and never a later one, so that the kept job waits no longer than it
        would have but for jobs that take much more than their estimate.

        Args:
            held: what running jobs have.
            waiting: jobs that this machine could start now.
            now: by the store's clock.
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
        """When enough running jobs have ended for the kept one; those that do not tell may end at any time."""
        by_end = sorted(held, key=_end)
        for number, each in enumerate(by_end, 1):
            left = [later.grant for later in by_end[number:]]
            if self._room.grant(kept, left, waiting) is not None:
                return each.until
        return None


def _end(holding: Holding) -> float:
    return -math.inf if holding.until is None else holding.until
