"""Selection of a dispatcher's next job: the store's queue, and the scheduler that decides about each of its jobs."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence

from service.scheduling.clock_watch import ClockWatch
from service.scheduling.packing import Capacity, Grant, QueuedJob
from service.scheduling.scheduler import Forecast, Holding, Reason, Snapshot, backfill, measured_pace, next_job
from service.store import Store
from service.store.leases import Lease
from service.store.tables import JobRow

_log = logging.getLogger(__name__)


class JobSelector:
    """Selector of jobs for one dispatcher.

    Args:
        dispatcher: Name of the dispatcher.
        store: Store with the queue.
        capacity: Total capacity of the dispatcher's machine.
        clocks: Clock checks that decide whether an expired lease is lost.
    """

    def __init__(self, dispatcher: str, store: Store, capacity: Capacity, clocks: ClockWatch) -> None:
        self.dispatcher = dispatcher
        self._store, self._capacity, self._clocks = store, capacity, clocks
        self._pace: float | None = None
        self._forecast: Forecast | None = None

    def lease_next_job(self, holdings: Sequence[Holding]) -> tuple[Lease, Grant] | None:
        """Lease the job that the scheduler chooses (`service.scheduling.scheduler`); None if it chooses none.

        The store locks one job of the queue at a time. The scheduler therefore gets one job at a time too.

        Args:
            holdings: Capacity of running jobs.
        """
        snapshot = self._snapshot(holdings)
        if snapshot is None:
            return None
        decision = next_job([], snapshot)

        def fits(job: JobRow) -> bool:
            nonlocal decision
            decision = next_job([_queued_job(job)], snapshot)
            return decision.grant is not None

        def should_reserve(job: JobRow) -> bool:
            return decision.reserved_for == job.id

        def backfills(_reserved: JobRow) -> Callable[[JobRow], bool] | None:
            forecast, pace = decision.forecast, snapshot.pace
            self._forecast = forecast
            if decision.reason != Reason.NONE_ENDS_IN_TIME or forecast is None or pace is None:
                return None

            def ends_in_time(job: JobRow) -> bool:
                nonlocal decision
                decision = backfill([_queued_job(job)], forecast, pace, snapshot)
                return decision.grant is not None

            return ends_in_time

        lease = self._store.leases.take(self.dispatcher, fits, should_reserve, backfills, self._clocks.is_lost)
        _log.debug("scheduling decision: %s", decision.reason, extra={"job": decision.job_id})
        return (lease, decision.grant) if lease is not None and decision.grant is not None else None

    def _snapshot(self, holdings: Sequence[Holding]) -> Snapshot | None:
        """Return the state of the machine and the fleet; None if no capacity is free or no job waits."""
        self._pace = measured_pace(holdings, self._pace)
        if self._capacity.free([each.grant for each in holdings]) < 1:
            return None  # without a query, which would lock rows that other dispatchers want
        dispatchers = max(1, self._store.operations.dispatcher_count())
        if not (waiting := self._store.leases.waiting(self._capacity.size * dispatchers)):
            return None
        waiting = -(-waiting // dispatchers)  # other dispatchers take their portion of the queue
        now = self._store.database.clock()
        return Snapshot(self._capacity, holdings, waiting, now, dispatchers, self._pace, self._forecast)


def _queued_job(row: JobRow) -> QueuedJob:
    return QueuedJob(row.id, row.queued_at, row.parameters, row.inputs)
