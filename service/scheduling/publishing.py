"""Publication of an attempt's files by the dispatcher: some while the attempt runs, the results at its end."""

from __future__ import annotations

import contextlib
import logging
import shutil
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from safetensors import SafetensorError, safe_open

from service.files.objects import Artifacts, disk_errors
from service.inputs import CHECKPOINT, RESULT
from service.problems import NoSpaceError, ServiceError, StoreError
from service.states import Published
from service.store import Store
from service.store.queue import LIVE, Lease

#: Length of the log's end in the error of a crash, in bytes.
_LOG_TAIL = 2000
#: Delay in seconds before a failed upload is retried, and time in seconds after which an attempt fails if its results
#: cannot be uploaded. The latter is long enough for a restart of the file store, which must not lose a finished job.
_RETRY_SECONDS, PATIENCE_SECONDS = 5.0, 600.0

_log = logging.getLogger(__name__)
_STEM = Path(RESULT).stem
#: Result files of an ended job by artifact name.
_RESULTS = {
    "report.json": f"{_STEM}.report.json",
    "report.html": f"{_STEM}.report.html",
    "before_after.jpg": f"{_STEM}.before_after.jpg",
    "loss.png": f"{_STEM}.loss.png",
    "colors.f16": f"{_STEM}.colors.f16",
}
#: Names of files that become visible only when the job ends.
RESULTS = frozenset((RESULT, *_RESULTS))


class Outbox:
    """Uploader of an attempt's files; users can see them only once they have database rows.

    Args:
        out: Folder that the attempt writes to.
    """

    def __init__(self, job_id: str, epoch: int, out: Path, artifacts: Artifacts) -> None:
        self._job_id, self._epoch = job_id, epoch
        self._out, self._artifacts = out, artifacts
        self._uploaded: dict[str, tuple[int, int]] = {}

    def unfinished(self) -> dict[str, Path]:
        """Return the files that are visible while the job runs; some may not exist yet."""
        files = {
            "plan.json": self._out / f"{_STEM}.plan.json",
            "views.jpg": self._out / f"{_STEM}.views.jpg",
            CHECKPOINT: self._out / f"{_STEM}.checkpoint.safetensors",
        }
        files |= {f"previews/{path.name}": path for path in (self._out / "previews").glob("[!.]*.jpg")}
        return files | {f"{LIVE}{path.name}": path for path in (self._out / LIVE).glob("[!.]*")}

    def results(self) -> dict[str, Path]:
        """Return the result files of an ended job."""
        files = {RESULT: self._out / RESULT} | {name: self._out / file for name, file in _RESULTS.items()}
        return {name: path for name, path in files.items() if path.is_file()}

    def put(self, files: Mapping[str, Path]) -> tuple[list[Published], ServiceError | None]:
        """Upload new and changed files; return them, and the error that stopped the upload (None for no error)."""
        done = []
        for name, path in files.items():
            with contextlib.suppress(FileNotFoundError):
                status = path.stat()
                stamp = (status.st_size, status.st_mtime_ns)
                if self._uploaded.get(name) == stamp:
                    continue
                # later checkpoints and colors replace the file instead of overwriting it; results are never rewritten
                final = name == CHECKPOINT or name in RESULTS or name.startswith(LIVE)
                step = _saved_step(path) if name == CHECKPOINT else None
                try:
                    file = self._artifacts.put(self._job_id, self._epoch, name, path, final=final)
                    done.append(replace(file, step=step))
                except (StoreError, NoSpaceError) as error:
                    return done, error
                self._uploaded[name] = stamp
        return done, None


def _saved_step(checkpoint: Path) -> int | None:
    """Return the step of a checkpoint; None if it is damaged, which the next attempt detects.

    Raises:
        FileNotFoundError: If the checkpoint has just been removed.
    """
    try:
        with safe_open(checkpoint, "np") as file:
            return int(file.metadata()["step"])
    except (SafetensorError, TypeError, KeyError):
        return None


class Publisher:
    """Publisher of one attempt's files, which makes them visible under its lease.

    Args:
        log_seconds: Interval between copies of a growing log.
    """

    def __init__(self, lease: Lease, folder: Path, store: Store, artifacts: Artifacts, log_seconds: float) -> None:
        self._lease, self._folder = lease, folder
        self._store, self._artifacts = store, artifacts
        self._outbox = Outbox(lease.job_id, lease.epoch, folder / "out", artifacts)
        self._log_seconds = log_seconds
        self._log_copied_at = self._refused_at = float("-inf")
        self._results: dict[str, Published] = {}

    # --- during the attempt ---------------------------------------------------------------------------------------

    def publish_unfinished(self, *, whole_log: bool = False) -> None:
        """Publish new and changed files that are visible while the job runs.

        If the file store rejects them, the job continues and the upload is repeated later.

        Args:
            whole_log: Whether to publish the current log even if it has just been copied.
        """
        if time.monotonic() - self._refused_at < _RETRY_SECONDS and not whole_log:
            return
        refused: ServiceError | None
        put: list[Published]
        try:
            with disk_errors():
                files = self._outbox.unfinished() | self._grown_log(now=whole_log)
        except (StoreError, NoSpaceError) as error:  # there is no space for a copy of the log
            put, refused = [], error
        else:
            put, refused = self._outbox.put(files)
        self.publish(put)
        if refused is not None:
            self._refused_at = time.monotonic()
            _log.warning("upload failed, retrying: %s", _reason(refused), extra=self._lease.log_fields)

    def publish(self, files: Sequence[Published]) -> None:
        """Make stored files visible, except for results, which become visible at the end."""
        self._results |= {file.name: file for file in files if file.name in RESULTS}
        now = [file for file in files if file.name not in RESULTS]
        if now:
            self._remove(self._store.leases.publish(self._lease, now))

    def _remove(self, locations: Sequence[str]) -> None:
        """Remove replaced files; those that remain are swept when the job has ended."""
        try:
            for location in locations:
                self._artifacts.objects.remove(location)
        except StoreError as error:
            _log.warning("replaced files not deleted yet: %s", _reason(error), extra=self._lease.log_fields)

    def _grown_log(self, *, now: bool) -> dict[str, Path]:
        """Return a copy of the log if one is due, because the process keeps writing to the log itself."""
        log, copy = self._folder / "log.txt", self._folder / "log-so-far.txt"
        moment = time.monotonic()
        if not now and moment - self._log_copied_at < self._log_seconds:
            return {}
        self._log_copied_at = moment
        if now or log.stat().st_size != (copy.stat().st_size if copy.exists() else 0):
            shutil.copyfile(log, copy)
        return {"log.txt": copy}

    # --- at the end of the attempt --------------------------------------------------------------------------------

    def has_result(self) -> bool:
        """Return whether the stylized scene exists."""
        return RESULT in self._results or RESULT in self._outbox.results()

    def succeed(self, result: dict[str, Any], given_up: Callable[[], bool] = lambda: False) -> None:
        """Mark the job as succeeded and publish its results.

        Args:
            given_up: Callback that returns whether to stop waiting; it is called while the file store is unreachable.

        Raises:
            StoreError, NoSpaceError: If the store was unreachable or full for too long.
        """
        self.publish(put_patiently(self._outbox, given_up))
        self._store.leases.succeed(self._lease, list(self._results.values()), result)

    def sweep(self) -> None:
        """Remove leftovers of all attempts at the ended job; housekeeping repeats it if it fails."""
        try:
            sweep(self._store, self._artifacts, self._lease.job_id, self._lease.epoch)
        except StoreError as error:
            _log.warning("leftover files not deleted yet: %s", _reason(error), extra=self._lease.log_fields)

    def log_tail(self) -> str | None:
        """Return the end of the log; None if there is no log."""
        try:
            return (self._folder / "log.txt").read_bytes()[-_LOG_TAIL:].decode(errors="replace")
        except OSError:
            return None


def put_patiently(outbox: Outbox, given_up: Callable[[], bool]) -> list[Published]:
    """Upload a job's results; retry failed uploads, because the results would be lost otherwise.

    Raises:
        StoreError, NoSpaceError: If the file store was unreachable or full for too long, or `given_up` returned true.
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
        _log.warning("upload of results failed, retrying: %s", _reason(refused))
        time.sleep(_RETRY_SECONDS)


def _reason(error: ServiceError) -> str:
    """Return an error with its cause, for the operator."""
    cause = error.__cause__
    return f"{error} ({type(cause).__name__}: {cause})" if cause is not None else str(error)


def sweep(store: Store, artifacts: Artifacts, job_id: str, epoch: int) -> None:
    """Remove leftovers of all attempts at an ended job.

    Args:
        epoch: Epoch of the job's last lease.
    """
    artifacts.sweep(job_id, epoch, {row.location for row in store.jobs.artifacts(job_id)})
    store.retention.mark_swept(job_id, epoch)
