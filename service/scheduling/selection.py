"""Selection of the jobs that a machine starts.

The store goes through its queue in order (`service.store.leases`). The first job that fits the free capacity starts
(`service.scheduling.packing`). If a job does not fit, capacity is reserved for it, because otherwise smaller jobs would
overtake it forever; with several dispatchers this happens only once the job has waited for at least as long as it would
still have to wait here, and until then the job is skipped.

Without backfilling, the capacity that is already free would be idle until the last of the preceding jobs ends: a
seventh to a third of a fully loaded fleet (`benchmarks.fleet`). Therefore the first later job that fits and is expected
to end before the reserved job can start is started (EASY backfilling: D. Lifka, "The ANL/IBM SP scheduling system",
1995). The start of the reserved job follows from the remaining seconds that running jobs report. The duration of the
other job is estimated from its record and scaled by the measured pace of this machine; nothing is backfilled before a
pace is known.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from statistics import median

from service.scheduling.clock_watch import ClockWatch
from service.scheduling.packing import Capacity, Grant, estimated_seconds
from service.store import Store
from service.store.leases import Lease
from service.store.tables import JobRow

#: Safety factor on the estimated duration: jobs of equal size differ by a third (standard deviation).
_CAUTION = 1.5
#: Minimum gap in seconds that is worth backfilling: no job starts, plans and ends in less time.
_MIN_GAP = 20.0


@dataclass(frozen=True)
class Holding:
    """Capacity that a running job occupies, and its expected end.

    Attributes:
        until: Expected end by the store's clock; None if unknown.
        pace: Actual duration divided by the estimated one; None if unknown.
    """

    grant: Grant
    until: float | None = None
    pace: float | None = None


class JobSelector:
    """Selector of jobs for one dispatcher.

    Args:
        capacity: Total capacity of the dispatcher's machine.
        clocks: Clock checks that decide whether an expired lease is lost.
    """

    def __init__(self, dispatcher: str, store: Store, capacity: Capacity, clocks: ClockWatch) -> None:
        self.dispatcher = dispatcher
        self._store, self._capacity, self._clocks = store, capacity, clocks
        self._pace: float | None = None
        #: The reserved job, and the earliest forecast so far of its start by the store's clock.
        self._forecast: tuple[str, float] | None = None

    def lease_next_job(self, holdings: Sequence[Holding]) -> tuple[Lease, Grant] | None:
        """Lease the next job to start on this machine; None if there is none.

        Args:
            holdings: Capacity of running jobs.
        """
        paces = [each.pace for each in holdings if each.pace is not None]
        self._pace = median(paces) if paces else self._pace
        held = [each.grant for each in holdings]
        if self._capacity.free(held) < 1:
            return None  # without a query, which would lock rows that other dispatchers want
        dispatchers = max(1, len(self._store.operations.dispatchers()))
        if not (waiting := self._store.leases.waiting(self._capacity.size * dispatchers)):
            return None
        waiting = -(-waiting // dispatchers)  # other dispatchers take their portion of the queue
        now = self._store.database.clock()
        grants: dict[str, Grant] = {}
        gap = 0.0

        def fits(job: JobRow) -> bool:
            grant = self._capacity.grant(job, held, waiting)
            if grant is not None:
                grants[job.id] = grant
            return grant is not None

        def should_reserve(job: JobRow) -> bool:
            nonlocal gap
            starts = self._expected_start(job, holdings, waiting)
            if starts is None:
                return True
            if dispatchers > 1 and not self._waits_longest_here(job, starts, now):
                return False
            gap = self._earliest_forecast(job, starts) - now
            return True

        def backfills(job: JobRow) -> bool:
            if self._pace is None or gap < _MIN_GAP or not fits(job):
                return False
            return _CAUTION * self._pace * estimated_seconds(job, grants[job.id].ranks) <= gap

        lease = self._store.leases.take(self.dispatcher, fits, should_reserve, backfills, self._clocks.is_lost)
        return (lease, grants[lease.job_id]) if lease is not None else None

    def _expected_start(self, job: JobRow, holdings: Sequence[Holding], waiting: int) -> float | None:
        """Return when enough running jobs will have ended for a job to start, by the store's clock; None if unknown.

        Jobs with unknown ends count as the first to end.
        """
        by_end = sorted(holdings, key=lambda each: -math.inf if each.until is None else each.until)
        for count, each in enumerate(by_end, 1):
            if self._capacity.grant(job, [later.grant for later in by_end[count:]], waiting) is not None:
                return each.until
        return None

    def _waits_longest_here(self, job: JobRow, starts: float, now: float) -> bool:
        """Return whether to reserve capacity here for a job that may fit on another machine sooner.

        Dispatchers do not know each other's forecasts. A job's waiting time stands for them: the machine with the
        shortest remaining wait is the first to reserve capacity.
        """
        is_reserved = self._forecast is not None and self._forecast[0] == job.id
        return is_reserved or starts - now <= now - job.queued_at

    def _earliest_forecast(self, job: JobRow, starts: float) -> float:
        """Return the earliest forecast of a reserved job: later ones must not let further jobs delay it."""
        if self._forecast is not None and self._forecast[0] == job.id:
            starts = min(starts, self._forecast[1])
        self._forecast = (job.id, starts)
        return starts
