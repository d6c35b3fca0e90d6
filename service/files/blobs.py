"""Inputs of jobs: files that are received in constant memory and deduplicated by SHA-256.

If the file store is a local folder, inputs are files in the data folder (`BlobFolder`). Otherwise they are objects of
the file store (`service.files.stored_blobs`). Both implement `Blobs`.
"""

from __future__ import annotations

import errno
import fcntl
import hashlib
import os
import secrets
import shutil
import threading
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from io import FileIO
from pathlib import Path
from typing import IO, Protocol

from service import problems
from service.errors import NotFoundError, StoreError
from service.files.objects import ObjectStore
from service.store.inputs import InputRows, check_offset
from service.store.tables import BlobRow, UploadRow
from sgsst_core.errors import OutputError

#: Age in seconds at which files without a database row are removed; younger files may not have their row yet.
_ORPHAN_SECONDS = 3600.0
#: Folders of inputs and of unfinished uploads, in the file store (in the data folder if the file store is local). All
#: other folders of the file store belong to jobs.
BLOBS, UPLOADS = "blobs", "uploads"
#: Minimum number of free inodes, since both requests and the database create files.
_MIN_FREE_INODES = 1000


@contextmanager
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
        if not isinstance(cause, OSError) or cause.errno in (errno.ENOENT, errno.EMFILE, errno.ENFILE):
            raise
        full = cause.errno in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
        problem = problems.NO_SPACE if full else problems.STORE_UNAVAILABLE
        raise problem(f"The service cannot write the file: {cause.strerror}.") from error


class Receiver:
    """File that is being received; `Blobs.add` turns it into a blob."""

    def __init__(self, path: Path, limit: int, ensure_space: Callable[[int], None]) -> None:
        self.path = path
        self.size = 0
        self._limit = limit
        self._ensure_space = ensure_space
        self._lock = threading.Lock()  # a thread that hangs and was given up still writes to the file
        with disk_errors():
            self._file = path.open("xb", buffering=0)

    def write(self, data: bytes) -> None:
        """Append bytes to the file.

        Raises:
            TOO_LARGE: If the file exceeds its size limit.
            NoSpaceError: If the disk is too full.
            StoreError: If the disk fails otherwise.
        """
        self.size += len(data)
        if self.size > self._limit:
            raise problems.TOO_LARGE(f"A file has more than {self._limit:,} bytes.", limit=self._limit)
        with self._lock:
            self._ensure_space(len(data))
            write_all(self._file, data)

    def close(self) -> None:
        """Make the bytes durable and close the file."""
        with disk_errors():
            os.fsync(self._file.fileno())
            self._file.close()

    def discard(self) -> None:
        """Delete the received bytes."""
        with self._lock:
            self._file.close()
            self.path.unlink(missing_ok=True)


class PartWriter(Protocol):
    """Writer of the next bytes of an upload."""

    def write(self, data: bytes) -> None:
        """Append bytes; they become part of the upload with the next `save`."""

    def save(self) -> float:
        """Make the bytes durable, record them in the database, and return the upload's new expiry time.

        Raises:
            ConflictError: If another request has saved bytes at the same offset meanwhile.
        """

    def discard(self) -> None:
        """Drop the bytes written since the last `save`."""

    def close(self) -> None:
        """Close the writer; unsaved bytes are lost."""


class Blobs(ABC):
    """Store of all inputs of jobs (blobs); the database has a row for each.

    Args:
        folder: Data folder; files that are being received are in its subfolder `incoming`.
        min_free: Minimum free disk space of `folder` in bytes; data that would leave less is rejected.
        objects: File store that holds the blobs, under `BLOBS`.
    """

    def __init__(self, folder: Path, inputs: InputRows, min_free: int, objects: ObjectStore) -> None:
        self.objects = objects
        self.incoming = folder / "incoming"
        self.incoming.mkdir(parents=True, exist_ok=True)
        self._inputs, self._min_free = inputs, min_free

    def missing_space(self, size: int) -> int:
        """Return the bytes to free before `size` bytes (at least one) can be written; not positive if they can."""
        return max(size, 1) + self._min_free - shutil.disk_usage(self.incoming).free

    def ensure_space(self, size: int) -> None:
        """Raise NoSpaceError if `size` more bytes would leave too little free disk space."""
        if self.missing_space(size) > 0:
            raise problems.NO_SPACE()
        inodes = os.statvfs(self.incoming)
        if inodes.f_files and inodes.f_favail < _MIN_FREE_INODES:  # file systems without an inode table report 0
            raise problems.NO_SPACE("The service's disk cannot hold more files. Try again later.")

    def receive(self, limit: int) -> Receiver:
        """Return a new file to write to."""
        self.ensure_space(0)
        return Receiver(self.incoming / f"{secrets.token_hex(12)}.part", limit, self.ensure_space)

    @abstractmethod
    def add(self, path: Path, upload_id: str | None = None) -> str:
        """Turn a received, durable file into a blob and return its SHA-256; `path` no longer exists afterwards.

        The digest is computed from the file that becomes the blob. If there is a blob with the same digest already and
        its file is lost or damaged, that file is replaced.

        Args:
            path: Complete file that is no longer written to.
            upload_id: Upload or receipt (`service.store.inputs`) that holds the blob from now on; None for none.

        Raises:
            NotFoundError: If the upload or receipt is gone.
        """

    @abstractmethod
    def remove(self, locations: Iterable[str]) -> None:
        """Remove the files of blobs whose rows have been deleted.

        If a file cannot be removed now, a later call of `collect` removes it.
        """

    @abstractmethod
    def fetch(self, rows: Mapping[str, BlobRow], folder: Path) -> dict[str, Path]:
        """Return the local paths of blobs by digest, after verifying each blob.

        Args:
            rows: Rows of the blobs by digest.
            folder: Folder in which local files may be created; the returned paths are valid as long as it exists.

        Raises:
            LostFileError: If the file store does not have a blob.
            DamagedFileError: If a blob does not match its digest.
            StoreError: If the file store does not respond.
        """

    @abstractmethod
    def start_upload(self, upload_id: str) -> None:
        """Prepare for receiving the bytes of a new upload, whose database row exists already."""

    @abstractmethod
    def append(self, upload: UploadRow, seconds: float) -> PartWriter:
        """Return a writer of an upload's next bytes.

        Args:
            seconds: Time from each `save` until the upload expires.

        Raises:
            NotFoundError: If the preceding bytes are gone.
            ConflictError: If the upload's offset has changed.
            UPLOAD_LOCKED: If this or another process has an open writer of the upload.
        """

    def finish_upload(self, upload: UploadRow, seconds: float) -> str:
        """Turn a completely saved upload into a blob and return the blob's SHA-256.

        The upload's bytes remain until the blob has a database row, so the call can be repeated after a crash.

        Raises:
            NotFoundError: If the upload's bytes are gone.
            UPLOAD_LOCKED: If another request is finishing the upload.
        """
        try:
            return self._finish_upload(upload, seconds)
        except (FileNotFoundError, NotFoundError):  # missing also if another request has just finished the upload
            known = self._inputs.upload(upload.id, upload.owner).sha256
            if known is None:
                raise problems.LOST_UPLOAD(upload_id=upload.id) from None
            return known

    @abstractmethod
    def _finish_upload(self, upload: UploadRow, seconds: float) -> str:
        """Finish an upload; raise FileNotFoundError if bytes are missing."""

    @abstractmethod
    def discard_upload(self, upload_id: str) -> None:
        """Remove the received bytes of an upload whose database row is gone."""

    def collect(self) -> int:
        """Remove unused blobs and leftovers of crashes; return the number of removed files."""
        for upload_id in self._inputs.expire_uploads():
            self.discard_upload(upload_id)
        unused = self._inputs.collect()
        self.remove(unused)
        removed = len(unused) + self._collect_orphans()
        before = time.time() - _ORPHAN_SECONDS
        for path in self.incoming.iterdir():
            if _older(path, before):
                if path.is_dir() and not path.is_symlink():
                    shutil.rmtree(path, ignore_errors=True)
                else:
                    path.unlink(missing_ok=True)
                removed += 1
        return removed

    @abstractmethod
    def _collect_orphans(self) -> int:
        """Remove files without database rows, which processes left behind when they died; return their number."""


class BlobFolder(Blobs):
    """Inputs as files in the data folder."""

    def __init__(self, folder: Path, inputs: InputRows, min_free_bytes: int) -> None:
        super().__init__(folder, inputs, min_free_bytes, ObjectStore(f"file://{folder}"))
        self._blobs, self.uploads = folder / BLOBS, folder / UPLOADS
        for path in (self._blobs, self.uploads):
            path.mkdir(parents=True, exist_ok=True)

    @disk_errors()
    def add(self, path: Path, upload_id: str | None = None, *, link: bool = False) -> str:
        """Move or link a received file to its final path and return its SHA-256.

        Args:
            link: Whether to hard-link the file instead of moving it, so that `path` remains.
        """
        with open_file(path, "rb") as file:
            os.fchmod(file.fileno(), 0o400)
            size, sha256 = os.fstat(file.fileno()).st_size, hashlib.file_digest(file, "sha256").hexdigest()
        final = self._blobs / sha256[:2] / f"{sha256}-{secrets.token_hex(4)}"
        final.parent.mkdir(exist_ok=True)
        if link:
            os.link(path, final)
        else:
            path.replace(final)
        flush_folder(final.parent)
        try:
            location = self._inputs.add_blob(sha256, f"{final.parent.name}/{final.name}", size, upload_id)
        except NotFoundError:
            final.unlink()
            raise
        known = self._blobs / location
        intact = self.objects.fault(f"{BLOBS}/{location}", sha256) is None  # read even if new: time would tell which
        if known == final:
            return sha256
        if intact:
            final.unlink()  # an intact file stays: a confined process may open only the file that it was given
        else:
            known.parent.mkdir(exist_ok=True)
            final.replace(known)
            final.unlink(missing_ok=True)  # renaming one of two hard links to the other is a no-op
            flush_folder(known.parent)
        return sha256

    def remove(self, locations: Iterable[str]) -> None:
        """Remove the files."""
        for location in locations:
            (self._blobs / location).unlink(missing_ok=True)

    def fetch(self, rows: Mapping[str, BlobRow], folder: Path) -> dict[str, Path]:  # noqa: ARG002 (base signature)
        """Return the paths of the verified blobs; `folder` is not used."""
        for sha256, row in rows.items():
            self.objects.check(f"{BLOBS}/{row.location}", sha256)
        return {sha256: self._blobs / row.location for sha256, row in rows.items()}

    def start_upload(self, upload_id: str) -> None:
        """Create an empty file for the upload."""
        with disk_errors():
            open_file(self.upload_path(upload_id), "ab").close()

    def append(self, upload: UploadRow, seconds: float) -> PartWriter:
        """Return a writer to the upload's file."""
        return _FileWriter(self.upload_path(upload.id), self._inputs, upload, seconds)

    def _finish_upload(self, upload: UploadRow, seconds: float) -> str:
        path = self.upload_path(upload.id)
        with open_file(path, "rb") as file:
            _lock(file)
            known = self._inputs.upload(upload.id, upload.owner).sha256
            if known is not None:
                return known
            if os.fstat(file.fileno()).st_size != upload.length:
                raise FileNotFoundError(path)
            sha256 = self.add(path, upload.id, link=True)
            self._inputs.finish_upload(upload.id, sha256, seconds)
            path.unlink(missing_ok=True)
            return sha256

    def discard_upload(self, upload_id: str) -> None:
        """Remove the upload's file."""
        self.upload_path(upload_id).unlink(missing_ok=True)

    def _collect_orphans(self) -> int:
        known, before, removed = self._inputs.locations(), time.time() - _ORPHAN_SECONDS, 0
        for path in self._blobs.glob("*/*"):
            if _older(path, before) and f"{path.parent.name}/{path.name}" not in known:
                path.unlink(missing_ok=True)
                removed += 1
        return removed

    def upload_path(self, upload_id: str) -> Path:
        """Return the path of the bytes of an unfinished upload."""
        return self.uploads / f"{upload_id}.part"


class _FileWriter:
    """Writer to the file of an unfinished upload, starting at the offset in the database.

    Each writer locks the file, so that only one writer per upload is open at a time across all processes.
    """

    def __init__(self, path: Path, inputs: InputRows, upload: UploadRow, seconds: float) -> None:
        self._inputs, self._upload, self._seconds = inputs, upload, seconds
        self._offset = self._saved = upload.offset
        try:
            with disk_errors():
                self._file = open_file(path, "r+b")
        except FileNotFoundError:
            raise problems.LOST_UPLOAD(upload_id=upload.id) from None
        except StoreError:
            # while another request turns a complete upload into a blob, its file is read-only
            if inputs.upload(upload.id, upload.owner).offset == upload.length:
                raise problems.UPLOAD_LOCKED() from None
            raise
        try:
            _lock(self._file)
            # read the row again: no other writer changes it while the lock is held
            check_offset(inputs.upload(upload.id, upload.owner), upload.offset)
            # writing beyond the end of the file would fill the gap with zeros
            if os.fstat(self._file.fileno()).st_size < upload.offset:
                raise problems.LOST_UPLOAD(upload_id=upload.id)
            self._file.truncate(upload.offset)  # a crash may have left unrecorded bytes
            self._file.seek(upload.offset)
        except BaseException:
            self._file.close()
            raise

    def write(self, data: bytes) -> None:
        write_all(self._file, data)
        self._offset += len(data)

    def save(self) -> float:
        with disk_errors():
            os.fsync(self._file.fileno())
        size = self._offset - self._saved
        expires = self._inputs.advance_upload(self._upload.id, self._saved, size, self._seconds)
        self._saved = self._offset
        return expires

    def discard(self) -> None:
        self._file.truncate(self._saved)
        self._file.seek(self._saved)
        self._offset = self._saved

    def close(self) -> None:
        self._file.close()


def open_file(path: Path, mode: str) -> FileIO:
    """Open a received file without buffering, but not through a symbolic link, which is none of the service's.

    Raises:
        FileNotFoundError: If there is no such file, or it is a link.
    """

    def opened(name: str, flags: int) -> int:
        try:
            return os.open(name, flags | os.O_NOFOLLOW, 0o600)
        except OSError as error:
            if error.errno == errno.ELOOP:
                raise FileNotFoundError(errno.ENOENT, "is a symbolic link", name) from error
            raise

    return FileIO(path, mode, opener=opened)


def _lock(file: IO[bytes]) -> None:
    """Lock an upload's file until it is closed; the system releases the lock if the process dies.

    Raises:
        UPLOAD_LOCKED: If another writer holds the lock.
    """
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        raise problems.UPLOAD_LOCKED() from None


def write_all(file: object, data: bytes) -> None:
    """Write all bytes to an unbuffered file.

    Raises:
        NoSpaceError: If the disk or a quota is full, or the file is too large for the file system.
        StoreError: If the disk fails otherwise.
    """
    view = memoryview(data)
    with disk_errors():
        while view:
            view = view[file.write(view) :]  # type: ignore[attr-defined]


def flush_folder(folder: Path) -> None:
    """Make the entries of a folder durable (fsync)."""
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def _older(path: Path, before: float) -> bool:
    try:
        return path.lstat().st_ctime < before  # ctime also changes when the file is renamed
    except OSError:
        return False
