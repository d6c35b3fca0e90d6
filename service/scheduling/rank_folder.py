"""Staging of a job's files on a machine that shares only the file store with the dispatcher (`StoreWorkplace`).

Settings come from the machine itself: the environment of its Ray node defines the data folder (`SGSST_DATA`, a
temporary folder by default), the size of the cache, and the credentials of the store.
"""

from __future__ import annotations

import contextlib
import fcntl
import logging
import os
import secrets
import shutil
import socket
import stat
import tempfile
import threading
import time
from collections.abc import Sequence
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

from service import problems
from service.files.blobs import open_cache
from service.files.objects import Artifacts, ObjectStore
from service.inputs import RESULT, stage
from service.problems import DamagedFileError, LostFileError, ServiceError
from service.scheduling.messages import StoreWorkplace
from service.scheduling.publishing import Outbox, put_patiently
from service.settings import ServiceSettings, keep_private, read_settings
from service.states import Published
from service.store.tables import ArtifactRow
from sgsst_core.errors import InfrastructureError
from sgsst_core.features.weight_files import cache_folder
from sgsst_core.files.atomic import file_digest
from worker.run import Stored

#: Interval between checks for new files to upload, in seconds.
_SCAN_SECONDS = 0.5
#: Delay in seconds before files that the store rejected are uploaded again.
_RETRY_SECONDS = 5.0
#: Prefix of the names of feature network weights in the store.
_WEIGHTS_FOLDER = "weights"

_log = logging.getLogger(__name__)


class RankFolder:
    """Folder of a rank, locked while the rank lives, so that other ranks can recognize leftover folders.

    Folders of killed ranks are removed by the driver and by later ranks.
    """

    def __init__(self, workplace: StoreWorkplace, rank: int, stored: Stored) -> None:
        settings = node_settings()
        keep_private(settings)
        parent = _ranks_folder(settings)
        parent.mkdir(parents=True, exist_ok=True)
        remove_leftovers()
        self._root = parent / f"{workplace.job_id}-{workplace.epoch}-{rank}-{secrets.token_hex(4)}"
        with _locked(parent / "all"):  # an unlocked folder would be taken for a leftover
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
                refused = self._upload()
            except Exception:  # the job continues whatever the error is
                _log.exception("upload failed, retrying")
                refused = None
            if refused is not None:
                _log.warning("upload failed, retrying: %s", refused.__cause__ or refused)
                self._stop.wait(_RETRY_SECONDS)

    def _upload(self) -> ServiceError | None:
        put, refused = self._outbox.put(self._outbox.unfinished())
        self._report(put)
        return refused

    def _report(self, files: Sequence[Published]) -> None:
        for file in files:
            self._stored(file, file.step)

    def finish(self, *, done: bool) -> None:
        self.stop()
        if done:
            self._report(put_patiently(self._outbox, lambda: False))
        refused = self._upload()
        if refused is not None and not done:
            time.sleep(_RETRY_SECONDS)
            refused = self._upload()
            if refused is not None:
                raise refused

    def stop(self) -> None:
        self._stop.set()
        self._thread.join()


def fetch_checkpoint(artifacts: Artifacts, checkpoint: ArtifactRow | Published, out: Path) -> None:
    """Fetch a checkpoint into the folder of outputs; if it is lost or damaged, the job starts from the first step."""
    try:
        artifacts.fetch(checkpoint.location, out / f"{Path(RESULT).stem}.checkpoint.safetensors", checkpoint.sha256)
    except (LostFileError, DamagedFileError) as error:
        _log.warning("checkpoint not usable, job restarts: name=%s: %s", checkpoint.location, error)


def store_weights(objects: ObjectStore) -> tuple[Published, ...]:
    """Upload this machine's installed weights unless they are stored already, and return them.

    Raises:
        StoreError: If the store cannot be reached.
    """
    weights = []
    for path in sorted(cache_folder().glob("*.safetensors")):
        status = path.stat()
        sha256 = _digest(path, status.st_size, status.st_mtime_ns)
        location = f"{_WEIGHTS_FOLDER}/{sha256}"
        if objects.size(location) < 0:
            objects.put(path, location)
        weights.append(Published(path.name, location, status.st_size, sha256))
    return tuple(weights)


@lru_cache
def _digest(path: Path, _size: int, _changed: int) -> str:
    return file_digest(path)


def node_settings() -> ServiceSettings:
    """Return the settings of this machine; the data folder is temporary unless the environment defines one.

    Raises:
        InfrastructureError: If other users have made the temporary folder, or can change it.
    """
    if os.environ.get("SGSST_DATA"):
        return read_settings()
    folder = Path(tempfile.gettempdir()) / f"sgsst-{os.getuid()}"
    with contextlib.suppress(FileExistsError):
        folder.mkdir(mode=0o700)
    status = folder.lstat()
    if not stat.S_ISDIR(status.st_mode) or status.st_uid != os.getuid() or status.st_mode & 0o022:
        raise InfrastructureError(
            f"{folder} on {socket.gethostname()} is no folder that only this user can write to. Delete it, or set "
            "SGSST_DATA there."
        )
    return ServiceSettings(data=folder)


def _ranks_folder(settings: ServiceSettings) -> Path:
    return settings.folder / "ranks"


def remove_leftovers() -> None:
    """Remove the folders of dead ranks on this machine: those whose lock is not held."""
    try:
        parent = _ranks_folder(node_settings())
    except InfrastructureError:  # ranks refuse it, too
        return
    if not parent.is_dir():
        return
    with _locked(parent / "all"):
        for path in parent.iterdir():
            if not path.is_dir():
                continue
            with contextlib.suppress(OSError), (path / "lock").open("a") as lock:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
                shutil.rmtree(path, ignore_errors=True)


@contextlib.contextmanager
def _locked(path: Path) -> Any:
    with path.open("w") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        yield
