"""Protocol of one download: request headers and handling of the response. The transport does the sending."""

from __future__ import annotations

import hashlib
import re
from collections.abc import Callable
from pathlib import Path

import httpx

from api.client.answers import ApiError
from sgsst_core.files.atomic import disk_errors

Progress = Callable[[int, int], None]

#: Bytes per read or write operation on the disk.
BLOCK = 1 << 20
#: SHA-256 in an ETag. A proxy may have made the tag weak, or appended to it.
_SHA256 = re.compile(r"[0-9a-f]{64}")


class Download:
    """Download of a file to a target path. A partial file is resumed, and the complete file is checked by its SHA-256.

    Attributes:
        path: Path of the file on the service.
    """

    def __init__(self, path: str, target: Path, progress: Progress) -> None:
        self.path = path
        self._target, self._progress = target, progress
        self._part = target.with_name(target.name + ".part")
        self._stamp = target.with_name(target.name + ".part.etag")
        self._done = self._size = 0
        #: Hash of the first `_hashed` bytes of the partial file.
        self._digest, self._hashed = hashlib.sha256(), 0

    def headers(self) -> dict[str, str]:
        """Return headers that resume the partial file, if there is one, and that keep proxies from compressing."""
        self._done = self._part.stat().st_size if self._part.exists() else 0
        if not self._done or not self._stamp.exists():
            return {"Accept-Encoding": "identity"}
        tag = f'"{self._stamp.read_text()}"'
        return {"Accept-Encoding": "identity", "Range": f"bytes={self._done}-", "If-Range": tag}

    def begin(self, response: httpx.Response) -> bool:
        """Process the headers of a successful response, or of status 416, which means that all bytes were received.

        Returns:
            Whether the response's body must be written.

        Raises:
            ApiError: If the response does not state the SHA-256 of the file.
            OutputError: If the disk is full.
        """
        if response.status_code == httpx.codes.REQUESTED_RANGE_NOT_SATISFIABLE:
            return False
        stated = _SHA256.search(response.headers.get("etag", ""))
        if stated is None:
            raise ApiError(
                f"{response.url}: has no SHA-256 as its ETag, so the file cannot be checked. Check the address, and "
                "which headers a proxy removes."
            )
        if response.status_code != httpx.codes.PARTIAL_CONTENT:
            self._done = self._hashed = 0
            self._digest = hashlib.sha256()
            with disk_errors(self._target, self._part):
                self._part.write_bytes(b"")
                self._stamp.write_text(stated[0])
        self._size = self._done + int(response.headers.get("content-length", 0))
        return True

    def write(self, block: bytes) -> None:
        """Append a block to the partial file.

        Raises:
            OutputError: If the disk is full.
        """
        with disk_errors(self._target, self._part, self._size), self._part.open("ab") as file:
            file.write(block)
        if self._hashed == self._done:
            self._digest.update(block)
            self._hashed += len(block)
        self._done += len(block)

    def report(self) -> None:
        """Report the progress."""
        self._progress(self._done, self._size)

    def finish(self) -> None:
        """Check the whole file, then rename it to its target.

        Raises:
            ApiError: If the SHA-256 differs from the service's. The partial file is then deleted.
        """
        expected = self._stamp.read_text() if self._stamp.exists() else ""
        self._stamp.unlink(missing_ok=True)
        if self._sha256() != expected:
            self._part.unlink()
            raise ApiError(f"{self.path}: the download was damaged in transit. Try again.", 460)
        self._part.replace(self._target)

    def discard(self) -> None:
        """Delete the partial file."""
        self._part.unlink(missing_ok=True)
        self._stamp.unlink(missing_ok=True)

    def _sha256(self) -> str:
        """Return the SHA-256 of the partial file. Bytes that an earlier process has written are read for that."""
        with self._part.open("rb") as file:
            file.seek(self._hashed)
            while block := file.read(BLOCK):
                self._digest.update(block)
                self._hashed += len(block)
        return self._digest.hexdigest()
