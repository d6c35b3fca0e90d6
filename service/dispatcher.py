"""The dispatcher: leases jobs from the store and runs them, each attempt in a process of its own.

`python -m service.dispatcher` is one. Any number of them may work on one store; who dies loses its leases.
Ray is started by the process of an attempt that has more than one rank, on that process' main thread, and ends with it:
so neither a job nor Ray can take the dispatcher along.
"""

from __future__ import annotations

import contextlib
import hashlib
import logging
import os
import shutil
import signal
import socket
import threading
import time
from types import FrameType

from sqlalchemy.exc import SQLAlchemyError

from service.artifacts import Artifacts
from service.blobs import BlobFolder
from service.errors import LeaseLostError
from service.logs import set_up
from service.machine import count_gpus
from service.running import RunningAttempt
from service.settings import ServiceSettings
from service.store import Store, open_store
from service.store.jobs import DAY, Lease
from service.store.tables import JobRow
from service.webhooks import Deliverer
from worker.processes import ProcessId, home

#: Seconds between two looks for what has expired.
_HOUSEKEEPING_SECONDS = 60.0
#: Of a lease's time that passes before it is renewed.
_RENEW_SHARE = 1 / 3

_log = logging.getLogger(__name__)


class Dispatcher:
    """Runs jobs until it is told to stop.

    Jobs run side by side as long as there is room: on GPUs, each rank takes one; without any, each job takes one of
    `parallel_jobs` places, and its ranks share the cores.
    """

    def __init__(self, settings: ServiceSettings, store: Store) -> None:
        self._settings, self._store = settings, store
        self._artifacts = Artifacts(settings.artifacts_url)
        self._blobs = BlobFolder(settings.folder, store.inputs, settings.min_free_bytes)
        self._gpus = count_gpus()
        self._places = settings.parallel_jobs or max(1, self._gpus)
        self._running: dict[str, RunningAttempt] = {}
        self._stop = threading.Event()
        self.name = own_name()
        self._work = settings.folder / "work" / self.name
        self._renewed_at = self._kept_at = float("-inf")
        self._deliverer = Deliverer(settings, store)

    def stop(self) -> None:
        """Let `run` end: running jobs save their state and go back into the queue."""
        self._stop.set()

    def run(self) -> None:
        """Work until `stop`."""
        self._take_over_from_the_dead()
        self._work.mkdir(parents=True, exist_ok=True)
        self._deliverer.start()
        _log.info("dispatcher %s is ready: %d places, %d GPUs", self.name, self._places, self._gpus)
        while not self._stop.is_set():
            try:
                self._round()
            except (SQLAlchemyError, OSError):  # the database is away or locked; leases run out if it stays so
                _log.exception("the store cannot be reached")
                self._abandon_expired()
                self._stop.wait(2.0)
            self._stop.wait(self._settings.poll_seconds)
        self._shut_down()

    def _take_over_from_the_dead(self) -> None:
        """Of dispatchers that ran on this machine and are gone, nothing needs to be waited for."""
        for name in self._store.jobs.lease_owners():
            if is_dead(name):
                _log.info("dispatcher %s is gone; its jobs are taken over", name)
                self._store.jobs.end_leases(name)
        if self._work.parent.is_dir():
            for path in self._work.parent.iterdir():
                if is_dead(path.name):
                    shutil.rmtree(path, ignore_errors=True)

    def _round(self) -> None:
        for job_id, attempt in list(self._running.items()):
            if not attempt.alive:
                del self._running[job_id]
        self._renew()
        while not self._stop.is_set() and (lease := self._store.jobs.lease(self.name, self._fits)) is not None:
            self._start(lease)
        if time.monotonic() - self._kept_at > _HOUSEKEEPING_SECONDS:
            self._keep_house()
            self._kept_at = time.monotonic()

    # --- room ------------------------------------------------------------------------------------------------------

    def _free_devices(self) -> list[int]:
        taken = {index for attempt in self._running.values() for index in attempt.devices}
        return [index for index in range(self._gpus) if index not in taken]

    def _ranks(self, job: JobRow) -> int:
        """How many ranks a job gets: as many as it asks for and the machine has; one unless it asks."""
        asked = int(job.parameters.get("workers") or 1)
        return max(1, min(asked, self._gpus)) if self._gpus and not os.environ.get("RAY_ADDRESS") else asked

    def _fits(self, job: JobRow) -> bool:
        if len(self._running) >= self._places:
            return False
        return not self._gpus or len(self._free_devices()) >= min(self._ranks(job), self._gpus)

    def _start(self, lease: Lease) -> None:
        ranks = self._ranks(lease.job)
        devices = self._free_devices()[:ranks]
        folder = self._work / f"{lease.job_id}-{lease.epoch}"
        attempt = RunningAttempt(
            lease, ranks, devices, folder, self._store, self._blobs, self._artifacts, self._settings
        )
        self._running[lease.job_id] = attempt
        attempt.start()

    # --- leases ----------------------------------------------------------------------------------------------------

    def _renew(self) -> None:
        """Hold the leases of all running attempts, and see which of their jobs are to be canceled or are lost."""
        if not self._running:
            self._renewed_at = time.monotonic()
            return
        leases = [attempt.lease for attempt in self._running.values()]
        if time.monotonic() - self._renewed_at >= _RENEW_SHARE * self._settings.lease_seconds:
            found = self._store.jobs.renew(leases)
            self._renewed_at = time.monotonic()
        else:
            found = self._store.jobs.look(leases)
        for job_id, status in found.items():
            attempt = self._running[job_id]
            if status is None and attempt.alive:
                attempt.abandon()
            elif status == "canceling":
                attempt.cancel()

    def _abandon_expired(self) -> None:
        """Without a store for as long as a lease: others may have the jobs by now."""
        if time.monotonic() - self._renewed_at > self._settings.lease_seconds:
            for attempt in self._running.values():
                attempt.abandon()

    def _shut_down(self) -> None:
        _log.info("shutting down: %d running jobs save their state", len(self._running))
        for attempt in self._running.values():
            attempt.release()
        while any(attempt.alive for attempt in self._running.values()):
            with contextlib.suppress(SQLAlchemyError, LeaseLostError):
                self._renew()
            time.sleep(0.2)
        self._deliverer.stop()
        shutil.rmtree(self._work, ignore_errors=True)

    # --- housekeeping ----------------------------------------------------------------------------------------------

    def _keep_house(self) -> None:
        for job_id in self._store.jobs.expire(self._settings.retention_days * DAY):
            self._artifacts.remove_job(job_id)
        self._blobs.collect()


def own_name() -> str:
    """Names this process for good: where it runs, its number there, and when it started."""
    own = ProcessId.of_this()
    return f"{socket.gethostname()[:40]}-{_home()}-{own.number}-{int(own.started)}"


def is_dead(name: str) -> bool:
    """Whether a dispatcher of that name ran where this process can see it, and is gone."""
    parts = name.rsplit("-", 3)
    if len(parts) != 4 or parts[1] != _home() or not (parts[2] + parts[3]).isdigit():
        return False
    return ProcessId(home(), int(parts[2]), float(parts[3]) + 0.5).find() is None


def _home() -> str:
    return hashlib.sha256(repr(home()).encode()).hexdigest()[:8]


def main() -> None:
    """Run a dispatcher with the environment's settings until SIGTERM or SIGINT."""
    from worker.processes import die_with_parent

    if os.environ.get("SGSST_DIE_WITH_PARENT"):
        die_with_parent()
    settings = ServiceSettings()
    set_up(settings.log_format)
    dispatcher = Dispatcher(settings, open_store(settings))

    def handle(number: int, frame: FrameType | None) -> None:
        dispatcher.stop()

    signal.signal(signal.SIGTERM, handle)
    signal.signal(signal.SIGINT, handle)
    dispatcher.run()


if __name__ == "__main__":
    main()
