"""Results: whole files under names of their own, in a local folder or an S3-compatible bucket (fsspec)."""

from __future__ import annotations

import errno
import hashlib
import mimetypes
import os
import secrets
import shutil
from collections.abc import Iterator
from pathlib import Path

import fsspec
from fsspec.implementations.local import LocalFileSystem

from service.store.leases import Published
from sgsst_core.files.atomic import atomic_path

_CHUNK = 1 << 20
#: What the system says where a file cannot have another name there: it is on another file system, or on one without.
_NO_LINKS = (errno.EXDEV, errno.EPERM, errno.ENOTSUP, errno.EMLINK)
_MEDIA_TYPES = {
    ".ply": "application/octet-stream",
    ".json": "application/json",
    ".txt": "text/plain; charset=utf-8",
    ".html": "text/html; charset=utf-8",
}


class Artifacts:
    """Where results are. A name is never written twice: rows in the store point to what counts."""

    def __init__(self, url: str) -> None:
        self._files, self._root = fsspec.core.url_to_fs(url)
        self.local = isinstance(self._files, LocalFileSystem)
        if self.local:
            self._files.makedirs(self._root, exist_ok=True)

    def put(self, job_id: str, epoch: int, name: str, source: Path, *, final: bool = False) -> Published:
        """Bring a file in; it is durable and whole when this returns, and visible once its row is in the store.

        Args:
            final: nobody writes to the file any more, though another may take its name: in a folder of the same file
                system it is not copied, but has one more name.
        """
        location = f"{job_id}/{epoch}/{secrets.token_hex(6)}/{name}"
        if not self.local:
            size, sha256 = _digest(source)
            self._files.put_file(str(source), f"{self._root}/{location}")
            return Published(name, location, size, sha256)
        target = Path(self._root, location)
        target.parent.mkdir(parents=True, exist_ok=True)
        with atomic_path(target) as temporary:
            if not (final and _linked(source, temporary)):
                shutil.copyfile(source, temporary)
            size, sha256 = _digest(temporary)
        return Published(name, location, size, sha256)

    def read(self, location: str, start: int, stop: int) -> Iterator[bytes]:
        """The bytes from `start` up to `stop`, in pieces."""
        with self._files.open(f"{self._root}/{location}", "rb") as file:
            file.seek(start)
            left = stop - start
            while left > 0:
                data = file.read(min(_CHUNK, left))
                if not data:
                    raise OSError(f"{location}: is shorter than its row says")
                left -= len(data)
                yield data

    def fetch(self, location: str, target: Path) -> None:
        """Copy a result to a local file; it appears whole or not at all."""
        with atomic_path(target) as temporary:
            self._files.get_file(f"{self._root}/{location}", str(temporary))

    def remove(self, location: str) -> None:
        """Remove one file, where it is still there."""
        try:
            self._files.rm_file(f"{self._root}/{location}")
        except FileNotFoundError:
            return

    def remove_job(self, job_id: str) -> None:
        """Remove all files of a job."""
        try:
            self._files.rm(f"{self._root}/{job_id}", recursive=True)
        except FileNotFoundError:
            return

    def sweep(self, job_id: str, epoch: int, kept: set[str]) -> None:
        """Remove a job's files that no row refers to: those of attempts that were cut off.

        Args:
            epoch: of the last lease whose files are looked at; a later one's may still be without their rows.
            kept: locations that rows refer to.
        """
        top = f"{self._root}/{job_id}"
        for path in self._files.find(top):
            below = path.rsplit(f"/{job_id}/", 1)[-1]
            location = f"{job_id}/{below}"
            if location not in kept and int(below.partition("/")[0]) <= epoch:
                self.remove(location)

    def ping(self) -> None:
        """Prove that the place can be reached; raises OSError, or what fsspec raises."""
        # a prefix of a bucket is nothing that could be there before something is in it
        place = self._root if self.local else self._root.partition("/")[0]
        self._files.invalidate_cache()
        if not self._files.exists(place):
            raise FileNotFoundError(f"The results' place {place!r} is not there, or cannot be reached.")


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


def _digest(path: Path) -> tuple[int, str]:
    digest, size = hashlib.sha256(), 0
    with path.open("rb") as file:
        while data := file.read(_CHUNK):
            digest.update(data)
            size += len(data)
    return size, digest.hexdigest()
