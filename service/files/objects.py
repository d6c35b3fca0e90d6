"""File store behind an fsspec URL: a local folder, an S3-compatible bucket, or any other file system of fsspec.

Objects are written as a whole, and overwritten only to repair them. Failures of a remote store (unreachable, slow,
broken) are raised as `StoreError`; errors of a local folder are raised unchanged.
"""

from __future__ import annotations

import contextlib
import hashlib
import logging
import time
from collections import OrderedDict
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from datetime import datetime
from functools import partial
from pathlib import Path
from typing import Any, Literal, TypeVar

import fsspec
from fsspec.implementations.local import LocalFileSystem

from service import problems
from service.errors import StoreError

#: Limits of each request to S3: timeouts for connecting and for responses in seconds, and number of tries, with
#: exponential backoff. The S3 client alone retries; retries of fsspec around it would multiply both. A store that
#: accepts connections and never responds raises an error after three quarters of a minute.
_CONNECT_SECONDS, _ANSWER_SECONDS, _TRIES = 3.0, 10.0, 4
#: Chunk size in bytes and number of concurrent chunks for transfers of large S3 objects; the defaults would use half a
#: gigabyte of memory.
_PIECE_BYTES, _PIECES = 16 << 20, 3
#: Minimum and maximum size of an S3 object part in bytes (the last one may be smaller), and maximum number of parts.
MIN_PART_BYTES, _MAX_PART_BYTES, _MAX_PARTS = 5 << 20, 5 << 30, 10_000
#: Bytes of an object that are read at a time.
CHUNK = 1 << 17
#: Time in seconds for which a verified object is not hashed again unless it changes, and maximum number of objects for
#: which this is cached.
_CHECKED_SECONDS, _MAX_CHECKED = 3600.0, 10_000

_log = logging.getLogger(__name__)

T = TypeVar("T")

#: File system metadata that change with an object's content: size, times, and inode or ETag.
Stamp = tuple[Any, ...]


class TruncatedError(OSError):
    """Object with fewer bytes than expected."""


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
            TruncatedError: If the object ends before `stop`.
        """
        with self._translated(name), self._files.open(self._path(name), "rb", block_size=32 * chunk) as file:
            file.seek(start)
            left = stop - start
            while left > 0:
                data = _uninterrupted(partial(file.read, min(chunk, left)))
                if not data:
                    raise TruncatedError(f"{name}: is shorter than its row says")
                left -= len(data)
                yield data

    def stamp(self, name: str) -> Stamp:
        """Return metadata that change when the object's content changes."""
        with self._translated(name):
            if self.local:
                status = Path(self._path(name)).stat()
                return status.st_size, status.st_mtime_ns, status.st_ctime_ns, status.st_ino, status.st_dev
            self._files.invalidate_cache()
            entry = self._files.info(self._path(name))
            return entry["size"], _changed(entry), entry.get("ETag")

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

    def can_join(self, sizes: list[int]) -> bool:
        """Return whether the server can concatenate objects of these sizes itself, without another upload."""
        fit = all(size >= MIN_PART_BYTES for size in sizes[:-1]) and max(sizes, default=0) <= _MAX_PART_BYTES
        return self._s3 and 0 < len(sizes) <= _MAX_PARTS and fit

    def join(self, parts: list[str], name: str) -> None:
        """Concatenate objects on the server, by an S3 multipart upload with copied parts; see `can_join`."""
        with self._translated(name):
            target = dict(zip(("Bucket", "Key"), self._path(name).split("/", 1), strict=True))
            created = self._files.call_s3("create_multipart_upload", **target)
            target["UploadId"] = created["UploadId"]
            try:
                done = []
                for number, part in enumerate(parts, 1):
                    source = dict(zip(("Bucket", "Key"), self._path(part).split("/", 1), strict=True))
                    copied = self._files.call_s3("upload_part_copy", **target, PartNumber=number, CopySource=source)
                    done.append({"PartNumber": number, "ETag": copied["CopyPartResult"]["ETag"]})
                self._files.call_s3("complete_multipart_upload", **target, MultipartUpload={"Parts": done})
            except BaseException:
                with contextlib.suppress(Exception):
                    self._files.call_s3("abort_multipart_upload", **target)
                raise
            self._files.invalidate_cache()

    def abort_old_parts(self, before: float) -> int:
        """Abort multipart uploads that were started before `before` and never finished; return their number."""
        if not self._s3:
            return 0
        bucket, _, prefix = self.root.partition("/")
        with self._translated(prefix):
            listing = self._files.call_s3("list_multipart_uploads", Bucket=bucket, Prefix=prefix)
            old = [entry for entry in listing.get("Uploads", ()) if entry["Initiated"].timestamp() < before]
            for entry in old:
                self._files.call_s3(
                    "abort_multipart_upload", Bucket=bucket, Key=entry["Key"], UploadId=entry["UploadId"]
                )
            return len(old)

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
        """Convert all errors of a remote store, whatever library raises them, to `StoreError`.

        A missing object of a missing bucket is no lost file: its store is away.
        """
        try:
            yield
        except (TruncatedError, StoreError):
            raise
        except Exception as error:
            if self.local or (isinstance(error, FileNotFoundError) and (not self._s3 or self._exists())):
                raise
            error.add_note(f"store of files: {name}")  # for the operator's log
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
