"""What attempts have made becomes visible: while they run, and the results at their end. By the dispatcher alone."""

from __future__ import annotations

import logging
import shutil
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from service.errors import StoreError
from service.files.artifacts import Artifacts
from service.files.names import RESULT
from service.scheduling.outbox import RESULTS, Outbox
from service.store import Store
from service.store.leases import Lease, Published

#: The end of a log that the error of a crash carries.
_LOG_TAIL = 2000
#: Seconds between two tries to put what the store of files did not take, and for results until the attempt is given up:
#: a store that restarts must not cost a job that has just ended.
_AGAIN_SECONDS, PATIENCE_SECONDS = 5.0, 600.0

_log = logging.getLogger(__name__)


class Publisher:
    """Puts the files of one attempt to their places, and makes them visible under its lease.

    Args:
        folder: of the attempt.
        log_seconds: between two copies of a log that grows.
    """

    def __init__(self, lease: Lease, folder: Path, store: Store, artifacts: Artifacts, log_seconds: float) -> None:
        self._lease, self._folder = lease, folder
        self._store, self._artifacts = store, artifacts
        self._outbox = Outbox(lease.job_id, lease.epoch, folder / "out", artifacts)
        self._log_seconds = log_seconds
        self._log_copied_at = self._refused_at = float("-inf")
        self._results: dict[str, Published] = {}

    # --- while it runs ---------------------------------------------------------------------------------------------

    def publish_unfinished(self, *, whole_log: bool = False) -> None:
        """Publish what may be looked at while the job runs, as far as it is new or has changed.

        Where the store of files does not take it, the job goes on, and this is tried again later.

        Args:
            whole_log: take the log as it is now, even if it has just been copied.
        """
        if time.monotonic() - self._refused_at < _AGAIN_SECONDS and not whole_log:
            return
        put, refused = self._outbox.put(self._outbox.unfinished() | self._grown_log(now=whole_log))
        self.publish(put)
        if refused is not None:
            self._refused_at = time.monotonic()
            _log.warning("%s: some files could not be stored: %s", self._lease.job_id, _reason(refused))

    def publish(self, files: Sequence[Published]) -> None:
        """Make files visible that are in the store of files; results are kept for the end."""
        self._results |= {file.name: file for file in files if file.name in RESULTS}
        now = [file for file in files if file.name not in RESULTS]
        if now:
            self._remove(self._store.leases.publish(self._lease, now))

    def _remove(self, locations: Sequence[str]) -> None:
        """Remove what nothing refers to now; what stays is swept when the job has ended."""
        try:
            for location in locations:
                self._artifacts.remove(location)
        except StoreError as error:
            _log.warning("%s: replaced files could not be deleted yet: %s", self._lease.job_id, _reason(error))

    def _grown_log(self, *, now: bool) -> dict[str, Path]:
        """A copy of the log as far as it is, once in a while: the process goes on writing to the log itself."""
        log, copy = self._folder / "log.txt", self._folder / "log-so-far.txt"
        moment = time.monotonic()
        if not now and moment - self._log_copied_at < self._log_seconds:
            return {}
        self._log_copied_at = moment
        if now or log.stat().st_size != (copy.stat().st_size if copy.exists() else 0):
            shutil.copyfile(log, copy)
        return {"log.txt": copy}

    # --- at its end ------------------------------------------------------------------------------------------------

    def has_result(self) -> bool:
        """Whether the stylized scene is there."""
        return RESULT in self._results or RESULT in self._outbox.results()

    def succeed(self, result: dict[str, Any], given_up: Callable[[], bool] = lambda: False) -> None:
        """End the job with its results.

        Args:
            given_up: asked while the store of files is away: whether to wait no longer.

        Raises:
            StoreError: it was away for too long.
        """
        self.publish(put_patiently(self._outbox, given_up))
        self._store.leases.succeed(self._lease, list(self._results.values()), result)

    def sweep(self) -> None:
        """Remove what attempts at the job, which has ended, have left behind; housekeeping does what this cannot."""
        try:
            sweep(self._store, self._artifacts, self._lease.job_id, self._lease.epoch)
        except StoreError as error:
            _log.warning("%s: leftover files could not be deleted: %s", self._lease.job_id, _reason(error))

    def log_tail(self) -> str | None:
        """The end of the log; None where there is none."""
        try:
            return (self._folder / "log.txt").read_bytes()[-_LOG_TAIL:].decode(errors="replace")
        except OSError:
            return None


def put_patiently(outbox: Outbox, given_up: Callable[[], bool]) -> list[Published]:
    """Put a job's results, which would be lost otherwise: as often as it takes.

    Raises:
        StoreError: the store of files was away for too long, or `given_up` said so.
    """
    started = time.monotonic()
    done: list[Published] = []
    while True:
        put, refused = outbox.put(outbox.results())
        done += put
        if refused is None:
            return done
        if given_up() or time.monotonic() - started > PATIENCE_SECONDS:
            raise refused
        _log.warning("results could not be stored; retrying: %s", _reason(refused))
        time.sleep(_AGAIN_SECONDS)


def _reason(error: StoreError) -> str:
    """What is behind it, for the operator."""
    cause = error.__cause__
    return f"{error} ({type(cause).__name__}: {cause})" if cause is not None else str(error)


def sweep(store: Store, artifacts: Artifacts, job_id: str, epoch: int) -> None:
    """Remove what attempts at a job that has ended have left behind.

    Args:
        epoch: of the job's last lease.
    """
    if store.database.rolled_back:
        return
    artifacts.sweep(job_id, epoch, {row.location for row in store.jobs.artifacts(job_id)})
    store.retention.mark_swept(job_id, epoch)
