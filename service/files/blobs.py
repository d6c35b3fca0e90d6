"""Inputs: received in constant memory, kept once under the SHA-256 of their content.

Where the store of files is a local folder they are files of the data folder (`BlobFolder`); else they are in the store
(`service.files.stored_blobs`). Both are `Blobs`.
"""

from __future__ import annotations

import fcntl
import os
import secrets
import shutil
import tempfile
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Protocol

from service.errors import LockedError, NoSpaceError, NotFoundError, TooLargeError
from service.files.cache import file_digest
from service.files.objects import ObjectStore
from service.store.inputs import Inputs, check_offset
from service.store.tables import BlobRow, UploadRow

#: Files that no row refers to are removed at this age: a younger one's row may still be on its way.
_ORPHAN_SECONDS = 3600.0
#: Folders of the store of files, and of the data folder where that is a local one; all others are those of jobs.
BLOBS, UPLOADS = "blobs", "uploads"
#: Inodes that a file system must have left: a request needs some, and the database too.
_MIN_FREE_INODES = 1000


class Receiver:
    """A file that is being received; it becomes a blob by `Blobs.keep`."""

    def __init__(self, path: Path, limit: int, room: Callable[[int], None]) -> None:
        self.path = path
        self.size = 0
        self._limit = limit
        self._room = room
        self._file = path.open("wb", buffering=0)

    def write(self, data: bytes) -> None:
        """Take some bytes in.

        Raises:
            TooLargeError: they are more than allowed.
            NoSpaceError: the disk is too full.
        """
        self.size += len(data)
        if self.size > self._limit:
            raise TooLargeError(f"A file has more than {self._limit:,} bytes.", limit=self._limit)
        self._room(len(data))
        write_all(self._file, data)

    def close(self) -> None:
        """Make the bytes durable."""
        os.fsync(self._file.fileno())
        self._file.close()

    def discard(self) -> None:
        """Forget what has arrived."""
        self._file.close()
        self.path.unlink(missing_ok=True)


class PartWriter(Protocol):
    """Takes the next bytes of an upload in."""

    def write(self, data: bytes) -> None:
        """Take some bytes in. They are the writer's alone until `save`."""

    def save(self) -> float:
        """Make what has come durable, and tell the store; returns when the upload expires now.

        Raises:
            ConflictError: another request has saved the same bytes meanwhile.
        """

    def discard(self) -> None:
        """Forget what has come since the last `save`."""

    def close(self) -> None:
        """Let go of it; what was not saved is lost."""


class Blobs(ABC):
    """All inputs; rows in the store say what there is.

    Args:
        folder: of what is on its way in.
        min_free: bytes of its disk below which nothing is taken in.
        objects: Store of files that holds the blobs, below `BLOBS`.
    """

    def __init__(self, folder: Path, inputs: Inputs, min_free: int, objects: ObjectStore) -> None:
        self.objects = objects
        self.incoming = folder / "incoming"
        self.incoming.mkdir(parents=True, exist_ok=True)
        self._inputs, self._min_free = inputs, min_free

    def ensure_room(self, size: int) -> None:
        """Raise NoSpaceError where `size` more bytes would leave too little of the disk."""
        if shutil.disk_usage(self.incoming).free - size < self._min_free:
            raise NoSpaceError("The service's disk is too full to take this in. Try again later.")
        inodes = os.statvfs(self.incoming)
        if inodes.f_files and inodes.f_favail < _MIN_FREE_INODES:  # file systems without a table of inodes say 0
            raise NoSpaceError("The service's disk cannot hold more files. Try again later.")

    def receive(self, limit: int) -> Receiver:
        """Return a new file to write to."""
        self.ensure_room(0)
        return Receiver(self.incoming / f"{secrets.token_hex(12)}.part", limit, self.ensure_room)

    @abstractmethod
    def keep(self, path: Path, upload_id: str | None = None) -> str:
        """Make a received, durable file a blob, and return its SHA-256; the file is gone then.

        What is hashed is the file that gets the name. A blob of the same content that was lost or damaged is replaced.

        Args:
            path: File that nobody writes to any more.
            upload_id: Upload or receipt that holds the blob from then on.

        Raises:
            NotFoundError: The upload or receipt is gone.
        """

    @abstractmethod
    def remove(self, locations: Iterable[str]) -> None:
        """Remove the files of blobs whose rows have been deleted; what cannot be removed now is collected later."""

    @abstractmethod
    def bring(self, rows: Mapping[str, BlobRow], folder: Path) -> dict[str, Path]:
        """Return blobs as files of this machine, by digest, after comparing each with its digest.

        Args:
            rows: Blobs by digest.
            folder: Folder for these files alone; they stay as long as it does.

        Raises:
            LostFileError: The store of files does not have one.
            DamagedFileError: One is not what its digest says.
            StoreError: The store of files does not answer.
        """

    def read(self, row: BlobRow, start: int, stop: int) -> Iterator[bytes]:
        """Yield the bytes of a blob from `start` up to `stop`, straight from the store of files.

        Raises:
            FileNotFoundError: The blob has just been removed.
            StoreError: The store of files does not answer.
        """
        return self.objects.read(f"{BLOBS}/{row.location}", start, stop)

    @contextmanager
    def lent(self, rows: Mapping[str, BlobRow]) -> Iterator[dict[str, Path]]:
        """As `bring`, for as long as the block takes."""
        with tempfile.TemporaryDirectory(dir=self.incoming) as folder:
            yield self.bring(rows, Path(folder))

    @abstractmethod
    def begin_upload(self, upload_id: str) -> None:
        """Prepare for the bytes of an upload whose row has been made."""

    @abstractmethod
    def append(self, upload: UploadRow, seconds: float) -> PartWriter:
        """Return a writer of an upload's next bytes.

        Args:
            upload: Row of the upload.
            seconds: Time after each `save` until the upload expires.

        Raises:
            NotFoundError: The bytes before them are gone.
            ConflictError: The next byte is another one by now.
            LockedError: Another writer of the upload is open, in this process or in another one.
        """

    @abstractmethod
    def finish_upload(self, upload: UploadRow, seconds: float) -> str:
        """Make an upload whose last byte has been saved a blob, and return the blob's SHA-256.

        The upload's bytes stay until the database knows the blob: if the process dies before, this can be repeated.

        Raises:
            NotFoundError: The upload's bytes are gone.
            LockedError: Another request is doing the same.
        """

    @abstractmethod
    def forget_upload(self, upload_id: str) -> None:
        """Remove what has arrived of an upload whose row is gone."""

    def collect(self) -> int:
        """Remove blobs that nobody needs, and what crashes have left behind; return how many files.

        A database that has gone back in time does not know who needs what: then no blob is removed.
        """
        for upload_id in self._inputs.expire_uploads():
            self.forget_upload(upload_id)
        removed = 0 if self._inputs.rolled_back else self._collect_blobs()
        before = self._expiry() - _ORPHAN_SECONDS
        for path in self.incoming.iterdir():
            if _older(path, before):
                _remove(path)
                removed += 1
        return removed

    def _expiry(self) -> float:
        """Return the time by which files expire: neither their machine's clock alone decides, nor the database's."""
        return min(time.time(), self._inputs.expiry())

    @abstractmethod
    def _collect_blobs(self) -> int:
        """Remove blobs that nobody needs; returns how many files."""


class BlobFolder(Blobs):
    """Inputs as files of the data folder."""

    def __init__(self, folder: Path, inputs: Inputs, min_free_bytes: int) -> None:
        super().__init__(folder, inputs, min_free_bytes, ObjectStore(f"file://{folder}"))
        self._blobs, self.uploads = folder / BLOBS, folder / UPLOADS
        for path in (self._blobs, self.uploads):
            path.mkdir(parents=True, exist_ok=True)

    def keep(self, path: Path, upload_id: str | None = None, *, leave: bool = False) -> str:
        """Move a received file to its place, and return its SHA-256.

        Args:
            path: File that nobody writes to any more.
            leave: Whether the file keeps its old name as well.
        """
        path.chmod(0o400)
        size, sha256 = path.stat().st_size, file_digest(path)
        final = self._blobs / sha256[:2] / f"{sha256}-{secrets.token_hex(4)}"
        final.parent.mkdir(exist_ok=True)
        if leave:
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
        if known != final:  # it takes the place of a file of the same content, which may be lost or damaged
            known.parent.mkdir(exist_ok=True)
            final.replace(known)
            final.unlink(missing_ok=True)  # two names of one file: the system renames nothing
            flush_folder(known.parent)
        return sha256

    def remove(self, locations: Iterable[str]) -> None:
        """Remove their files."""
        for location in locations:
            (self._blobs / location).unlink(missing_ok=True)

    def bring(self, rows: Mapping[str, BlobRow], folder: Path) -> dict[str, Path]:  # noqa: ARG002 (others need it)
        """Return their places; nothing is put into `folder`."""
        for sha256, row in rows.items():
            self.objects.check(f"{BLOBS}/{row.location}", sha256)
        return {sha256: self._blobs / row.location for sha256, row in rows.items()}

    def begin_upload(self, upload_id: str) -> None:
        """Create its file, empty."""
        self.upload_path(upload_id).touch()

    def append(self, upload: UploadRow, seconds: float) -> PartWriter:
        """Write to the upload's file."""
        return _FileWriter(self.upload_path(upload.id), self._inputs, upload, seconds)

    def finish_upload(self, upload: UploadRow, seconds: float) -> str:
        """Link its file."""
        path = self.upload_path(upload.id)
        try:
            with path.open("rb") as file:
                _lock(file)
                known = self._inputs.upload(upload.id, upload.owner).sha256
                if known is not None:
                    return known
                if path.stat().st_size != upload.length:
                    raise gone(upload)
                sha256 = self.keep(path, upload.id, leave=True)
                self._inputs.finish_upload(upload.id, sha256, seconds)
                path.unlink(missing_ok=True)
                return sha256
        except FileNotFoundError:  # unless another request has just finished it
            known = self._inputs.upload(upload.id, upload.owner).sha256
            if known is None:
                raise gone(upload) from None
            return known

    def forget_upload(self, upload_id: str) -> None:
        """Remove its file."""
        self.upload_path(upload_id).unlink(missing_ok=True)

    def _collect_blobs(self) -> int:
        unused = self._inputs.collect()
        self.remove(unused)
        removed = len(unused)
        known = self._inputs.locations()
        before = self._expiry() - _ORPHAN_SECONDS
        for path in self._blobs.glob("*/*"):
            if _older(path, before) and f"{path.parent.name}/{path.name}" not in known:
                path.unlink(missing_ok=True)
                removed += 1
        return removed

    def upload_path(self, upload_id: str) -> Path:
        """Return the path of the bytes of an unfinished upload."""
        return self.uploads / f"{upload_id}.part"


class _FileWriter:
    """Writer to the file of an unfinished upload, from the offset that the database has.

    Only one is open at a time, in whatever process: it holds a lock on the file, by the descriptor that it writes to.
    """

    def __init__(self, path: Path, inputs: Inputs, upload: UploadRow, seconds: float) -> None:
        self._inputs, self._upload, self._seconds = inputs, upload, seconds
        self._offset = self._saved = upload.offset
        try:
            self._file = path.open("r+b", buffering=0)
        except FileNotFoundError:
            raise gone(upload) from None
        try:
            _lock(self._file)
            check_offset(inputs.upload(upload.id, upload.owner), upload.offset)  # as it is now that nobody changes it
            if os.fstat(self._file.fileno()).st_size < upload.offset:  # zeros would take the place of what is missing
                raise gone(upload)
            self._file.truncate(upload.offset)  # a crash may have left more, of which nothing is known
            self._file.seek(upload.offset)
        except BaseException:
            self._file.close()
            raise

    def write(self, data: bytes) -> None:
        write_all(self._file, data)
        self._offset += len(data)

    def save(self) -> float:
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


def _lock(file: IO[bytes]) -> None:
    """Lock an upload's file until it is closed; the system lets go of a lock whose process dies.

    Raises:
        LockedError: Somebody else has it open like this.
    """
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        raise LockedError from None


def gone(upload: UploadRow) -> NotFoundError:
    """Return the error of an upload whose bytes are not there any more."""
    return NotFoundError(f"The bytes of upload {upload.id} are gone. Begin a new one.")


def write_all(file: object, data: bytes) -> None:
    """Write every byte to an unbuffered file; a full disk becomes NoSpaceError."""
    view = memoryview(data)
    try:
        while view:
            view = view[file.write(view) :]  # type: ignore[attr-defined]
    except OSError as error:
        raise NoSpaceError(f"The service cannot write what it receives: {error.strerror}.") from error


def flush_folder(folder: Path) -> None:
    """Make names in a folder durable."""
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def _remove(path: Path) -> None:
    if path.is_dir():
        shutil.rmtree(path, ignore_errors=True)
    else:
        path.unlink(missing_ok=True)


def _older(path: Path, before: float) -> bool:
    try:
        return path.stat().st_ctime < before  # the time of the last change of its name, too
    except OSError:
        return False
