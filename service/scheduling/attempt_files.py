"""Files of an attempt: staged for its ranks, published while it runs, and its results at its end.

Ranks stage them themselves on machines that share only the file store with the dispatcher (`StoreWorkplace`). Settings
come from such a machine itself: the environment of its Ray node defines the data folder (`SGSST_DATA`), the size of the
cache, and the credentials of the store.
"""

import contextlib
import fcntl
import logging
import os
import secrets
import shutil
import socket
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

from safetensors import SafetensorError, safe_open

from service import problems
from service.deadlines import until_answered
from service.files.blobs import open_cache
from service.files.objects import Artifacts, ObjectStore, disk_errors, locked
from service.inputs import CHECKPOINT, RESULT, stage
from service.problems import DamagedFileError, LostFileError, NoSpaceError, ServiceError, StoreError
from service.scheduling.messages import StoreWorkplace
from service.settings import ServiceSettings, keep_private, read_settings
from service.states import Published
from service.store import Store
from service.store.queue import LIVE, Lease
from service.store.tables import ArtifactRow
from sgsst_core.errors import InfrastructureError
from sgsst_core.features.weight_files import cache_folder
from sgsst_core.files.atomic import file_digest
from worker.run import Stored

#: Length of the log's end in the error of a crash, in bytes.
_LOG_TAIL = 2000
#: Delay in seconds before a failed upload is retried, and time in seconds after which an attempt fails if its results
#: cannot be uploaded. The latter is long enough for a restart of the file store, which must not lose a finished job.
_RETRY_SECONDS, PATIENCE_SECONDS = 5.0, 600.0

_log = logging.getLogger(__name__)
_STEM = Path(RESULT).stem
#: Interval between checks of a rank for new files to upload, in seconds.
_SCAN_SECONDS = 0.5
#: Prefix of the names of feature network weights in the store.
_WEIGHTS_FOLDER = "weights"
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

    def put(self, files: Mapping[str, Path], stored: Callable[[Published], None]) -> None:
        """Upload new and changed files.

        Args:
            stored: Callback that receives each file once it is stored.

        Raises:
            StoreError, NoSpaceError: If the file store rejects a file.
        """
        for name, path in files.items():
            with contextlib.suppress(FileNotFoundError):
                status = path.stat()
                stamp = (status.st_size, status.st_mtime_ns)
                if self._uploaded.get(name) == stamp:
                    continue
                # later checkpoints and colors replace the file instead of overwriting it; results are never rewritten
                final = name == CHECKPOINT or name in RESULTS or name.startswith(LIVE)
                step = _saved_step(path) if name == CHECKPOINT else None
                file = self._artifacts.put(self._job_id, self._epoch, name, path, final=final)
                self._uploaded[name] = stamp
                stored(replace(file, step=step))


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
        put: list[Published] = []
        try:
            with disk_errors():
                files = self._outbox.unfinished() | self._grown_log(now=whole_log)
            self._outbox.put(files, put.append)
        except (StoreError, NoSpaceError) as error:
            self._refused_at = time.monotonic()
            _log.warning("upload failed, retrying: %s", _reason(error), extra=self._lease.log_fields)
        self.publish(put)

    def publish(self, files: Sequence[Published]) -> None:
        """Make stored files visible, except for results, which become visible at the end."""
        self._results |= {file.name: file for file in files if file.name in RESULTS}
        now = [file for file in files if file.name not in RESULTS]
        if now:
            self._artifacts.objects.discard(self._store.leases.publish(self._lease, now))

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

    def log_tail(self) -> str:
        """Return the end of the log."""
        return (self._folder / "log.txt").read_bytes()[-_LOG_TAIL:].decode(errors="replace")


def put_patiently(outbox: Outbox, given_up: Callable[[], bool] = lambda: False) -> list[Published]:
    """Upload a job's results; retry failed uploads, because the results would be lost otherwise.

    Raises:
        StoreError, NoSpaceError: If the file store was unreachable or full for too long, or `given_up` returned true.
    """
    done: list[Published] = []
    until_answered(lambda: outbox.put(outbox.results(), done.append), PATIENCE_SECONDS, given_up)
    return done


def _reason(error: Exception) -> str:
    """Return an error with its cause, for the operator."""
    cause = error.__cause__
    return f"{error} ({type(cause).__name__}: {cause})" if cause is not None else str(error)


# --- on machines that share only the file store -------------------------------------------------------------------


class RankFolder:
    """Folder of a rank, locked while the rank lives, so that other ranks can recognize leftover folders.

    Folders of killed ranks are removed by the driver and by later ranks.
    """

    def __init__(self, workplace: StoreWorkplace, rank: int, stored: Stored) -> None:
        if not os.environ.get("SGSST_DATA"):
            raise InfrastructureError(
                f"{socket.gethostname()} has no SGSST_DATA. Set it to a folder before `ray start`."
            )
        settings = read_settings()
        keep_private(settings)
        parent = settings.folder / "ranks"
        parent.mkdir(parents=True, exist_ok=True)
        remove_leftovers()
        self._root = parent / f"{workplace.job_id}-{workplace.epoch}-{rank}-{secrets.token_hex(4)}"
        with locked(parent / "all"):  # an unlocked folder would be taken for a leftover
            self._root.mkdir()
            self._lock = (self._root / "lock").open("w")
            fcntl.flock(self._lock, fcntl.LOCK_EX)
        self.folder = self._root / "job"
        self._uploader: _Uploader | None = None
        try:
            self._stage(workplace, settings, rank)
        except BaseException:
            self.close()
            raise
        if rank == 0:
            outbox = Outbox(workplace.job_id, workplace.epoch, self.folder / "out", Artifacts(workplace.url))
            self._uploader = _Uploader(outbox, stored)

    def _stage(self, workplace: StoreWorkplace, settings: ServiceSettings, rank: int) -> None:
        cache, artifacts = open_cache(settings), Artifacts(workplace.url)
        files, weights, out = self._root / "files", self._root / "weights", self.folder / "out"
        for path in (files, weights, out):
            path.mkdir(parents=True)

        def link(file: Published, target: Path) -> Path:
            cache.link(file.sha256, file.size, target, partial(artifacts.objects.get, file.location))
            return target

        blobs = {file.sha256: link(file, files / file.sha256) for file in workplace.files}
        stage(self.folder, workplace.inputs, blobs)
        try:
            for file in workplace.weights:
                link(file, weights / file.name)
        except (LostFileError, DamagedFileError) as error:  # not the user's fault, and the user cannot send it again
            raise problems.STORE_UNAVAILABLE("The network's weights in the store of files cannot be used.") from error
        if workplace.weights:
            os.environ["SGSST_CACHE"] = str(weights)
        if workplace.checkpoint is not None and rank == 0:
            fetch_checkpoint(artifacts, workplace.checkpoint, out)

    def finish(self, *, done: bool) -> None:
        """Upload the remaining files: a checkpoint, or the results.

        Raises:
            StoreError: If the store was unreachable for too long.
        """
        if self._uploader is not None:
            self._uploader.finish(done=done)

    def close(self) -> None:
        """Remove the folder."""
        if self._uploader is not None:
            self._uploader.stop()
        shutil.rmtree(self._root, ignore_errors=True)
        self._lock.close()


class _Uploader:
    """Uploader of a job's files in its own thread, so that steps do not wait for the store."""

    def __init__(self, outbox: Outbox, stored: Stored) -> None:
        self._outbox, self._stored = outbox, stored
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="uploader", daemon=True)
        self._thread.start()

    def _run(self) -> None:
        while not self._stop.wait(_SCAN_SECONDS):
            try:
                self._upload()
            except Exception as error:  # the job continues whatever the error is
                is_bug = not isinstance(error, ServiceError)
                _log.warning("upload failed, retrying: %s", _reason(error), exc_info=is_bug)
                self._stop.wait(_RETRY_SECONDS)

    def _upload(self) -> None:
        self._outbox.put(self._outbox.unfinished(), self._report)

    def _report(self, file: Published) -> None:
        self._stored(file, file.step)

    def finish(self, *, done: bool) -> None:
        self.stop()
        if done:
            for file in put_patiently(self._outbox):
                self._report(file)
        try:
            self._upload()
        except (StoreError, NoSpaceError):
            if not done:
                time.sleep(_RETRY_SECONDS)
                self._upload()

    def stop(self) -> None:
        self._stop.set()
        self._thread.join()


def fetch_checkpoint(artifacts: Artifacts, checkpoint: ArtifactRow | Published, out: Path) -> None:
    """Fetch a checkpoint into the folder of outputs; if it is lost or damaged, the job starts from the first step."""
    try:
        artifacts.fetch(checkpoint.location, out / f"{_STEM}.checkpoint.safetensors", checkpoint.sha256)
    except (LostFileError, DamagedFileError) as error:
        _log.warning("checkpoint not usable, job restarts: name=%s: %s", checkpoint.location, error)


def store_weights(objects: ObjectStore) -> tuple[Published, ...]:
    """Upload this machine's installed weights unless they are stored already, and return them.

    Raises:
        StoreError: If the store cannot be reached.
    """
    weights = []
    for path in sorted(cache_folder().glob("*.safetensors")):
        sha256 = file_digest(path)
        location = f"{_WEIGHTS_FOLDER}/{sha256}"
        if objects.size(location) < 0:
            objects.put(path, location)
        weights.append(Published(path.name, location, path.stat().st_size, sha256))
    return tuple(weights)


def remove_leftovers() -> None:
    """Remove the folders of dead ranks on this machine: those whose lock is not held."""
    parent = read_settings().folder / "ranks"
    if parent.is_dir():
        with locked(parent / "all"):
            for path in filter(Path.is_dir, parent.iterdir()):
                with contextlib.suppress(OSError), (path / "lock").open("a") as lock:
                    fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
                    shutil.rmtree(path, ignore_errors=True)
