"""Progress of an attempt: its record in the store, and the expected end of the job."""

from __future__ import annotations

import time
from typing import Any

from service.scheduling.endings import Message
from service.scheduling.packing import Grant, estimated_seconds
from service.scheduling.selection import Holding
from service.store import Store
from service.store.leases import Lease

#: Seconds between writes of progress: in the first minute, and for long-running jobs. More frequent writes would go
#: unnoticed, and on a large fleet they are most of the database's load.
_PROGRESS_SECONDS = (1.0, 5.0)


class ProgressWriter:
    """Writer of an attempt's progress, which starts with the attempt."""

    def __init__(self, lease: Lease, store: Store) -> None:
        self._lease, self._store = lease, store
        self._started_at, self._written_at = time.monotonic(), 0.0
        self._pending: dict[str, Any] | None = None
        self._ends_at: float | None = None

    def update(self, message: Message) -> None:
        """Take the progress from a message of the attempt's process; messages of other kinds are ignored."""
        if message["kind"] == "progress" and (left := message.get("seconds_left")) is not None:
            self._ends_at = time.monotonic() + left
        if message["kind"] in ("stage", "prepared", "progress"):
            self._pending = progress_record(message, self._lease.job.attempt)

    def write(self, *, now: bool = False) -> None:
        """Write new progress to the store if a write is due; `now` writes it in any case."""
        time_now = time.monotonic()
        due = time_now - self._written_at >= progress_seconds(time_now - self._started_at)
        if self._pending is not None and (now or due):
            self._store.leases.report_progress(self._lease, self._pending)
            self._pending, self._written_at = None, time_now

    def holding(self, grant: Grant) -> Holding:
        """Return the capacity of the attempt with its expected end according to the last progress message."""
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


def progress_record(message: Message, attempt: int) -> dict[str, Any]:
    """Convert a message to the progress entry of a job's record; before the steps, a step is a view."""
    step, total = message.get("step", 0), message.get("total", 0)
    checked, to_check = message.get("views") or (None, None)
    return {
        "stage": message.get("stage", "coarse" if message["kind"] == "progress" else "starting"),
        "step": step,
        "total": total,
        "fraction": step / total if total else 0.0,
        "eta_s": message.get("seconds_left"),
        "loss": message.get("loss"),
        "scales": message.get("scales"),
        "mean_loss": message.get("mean_loss"),
        "mean_scales": message.get("mean_scales"),
        "seconds": message.get("seconds"),
        "views_checked": checked,
        "views_to_check": to_check,
        "attempt": attempt,
    }
