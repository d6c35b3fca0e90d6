"""Dispatcher: leases jobs from the store and runs each attempt in a process of its own.

`python -m service.scheduling.dispatcher` starts one. Any number of dispatchers may share a store; a dispatcher that
dies loses its leases. The process of an attempt with more than one rank starts Ray on its main thread, and Ray ends
with that process. Neither a job nor Ray can therefore crash the dispatcher.
"""

from __future__ import annotations

import contextlib
import logging
import os
import shutil
import signal
import threading
import time
from collections.abc import Callable, Sequence
from types import FrameType

from service.errors import DamagedWeightsError, DatabaseUnavailableError, LeaseLostError
from service.files.artifacts import Artifacts
from service.files.stored_blobs import open_blobs
from service.logs import set_up
from service.private import keep_private
from service.scheduling.clock_watch import ClockWatch
from service.scheduling.machine import Machine, is_dead, own_name
from service.scheduling.packing import Capacity, Grant, QueuedJob
from service.scheduling.publishing import sweep
from service.scheduling.running import RunningAttempt
from service.scheduling.scheduler import Forecast, Holding, Reason, Snapshot, backfill, measured_pace, next_job
from service.scheduling.strays import remove_strays
from service.scheduling.webhooks import Deliverer
from service.settings import ServiceSettings
from service.store import Store, open_store
from service.store.leases import Lease
from service.store.states import JobStatus
from service.store.tables import JobRow
from service.weights import check_weights

#: Interval between searches for expired and leftover data, in seconds.
_HOUSEKEEPING_SECONDS = 60.0
#: Interval between searches for stray files, in seconds (`service.scheduling.strays`).
_STRAYS_SECONDS = 3600.0
#: Time for which a stopping dispatcher waits for each of its background threads, in seconds.
_LAST_SECONDS = 5.0
#: Maximum number of jobs whose leftover files are removed per round of housekeeping.
_SWEEPS = 20
#: Fractions of a lease's duration: the age at which a lease is renewed, and the age at which its job is killed if
#: renewing has failed. The latter is below 1, because other dispatchers may take an expired lease and clocks differ.
_RENEW_SHARE, _ABANDON_SHARE = 1 / 3, 3 / 4

_log = logging.getLogger(__name__)


class Dispatcher:
    """Dispatcher that runs jobs concurrently within the machine's capacity (`service.scheduling.packing`).

    Args:
        machine: Machine to run jobs on; None detects it.
    """

    def __init__(self, settings: ServiceSettings, store: Store, machine: Machine | None = None) -> None:
        self._settings, self._store = settings, store
        self._artifacts = Artifacts(settings.artifacts_url)
        self._blobs = open_blobs(settings, store.inputs, self._artifacts)
        self._machine = machine or Machine.find(settings)
        self._capacity = Capacity(self._machine, settings.parallel_jobs)
        self._pace: float | None = None
        self._forecast: Forecast | None = None
        self._running: dict[str, RunningAttempt] = {}
        self._stop = threading.Event()
        self.name = own_name()
        self._clocks = ClockWatch(store, settings.lease_seconds)
        self._work = settings.folder / "work" / self.name
        self._renewed_at = self._announced_at = self._strays_at = float("-inf")
        self._ended = threading.Event()
        work = (self._keep_house_now_and_then, self._abandon_late)
        self._beside = [threading.Thread(target=each, name=each.__name__, daemon=True) for each in work]
        self._deliverer = Deliverer(settings, store)

    def stop(self) -> None:
        """Make `run` return: running jobs save their state and return to the queue."""
        self._stop.set()

    def run(self) -> None:
        """Run jobs until `stop`."""
        self._take_over_from_the_dead()
        self._work.mkdir(parents=True, exist_ok=True)
        self._deliverer.start()
        for thread in self._beside:
            thread.start()
        what = "GPUs" if self._machine.gpus else "places"
        _log.info("dispatcher %s is ready: %d %s", self.name, self._capacity.size, what)
        while not self._stop.is_set():
            try:
                self._work_once()
            except (DatabaseUnavailableError, OSError):  # the database is down or locked; if it stays so, leases expire
                _log.exception("the store cannot be reached")
                self._stop.wait(2.0)
            self._stop.wait(self._settings.poll_seconds)
        self._shut_down()

    def _take_over_from_the_dead(self) -> None:
        """Expire the leases of dead dispatchers of this machine at once, and delete their work folders."""
        known = {row.name for row in self._store.operations.dispatchers()}
        for name in sorted(known.union(self._store.leases.holders())):
            if is_dead(name):
                _log.info("dispatcher %s is gone; taking over its jobs", name)
                self._store.leases.run_out(name)
                self._store.operations.gone(name)
        if self._work.parent.is_dir():
            for path in self._work.parent.iterdir():
                if is_dead(path.name):
                    shutil.rmtree(path, ignore_errors=True)

    def _work_once(self) -> None:
        for job_id, attempt in list(self._running.items()):
            if not attempt.alive:
                del self._running[job_id]
        self._renew_leases()
        self._announce_alive()
        try:
            check_weights()
        except DamagedWeightsError:
            return
        while not self._stop.is_set() and (found := self.lease_next_job(self._holdings())) is not None:
            self._start_attempt(*found)

    # --- capacity --------------------------------------------------------------------------------------------------

    def _holdings(self) -> list[Holding]:
        return [attempt.holding for attempt in self._running.values()]

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

        lease = self._store.leases.take(self.name, fits, should_reserve, backfills, self._clocks.is_lost)
        _log.debug("scheduling decision: %s", decision.reason, extra={"job": decision.job_id})
        return (lease, decision.grant) if lease is not None and decision.grant is not None else None

    def _snapshot(self, holdings: Sequence[Holding]) -> Snapshot | None:
        """Return the state of the machine and the fleet; None if no capacity is free or no job waits."""
        self._pace = measured_pace(holdings, self._pace)
        if self._capacity.free([each.grant for each in holdings]) < 1:
            return None  # without a query, which would lock rows that other dispatchers want
        dispatchers = max(1, self._store.operations.alive())
        if not (waiting := self._store.leases.waiting(self._capacity.size * dispatchers)):
            return None
        waiting = -(-waiting // dispatchers)  # other dispatchers take their portion of the queue
        now = self._store.database.clock()
        return Snapshot(self._capacity, holdings, waiting, now, dispatchers, self._pace, self._forecast)

    def _start_attempt(self, lease: Lease, grant: Grant) -> None:
        folder = self._work / f"{lease.job_id}-{lease.epoch}"
        attempt = RunningAttempt(
            lease, grant, folder, self._store, self._blobs, self._artifacts, self._settings, self._machine.cluster
        )
        self._running[lease.job_id] = attempt
        attempt.start()

    # --- leases ----------------------------------------------------------------------------------------------------

    def _announce_alive(self) -> None:
        """Send a heartbeat if it is due."""
        if time.monotonic() - self._announced_at >= _RENEW_SHARE * self._settings.lease_seconds:
            self._store.operations.beat(
                self.name, self._capacity.size, self._capacity.free([each.grant for each in self._holdings()])
            )
            self._announced_at = time.monotonic()

    def _renew_leases(self) -> None:
        """Renew the leases of all running attempts, and handle jobs that are canceled or lost."""
        now = time.monotonic()  # taken before the request, so that a lease is never assumed to last too long
        if not self._running:
            self._renewed_at = now
            return
        leases = [attempt.lease for attempt in self._running.values()]
        if now - self._renewed_at >= _RENEW_SHARE * self._settings.lease_seconds:
            found = self._store.leases.renew(leases)
            self._renewed_at = now
        else:
            found = self._store.leases.statuses(leases)
        for job_id, status in found.items():
            attempt = self._running[job_id]
            if status is None and attempt.alive:
                attempt.abandon()
            elif status == JobStatus.CANCELING:
                attempt.cancel()

    def _abandon_late(self) -> None:
        """Abandon jobs whose leases could not be renewed, before the leases expire.

        This runs in a thread of its own, because the thread that renews leases may wait for a database that does not
        respond.
        """
        limit = _ABANDON_SHARE * self._settings.lease_seconds
        while not self._ended.wait(_RENEW_SHARE * (self._settings.lease_seconds - limit)):
            late = time.monotonic() - self._renewed_at
            if late > limit:
                for attempt in [each for each in self._running.copy().values() if not each.abandoned]:
                    _log.error("%s is abandoned: no lease could be renewed for %.0f s", attempt.lease.job_id, late)
                    attempt.abandon()

    def _shut_down(self) -> None:
        _log.info("shutting down; %d running jobs are saving their state", len(self._running))
        for attempt in self._running.values():
            attempt.release()
        with contextlib.suppress(DatabaseUnavailableError):
            self._store.operations.gone(self.name)
        while any(attempt.alive for attempt in self._running.values()):
            with contextlib.suppress(DatabaseUnavailableError, LeaseLostError):
                self._renew_leases()
            time.sleep(0.2)
        self._ended.set()
        self._deliverer.stop()
        for thread in self._beside:
            thread.join(_LAST_SECONDS)
        shutil.rmtree(self._work, ignore_errors=True)

    # --- housekeeping ----------------------------------------------------------------------------------------------

    def _keep_house_now_and_then(self) -> None:
        """Run housekeeping periodically, in its own thread so that a slow file store does not delay renewing leases."""
        while not self._ended.is_set():
            self._keep_house()
            self._ended.wait(_HOUSEKEEPING_SECONDS)

    def _keep_house(self) -> None:
        try:
            if not self._clocks.confirm():
                return
            for job_id in self._store.retention.expire():
                self._artifacts.remove_job(job_id)
            for job_id, epoch in self._store.retention.unswept(_SWEEPS):
                sweep(self._store, self._artifacts, job_id, epoch)
            self._blobs.collect()
            if time.monotonic() - self._strays_at > _STRAYS_SECONDS:
                self._strays_at = time.monotonic()
                remove_strays(self._store, self._artifacts)
        except Exception:  # file stores raise arbitrary errors; running jobs must not suffer
            _log.exception("expired files could not all be removed; retrying later")


def _queued_job(row: JobRow) -> QueuedJob:
    return QueuedJob(row.id, row.queued_at, row.parameters, row.inputs)


def main() -> None:
    """Run a dispatcher with the environment's settings until SIGTERM or SIGINT."""
    from worker.processes import die_with_parent

    if os.environ.get("SGSST_DIE_WITH_PARENT"):
        die_with_parent()
    settings = ServiceSettings()
    set_up(settings.log_format)
    keep_private(settings)
    dispatcher = Dispatcher(settings, open_store(settings, patience=settings.start_seconds))

    def handle(_number: int, _frame: FrameType | None) -> None:
        dispatcher.stop()

    signal.signal(signal.SIGTERM, handle)
    signal.signal(signal.SIGINT, handle)
    dispatcher.run()


if __name__ == "__main__":
    main()
