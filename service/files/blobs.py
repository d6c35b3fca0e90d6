"""Inputs on disk: received in constant memory, kept once under the SHA-256 of their content."""

from __future__ import annotations

import hashlib
import os
import secrets
import shutil
import time
from collections import OrderedDict
from collections.abc import Callable
from pathlib import Path
from typing import Protocol

from service.errors import NoSpaceError, NotFoundError, TooLargeError
from service.store.inputs import Inputs
from service.store.tables import UploadRow

#: Files that no row refers to are removed at this age: a younger one's row may still be on its way.
_ORPHAN_SECONDS = 3600.0
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
    """A file on its way in: bytes are hashed and written as they come, and are no blob before `BlobFolder.keep`."""

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


class BlobFolder:
    """The folder of all inputs; rows in the store say what is in it."""

    def __init__(self, folder: Path, inputs: Inputs, min_free_bytes: int) -> None:
        self._blobs, self.incoming, self.uploads = folder / "blobs", folder / "incoming", folder / "uploads"
        for path in (self._blobs, self.incoming, self.uploads):
            path.mkdir(parents=True, exist_ok=True)
        self._inputs = inputs
        self._min_free = min_free_bytes
        self._digests: OrderedDict[str, tuple[int, Digest]] = OrderedDict()

    def ensure_room(self, size: int) -> None:
        """Raise NoSpaceError where `size` more bytes would leave too little of the disk."""
        if shutil.disk_usage(self._blobs).free - size < self._min_free:
            raise NoSpaceError("The service's disk is too full to take this in. Try again later.")

    def receive(self, limit: int) -> Receiver:
        """A new file to write to."""
        return Receiver(self.incoming / f"{secrets.token_hex(12)}.part", limit, self.ensure_room)

    def keep(self, path: Path, sha256: str, size: int, *, leave: bool = False) -> Path:
        """Make a received, durable file a blob: moved to its place, or removed where its content is there already.

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
        used = self._inputs.add_blob(sha256, location, size)
        if used != location:
            final.unlink()
        return self._blobs / used

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
        """Make an upload whose last byte is on the disk a blob, and tie it to that; returns the blob's SHA-256.

        The upload's own file stays until the store knows of the blob: when the process dies on the way, the same can
        be done again. The file is read for its digest only where that was not computed while it came.

        Raises:
            NotFoundError: the file is gone.
        """
        path = self.upload_path(upload.id)
        try:
            digest = self.digest_so_far(upload.id, upload.length)
            sha256 = digest.hexdigest() if digest is not None else _digest(path)
            self.keep(path, sha256, upload.length, leave=True)
        except FileNotFoundError:  # unless another request has just done it
            known = self._inputs.upload(upload.id, upload.owner).sha256
            if known is None:
                raise NotFoundError(f"The bytes of upload {upload.id} are gone. Begin a new one.") from None
            return known
        self._inputs.finish_upload(upload.id, sha256, seconds)
        self.keep_digest(upload.id, upload.length, None)
        path.unlink(missing_ok=True)
        return sha256

    def path(self, location: str) -> Path:
        """Where a blob's row says that its file is."""
        return self._blobs / location

    def collect(self) -> int:
        """Remove blobs that nobody needs, and what crashes have left behind; returns how many files."""
        removed = 0
        for upload_id in self._inputs.expire_uploads():
            self.upload_path(upload_id).unlink(missing_ok=True)
        for location in self._inputs.collect():
            self.path(location).unlink(missing_ok=True)
            removed += 1
        known = self._inputs.locations()
        before = time.time() - _ORPHAN_SECONDS
        for path in self._blobs.glob("*/*"):
            if _older(path, before) and f"{path.parent.name}/{path.name}" not in known:
                path.unlink(missing_ok=True)
                removed += 1
        for path in self.incoming.iterdir():
            if _older(path, before):
                path.unlink(missing_ok=True)
                removed += 1
        return removed

    def upload_path(self, upload_id: str) -> Path:
        """Where the bytes of an unfinished upload are."""
        return self.uploads / f"{upload_id}.part"


def _digest(path: Path) -> str:
    digest = hashlib.sha256()
    with path.open("rb") as file:
        while piece := file.read(_PIECE):
            digest.update(piece)
    return digest.hexdigest()


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


def _older(path: Path, before: float) -> bool:
    try:
        return path.stat().st_ctime < before  # the time of the last change of its name, too
    except OSError:
        return False
