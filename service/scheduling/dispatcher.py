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
from types import FrameType

from service.errors import DamagedWeightsError, DatabaseUnavailableError
from service.files.artifacts import Artifacts
from service.files.stored_blobs import open_blobs
from service.scheduling.housekeeping import Housekeeper
from service.scheduling.lease_keeper import RENEW_FRACTION, LeaseKeeper
from service.scheduling.machine import Machine, is_dead, own_name
from service.scheduling.packing import Capacity
from service.scheduling.running import RunningAttempt
from service.scheduling.selection import lease_next_job
from service.scheduling.stager import Stager
from service.scheduling.webhooks import Deliverer
from service.settings import ServiceSettings
from service.startup import start
from service.store import Store, open_store
from service.weights import check_weights

#: Delay before the next pass after one has failed, in seconds.
_OUTAGE_SECONDS = 2.0
#: Interval between checks of ending attempts during the shutdown, in seconds.
_SHUTDOWN_SECONDS = 0.2

_log = logging.getLogger(__name__)


class Dispatcher:
    """Dispatcher that runs jobs concurrently within the machine's capacity (`service.scheduling.packing`).

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
        self._announced_at = float("-inf")
        self._stop = threading.Event()
        blobs = open_blobs(settings, store.inputs, self._artifacts)
        self._stager = Stager(settings, store, blobs, self._artifacts, cluster=machine.cluster)
        self._lease_keeper = LeaseKeeper(store, settings.lease_seconds, self._running)
        self._helpers = Deliverer(settings, store), Housekeeper(store, self._artifacts, blobs)

    def stop(self) -> None:
        """Make `run` return: running jobs save their state and return to the queue."""
        self._stop.set()

    def run(self) -> None:
        """Run jobs until `stop`."""
        self._work.mkdir(parents=True, exist_ok=True)
        for helper in (self._lease_keeper, *self._helpers):
            helper.start()
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

    def _take_over_from_the_dead(self) -> None:
        """Expire the leases of dead dispatchers of this machine at once, and delete their work folders."""
        known = {row.name for row in self._store.operations.dispatchers()}
        for name in sorted(known.union(self._store.leases.holders())):
            if is_dead(name):
                _log.info("taking over jobs of a dead dispatcher: name=%s", name)
                self._store.leases.expire(name)
                self._store.operations.remove_dispatcher(name)
        if self._work.parent.is_dir():
            for path in self._work.parent.iterdir():
                if is_dead(path.name):
                    shutil.rmtree(path, ignore_errors=True)

    def _work_once(self) -> None:
        for job_id, attempt in list(self._running.items()):
            if not attempt.alive:
                del self._running[job_id]
        self._lease_keeper.update()
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
            attempt = RunningAttempt(lease, grant, folder, self._settings, self._store, self._artifacts, self._stager)
            self._running[lease.job_id] = attempt
            attempt.start()

    def _shut_down(self) -> None:
        _log.info("dispatcher stopping: running_jobs=%d", len(self._running))
        for attempt in self._running.values():
            attempt.release()
        with contextlib.suppress(Exception):
            self._store.operations.remove_dispatcher(self.name)
        while any(attempt.alive for attempt in self._running.values()):
            with contextlib.suppress(Exception):
                self._lease_keeper.update()
            time.sleep(_SHUTDOWN_SECONDS)
        for helper in (self._lease_keeper, *self._helpers):
            helper.stop()
        shutil.rmtree(self._work, ignore_errors=True)


def main() -> None:
    """Run a dispatcher with the environment's settings until SIGTERM, SIGINT or SIGHUP."""
    from worker.processes import STOP_SIGNALS, die_with_parent

    if os.environ.get("SGSST_DIE_WITH_PARENT"):
        die_with_parent()
    settings = start()
    dispatcher = Dispatcher(settings, open_store(settings, patience=settings.start_seconds))

    def handle(_number: int, _frame: FrameType | None) -> None:
        dispatcher.stop()

    for number in STOP_SIGNALS:
        signal.signal(number, handle)
    dispatcher.run()
    logging.shutdown()
    os._exit(0)  # threads that wait for a hanging file store would be waited for


if __name__ == "__main__":
    main()
