"""Results of jobs: complete files under unique names in the file store."""

from __future__ import annotations

import errno
import logging
import mimetypes
import os
import secrets
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from service import problems
from service.files.blobs import disk_errors
from service.files.objects import ObjectStore
from service.states import Published
from sgsst_core.files.atomic import atomic_path, file_digest
from sgsst_core.files.formats import RESULT_FORMATS

#: Error numbers that mean that a hard link is impossible: different file systems, or no support for hard links.
_NO_LINKS = (errno.EXDEV, errno.EPERM, errno.ENOTSUP, errno.EMLINK)
_MEDIA_TYPES = {
    **{each.suffix: each.media_type for each in RESULT_FORMATS},
    ".json": "application/json",
    ".txt": "text/plain; charset=utf-8",
    ".html": "text/html; charset=utf-8",
}

_log = logging.getLogger(__name__)


class Artifacts:
    """Results in the file store.

    The objects of a job are below a folder with its id. Their names are never reused; database rows refer to the
    current version of each file.
    """

    def __init__(self, url: str) -> None:
        self.objects = ObjectStore(url)
        self.local = self.objects.local
        if self.local:
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
        if not self.local:
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
        try:
            with atomic_path(target) as temporary:
                self.objects.get(location, temporary)
                digest = file_digest(temporary)
                if digest != sha256:
                    _log.error("file damaged: name=%s sha256=%s expected=%s", location, digest, sha256)
                    raise problems.FILE_DAMAGED(sha256=sha256)
        except FileNotFoundError as error:
            raise problems.FILE_LOST(sha256=sha256) from error

    def sweep(self, job_id: str, epoch: int, retained: set[str]) -> None:
        """Remove files that interrupted attempts at a job left behind and that no database row refers to.

        Args:
            epoch: Latest lease epoch whose files are removed; files of later leases may not have their rows yet.
            retained: Locations that database rows refer to; their files are not removed.
        """
        for location in self.objects.below(job_id):
            below = location.partition("/")[2]
            if location not in retained and int(below.partition("/")[0]) <= epoch:
                self.objects.remove(location)


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


@contextmanager
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
