"""Receiver of resumable uploads: one request at a time appends bytes, which are saved as they arrive."""

from __future__ import annotations

import base64
import hashlib
import threading
from functools import partial

from fastapi import Request

from api.http.context import Context
from api.http.multipart import body_blocks
from service import problems
from service.errors import ServiceError, StoreError
from service.store.tables import UploadRow

#: Digest algorithms of `Upload-Checksum`.
ALGORITHMS = ("sha256", "sha1", "md5")
#: Number of bytes after which an upload's state is saved. A crash loses at most this many bytes.
_SAVE_BYTES = 64 << 20


async def append_body(request: Request, context: Context, row: UploadRow, checksum: tuple[str, bytes] | None) -> float:
    """Append the request's body to the upload, and return the upload's new expiry time.

    Args:
        checksum: Algorithm and expected digest of the body; None for no check.
    """
    run = partial(context.threads.run, row.owner)
    writer = await run(_Writer, context, row, checksum)
    try:
        try:
            async for block in body_blocks(request, context.settings):
                await run(writer.write, block, size=_SAVE_BYTES)
        except StoreError:
            raise
        except ServiceError:
            if checksum is None:
                await run(writer.save, size=_SAVE_BYTES)  # no checksum can contradict them
            raise
        return await run(writer.finish, size=row.length if writer.complete else _SAVE_BYTES)
    finally:
        await context.threads.clean_up(run(writer.close))


class _Writer:
    """Writer that checks received bytes and saves them at intervals.

    A thread that hangs and was given up blocks the others, so that no file is closed while it is written to.
    """

    def __init__(self, context: Context, row: UploadRow, checksum: tuple[str, bytes] | None) -> None:
        self._context, self._row, self._checksum = context, row, checksum
        self._lock = threading.RLock()
        self._seconds = context.settings.upload_hours * 3600
        self._part = context.blobs.append(row, self._seconds)
        self._digest = hashlib.new(checksum[0]) if checksum else None
        self._offset = self._saved = row.offset

    def write(self, block: bytes) -> None:
        if self._offset + len(block) > self._row.length:
            raise longer_than_declared(self._row.length)
        with self._lock:
            self._context.blobs.ensure_space(len(block))
            self._part.write(block)
            self._offset += len(block)
            if self._digest is not None:
                self._digest.update(block)
            elif self._offset - self._saved >= _SAVE_BYTES:
                self.save()

    @property
    def complete(self) -> bool:
        """Whether all bytes of the upload have been written."""
        return self._offset == self._row.length

    def save(self) -> float:
        """Make the received bytes durable, then update the database. Return the upload's new expiry time."""
        with self._lock:
            self._saved = self._offset
            return self._part.save()

    def finish(self) -> float:
        """Verify and save the bytes of the request. Store the file as a blob if the upload is complete."""
        if self._digest is not None and self._checksum is not None and self._digest.digest() != self._checksum[1]:
            self._part.discard()
            raise problems.CHECKSUM_MISMATCH()
        expires = self.save()
        self.close()
        if self.complete:
            self._context.blobs.finish_upload(self._row, self._seconds)
        return expires

    def close(self) -> None:
        with self._lock:
            self._part.close()


def longer_than_declared(length: int) -> ServiceError:
    """Return the error for a part with more bytes than the upload lacks."""
    return problems.TOO_LARGE(f"The parts have more bytes than the {length:,} of Upload-Length.", limit=length)


def parse_checksum(header: str) -> tuple[str, bytes]:
    """Return the algorithm and the digest of an `Upload-Checksum` header.

    Raises:
        MALFORMED_BODY: If the header is malformed.
    """
    name, _, value = header.partition(" ")
    if name not in ALGORITHMS:
        raise problems.MALFORMED_BODY(f"Upload-Checksum: {name[:20]!r} is none of {', '.join(ALGORITHMS)}.")
    try:
        return name, base64.b64decode(value, validate=True)
    except ValueError as error:  # raised for non-ASCII characters too
        raise problems.MALFORMED_BODY("Upload-Checksum: the digest is not base64.") from error
