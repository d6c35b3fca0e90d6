"""Files of a scene that consists of several, in a ZIP archive or in a folder."""

from __future__ import annotations

import io
import struct
import zipfile
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO, NamedTuple

from sgsst_core.errors import SceneError
from sgsst_core.files.formats.scene_format import about_surplus, read_bytes, without_padding

ZIP_MAGIC = b"PK\x03\x04"
#: Record at the end of a ZIP archive, and its signature; archives above 4 GB have a locator of another record before.
_END = struct.Struct("<4s4H2LH")
_END_MAGIC, _LOCATOR_MAGIC, _LOCATOR_BYTES = b"PK\x05\x06", b"PK\x06\x07", 20
_MAX_COMMENT_BYTES = 1 << 16
#: Maximum number of files in the archive of a scene, and bytes of their list.
_MAX_ENTRIES = 256
_MAX_LIST_BYTES = 1 << 18


class FilesOfScene:
    """Files of a scene: those of an archive, or those beside one of them.

    Args:
        path: Path of the archive, or of a file in the folder.
        folder: Prefix of all names, such as "0_0/".
        archive: Archive that is open already; None opens it for each file.

    Attributes:
        surplus: Note on bytes before or after the archive.
    """

    def __init__(self, path: Path, folder: str = "", archive: zipfile.ZipFile | None = None) -> None:
        self.path, self.folder, self._archive = path, folder, archive
        self.is_archived = read_bytes(path, 0, 4) == ZIP_MAGIC
        self.surplus: tuple[str, ...] = ()
        if self.is_archived and archive is None:
            end = archive_end(path)
            if end.entries > _MAX_ENTRIES or end.list_bytes > _MAX_LIST_BYTES:
                raise SceneError(f"{path}: is a ZIP archive of {end.entries} files, so no SOG scene. Unpack it first.")
            self.surplus = end.surplus

    def size(self, name: str) -> int:
        """Return an upper bound for the bytes of a file: its size, or that of the archive, whose list may be wrong."""
        try:
            return (self.path if self.is_archived else self.path.parent / (self.folder + name)).stat().st_size
        except OSError as error:
            raise self._unreadable(name, error) from error

    def load(self, name: str, limit: int, *, whole: bool = True) -> bytes:
        """Return the content of a file of at most `limit` bytes, or its first `limit` bytes if `whole` is False."""
        where = self.folder + name
        try:
            with self._open(where) as file:
                data = file.read(limit + whole)
        except KeyError as error:
            if self._archive is not None:
                raise SceneError(f"{self.path}: {where} is missing. Archive or export the scene again.") from error
            raise SceneError(
                f"{self.path}: is a ZIP archive without {name}, so no SOG scene. Unpack it, and give the scene in it."
            ) from error
        except OSError as error:
            raise self._unreadable(name, error) from error
        except (zipfile.BadZipFile, zlib.error, EOFError, RuntimeError, ValueError, struct.error) as error:
            raise SceneError(f"{self.path}: {where} is damaged: {error}. Copy or export the scene again.") from error
        if len(data) > limit:
            raise SceneError(
                f"{self.path}: {where} has more than {limit} bytes, too many for this scene. Export it again."
            )
        return data

    def _unreadable(self, name: str, error: OSError) -> SceneError:
        return SceneError(
            f"{self.path}: {self.folder}{name} cannot be read: {error.strerror}. Give the whole folder, or an archive."
        )

    @contextmanager
    def _open(self, name: str) -> Iterator[IO[bytes]]:
        if not self.is_archived:
            with (self.path.parent / name).open("rb") as file:
                yield file
        elif self._archive is not None:
            with _opened_member(self._archive, name) as file:
                yield file
        else:
            with zipfile.ZipFile(self.path) as archive, _opened_member(archive, name) as file:
                yield file


def _opened_member(archive: zipfile.ZipFile, name: str) -> IO[bytes]:
    if archive.getinfo(name).compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
        raise zipfile.BadZipFile("its compression is not supported")
    return archive.open(name)


class ArchiveEnd(NamedTuple):
    """Statement at the end of an archive.

    Attributes:
        list_start, list_bytes: Position of their list, and its size.
        surplus: Note on bytes before or after the archive.
    """

    entries: int
    list_start: int
    list_bytes: int
    surplus: tuple[str, ...]


def archive_end(path: Path) -> ArchiveEnd:
    """Read the end of an archive, before its list of files is read.

    Raises:
        SceneError: If it is truncated, or larger than 4 GB.
    """
    with path.open("rb") as file:
        size = file.seek(0, io.SEEK_END)
        file.seek(max(0, size - _LOCATOR_BYTES - _END.size - _MAX_COMMENT_BYTES))
        tail = file.read()
    position = tail.rfind(_END_MAGIC)
    if position < 0 or position + _END.size > len(tail):
        raise SceneError(f"{path}: is a truncated ZIP archive. Copy or export the scene again.")
    entries, list_bytes, list_offset, comment_bytes = _END.unpack_from(tail, position)[4:]
    if tail[max(0, position - _LOCATOR_BYTES) : position].startswith(_LOCATOR_MAGIC):
        raise SceneError(f"{path}: is a ZIP archive of more than 4 GB, which cannot be read. Unpack it first.")
    list_start = size - len(tail) + position - list_bytes
    after = without_padding(tail[position + _END.size + comment_bytes :])
    surplus = about_surplus(max(0, list_start - list_offset) + len(after), "byte")
    return ArchiveEnd(entries, max(0, list_start), list_bytes, surplus)
