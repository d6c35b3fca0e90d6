"""Results: whole files under names of their own, in the store of files."""

from __future__ import annotations

import errno
import logging
import mimetypes
import os
import secrets
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from service.errors import DamagedFileError, LostFileError
from service.files.cache import file_digest
from service.files.objects import ObjectStore
from service.store.leases import Published
from sgsst_core.files.atomic import atomic_path

#: What the system says where a file cannot have another name there: it is on another file system, or on one without.
_NO_LINKS = (errno.EXDEV, errno.EPERM, errno.ENOTSUP, errno.EMLINK)
_MEDIA_TYPES = {
    ".ply": "application/octet-stream",
    ".json": "application/json",
    ".txt": "text/plain; charset=utf-8",
    ".html": "text/html; charset=utf-8",
}

_log = logging.getLogger(__name__)


class Artifacts:
    """Where results are. A name is never written twice: rows in the store point to what counts."""

    def __init__(self, url: str) -> None:
        self.objects = ObjectStore(url)
        self.local = self.objects.local
        if self.local:
            self.objects.make_folder()

    def put(self, job_id: str, epoch: int, name: str, source: Path, *, final: bool = False) -> Published:
        """Bring a file in; it is durable and whole when this returns, and visible once its row is in the store.

        Args:
            final: nobody writes to the file any more, though another may take its name: in a folder of the same file
                system it is not copied, but has one more name.
        """
        location = f"{job_id}/{epoch}/{secrets.token_hex(6)}/{name}"
        if not self.local:
            with _held(source) as held:
                size, sha256 = held.stat().st_size, file_digest(held)
                self.objects.put(held, location)
            return Published(name, location, size, sha256)
        target = Path(self.objects.root, location)
        target.parent.mkdir(parents=True, exist_ok=True)
        with atomic_path(target) as temporary:
            if not (final and _linked(source, temporary)):
                shutil.copyfile(source, temporary)
            size, sha256 = temporary.stat().st_size, file_digest(temporary)
        return Published(name, location, size, sha256)

    def read(self, location: str, start: int, stop: int) -> Iterator[bytes]:
        """The bytes from `start` up to `stop`, in pieces."""
        return self.objects.read(location, start, stop)

    def check(self, location: str, sha256: str) -> None:
        """Prove that a result is what its row says, unless that has just been done.

        Raises:
            LostFileError, DamagedFileError: It is not.
        """
        self.objects.check_once(location, sha256)

    def fetch(self, location: str, target: Path, sha256: str) -> None:
        """Copy a result to a local file; it appears whole or not at all.

        Raises:
            LostFileError: The result is not in the store of files.
            DamagedFileError: What came has another SHA-256.
        """
        try:
            with atomic_path(target) as temporary:
                self.objects.get(location, temporary)
                found = file_digest(temporary)
                if found != sha256:
                    _log.error("%s is damaged: its SHA-256 is %s, and should be %s", location, found, sha256)
                    raise DamagedFileError.of(sha256)
        except FileNotFoundError as error:
            raise LostFileError.of(sha256) from error

    def remove(self, location: str) -> None:
        """Remove one file, where it is still there."""
        self.objects.remove(location)

    def remove_job(self, job_id: str) -> None:
        """Remove all files of a job."""
        self.objects.remove_below(job_id)

    def sweep(self, job_id: str, epoch: int, kept: set[str]) -> None:
        """Remove a job's files that no row refers to: those of attempts that were cut off.

        Args:
            epoch: of the last lease whose files are looked at; a later one's may still be without their rows.
            kept: locations that rows refer to.
        """
        for location in self.objects.below(job_id):
            below = location.partition("/")[2]
            if location not in kept and int(below.partition("/")[0]) <= epoch:
                self.remove(location)

    def ping(self) -> None:
        """Prove that the place can be reached; raises OSError or StoreError."""
        self.objects.ping()


def media_type(name: str) -> str:
    """What a result is, for HTTP."""
    return _MEDIA_TYPES.get(Path(name).suffix) or mimetypes.guess_type(name)[0] or "application/octet-stream"


def _linked(source: Path, target: Path) -> bool:
    """Put a file's second name in the place of another file, where the file system can."""
    target.unlink()
    try:
        os.link(source, target)
    except OSError as error:
        if error.errno not in _NO_LINKS:
            raise
        return False
    return True


@contextmanager
def _held(source: Path) -> Iterator[Path]:
    """One more name for a file as it is now: whoever replaces it meanwhile changes nothing of what is sent."""
    held = source.with_name(f".{secrets.token_hex(6)}-{source.name}")
    try:
        os.link(source, held)
    except OSError as error:
        if error.errno not in _NO_LINKS:
            raise
        yield source
        return
    try:
        yield held
    finally:
        held.unlink(missing_ok=True)
