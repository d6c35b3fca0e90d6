"""A host's copies of files that are in the store: each fetched once, verified by its SHA-256, bounded in size.

A file is named by its digest. Who wants one gets one more name for it (a hard link) in a folder of its own on the same
file system: what has more than one name is in use, and is not evicted. Any number of processes may share a cache: files
appear by renaming, each digest is fetched under a lock, and evicting a name takes nothing from those who have another.
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import hashlib
import logging
import os
import secrets
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

from service.errors import DamagedFileError, LostFileError, NoSpaceError

_CHUNK = 1 << 20
#: Fetches of one file before what comes counts as damaged in the store itself.
_TRIES = 2
#: Half files of processes that died are removed at this age: no fetch takes so long.
_HALF_SECONDS = 6 * 3600.0
#: What the system says when there is no room left.
_NO_ROOM = (errno.ENOSPC, errno.EDQUOT)

_log = logging.getLogger(__name__)

#: Copies an object of the store to a file.
Fetch = Callable[[Path], None]


@dataclass(frozen=True)
class _Entry:
    path: Path
    size: int
    names: int
    used_at: int


class FileCache:
    """The cache of a folder.

    Args:
        folder: made where it is missing.
        limit: bytes of all files together; what is in use stays, and may make it more.
    """

    def __init__(self, folder: Path, limit: int) -> None:
        self._files, self._locks, self._half = folder / "files", folder / "locks", folder / "half"
        self._limit = limit
        for path in (self._files, self._locks, self._half):
            path.mkdir(parents=True, exist_ok=True)

    def link(self, sha256: str, size: int, target: Path, fetch: Fetch) -> None:
        """Give a file one more name, after fetching it where it is not there, or damaged on this host's disk.

        Args:
            target: on the file system of the cache; nothing is there yet.
            fetch: brings it from the store.

        Raises:
            LostFileError: the store does not have it.
            DamagedFileError: what came is not what was asked for.
            StoreError: `fetch` raised it.
            NoSpaceError: the disk is full, whatever was evicted.
        """
        if self._linked(sha256, target):
            return
        with self._locked(sha256[:2]):
            if self._linked(sha256, target):
                return
            self._fill(sha256, size, target, fetch)
        self.evict()

    def adopt(self, source: Path, sha256: str) -> None:
        """Take a whole, verified file over as it is; where it is there already, `source` is removed."""
        with self._locked(sha256[:2]):
            if self._path(sha256).exists():
                source.unlink()
            else:
                self._keep(source, sha256)
        self.evict()

    def evict(self, wanted: int = 0) -> None:
        """Remove what was used longest ago, as far as nobody uses it now.

        Args:
            wanted: bytes that are to be free below the limit.
        """
        if self._total() + wanted <= self._limit:
            return
        with self._locked("evict"):
            entries = sorted(self._entries(), key=lambda entry: entry.used_at)
            total = sum(entry.size for entry in entries) + wanted
            for entry in entries:
                if total <= self._limit:
                    break
                if entry.names == 1:
                    entry.path.unlink(missing_ok=True)
                    total -= entry.size
            self._remove_half_files()

    def free(self, size: int) -> None:
        """Evict so many bytes, as far as they are not in use, for others who need the disk."""
        self.evict(self._limit - self._total() + size)

    def _fill(self, sha256: str, size: int, target: Path, fetch: Fetch) -> None:
        self.evict(size)
        half, found = self._half / secrets.token_hex(8), ""
        try:
            for _ in range(_TRIES):
                self._fetch(half, fetch)
                found = file_digest(half)
                if found == sha256:
                    os.link(half, target)  # before it can be evicted
                    self._keep(half, sha256)
                    return
        except FileNotFoundError as error:
            raise LostFileError.of(sha256) from error
        finally:
            half.unlink(missing_ok=True)
        _log.error("the file with SHA-256 %s is damaged in the store: the received file has %s", sha256, found)
        raise DamagedFileError.of(sha256)

    def _fetch(self, half: Path, fetch: Fetch) -> None:
        """Fetch; where the disk is full, evict all that is not in use, and fetch again."""
        try:
            fetch(half)
            return
        except Exception as error:
            if not is_full(error):
                raise
        half.unlink(missing_ok=True)
        self.evict(self._limit)
        try:
            fetch(half)
        except Exception as error:
            if is_full(error):
                raise NoSpaceError(f"The disk of {self._files.parent} is full.") from error
            raise

    def _keep(self, source: Path, sha256: str) -> None:
        """Give a file its place. Its time is by its content: the same on every host, and after every fetch."""
        moment = int(sha256[:8], 16)
        source.chmod(0o400)
        os.utime(source, ns=(time.time_ns(), moment * 1_000_000_000))
        final = self._path(sha256)
        final.parent.mkdir(exist_ok=True)
        source.replace(final)

    def _linked(self, sha256: str, target: Path) -> bool:
        path = self._path(sha256)
        try:
            os.link(path, target)
            # the time of last use is kept here: file systems seldom keep it by themselves
            os.utime(target, ns=(time.time_ns(), target.stat().st_mtime_ns))
        except FileNotFoundError:
            return False
        if file_digest(target) == sha256:
            return True
        _log.error("%s is damaged; fetching it again", path)
        target.unlink()
        path.unlink(missing_ok=True)
        return False

    def _path(self, sha256: str) -> Path:
        return self._files / sha256[:2] / sha256

    def _total(self) -> int:
        return sum(entry.size for entry in self._entries())

    def _entries(self) -> Iterator[_Entry]:
        for path in self._files.glob("*/*"):
            with contextlib.suppress(FileNotFoundError):
                status = path.stat()
                yield _Entry(path, status.st_size, status.st_nlink, status.st_atime_ns)

    def _remove_half_files(self) -> None:
        for path in self._half.iterdir():
            with contextlib.suppress(FileNotFoundError):
                # the inode's time: a whole one that is about to get its place has a time by its content already
                if path.stat().st_ctime < time.time() - _HALF_SECONDS:
                    path.unlink()

    @contextlib.contextmanager
    def _locked(self, name: str) -> Iterator[None]:
        """Keep other processes and threads out; the system lets go of a lock whose process dies."""
        with (self._locks / name).open("w") as file:
            fcntl.flock(file, fcntl.LOCK_EX)
            yield


def file_digest(path: Path) -> str:
    """SHA-256 of a file."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def is_full(error: BaseException | None) -> bool:
    """Whether an error says, itself or by its cause, that the disk is full."""
    while error is not None:
        if isinstance(error, OSError) and error.errno in _NO_ROOM:
            return True
        error = error.__cause__ or error.__context__
    return False
