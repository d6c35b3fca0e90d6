"""Inputs: received in constant memory, kept once under the SHA-256 of their content.

Where the store of files is a local folder they are files of the data folder (`BlobFolder`); else they are in the store
(`service.files.stored_blobs`). Both are `Blobs`.
"""

from __future__ import annotations

import hashlib
import os
import secrets
import shutil
import tempfile
import time
from abc import ABC, abstractmethod
from collections import OrderedDict
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Protocol

from service.errors import NoSpaceError, NotFoundError, StoreError, TooLargeError
from service.files.cache import file_digest
from service.store.inputs import Inputs
from service.store.tables import BlobRow, UploadRow

#: Files that no row refers to are removed at this age: a younger one's row may still be on its way.
_ORPHAN_SECONDS = 3600.0
#: Bytes that a blob is read in.
_PIECE = 1 << 20
#: Unfinished uploads whose digests so far are remembered; what is forgotten is read again at the end.
_MAX_DIGESTS = 10_000


class Digest(Protocol):
    """What `hashlib` makes."""

    def update(self, data: bytes, /) -> None:
        """Take bytes in."""

    def copy(self) -> Digest:
        """One more, of the same bytes so far."""

    def hexdigest(self) -> str:
        """Of all bytes so far."""


class Receiver:
    """A file on its way in: bytes are hashed and written as they come, and are no blob before `Blobs.keep`."""

    def __init__(self, path: Path, limit: int, room: Callable[[int], None]) -> None:
        self.path = path
        self.size = 0
        self._limit = limit
        self._room = room
        self._digest = hashlib.sha256()
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
        self._digest.update(data)

    def close(self) -> str:
        """Make the bytes durable; returns their SHA-256."""
        os.fsync(self._file.fileno())
        self._file.close()
        return self._digest.hexdigest()

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
    """

    def __init__(self, folder: Path, inputs: Inputs, min_free: int) -> None:
        self.incoming = folder / "incoming"
        self.incoming.mkdir(parents=True, exist_ok=True)
        self._inputs, self._min_free = inputs, min_free

    def ensure_room(self, size: int) -> None:
        """Raise NoSpaceError where `size` more bytes would leave too little of the disk."""
        if shutil.disk_usage(self.incoming).free - size < self._min_free:
            raise NoSpaceError("The service's disk is too full to take this in. Try again later.")

    def receive(self, limit: int) -> Receiver:
        """A new file to write to."""
        return Receiver(self.incoming / f"{secrets.token_hex(12)}.part", limit, self.ensure_room)

    @abstractmethod
    def keep(self, path: Path, sha256: str, size: int, upload_id: str | None = None) -> None:
        """Make a received, durable file a blob, which an upload or a receipt holds from then on; the file is gone then.

        Raises:
            NotFoundError: the upload or receipt is gone.
        """

    @abstractmethod
    def remove(self, locations: Iterable[str]) -> None:
        """Remove the files of blobs whose rows have been deleted; what cannot be removed now is collected later."""

    @abstractmethod
    def bring(self, rows: Mapping[str, BlobRow], folder: Path) -> dict[str, Path]:
        """Blobs as files of this machine, by digest. They stay as long as `folder`, which is for them alone, does.

        Raises:
            StoreError: one cannot be had.
        """

    @abstractmethod
    def read(self, row: BlobRow, start: int, stop: int) -> Iterator[bytes]:
        """The bytes of a blob from `start` up to `stop`, in pieces.

        Raises:
            FileNotFoundError: it has just been removed.
            StoreError: the store of files is away.
        """

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
        """Write behind what an upload has.

        Args:
            upload: its row, of this moment.
            seconds: after which it expires, from each `save` on.

        Raises:
            NotFoundError: what it has had is gone.
        """

    @abstractmethod
    def finish_upload(self, upload: UploadRow, seconds: float) -> str:
        """Make an upload whose last byte has been saved a blob, and tie it to that; returns the blob's SHA-256.

        What the upload has stays until the store knows of the blob: when the process dies on the way, the same can be
        done again.

        Raises:
            NotFoundError: its bytes are gone.
        """

    @abstractmethod
    def forget_upload(self, upload_id: str) -> None:
        """Remove what has arrived of an upload whose row is gone."""

    def collect(self) -> int:
        """Remove blobs that nobody needs, and what crashes have left behind; returns how many files."""
        for upload_id in self._inputs.expire_uploads():
            self.forget_upload(upload_id)
        removed = self._collect_blobs()
        before = time.time() - _ORPHAN_SECONDS
        for path in self.incoming.iterdir():
            if _older(path, before):
                _remove(path)
                removed += 1
        return removed

    @abstractmethod
    def _collect_blobs(self) -> int:
        """Remove blobs that nobody needs; returns how many files."""


class BlobFolder(Blobs):
    """Inputs as files of the data folder."""

    def __init__(self, folder: Path, inputs: Inputs, min_free_bytes: int) -> None:
        super().__init__(folder, inputs, min_free_bytes)
        self._blobs, self.uploads = folder / "blobs", folder / "uploads"
        for path in (self._blobs, self.uploads):
            path.mkdir(parents=True, exist_ok=True)
        self._digests: OrderedDict[str, tuple[int, Digest]] = OrderedDict()

    def keep(self, path: Path, sha256: str, size: int, upload_id: str | None = None, *, leave: bool = False) -> None:
        """Move a received file to its place, or remove it where its content is there already.

        Args:
            leave: let it have its old name as well.
        """
        location = f"{sha256[:2]}/{sha256}-{secrets.token_hex(4)}"
        final = self._blobs / location
        final.parent.mkdir(exist_ok=True)
        if leave:
            os.link(path, final)
        else:
            path.replace(final)
        final.chmod(0o440)
        flush_folder(final.parent)
        try:
            kept = self._inputs.add_blob(sha256, location, size, upload_id) == location
        except NotFoundError:
            final.unlink()
            raise
        if not kept:
            final.unlink()

    def remove(self, locations: Iterable[str]) -> None:
        """Remove their files."""
        for location in locations:
            (self._blobs / location).unlink(missing_ok=True)

    def bring(self, rows: Mapping[str, BlobRow], folder: Path) -> dict[str, Path]:  # noqa: ARG002 (others need it)
        """Where they are; nothing is put into `folder`."""
        found = {sha256: self._blobs / row.location for sha256, row in rows.items()}
        gone = next((path for path in found.values() if not path.is_file()), None)
        if gone is not None:
            raise StoreError("An input is not in the service's data folder.", retry_after=30) from FileNotFoundError(
                gone
            )
        return found

    def read(self, row: BlobRow, start: int, stop: int) -> Iterator[bytes]:
        """From its file."""
        with (self._blobs / row.location).open("rb", buffering=0) as file:
            file.seek(start)
            while start < stop and (data := file.read(min(_PIECE, stop - start))):
                start += len(data)
                yield data

    def begin_upload(self, upload_id: str) -> None:
        """Its file, empty."""
        self.upload_path(upload_id).touch()

    def append(self, upload: UploadRow, seconds: float) -> PartWriter:
        """Write to the upload's file."""
        return _FileWriter(self, self._inputs, upload, seconds)

    def digest_so_far(self, upload_id: str, offset: int) -> Digest | None:
        """The SHA-256 of an upload's bytes before an offset, to go on with; None where this process has not seen all of
        them, or has forgotten it.
        """
        if not offset:
            return hashlib.sha256()
        at, digest = self._digests.get(upload_id, (-1, None))
        return digest.copy() if digest is not None and at == offset else None

    def keep_digest(self, upload_id: str, offset: int, digest: Digest | None) -> None:
        """Remember an upload's digest up to an offset for the request that goes on there."""
        self._digests.pop(upload_id, None)
        if digest is not None:
            self._digests[upload_id] = offset, digest.copy()
            if len(self._digests) > _MAX_DIGESTS:
                self._digests.popitem(last=False)

    def finish_upload(self, upload: UploadRow, seconds: float) -> str:
        """Link its file; that is read for its digest only where that was not computed while it came."""
        path = self.upload_path(upload.id)
        try:
            digest = self.digest_so_far(upload.id, upload.length)
            sha256 = digest.hexdigest() if digest is not None else file_digest(path)
            self.keep(path, sha256, upload.length, upload.id, leave=True)
        except FileNotFoundError:  # unless another request has just done it
            known = self._inputs.upload(upload.id, upload.owner).sha256
            if known is None:
                raise NotFoundError(f"The bytes of upload {upload.id} are gone. Begin a new one.") from None
            return known
        self._inputs.finish_upload(upload.id, sha256, seconds)
        self.keep_digest(upload.id, upload.length, None)
        path.unlink(missing_ok=True)
        return sha256

    def forget_upload(self, upload_id: str) -> None:
        """Remove its file."""
        self.upload_path(upload_id).unlink(missing_ok=True)
        self.keep_digest(upload_id, 0, None)

    def _collect_blobs(self) -> int:
        unused = self._inputs.collect()
        self.remove(unused)
        removed = len(unused)
        known = self._inputs.locations()
        before = time.time() - _ORPHAN_SECONDS
        for path in self._blobs.glob("*/*"):
            if _older(path, before) and f"{path.parent.name}/{path.name}" not in known:
                path.unlink(missing_ok=True)
                removed += 1
        return removed

    def upload_path(self, upload_id: str) -> Path:
        """Where the bytes of an unfinished upload are."""
        return self.uploads / f"{upload_id}.part"


class _FileWriter:
    """The file of an unfinished upload, from the offset that the store knows on."""

    def __init__(self, blobs: BlobFolder, inputs: Inputs, upload: UploadRow, seconds: float) -> None:
        self._blobs, self._inputs, self._upload, self._seconds = blobs, inputs, upload, seconds
        path = blobs.upload_path(upload.id)
        there = path.stat().st_size if path.exists() else 0
        if there < upload.offset:  # zeros would take the place of what is missing
            raise NotFoundError(f"The bytes of upload {upload.id} are gone. Begin a new one.")
        self._file = path.open("r+b" if path.exists() else "w+b", buffering=0)
        self._file.truncate(upload.offset)  # a crash may have left more, of which nothing is known
        self._file.seek(upload.offset)
        self._digest = blobs.digest_so_far(upload.id, upload.offset)
        self._offset = self._saved = upload.offset

    def write(self, data: bytes) -> None:
        write_all(self._file, data)
        self._offset += len(data)
        if self._digest is not None:
            self._digest.update(data)

    def save(self) -> float:
        os.fsync(self._file.fileno())
        self._saved = self._offset
        self._blobs.keep_digest(self._upload.id, self._offset, self._digest)
        return self._inputs.advance_upload(self._upload.id, self._offset, self._seconds)

    def discard(self) -> None:
        self._file.truncate(self._saved)

    def close(self) -> None:
        self._file.close()


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
