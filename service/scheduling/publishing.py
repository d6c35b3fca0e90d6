"""What of a running attempt's folder is published: files that grow while it runs, and the results at its end."""

from __future__ import annotations

import contextlib
import shutil
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

from safetensors import SafetensorError, safe_open

from service.files.artifacts import Artifacts
from service.files.names import CHECKPOINT, RESULT
from service.store import Store
from service.store.leases import Lease, Published

#: The end of a log that the error of a crash carries.
_LOG_TAIL = 2000


class Publisher:
    """Puts the files of one attempt to their places, and makes them visible under its lease.

    Args:
        folder: of the attempt.
        log_seconds: between two copies of a log that grows.
    """

    def __init__(self, lease: Lease, folder: Path, store: Store, artifacts: Artifacts, log_seconds: float) -> None:
        self._lease = lease
        self._folder, self._out = folder, folder / "out"
        self._store, self._artifacts = store, artifacts
        self._log_seconds = log_seconds
        self._log_copied_at = float("-inf")
        self._published: dict[str, tuple[int, int]] = {}

    # --- while it runs ---------------------------------------------------------------------------------------------

    def publish_unfinished(self, *, whole_log: bool = False) -> None:
        """Publish what may be looked at while the job runs, as far as it is new or has changed.

        Args:
            whole_log: take the log as it is now, even if it has just been copied.
        """
        self._publish(self._unfinished_files() | self._grown_log(now=whole_log))

    def _unfinished_files(self) -> dict[str, Path]:
        stem = Path(RESULT).stem
        files = {
            "plan.json": self._out / f"{stem}.plan.json",
            "views.jpg": self._out / f"{stem}.views.jpg",
            CHECKPOINT: self._out / f"{stem}.checkpoint.safetensors",
        }
        previews = self._out / "previews"
        if previews.is_dir():
            files |= {f"previews/{path.name}": path for path in previews.glob("step_*.jpg")}
        return files

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

    def _publish(self, files: dict[str, Path]) -> None:
        """Publish those files that are new or have changed."""
        fresh = {}
        for name, path in files.items():
            with contextlib.suppress(FileNotFoundError):
                status = path.stat()
                stamp = (status.st_size, status.st_mtime_ns)
                if self._published.get(name) != stamp:
                    fresh[name] = (path, stamp)
        put = [done for name, (path, _) in fresh.items() if (done := self._store_file(name, path)) is not None]
        if put:
            for location in self._store.leases.publish(self._lease, put):
                self._artifacts.remove(location)
            self._published |= {name: stamp for name, (_, stamp) in fresh.items()}

    def _store_file(self, name: str, path: Path) -> Published | None:
        """Copy a file to the results; None where it has just been replaced or removed."""
        try:
            step = _saved_step(path) if name == CHECKPOINT else None
            # a later checkpoint takes the name of this one, and leaves its bytes
            put = self._artifacts.put(self._lease.job_id, self._lease.epoch, name, path, final=name == CHECKPOINT)
            return replace(put, step=step)
        except FileNotFoundError:
            return None

    # --- at its end ------------------------------------------------------------------------------------------------

    def has_result(self) -> bool:
        """Whether the stylized scene is there."""
        return (self._out / RESULT).is_file()

    def succeed(self, result: dict[str, Any]) -> None:
        """End the job with its results."""
        stem = Path(RESULT).stem
        names = {
            RESULT: self._out / RESULT,
            "report.json": self._out / f"{stem}.report.json",
            "report.html": self._out / f"{stem}.report.html",
            "before_after.jpg": self._out / f"{stem}.before_after.jpg",
            "loss.png": self._out / f"{stem}.loss.png",
        }
        put = [
            self._artifacts.put(self._lease.job_id, self._lease.epoch, name, path, final=True)
            for name, path in names.items()
            if path.is_file()
        ]
        self._store.leases.succeed(self._lease, put, result)

    def sweep(self) -> None:
        """Remove what attempts at the job, which has ended, have left behind."""
        sweep(self._store, self._artifacts, self._lease.job_id, self._lease.epoch)

    def log_tail(self) -> str | None:
        """The end of the log; None where there is none."""
        try:
            return (self._folder / "log.txt").read_bytes()[-_LOG_TAIL:].decode(errors="replace")
        except OSError:
            return None


def sweep(store: Store, artifacts: Artifacts, job_id: str, epoch: int) -> None:
    """Remove what attempts at a job that has ended have left behind.

    Args:
        epoch: of the job's last lease.
    """
    artifacts.sweep(job_id, epoch, {row.location for row in store.jobs.artifacts(job_id)})
    store.retention.mark_swept(job_id, epoch)


def _saved_step(checkpoint: Path) -> int | None:
    """The step that a checkpoint was saved at; None for one that is damaged, which the next attempt will find out.

    Raises:
        FileNotFoundError: it has just been removed.
    """
    try:
        with safe_open(checkpoint, "np") as file:
            return int(file.metadata()["step"])
    except (SafetensorError, TypeError, KeyError):
        return None
