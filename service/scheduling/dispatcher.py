"""Dispatcher: leases jobs from the store and runs each attempt in a process of its own.

`python -m service.scheduling.dispatcher` starts one. Any number of dispatchers may share a store; a dispatcher that
dies loses its leases. The process of an attempt with more than one rank starts Ray on its main thread, and Ray ends
with that process. Neither a job nor Ray can therefore crash the dispatcher.
"""

import contextlib
import logging
import os
import shutil
import signal
import threading
import time
from collections.abc import Callable, Sequence
from functools import partial

from service.files.blobs import open_blobs
from service.files.objects import Artifacts
from service.problems import DamagedWeightsError, DatabaseUnavailableError
from service.scheduling.attempts import RunningAttempt, prepare
from service.scheduling.capacity import Capacity, Grant, Machine, is_dead, own_name
from service.scheduling.housekeeping import clean_up, remove_orphans
from service.scheduling.webhooks import Deliverer
from service.settings import ServiceSettings, check_weights, start
from service.store import Store, open_store
from service.store.queue import Lease

#: Fractions of a lease's duration: the age at which a lease is renewed, and the age at which its job is killed if
#: renewing has failed. The latter is below 1, because other dispatchers may take an expired lease and clocks differ.
RENEW_FRACTION, _ABANDON_FRACTION = 1 / 3, 3 / 4
#: Fraction of a lease's duration between checks whether it has been renewed.
_CHECK_FRACTION = RENEW_FRACTION * (1 - _ABANDON_FRACTION)

_log = logging.getLogger(__name__)


def lease_next_job(
    dispatcher: str, store: Store, capacity: Capacity, held: Sequence[Grant]
) -> tuple[Lease, Grant] | None:
    """Lease the first job of the queue that fits the free capacity of a machine; None if there is none.

    Args:
        capacity: Total capacity of the dispatcher's machine.
        held: Capacity of its running jobs.
    """
    if capacity.free(held) < 1:
        return None  # without a query, which would lock rows that other dispatchers want
    dispatchers = max(1, len(store.operations.dispatchers()))
    waiting = -(-store.leases.waiting(capacity.size * dispatchers) // dispatchers)  # others take their portion
    grant = partial(capacity.grant, held=held, waiting=waiting)
    lease = store.leases.take(dispatcher, lambda job: grant(job) is not None) if waiting else None
    granted = grant(lease.job) if lease is not None else None
    return (lease, granted) if lease is not None and granted is not None else None


#: Intervals between rounds of housekeeping, of searching for orphaned files, and of sending webhooks, in seconds.
_HOUSEKEEPING_SECONDS, _SEARCH_SECONDS, _WEBHOOK_SECONDS = 60.0, 3600.0, 2.0
#: Delay before the next pass after one has failed, in seconds.
_OUTAGE_SECONDS = 2.0
#: Interval between checks of ending attempts during the shutdown, in seconds.
_SHUTDOWN_SECONDS = 0.2


class Dispatcher:
    """Dispatcher that runs jobs concurrently within the machine's capacity (`service.scheduling.capacity`).

    Args:
        machine: Machine to run jobs on; None detects it.
    """

    def __init__(self, settings: ServiceSettings, store: Store, machine: Machine | None = None) -> None:
        machine = machine or Machine.find(settings)
        self.name = own_name()
        self._settings, self._store = settings, store
        self._artifacts = Artifacts(settings.artifacts_url)
        self._capacity = Capacity(machine, settings.parallel_jobs)
        self._work = settings.folder / "work" / self.name
        self._running: dict[str, RunningAttempt] = {}
        self._announced_at = self._renewed_at = float("-inf")
        self._stop, self._ended = threading.Event(), threading.Event()
        blobs = open_blobs(settings, store.inputs, self._artifacts)
        self._cluster = machine.cluster
        self._prepare = partial(prepare, settings, store, blobs, self._artifacts, self._cluster)
        #: Periodic work in threads of its own, because it may wait for the database, files or receivers: name,
        #: interval in seconds, and function.
        self._helpers = [
            ("lease-keeper", _CHECK_FRACTION * settings.lease_seconds, self._abandon_late),
            ("housekeeper", _HOUSEKEEPING_SECONDS, partial(clean_up, store, self._artifacts, blobs)),
            ("orphan-search", _SEARCH_SECONDS, partial(remove_orphans, store, self._artifacts, blobs)),
        ]
        if settings.webhooks:
            self._helpers.append(("webhooks", _WEBHOOK_SECONDS, Deliverer(settings, store).deliver_due))

    def stop(self) -> None:
        """Make `run` return: running jobs save their state and return to the queue."""
        self._stop.set()

    def run(self) -> None:
        """Run jobs until `stop`."""
        self._work.mkdir(parents=True, exist_ok=True)
        for name, seconds, function in self._helpers:
            threading.Thread(target=self._repeat, args=(seconds, function), name=name, daemon=True).start()
        _log.info("dispatcher started: name=%s capacity=%d", self.name, self._capacity.size)
        work = self._take_over_from_the_dead
        while not self._stop.is_set():
            try:
                work()
                work = self._work_once
            except Exception as error:  # the database is away or locked, or a bug; if it stays so, leases expire
                is_bug = not isinstance(error, DatabaseUnavailableError)
                _log.error("pass failed, retrying: seconds=%.0f: %s", _OUTAGE_SECONDS, error, exc_info=is_bug)
                self._stop.wait(_OUTAGE_SECONDS)
            self._stop.wait(self._settings.poll_seconds)
        self._shut_down()

    def _repeat(self, seconds: float, work: Callable[[], None]) -> None:
        """Call some work periodically until the dispatcher has ended, whatever errors it raises."""
        while True:
            try:
                work()
            except Exception:
                _log.exception("periodic work failed, retrying: seconds=%.0f", seconds)
            if self._ended.wait(seconds):
                return

    def _take_over_from_the_dead(self) -> None:
        """Expire the leases of dead dispatchers of this machine at once, and delete their work folders."""
        known = {row.name for row in self._store.operations.dispatchers()}
        for name in sorted(known.union(self._store.leases.holders())):
            if is_dead(name):
                _log.info("taking over jobs of a dead dispatcher: name=%s", name)
                self._store.leases.expire(name)
        if self._work.parent.is_dir():
            for path in self._work.parent.iterdir():
                if is_dead(path.name):
                    shutil.rmtree(path, ignore_errors=True)

    def _work_once(self) -> None:
        self._running = {job_id: attempt for job_id, attempt in self._running.items() if attempt.alive}
        self._update_leases()
        if time.monotonic() - self._announced_at >= RENEW_FRACTION * self._settings.lease_seconds:
            free = self._capacity.free([attempt.grant for attempt in self._running.values()])
            self._store.operations.record_heartbeat(self.name, self._capacity.size, free)
            self._announced_at = time.monotonic()
        try:
            check_weights()
        except DamagedWeightsError:
            return
        while not self._stop.is_set():
            held = [attempt.grant for attempt in self._running.values()]
            taken = lease_next_job(self.name, self._store, self._capacity, held)
            if taken is None:
                return
            lease, grant = taken
            folder = self._work / f"{lease.job_id}-{lease.epoch}"
            self._running[lease.job_id] = RunningAttempt(
                lease,
                grant,
                folder,
                self._settings,
                self._store,
                self._artifacts,
                self._prepare,
                self._cluster,
            )

    def _update_leases(self) -> None:
        """Renew all leases if that is due, and pass the statuses of the jobs to their attempts; abandon lost jobs."""
        now = time.monotonic()  # taken before the request, so that a lease is never assumed to last too long
        leases = [attempt.lease for attempt in self._running.values()]
        if now - self._renewed_at >= RENEW_FRACTION * self._settings.lease_seconds or not leases:
            statuses = self._store.leases.renew(leases) if leases else {}
            self._renewed_at = now
        else:
            statuses = self._store.leases.statuses(leases)
        for job_id, status in statuses.items():
            attempt = self._running[job_id]
            if status is not None:
                attempt.obey(status)
            elif attempt.alive:
                attempt.abandon()

    def _abandon_late(self) -> None:
        """Abandon jobs whose leases could not be renewed, before the leases expire.

        A thread of its own calls this, because the thread that renews leases may wait for a database that does not
        respond.
        """
        late = time.monotonic() - self._renewed_at
        if late > _ABANDON_FRACTION * self._settings.lease_seconds:
            for attempt in [each for each in dict(self._running).values() if not each.abandoned]:
                _log.error("attempt abandoned: lease not renewed for %.0f s", late, extra=attempt.lease.log_fields)
                attempt.abandon()

    def _shut_down(self) -> None:
        _log.info("dispatcher stopping: running_jobs=%d", len(self._running))
        for attempt in self._running.values():
            attempt.release()
        with contextlib.suppress(Exception):
            self._store.operations.remove_dispatcher(self.name)
        while any(attempt.alive for attempt in self._running.values()):
            with contextlib.suppress(Exception):
                self._update_leases()
            time.sleep(_SHUTDOWN_SECONDS)
        self._ended.set()
        shutil.rmtree(self._work, ignore_errors=True)


def main() -> None:
    """Run a dispatcher with the environment's settings until SIGTERM, SIGINT or SIGHUP."""
    from worker.processes import STOP_SIGNALS, die_with_parent

    if os.environ.get("SGSST_DIE_WITH_PARENT"):
        die_with_parent()
    settings = start()
    dispatcher = Dispatcher(settings, open_store(settings, patience=settings.start_seconds))

    for number in STOP_SIGNALS:
        signal.signal(number, lambda number, frame: dispatcher.stop())
    dispatcher.run()
    logging.shutdown()
    os._exit(0)  # threads that wait for a hanging file store would be waited for


if __name__ == "__main__":
    main()
