"""Cache of stored files on one host, verified by their SHA-256 and limited in total size.

Each file is fetched once and named by its digest. Callers get a hard link to the file in their own folder, which must
be on the same file system. A file with more than one link is in use and is not evicted. Any number of processes may
share a cache: files appear atomically by renaming, each digest is fetched under a lock, and evicting a file leaves the
callers' links intact.
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import logging
import os
import secrets
import time
from collections.abc import Callable, Iterator
from pathlib import Path

from service import problems
from sgsst_core.files.atomic import file_digest

#: Number of fetches with a wrong digest after which the file counts as damaged in the store.
_TRIES = 2
#: Age in seconds at which partially fetched files are removed; no fetch takes that long, so their processes have died.
_PARTIAL_SECONDS = 6 * 3600.0
#: Error numbers of a full disk.
_DISK_FULL = (errno.ENOSPC, errno.EDQUOT)

_log = logging.getLogger(__name__)

#: Function that copies an object of the store to a file.
Fetch = Callable[[Path], None]


class FileCache:
    """Cache in a folder.

    Args:
        folder: Folder of the cache; created if missing.
        limit: Maximum total size in bytes; files in use are never evicted and may exceed it.
    """

    def __init__(self, folder: Path, limit: int) -> None:
        self._files, self._locks, self._partial = folder / "files", folder / "locks", folder / "half"
        self._limit = limit
        for path in (self._files, self._locks, self._partial):
            path.mkdir(parents=True, exist_ok=True)

    def link(self, sha256: str, size: int, target: Path, fetch: Fetch) -> None:
        """Hard-link a file to `target`, after fetching it if it is not cached or its cached copy is damaged.

        Args:
            target: New path on the cache's file system.
            fetch: Function that copies the file from the store.

        Raises:
            LostFileError: If the store does not have the file.
            DamagedFileError: If the fetched file does not match its digest.
            StoreError: If `fetch` raises it.
            NoSpaceError: If the disk is full even after evicting all unused files.
        """
        if self._link(sha256, target):
            return
        with self._locked(sha256[:2]):
            if self._link(sha256, target):
                return
            self._fill(sha256, size, target, fetch)
        self.evict()

    def adopt(self, source: Path, sha256: str) -> None:
        """Move a complete, verified file into the cache; if its content is already cached, `source` is deleted."""
        with self._locked(sha256[:2]):
            if self._path(sha256).exists():
                source.unlink()
            else:
                self._add(source, sha256)
        self.evict()

    def evict(self, reserve: int = 0) -> None:
        """Evict the least recently used files that are not in use.

        Args:
            reserve: Bytes to leave free below the limit.
        """
        if self._total() + reserve <= self._limit:
            return
        with self._locked("evict"):
            total = self._total() + reserve
            for path, status in sorted(self._entries(), key=lambda entry: entry[1].st_atime_ns):
                if total <= self._limit:
                    break
                if status.st_nlink == 1:
                    path.unlink(missing_ok=True)
                    total -= status.st_size
            for path in self._partial.iterdir():
                with contextlib.suppress(FileNotFoundError):
                    # ctime, because a complete file has a synthetic modification time shortly before it is moved
                    if path.stat().st_ctime < time.time() - _PARTIAL_SECONDS:
                        path.unlink()

    def free(self, size: int) -> None:
        """Evict unused files to free `size` bytes of disk space for other purposes."""
        self.evict(self._limit - self._total() + size)

    def _fill(self, sha256: str, size: int, target: Path, fetch: Fetch) -> None:
        self.evict(size)
        partial, digest = self._partial / secrets.token_hex(8), ""
        try:
            for _ in range(_TRIES):
                self._fetch(partial, fetch)
                digest = file_digest(partial)
                if digest == sha256:
                    os.link(partial, target)  # link first: a file without other links could be evicted
                    self._add(partial, sha256)
                    return
        except FileNotFoundError as error:
            raise problems.FILE_LOST(sha256=sha256) from error
        finally:
            partial.unlink(missing_ok=True)
        _log.error("file damaged in the store: sha256=%s received=%s", sha256, digest)
        raise problems.FILE_DAMAGED(sha256=sha256)

    def _fetch(self, partial: Path, fetch: Fetch) -> None:
        """Fetch a file; if the disk is full, evict all unused files and retry."""
        try:
            fetch(partial)
            return
        except Exception as error:
            if not is_full(error):
                raise
        partial.unlink(missing_ok=True)
        self.evict(self._limit)
        try:
            fetch(partial)
        except Exception as error:
            if is_full(error):
                raise problems.NO_SPACE(f"The disk of {self._files.parent} is full.") from error
            raise

    def _add(self, source: Path, sha256: str) -> None:
        """Move a file into the cache.

        The modification time is derived from the digest, so that it is the same on every host and after every fetch.
        """
        seconds = int(sha256[:8], 16)
        source.chmod(0o400)
        os.utime(source, ns=(time.time_ns(), seconds * 1_000_000_000))
        final = self._path(sha256)
        final.parent.mkdir(exist_ok=True)
        source.replace(final)

    def _link(self, sha256: str, target: Path) -> bool:
        path = self._path(sha256)
        try:
            os.link(path, target)
            # the time of last use is set explicitly, because most file systems do not track it reliably
            os.utime(target, ns=(time.time_ns(), target.stat().st_mtime_ns))
        except FileNotFoundError:
            return False
        if file_digest(target) == sha256:
            return True
        _log.error("cached file damaged, fetching it again: path=%s", path)
        target.unlink()
        path.unlink(missing_ok=True)
        return False

    def _path(self, sha256: str) -> Path:
        return self._files / sha256[:2] / sha256

    def _total(self) -> int:
        return sum(status.st_size for _, status in self._entries())

    def _entries(self) -> Iterator[tuple[Path, os.stat_result]]:
        for path in self._files.glob("*/*"):
            with contextlib.suppress(FileNotFoundError):
                yield path, path.stat()

    @contextlib.contextmanager
    def _locked(self, name: str) -> Iterator[None]:
        """Hold an exclusive lock against other processes and threads; the system releases it if the process dies."""
        with (self._locks / name).open("w") as file:
            fcntl.flock(file, fcntl.LOCK_EX)
            yield


def is_full(error: BaseException | None) -> bool:
    """Return whether an error, or one of its causes, reports a full disk."""
    while error is not None:
        if isinstance(error, OSError) and error.errno in _DISK_FULL:
            return True
        error = error.__cause__ or error.__context__
    return False
