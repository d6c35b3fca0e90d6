"""Progress of an attempt: its record in the store, and the expected end of the job."""

from __future__ import annotations

import time

from service.scheduling.packing import Grant, estimated_seconds
from service.scheduling.selection import Holding
from service.store import Store
from service.store.leases import Lease
from sgsst_core.progress import Progress

#: Seconds between writes of progress: in the first minute, and for long-running jobs. More frequent writes would go
#: unnoticed, and on a large fleet they are most of the database's load.
_PROGRESS_SECONDS = (1.0, 5.0)


class ProgressWriter:
    """Writer of an attempt's progress, which starts with the attempt."""

    def __init__(self, lease: Lease, store: Store) -> None:
        self._lease, self._store = lease, store
        self._started_at, self._written_at = time.monotonic(), 0.0
        self._pending: Progress | None = None
        self._ends_at: float | None = None

    def update(self, progress: Progress) -> None:
        """Set the progress to be written next."""
        if progress.is_step and progress.eta_s is not None:
            self._ends_at = time.monotonic() + progress.eta_s
        self._pending = progress

    def write(self, *, now: bool = False) -> None:
        """Write new progress to the store if a write is due; `now` writes it in any case."""
        time_now = time.monotonic()
        due = time_now - self._written_at >= progress_seconds(time_now - self._started_at)
        if self._pending is not None and (now or due):
            self._store.leases.report_progress(self._lease, self._pending)
            self._pending, self._written_at = None, time_now

    def holding(self, grant: Grant) -> Holding:
        """Return the capacity of the attempt with its expected end according to the last step."""
        ends_at, job = self._ends_at, self._lease.job
        if ends_at is None:
            return Holding(grant)
        until = self._store.database.clock() + ends_at - time.monotonic()
        if job.attempt > 1:  # it may have resumed from a checkpoint, so its pace is unknown
            return Holding(grant, until)
        pace = (ends_at - self._started_at) / estimated_seconds(job, grant.ranks)
        return Holding(grant, until, pace)


def progress_seconds(elapsed: float) -> float:
    """Return the interval between writes of progress, in seconds, for an attempt that has run this long."""
    least, most = _PROGRESS_SECONDS
    return min(max(elapsed / 60, least), most)
