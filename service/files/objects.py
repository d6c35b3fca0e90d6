"""Files behind an fsspec URL (a local folder, an S3-compatible bucket), a cache of them, and the results of jobs there.

Objects are written as a whole, and overwritten only to repair them. Failures of a remote store (unreachable, slow,
broken) are raised as `StoreError`; errors of a local folder are raised unchanged.
"""

import contextlib
import errno
import fcntl
import hashlib
import logging
import mimetypes
import os
import secrets
import shutil
import time
from collections import OrderedDict
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from datetime import datetime
from functools import partial
from pathlib import Path
from typing import Any, Literal, TypeVar

import fsspec
from fsspec.implementations.local import LocalFileSystem

from service import problems
from service.problems import StoreError
from service.states import Published
from sgsst_core.errors import OutputError
from sgsst_core.files.atomic import DISK_FULL, atomic_path, file_digest
from sgsst_core.files.formats import RESULT_FORMATS

#: Limits of each request to S3: timeouts for connecting and for responses in seconds, and number of tries, with
#: exponential backoff. The S3 client alone retries; retries of fsspec around it would multiply both. A store that
#: accepts connections and never responds raises an error after three quarters of a minute.
_CONNECT_SECONDS, _ANSWER_SECONDS, _TRIES = 3.0, 10.0, 4
#: Chunk size in bytes and number of concurrent chunks for transfers of large S3 objects; the defaults would use half a
#: gigabyte of memory.
_PIECE_BYTES, _PIECES = 16 << 20, 3
#: Age in seconds at which files without a database row are removed, in a local folder and in a remote store; younger
#: ones may not have their row yet.
ORPHAN_SECONDS, REMOTE_ORPHAN_SECONDS = 3600.0, 6 * 3600.0
#: Bytes of an object that are read at a time.
CHUNK = 1 << 17
#: Time in seconds for which a verified object is not hashed again unless it changes, and maximum number of objects for
#: which this is cached.
_CHECKED_SECONDS, _MAX_CHECKED = 3600.0, 10_000

_log = logging.getLogger(__name__)

T = TypeVar("T")

#: File system metadata that change with an object's content: size, times, and inode or ETag.
Stamp = tuple[Any, ...]


@contextlib.contextmanager
def disk_errors() -> Iterator[None]:
    """Convert errors of the disk; missing files and a limit of open files are none.

    Raises:
        NoSpaceError: If the disk or a quota is full, or a file is too large for the file system.
        StoreError: If the disk fails otherwise, or denies access.
    """
    try:
        yield
    except (OSError, OutputError) as error:
        cause = error.__cause__ if isinstance(error, OutputError) else error
        no_files = (errno.EMFILE, errno.ENFILE)
        if not isinstance(cause, OSError) or isinstance(cause, FileNotFoundError) or cause.errno in no_files:
            raise
        problem = problems.NO_SPACE if cause.errno in DISK_FULL else problems.STORE_UNAVAILABLE
        raise problem(f"The service cannot write the file: {cause.strerror}.") from error


class ObjectStore:
    """Objects of a file store; their names are relative to its URL.

    Methods that read an object raise FileNotFoundError if there is no such object.
    """

    def __init__(self, url: str) -> None:
        self.url = url
        self._files, self.root = fsspec.core.url_to_fs(url, **_options(url))
        self.local = isinstance(self._files, LocalFileSystem)
        self._s3 = "s3" in self._files.protocol  # a name, or a tuple of names
        self._checked: OrderedDict[str, tuple[Stamp, str, float]] = OrderedDict()
        if self._s3:
            self._files.retries = 1

    def put(self, source: Path, name: str) -> None:
        """Upload a file atomically; it must not change during the upload."""
        with self._translated(name):
            options = {"chunksize": _PIECE_BYTES, "max_concurrency": _PIECES} if self._s3 else {}
            self._files.put_file(str(source), self._path(name), **options)

    def get(self, name: str, target: Path) -> None:
        """Copy an object to a local file."""
        with self._translated(name):
            if self._s3:
                self._get_pieces(self._path(name), target)
            else:
                self._files.get_file(self._path(name), str(target))

    def _get_pieces(self, path: str, target: Path) -> None:
        """Copy an S3 object in chunks, so that only an interrupted chunk has to be fetched again."""
        size = self._files.size(path)
        starts = range(0, size, _PIECE_BYTES)

        def piece(start: int) -> bytes:
            end = min(start + _PIECE_BYTES, size)
            data: bytes = _uninterrupted(partial(self._files.cat_file, path, start=start, end=end))
            return data

        with target.open("wb") as file, ThreadPoolExecutor(_PIECES) as pool:
            for first in range(0, len(starts), _PIECES):
                file.writelines(pool.map(piece, starts[first : first + _PIECES]))

    def read(self, name: str, start: int, stop: int, chunk: int = CHUNK) -> Iterator[bytes]:
        """Yield the bytes from `start` up to `stop` in chunks of at most `chunk` bytes.

        From S3, 32 chunks are fetched at a time; by default, the file system fetches 50 MB.

        Raises:
            FileNotFoundError: If there is no such object, or it ends before `stop`.
        """
        with self._translated(name), self._files.open(self._path(name), "rb", block_size=32 * chunk) as file:
            file.seek(start)
            left = stop - start
            while left > 0:
                data = _uninterrupted(partial(file.read, min(chunk, left)))
                if not data:
                    raise FileNotFoundError(f"{name}: is shorter than its row says")
                left -= len(data)
                yield data

    def stamp(self, name: str) -> Stamp:
        """Return metadata that change when the object's content changes."""
        with self._translated(name):
            self._files.invalidate_cache()
            entry = self._files.info(self._path(name))
            return entry["size"], _changed(entry), entry.get("ETag"), entry.get("ino")

    def size(self, name: str) -> int:
        """Return the size of an object in bytes; -1 if it does not exist."""
        try:
            return int(self.stamp(name)[0])
        except FileNotFoundError:
            return -1

    def digest(self, name: str) -> str:
        """Read an object completely and return its SHA-256."""
        with self._translated(name), self._files.open(self._path(name), "rb") as file:
            digest = hashlib.sha256()
            while data := _uninterrupted(partial(file.read, CHUNK)):
                digest.update(data)
            return digest.hexdigest()

    def check(self, name: str, sha256: str) -> None:
        """Read an object and verify its SHA-256.

        Raises:
            LostFileError: If there is no such object.
            DamagedFileError: If the SHA-256 differs.
        """
        fault = self.fault(name, sha256)
        if fault is not None:
            _log.error("file %s: store=%s name=%s sha256=%s", fault, self.url, name, sha256)
            raise problems.FILE_LOST(sha256=sha256) if fault == "missing" else problems.FILE_DAMAGED(sha256=sha256)

    def fault(self, name: str, sha256: str) -> Literal["missing", "damaged"] | None:
        """Return the fault of an object that should have this SHA-256; None if it is intact."""
        try:
            before = self.stamp(name)
            digest = self.digest(name)
        except FileNotFoundError:
            return "missing"
        if digest != sha256:
            return "damaged"
        self._checked[name] = before, sha256, time.monotonic()
        if len(self._checked) > _MAX_CHECKED:
            self._checked.popitem(last=False)
        return None

    def check_once(self, name: str, sha256: str) -> None:
        """Call `check`, unless the object has passed it within the last hour and has not changed since."""
        stamp, digest, checked_at = self._checked.get(name, (None, "", 0.0))
        with contextlib.suppress(FileNotFoundError):
            recent = digest == sha256 and time.monotonic() - checked_at <= _CHECKED_SECONDS
            if recent and stamp == self.stamp(name):
                return
        self.check(name, sha256)

    def move(self, name: str, new_name: str) -> None:
        """Rename an object."""
        with self._translated(name):
            if self.local:
                Path(self._path(new_name)).parent.mkdir(parents=True, exist_ok=True)
            self._files.mv(self._path(name), self._path(new_name))

    def remove(self, name: str) -> None:
        """Remove an object if it exists."""
        with self._translated(name), contextlib.suppress(FileNotFoundError):
            self._files.rm_file(self._path(name))

    def discard(self, names: Iterable[str]) -> None:
        """Remove objects that no database row refers to any longer; after an error, housekeeping removes the others."""
        try:
            for name in names:
                self.remove(name)
        except (StoreError, OSError) as error:
            _log.warning("unused files not deleted yet: %s", error.__cause__ or error)

    def remove_below(self, folder: str) -> None:
        """Remove all objects in a folder."""
        with self._translated(folder), contextlib.suppress(FileNotFoundError):
            self._files.invalidate_cache()
            self._files.rm(self._path(folder), recursive=True)

    def below(self, folder: str) -> dict[str, float]:
        """Return the modification times of all objects in a folder by name, in seconds since 1970 (0 if unknown)."""
        with self._translated(folder):
            self._files.invalidate_cache()
            inside = f"{self._path(folder).rstrip('/')}/"
            entries = self._files.find(inside, detail=True)  # some stores list an empty folder as an object
            return {
                path[len(self.root) + 1 :]: _changed(entry)
                for path, entry in entries.items()
                if path.startswith(inside)
            }

    def old(self, folder: str) -> list[str]:
        """Return the names of all objects in a folder that have a database row by now, or will never have one."""
        before = time.time() - (ORPHAN_SECONDS if self.local else REMOTE_ORPHAN_SECONDS)
        return sorted(name for name, changed in self.below(folder).items() if changed < before)

    def ping(self) -> None:
        """Raise OSError or StoreError if the store cannot be reached."""
        with self._translated(self.root):
            if not self._exists():
                raise FileNotFoundError(f"The file store {self.root!r} does not exist or cannot be reached.")

    def _exists(self) -> bool:
        """Return whether the folder or bucket exists; a prefix of a bucket does not before the first object in it."""
        self._files.invalidate_cache()
        return bool(self._files.exists(self.root if self.local else self.root.partition("/")[0]))

    def make_bucket(self) -> None:
        """Create the bucket of an S3 store if it does not exist."""
        if self._s3:
            bucket = self.root.partition("/")[0]
            with self._translated(bucket):
                if not self._exists():
                    self._files.mkdir(bucket)

    def _path(self, name: str) -> str:
        return f"{self.root}/{name}"

    @contextlib.contextmanager
    def _translated(self, name: str) -> Iterator[None]:
        """Convert all errors of a remote store, whatever library raises them, to `StoreError`, but not a full disk.

        A missing object of a missing bucket is no lost file: its store is away.
        """
        try:
            yield
        except StoreError:
            raise
        except Exception as error:
            if self.local or (isinstance(error, FileNotFoundError) and (not self._s3 or self._exists())):
                raise
            error.add_note(f"store of files: {name}")  # for the operator's log
            if is_full(error):
                raise problems.NO_SPACE() from error
            raise problems.STORE_UNAVAILABLE() from error


def _uninterrupted(read: Callable[[], T]) -> T:
    """Repeat a read whose response was cut off. The S3 client has retried requests without a response."""
    for left in reversed(range(_TRIES)):
        started = time.monotonic()
        try:
            return read()
        except FileNotFoundError:
            raise
        except Exception:
            if not left or time.monotonic() - started > _ANSWER_SECONDS:
                raise
    raise AssertionError


def _options(url: str) -> dict[str, Any]:
    """Return fsspec options for the protocol of a URL."""
    if not url.startswith(("s3://", "s3a://")):
        return {}
    retries = {"mode": "standard", "total_max_attempts": _TRIES}
    config = {"connect_timeout": _CONNECT_SECONDS, "read_timeout": _ANSWER_SECONDS, "retries": retries}
    return {"config_kwargs": config, "skip_instance_cache": True}


def _changed(entry: dict[str, Any]) -> float:
    """Return the modification time of an object from its file system entry."""
    modified = entry.get("LastModified") or entry.get("created")
    if isinstance(modified, float):  # local file: ctime changes with the file's links, mtime does not
        return max(modified, float(entry.get("mtime", 0.0)))
    modified = modified or entry.get("mtime")
    return modified.timestamp() if isinstance(modified, datetime) else float(modified or 0.0)


#: Age in seconds at which partially fetched files are removed; no fetch takes that long, so their processes have died.
_PARTIAL_SECONDS = 6 * 3600.0


#: Function that copies an object of the store to a file.
Fetch = Callable[[Path], None]


def _fetch_intact(fetch: Fetch, target: Path, sha256: str) -> None:
    """Copy an object of the store to a file, and verify its SHA-256.

    Raises:
        LostFileError: If there is no such object.
        DamagedFileError: If the SHA-256 differs.
    """
    try:
        fetch(target)
    except FileNotFoundError as error:
        raise problems.FILE_LOST(sha256=sha256) from error
    if (digest := file_digest(target)) != sha256:
        _log.error("file damaged in the store: sha256=%s received=%s", sha256, digest)
        raise problems.FILE_DAMAGED(sha256=sha256)


class FileCache:
    """Cache of stored files on one host, verified by their SHA-256 and limited in total size.

    Each file is fetched once and named by its digest. Callers get a hard link to the file in their own folder, which
    must be on the same file system. A file with more than one link is in use and is not evicted. Any number of
    processes may share a cache: files appear atomically by renaming, each digest is fetched under a lock, and evicting
    a file leaves the callers' links intact.

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
            StoreError, NoSpaceError: If `fetch` raises it.
        """
        if self._link(sha256, target):
            return
        with locked(self._locks / sha256[:2]):
            if self._link(sha256, target):
                return
            self._fill(sha256, size, target, fetch)
        self.evict()

    def adopt(self, source: Path, sha256: str) -> None:
        """Move a complete, verified file into the cache."""
        with locked(self._locks / sha256[:2]):
            self._add(source, sha256)
        self.evict()

    def evict(self, reserve: int = 0) -> None:
        """Evict the least recently used files that are not in use.

        Args:
            reserve: Bytes to leave free below the limit, and on the disk.
        """
        with locked(self._locks / "evict"):
            entries = sorted(self._entries(), key=lambda entry: entry[1].st_atime_ns)
            total = sum(status.st_size for _, status in entries)
            excess = reserve + max(total - self._limit, -shutil.disk_usage(self._files).free)
            for path, status in entries:
                if excess <= 0:
                    break
                if status.st_nlink == 1:
                    path.unlink(missing_ok=True)
                    excess -= status.st_size
            for path in self._partial.iterdir():
                with contextlib.suppress(FileNotFoundError):
                    # ctime, because a complete file has a synthetic modification time shortly before it is moved
                    if path.stat().st_ctime < time.time() - _PARTIAL_SECONDS:
                        path.unlink()

    def _fill(self, sha256: str, size: int, target: Path, fetch: Fetch) -> None:
        self.evict(size)
        partial = self._partial / secrets.token_hex(8)
        try:
            _fetch_intact(fetch, partial, sha256)
            os.link(partial, target)  # link first: a file without other links could be evicted
            self._add(partial, sha256)
        finally:
            partial.unlink(missing_ok=True)

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

    def _entries(self) -> Iterator[tuple[Path, os.stat_result]]:
        for path in self._files.glob("*/*"):
            with contextlib.suppress(FileNotFoundError):
                yield path, path.stat()


@contextlib.contextmanager
def locked(path: Path) -> Iterator[None]:
    """Hold an exclusive lock of a file against other processes and threads; the system releases it if they die."""
    with path.open("w") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        yield


def is_full(error: BaseException) -> bool:
    """Return whether an error, or its cause, reports a full disk."""
    return any(isinstance(each, OSError) and each.errno in DISK_FULL for each in (error, error.__cause__))


#: Error numbers that mean that a hard link is impossible: different file systems, or no support for hard links.
_NO_LINKS = (errno.EXDEV, errno.EPERM, errno.ENOTSUP, errno.EMLINK)
_MEDIA_TYPES = {
    **{each.suffix: each.media_type for each in RESULT_FORMATS},
    ".json": "application/json",
    ".txt": "text/plain; charset=utf-8",
    ".html": "text/html; charset=utf-8",
}


class Artifacts:
    """Results in the file store.

    The objects of a job are below a folder with its id. Their names are never reused; database rows refer to the
    current version of each file.
    """

    def __init__(self, url: str) -> None:
        self.objects = ObjectStore(url)
        if self.objects.local:
            Path(self.objects.root).mkdir(parents=True, exist_ok=True)

    @disk_errors()
    def put(self, job_id: str, epoch: int, name: str, source: Path, *, final: bool = False) -> Published:
        """Store a result file.

        The file is complete and durable when this function returns. Users can see it once it has a database row.

        Args:
            final: Whether the content of `source` no longer changes; the path may still be replaced with another file.
                A final file is hard-linked instead of copied if the file store is on the same file system.
        """
        location = f"{job_id}/{epoch}/{secrets.token_hex(6)}/{name}"
        if not self.objects.local:
            with _snapshot(source) as snapshot:
                size, sha256 = snapshot.stat().st_size, file_digest(snapshot)
                self.objects.put(snapshot, location)
            return Published(name, location, size, sha256)
        target = Path(self.objects.root, location)
        target.parent.mkdir(parents=True, exist_ok=True)
        with atomic_path(target) as temporary:
            if final:
                temporary.unlink()
            if not (final and _link(source, temporary)):
                shutil.copyfile(source, temporary)
            size, sha256 = temporary.stat().st_size, file_digest(temporary)
        return Published(name, location, size, sha256)

    @disk_errors()
    def fetch(self, location: str, target: Path, sha256: str) -> None:
        """Copy a result to a local file, atomically.

        Raises:
            LostFileError: If the file store does not have the result.
            DamagedFileError: If the received file has a different SHA-256.
        """
        with atomic_path(target) as temporary:
            _fetch_intact(partial(self.objects.get, location), temporary, sha256)


def media_type(name: str) -> str:
    """Return the media type of a result for HTTP."""
    known = next((kind for suffix, kind in _MEDIA_TYPES.items() if name.endswith(suffix)), None)
    return known or mimetypes.guess_type(name)[0] or "application/octet-stream"


def _link(source: Path, target: Path) -> bool:
    """Create a hard link to `source`; return False if the file system does not support that."""
    try:
        os.link(source, target)
    except OSError as error:
        if error.errno not in _NO_LINKS:
            raise
        return False
    return True


@contextlib.contextmanager
def _snapshot(source: Path) -> Iterator[Path]:
    """Provide a second hard link to a file, so that replacing the file during its upload does not affect the upload."""
    link = source.with_name(f".{secrets.token_hex(6)}-{source.name}")
    if not _link(source, link):
        yield source
        return
    try:
        yield link
    finally:
        link.unlink(missing_ok=True)
