"""Inputs in a remote file store that all hosts share; reads go through a cache on this host."""

from __future__ import annotations

import logging
import secrets
import time
from collections.abc import Iterable, Mapping, Sequence
from functools import partial
from pathlib import Path

from service.errors import ConflictError, DamagedFileError, LostFileError, NoSpaceError, NotFoundError, StoreError
from service.files.artifacts import Artifacts
from service.files.blobs import BLOBS, UPLOADS, BlobFolder, Blobs, PartWriter, write_all
from service.files.cache import FileCache
from service.files.objects import ObjectStore
from service.settings import ServiceSettings
from service.store.inputs import InputRows
from service.store.tables import BlobRow, UploadPartRow, UploadRow
from sgsst_core.files.atomic import file_digest

#: Age in seconds at which objects without a database row are removed; younger objects may not have their row yet.
_ORPHAN_SECONDS = 6 * 3600.0
#: Interval between searches of the store for objects without a database row, in seconds.
_SEARCH_SECONDS = 3600.0

_log = logging.getLogger(__name__)


def open_blobs(settings: ServiceSettings, inputs: InputRows, artifacts: Artifacts) -> Blobs:
    """Return the store of inputs: the data folder if the file store is a local folder, otherwise the file store."""
    if artifacts.local:
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
        self._local = settings.folder / "blobs"  # inputs from a time when the file store was local
        self._searched_at = float("-inf")

    def ensure_space(self, size: int) -> None:
        """Raise NoSpaceError if `size` more bytes do not fit, even after evicting cached files."""
        try:
            super().ensure_space(size)
        except NoSpaceError:
            self._cache.free(self.missing_space(size))
            super().ensure_space(size)

    def add(self, path: Path, upload_id: str | None = None) -> str:
        """Upload a received file, and move it into the cache.

        The work is the same if its content is already stored: its duration would tell what others have.
        """
        sha256, size = file_digest(path), path.stat().st_size
        location = f"{sha256[:2]}/{sha256}-{secrets.token_hex(4)}"
        self.objects.put(path, f"{BLOBS}/{location}")
        self._repair(self._register(sha256, location, size, upload_id), sha256, path)
        self._cache.adopt(path, sha256)
        return sha256

    def remove(self, locations: Iterable[str]) -> None:
        """Remove the objects."""
        for location in locations:
            try:
                self.objects.remove(f"{BLOBS}/{location}")
            except StoreError as error:
                _log.warning("unused input not deleted yet: name=%s error=%s", location, error.__cause__)

    def fetch(self, rows: Mapping[str, BlobRow], folder: Path) -> dict[str, Path]:
        """Return links in `folder` to this host's cached copies, after fetching missing ones."""
        target = folder / ".inputs"
        target.mkdir()
        paths = {}
        for sha256, row in rows.items():
            paths[sha256] = target / sha256
            self._cache.link(sha256, row.size, paths[sha256], partial(self.objects.get, f"{BLOBS}/{row.location}"))
        return paths

    def _register(self, sha256: str, location: str, size: int, upload_id: str | None) -> str:
        """Register an object as a blob and return the blob's location; a duplicate object is removed.

        Raises:
            NotFoundError: If the upload or receipt that should hold the blob is gone; the object is removed.
        """
        try:
            known = self._inputs.add_blob(sha256, location, size, upload_id)
        except NotFoundError:
            self.remove([location])
            raise
        if known != location:
            self.remove([location])
        return known

    def _repair(self, location: str, sha256: str, path: Path) -> None:
        """Replace a blob with this file if the blob is lost or damaged."""
        try:
            self.objects.check(f"{BLOBS}/{location}", sha256)
        except (LostFileError, DamagedFileError):
            self.objects.put(path, f"{BLOBS}/{location}")

    # --- uploads ---------------------------------------------------------------------------------------------------

    def start_upload(self, upload_id: str) -> None:
        """Do nothing: no preparation is needed."""

    def append(self, upload: UploadRow, seconds: float) -> PartWriter:
        """Return a writer that stores one object per `save`, so that any API process can continue the upload."""
        return _ObjectWriter(self.incoming, self.objects, self._inputs, upload, seconds)

    def _finish_upload(self, upload: UploadRow, seconds: float) -> str:
        whole = self.incoming / f"{secrets.token_hex(12)}.part"
        try:
            sha256 = self._finish(upload, whole)
            self._inputs.finish_upload(upload.id, sha256, seconds)
        finally:
            whole.unlink(missing_ok=True)
        self.discard_upload(upload.id)
        return sha256

    def _finish(self, upload: UploadRow, whole: Path) -> str:
        """Turn an upload's bytes into a blob and a cached file, and return their SHA-256.

        The parts are concatenated, on the server if possible, and the result is fetched once to hash and cache it.

        Args:
            whole: Temporary path for the complete file.

        Raises:
            FileNotFoundError: If a part is missing.
        """
        parts = self._inputs.parts(upload.id)
        if sum(part.size for part in parts) != upload.length:
            raise FileNotFoundError(upload.id)
        self.ensure_space(upload.length)
        joined = self._join(upload.id, parts)
        if joined is None:
            self._gather([part.location for part in parts], whole)
            return self.add(whole, upload.id)
        # hash the stored object itself, because it becomes the blob
        self.objects.get(f"{BLOBS}/{joined}", whole)
        sha256 = file_digest(whole)
        self._repair(self._register(sha256, joined, upload.length, upload.id), sha256, whole)
        self._cache.adopt(whole, sha256)
        return sha256

    def _join(self, upload_id: str, parts: Sequence[UploadPartRow]) -> str | None:
        """Concatenate parts on the server and return the location of the new blob; None if that is not possible."""
        if not self.objects.can_join([part.size for part in parts]):
            return None
        location = f"joined/{upload_id}-{secrets.token_hex(4)}"
        try:
            self.objects.join([part.location for part in parts], f"{BLOBS}/{location}")
        except StoreError as error:
            _log.warning("joining parts failed, sending the whole file: %s", error.__cause__)
            return None
        return location

    def _gather(self, locations: list[str], whole: Path) -> None:
        """Fetch the parts of an upload and concatenate them."""
        piece = whole.with_suffix(".piece")
        try:
            with whole.open("wb", buffering=0) as file:
                for location in locations:
                    self.objects.get(location, piece)
                    with piece.open("rb") as part:
                        while data := part.read(1 << 20):
                            write_all(file, data)
        finally:
            piece.unlink(missing_ok=True)

    def discard_upload(self, upload_id: str) -> None:
        """Remove the upload's objects."""
        self.objects.remove_below(f"{UPLOADS}/{upload_id}")

    # --- housekeeping ----------------------------------------------------------------------------------------------

    def _collect_orphans(self) -> int:
        self._cache.evict()
        if time.monotonic() - self._searched_at <= _SEARCH_SECONDS:
            return 0
        self._searched_at = time.monotonic()
        self._take_over()
        before = time.time() - _ORPHAN_SECONDS
        old = [name for name, changed in self.objects.below(BLOBS).items() if changed < before]
        known = {f"{BLOBS}/{location}" for location in self._inputs.locations()} if old else set()
        orphans = [name for name in old if name not in known]
        parts = [name for name, changed in self.objects.below(UPLOADS).items() if changed < before]
        uploads = self._inputs.known_uploads(sorted({name.split("/")[1] for name in parts}))
        orphans += [name for name in parts if name.split("/")[1] not in uploads]
        for name in orphans:
            self.objects.remove(name)
        return len(orphans) + self.objects.abort_old_parts(before)

    def _take_over(self) -> None:
        """Upload inputs that remain from a time when the file store was a local folder."""
        known = self._inputs.locations() if self._local.is_dir() else set()
        for path in self._local.glob("*/*"):
            location = f"{path.parent.name}/{path.name}"
            if location in known:
                self.objects.put(path, f"{BLOBS}/{location}")
            path.unlink()


class _ObjectWriter:
    """Writer of an upload's bytes: a file on this host buffers them until they are saved to the store."""

    def __init__(
        self, folder: Path, objects: ObjectStore, inputs: InputRows, upload: UploadRow, seconds: float
    ) -> None:
        self._objects, self._inputs, self._upload, self._seconds = objects, inputs, upload, seconds
        self._path = folder / f"{secrets.token_hex(12)}.part"
        self._file = self._path.open("wb", buffering=0)
        self._start, self._size = upload.offset, 0

    def write(self, data: bytes) -> None:
        write_all(self._file, data)
        self._size += len(data)

    def save(self) -> float:
        if not self._size:
            return self._upload.expires_at
        location = f"{UPLOADS}/{self._upload.id}/{self._start:016d}-{secrets.token_hex(6)}"
        self._objects.put(self._path, location)
        try:
            expires = self._inputs.advance_upload(self._upload.id, self._start, self._size, self._seconds, location)
        except (ConflictError, NotFoundError):
            self._objects.remove(location)
            raise
        self._start += self._size
        self.discard()
        return expires

    def discard(self) -> None:
        self._file.seek(0)
        self._file.truncate()
        self._size = 0

    def close(self) -> None:
        self._file.close()
        self._path.unlink(missing_ok=True)
