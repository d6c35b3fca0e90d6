"""Inputs of jobs: files that are received in constant memory and deduplicated by SHA-256.

If the file store is a local folder, inputs are files in the data folder (`BlobFolder`). Otherwise they are objects of
the file store, which all hosts share, and are read through a cache on this host (`StoredBlobs`).
"""

import errno
import fcntl
import hashlib
import os
import secrets
import shutil
import threading
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Mapping
from functools import partial
from io import FileIO
from pathlib import Path
from typing import IO

from service import problems
from service.files.objects import Artifacts, FileCache, ObjectStore, disk_errors
from service.problems import ConflictError, DamagedFileError, LostFileError, NoSpaceError, NotFoundError, StoreError
from service.settings import ServiceSettings
from service.store.files import BLOBS, UPLOADS, InputRows, check_offset
from service.store.tables import BlobRow, UploadRow
from sgsst_core.files.atomic import file_digest, flush_folder

#: Minimum number of free inodes, since both requests and the database create files.
_MIN_FREE_INODES = 1000


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


class PartWriter(ABC):
    """Writer of the next bytes of an upload.

    Attributes:
        offset: Offset of the next byte.
        saved: Offset up to which all bytes are saved.
    """

    def __init__(self, inputs: InputRows, upload: UploadRow, seconds: float, file: FileIO) -> None:
        self._inputs, self._upload, self._seconds, self._file = inputs, upload, seconds, file
        self.offset = self.saved = upload.offset

    def write(self, data: bytes) -> None:
        """Append bytes; they become part of the upload with the next `save`."""
        write_all(self._file, data)
        self.offset += len(data)

    @abstractmethod
    def save(self) -> float:
        """Make the bytes durable, record them in the database, and return the upload's new expiry time.

        Raises:
            ConflictError: If another request has saved bytes at the same offset meanwhile.
        """

    @abstractmethod
    def discard(self) -> None:
        """Drop the bytes written since the last `save`."""

    def close(self) -> None:
        """Close the writer; unsaved bytes are lost."""
        self._file.close()


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

    def ensure_space(self, size: int) -> None:
        """Raise NoSpaceError if `size` more bytes, at least one, would leave too little free disk space."""
        if shutil.disk_usage(self.incoming).free < max(size, 1) + self._min_free:
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
            upload_id: Upload or receipt (`service.store.files`) that holds the blob from now on; None for none.

        Raises:
            NotFoundError: If the upload or receipt is gone.
        """

    def remove(self, locations: Iterable[str]) -> None:
        """Remove the files of blobs whose rows have been deleted, as `ObjectStore.discard` does."""
        self.objects.discard(f"{BLOBS}/{location}" for location in locations)

    def _register(self, sha256: str, location: str, size: int, upload_id: str | None) -> str:
        """Register a stored file as a blob, and return the blob's location: another one if its content is known.

        Raises:
            NotFoundError: If the upload or receipt that should hold the blob is gone; the file is removed.
        """
        try:
            return self._inputs.add_blob(sha256, location, size, upload_id)
        except NotFoundError:
            self.remove([location])
            raise

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

    def collect(self) -> None:
        """Remove expired uploads and unused blobs."""
        for upload_id in self._inputs.expire_uploads():
            self.discard_upload(upload_id)
        self.remove(self._inputs.collect())


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
        location = self._register(sha256, f"{final.parent.name}/{final.name}", size, upload_id)
        known = self._blobs / location
        intact = self.objects.fault(f"{BLOBS}/{location}", sha256) is None  # read even if new: time would tell which
        if known == final:
            return sha256
        if intact:
            final.unlink()  # an intact file stays: a confined process may open only the file that it was given
        else:
            final.replace(known)
            flush_folder(known.parent)
        return sha256

    def fetch(self, rows: Mapping[str, BlobRow], folder: Path) -> dict[str, Path]:  # noqa: ARG002 (base signature)
        """Return the paths of the verified blobs; `folder` is not used."""
        for sha256, row in rows.items():
            self.objects.check(f"{BLOBS}/{row.location}", sha256)
        return {sha256: self._blobs / row.location for sha256, row in rows.items()}

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

    def upload_path(self, upload_id: str) -> Path:
        """Return the path of the bytes of an unfinished upload."""
        return self.uploads / f"{upload_id}.part"


class _FileWriter(PartWriter):
    """Writer to the file of an unfinished upload, starting at the offset in the database.

    Each writer locks the file, so that only one writer per upload is open at a time across all processes.
    """

    def __init__(self, path: Path, inputs: InputRows, upload: UploadRow, seconds: float) -> None:
        try:
            with disk_errors():
                file = open_file(path, "r+b" if upload.offset else "a+b")  # the first writer creates it
        except FileNotFoundError:
            raise problems.LOST_UPLOAD(upload_id=upload.id) from None
        except StoreError:
            # while another request turns a complete upload into a blob, its file is read-only
            if inputs.upload(upload.id, upload.owner).offset == upload.length:
                raise problems.UPLOAD_LOCKED() from None
            raise
        super().__init__(inputs, upload, seconds, file)
        try:
            _lock(file)
            # read the row again: no other writer changes it while the lock is held
            check_offset(inputs.upload(upload.id, upload.owner), upload.offset)
            # writing beyond the end of the file would fill the gap with zeros
            if os.fstat(file.fileno()).st_size < upload.offset:
                raise problems.LOST_UPLOAD(upload_id=upload.id)
            self.discard()  # a crash may have left unrecorded bytes
        except BaseException:
            file.close()
            raise

    def save(self) -> float:
        with disk_errors():
            os.fsync(self._file.fileno())
        size = self.offset - self.saved
        expires = self._inputs.advance_upload(self._upload.id, self.saved, size, self._seconds)
        self.saved = self.offset
        return expires

    def discard(self) -> None:
        self._file.truncate(self.saved)
        self._file.seek(self.saved)
        self.offset = self.saved


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


def open_blobs(settings: ServiceSettings, inputs: InputRows, artifacts: Artifacts) -> Blobs:
    """Return the store of inputs: the data folder if the file store is a local folder, otherwise the file store."""
    if artifacts.objects.local:
        return BlobFolder(settings.folder, inputs, settings.min_free_bytes)
    return StoredBlobs(settings, inputs, artifacts.objects)


def open_cache(settings: ServiceSettings) -> FileCache:
    """Return this host's cache of stored files."""
    return FileCache(settings.folder / "cache", settings.file_cache_bytes)


class StoredBlobs(Blobs):
    """Inputs as objects of the file store."""

    def __init__(self, settings: ServiceSettings, inputs: InputRows, objects: ObjectStore) -> None:
        super().__init__(settings.folder, inputs, settings.min_free_bytes, objects)
        self._cache = open_cache(settings)

    def ensure_space(self, size: int) -> None:
        """Raise NoSpaceError if `size` more bytes do not fit, even after evicting cached files."""
        try:
            super().ensure_space(size)
        except NoSpaceError:
            self._cache.evict(max(size, 1) + self._min_free)
            super().ensure_space(size)

    @disk_errors()
    def add(self, path: Path, upload_id: str | None = None) -> str:
        """Upload a received file, and move it into the cache.

        The work is the same if its content is already stored: its duration would tell what others have.
        """
        sha256, size = file_digest(path), path.stat().st_size
        location = f"{sha256[:2]}/{sha256}-{secrets.token_hex(4)}"
        self.objects.put(path, f"{BLOBS}/{location}")
        known = self._register(sha256, location, size, upload_id)
        if known != location:
            self.remove([location])
        try:
            self.objects.check(f"{BLOBS}/{known}", sha256)
        except (LostFileError, DamagedFileError):
            self.objects.put(path, f"{BLOBS}/{known}")
        self._cache.adopt(path, sha256)
        return sha256

    def fetch(self, rows: Mapping[str, BlobRow], folder: Path) -> dict[str, Path]:
        """Return links in `folder` to this host's cached copies, after fetching missing ones."""
        target = folder / ".inputs"
        target.mkdir()
        paths = {}
        for sha256, row in rows.items():
            paths[sha256] = target / sha256
            self._cache.link(sha256, row.size, paths[sha256], partial(self.objects.get, f"{BLOBS}/{row.location}"))
        return paths

    # --- uploads ---------------------------------------------------------------------------------------------------

    def append(self, upload: UploadRow, seconds: float) -> PartWriter:
        """Return a writer that stores one object per `save`, so that any API process can continue the upload."""
        return _ObjectWriter(self.incoming, self.objects, self._inputs, upload, seconds)

    @disk_errors()
    def _finish_upload(self, upload: UploadRow, seconds: float) -> str:
        parts = self._inputs.parts(upload.id)
        if sum(part.size for part in parts) != upload.length:
            raise FileNotFoundError(upload.id)
        self.ensure_space(upload.length)
        whole = self.incoming / f"{secrets.token_hex(12)}.part"
        try:
            with whole.open("wb", buffering=0) as file:
                for part in parts:
                    for data in self.objects.read(part.location, 0, part.size, 1 << 19):
                        write_all(file, data)
            sha256 = self.add(whole, upload.id)
            self._inputs.finish_upload(upload.id, sha256, seconds)
        finally:
            whole.unlink(missing_ok=True)
        self.discard_upload(upload.id)
        return sha256

    def discard_upload(self, upload_id: str) -> None:
        """Remove the upload's objects."""
        self.objects.remove_below(f"{UPLOADS}/{upload_id}")


class _ObjectWriter(PartWriter):
    """Writer of an upload's bytes: a file on this host buffers them until they are saved to the store."""

    @disk_errors()
    def __init__(
        self, folder: Path, objects: ObjectStore, inputs: InputRows, upload: UploadRow, seconds: float
    ) -> None:
        self._objects, self._path = objects, folder / f"{secrets.token_hex(12)}.part"
        super().__init__(inputs, upload, seconds, FileIO(self._path, "w"))

    def save(self) -> float:
        size = self.offset - self.saved
        if not size:
            return self._upload.expires_at
        self._file.truncate(size)  # a full disk may have cut off the last block
        location = f"{UPLOADS}/{self._upload.id}/{self.saved:016d}-{secrets.token_hex(6)}"
        self._objects.put(self._path, location)
        try:
            expires = self._inputs.advance_upload(self._upload.id, self.saved, size, self._seconds, location)
        except (ConflictError, NotFoundError):
            self._objects.remove(location)
            raise
        self.saved = self.offset
        self.discard()
        return expires

    def discard(self) -> None:
        self._file.seek(0)
        self._file.truncate()
        self.offset = self.saved

    def close(self) -> None:
        super().close()
        self._path.unlink(missing_ok=True)
