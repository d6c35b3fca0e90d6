"""Decision which job a machine starts next: a pure function of the queue and the running jobs.

`next_job` goes through the queue in order. It starts the first job that fits the free capacity
(`service.scheduling.packing`). If a job does not fit, capacity is reserved for it, because otherwise smaller jobs would
overtake it forever; with several dispatchers this happens only once the job has waited for at least as long as it would
still have to wait here, and until then the job is skipped. Without backfilling, the capacity that is already free would
be idle until the last of the preceding jobs ends: one GPU in ten on a fully loaded fleet. Therefore the first later job
that fits and is expected to end before the reserved job can start is started (EASY backfilling: D. Lifka, "The ANL/IBM
SP scheduling system", 1995). The start of the reserved job is forecast from the expected ends of the running jobs, and
the duration of the other job is estimated from its record (`service.scheduling.job_size`) and scaled by the measured
pace of this machine. Nothing is backfilled before a pace is known.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum
from statistics import median

from service.scheduling.job_size import estimated_seconds
from service.scheduling.packing import Capacity, Grant, QueuedJob

#: Safety factor on the estimated duration: jobs of equal size differ by a third (standard deviation).
_CAUTION = 1.5
#: Minimum gap in seconds that is worth backfilling: no job starts, plans and ends in less time.
_MIN_GAP = 20.0


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


@dataclass(frozen=True)
class Forecast:
    """Earliest forecast so far of when a reserved job starts.

    Attributes:
        job_id: Id of the reserved job.
        starts: Start of the job by the store's clock.
    """

    job_id: str
    starts: float


class Reason(StrEnum):
    """Reason of a decision."""

    FITS = "the job fits the free capacity"
    ENDS_IN_TIME = "the job will end before the reserved job starts"
    NONE_ENDS_IN_TIME = "capacity is reserved, and no other job will end in time"
    STARTS_SOON = "capacity is reserved, and the reserved job will start soon"
    NO_FORECAST = "capacity is reserved, and no forecast is possible yet"
    NONE_FITS = "no job fits, and other machines may have capacity sooner"


@dataclass(frozen=True)
class Snapshot:
    """State of a machine and of its fleet when a job is chosen.

    Attributes:
        capacity: Total capacity of the machine.
        holdings: Capacity of running jobs.
        waiting: Number of jobs that this machine could start now.
        now: Current time by the store's clock.
        dispatchers: Number of dispatchers that share the queue.
        pace: Pace of jobs on this machine; None if unknown.
        forecast: Latest forecast for a reserved job; None before the first one.
    """

    capacity: Capacity
    holdings: Sequence[Holding]
    waiting: int
    now: float
    dispatchers: int = 1
    pace: float | None = None
    forecast: Forecast | None = None

    def grant(self, job: QueuedJob) -> Grant | None:
        """Return the capacity that a job gets beside the running jobs; None if it does not fit."""
        return self.capacity.grant(job, [each.grant for each in self.holdings], self.waiting)


@dataclass(frozen=True)
class Decision:
    """Job to start, job to reserve capacity for, and the reason.

    Attributes:
        reason: Reason of the decision.
        job_id: Id of the job to start; None to start nothing.
        grant: Capacity of the job to start.
        reserved_for: Id of the job to reserve capacity for; None to reserve nothing.
        forecast: Latest forecast for a reserved job, for the next snapshot.
    """

    reason: Reason
    job_id: str | None = None
    grant: Grant | None = None
    reserved_for: str | None = None
    forecast: Forecast | None = None


def next_job(queue: Sequence[QueuedJob], snapshot: Snapshot) -> Decision:
    """Return which job of a queue to start, and which job to reserve capacity for.

    Args:
        queue: Waiting jobs in the order in which they should start.
        snapshot: State of the machine.
    """
    for position, job in enumerate(queue):
        if (grant := snapshot.grant(job)) is not None:
            return Decision(Reason.FITS, job.id, grant, forecast=snapshot.forecast)
        starts = _forecast_start(job, snapshot)
        if not _should_reserve(job, starts, snapshot):
            continue
        if snapshot.pace is None or starts is None:
            return Decision(Reason.NO_FORECAST, reserved_for=job.id, forecast=snapshot.forecast)
        return backfill(queue[position + 1 :], _earliest_forecast(job, starts, snapshot), snapshot.pace, snapshot)
    return Decision(Reason.NONE_FITS, forecast=snapshot.forecast)


def backfill(queue: Sequence[QueuedJob], forecast: Forecast, pace: float, snapshot: Snapshot) -> Decision:
    """Return which of the jobs behind a reserved job to start: the first that will end before the reserved job starts.

    Args:
        queue: Waiting jobs behind the reserved job, in order.
        forecast: Forecast for the reserved job.
        pace: Pace of jobs on this machine.
        snapshot: State of the machine.
    """
    gap = forecast.starts - snapshot.now
    if gap < _MIN_GAP:
        return Decision(Reason.STARTS_SOON, reserved_for=forecast.job_id, forecast=forecast)
    for job in queue:
        if (grant := snapshot.grant(job)) is not None and _cautious_seconds(job, grant, pace) <= gap:
            return Decision(Reason.ENDS_IN_TIME, job.id, grant, forecast.job_id, forecast)
    return Decision(Reason.NONE_ENDS_IN_TIME, reserved_for=forecast.job_id, forecast=forecast)


def measured_pace(holdings: Sequence[Holding], previous: float | None) -> float | None:
    """Return the median pace of the running jobs; `previous` if none of them has one yet."""
    paces = [each.pace for each in holdings if each.pace is not None]
    return median(paces) if paces else previous


def _should_reserve(job: QueuedJob, starts: float | None, snapshot: Snapshot) -> bool:
    """Return whether to reserve capacity here for a job that may fit on another machine sooner.

    Dispatchers do not know each other's forecasts. A job's waiting time stands for them: the machine with the shortest
    remaining wait is the first to reserve capacity.
    """
    if snapshot.dispatchers == 1 or starts is None:
        return True
    is_reserved = snapshot.forecast is not None and snapshot.forecast.job_id == job.id
    return is_reserved or starts - snapshot.now <= snapshot.now - job.queued_at


def _earliest_forecast(job: QueuedJob, starts: float, snapshot: Snapshot) -> Forecast:
    """Return the earliest forecast for a job, so that only jobs that exceed their estimates by far delay it."""
    previous = snapshot.forecast
    if previous is not None and previous.job_id == job.id:
        starts = min(starts, previous.starts)
    return Forecast(job.id, starts)


def _cautious_seconds(job: QueuedJob, grant: Grant, pace: float) -> float:
    return _CAUTION * pace * estimated_seconds(job.parameters, job.inputs, grant.ranks)


def _forecast_start(job: QueuedJob, snapshot: Snapshot) -> float | None:
    """Return when enough running jobs will have ended for a job to start; None if unknown.

    Jobs with unknown ends count as the first to end.
    """
    by_end = sorted(snapshot.holdings, key=lambda each: -math.inf if each.until is None else each.until)
    for count, each in enumerate(by_end, 1):
        remaining = [later.grant for later in by_end[count:]]
        if snapshot.capacity.grant(job, remaining, snapshot.waiting) is not None:
            return each.until
    return None
