"""Reader of PlayCanvas' streamed SOG, whose finest level is the scene, and writer of one with other colors.

lod-meta.json lists SOG scenes in folders of their own, each with Gaussians of one level of detail, and has a tree whose
leaves refer to ranges of them. The layout is that of
https://developer.playcanvas.com/user-manual/gaussian-splatting/formats/streamed-sog; early files lack its version and
counts. The environment, which is drawn beside any level, is part of the scene. All files may be in a ZIP archive.
"""

from __future__ import annotations

import json
import re
import struct
import zipfile
from collections import defaultdict
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from itertools import accumulate, pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sgsst_core.errors import OutputError, SceneError
from sgsst_core.files.advice import SCENES, known_kind
from sgsst_core.files.formats.archive import ZIP_MAGIC, FilesOfScene, archive_end
from sgsst_core.files.formats.scene_format import Arrays, FileStart, OpenScene, SceneFormat, SceneHeader, read_bytes
from sgsst_core.files.formats.sog import (
    GAUSSIANS_PER_BYTE,
    META_NAME,
    WRONG_JSON,
    SogFiles,
    SogHeader,
    read_colors,
    read_positions,
    read_sog,
    recolored,
    sog_header,
)

#: Name of the index in a folder or an archive.
INDEX_NAME = "lod-meta.json"
_MAX_INDEX_BYTES = 1 << 21
#: Maximum bytes of the list of an archive's files, and number of SOG scenes; usual ones have half a million Gaussians.
_MAX_LIST_BYTES, _MAX_PARTS = 1 << 21, 1024
#: Path of the meta.json of a part: in folders below the index, so that no other files are read.
_PART = re.compile(rf"((?:[\w-][\w.-]{{0,99}}/){{1,4}}){re.escape(META_NAME)}")


@dataclass(frozen=True)
class _Part:
    """SOG scene with the Gaussians of one level, or of the environment, whose level is None."""

    folder: str
    level: int | None
    header: SogHeader


@dataclass(frozen=True)
class StreamedHeader(SceneHeader):
    """Header of a streamed SOG.

    Attributes:
        parts: All parts, those of the scene first.
        ends: End of the Gaussians of each part of the scene among those of the scene, after a 0.
    """

    parts: tuple[_Part, ...]
    ends: tuple[int, ...]

    @property
    def rows(self) -> list[tuple[_Part, slice]]:
        """Return the parts of the scene with the slices of their Gaussians."""
        return [(part, slice(*span)) for part, span in zip(self.parts, pairwise(self.ends), strict=False)]


class _Opened:
    """Open streamed SOG.

    Attributes:
        surplus: Note on bytes around an archive.
    """

    def __init__(self, path: Path, archive: zipfile.ZipFile | None) -> None:
        self._path, self._archive, self._above = path, archive, ""
        self.surplus: tuple[str, ...] = ()
        if archive is not None:
            names = [name for name in archive.namelist() if f"/{name}".endswith(f"/{INDEX_NAME}")]
            self._above = min(names, key=len, default="").removesuffix(INDEX_NAME)  # an archive may hold the folder
            self.surplus = archive_end(path).surplus
        name = INDEX_NAME if archive is not None else path.name
        self.index = FilesOfScene(path, self._above, archive).load(name, _MAX_INDEX_BYTES)

    def part(self, folder: str) -> SogFiles:
        """Return the files of a part."""
        return SogFiles(self._path, self._above + folder, self._archive)


@contextmanager
def _opened(path: Path) -> Iterator[_Opened]:
    if read_bytes(path, 0, 4) != ZIP_MAGIC:
        yield _Opened(path, None)
        return
    try:
        archive = zipfile.ZipFile(path)
    except (OSError, zipfile.BadZipFile, NotImplementedError, ValueError, struct.error) as error:
        raise SceneError(f"{path}: is a damaged ZIP archive: {error}. Copy or export the scene again.") from error
    with archive:
        yield _Opened(path, archive)


def _matches(start: FileStart) -> bool:
    if not start.head.startswith(ZIP_MAGIC):
        return start.head.lstrip().startswith(b"{") and b'"lodLevels"' in start.head
    if known_kind(start.path, start.head, SCENES):
        return False
    try:
        end = archive_end(start.path)
    except SceneError:  # raised again by the reader of SOG
        return False
    names = read_bytes(start.path, end.list_start, end.list_start + min(end.list_bytes, _MAX_LIST_BYTES + 1))
    return len(names) <= _MAX_LIST_BYTES and INDEX_NAME.encode() in names


def _read_header(start: FileStart) -> StreamedHeader:
    with _opened(start.path) as opened:
        try:
            index = json.loads(opened.index)
            folders = _levels(index)
        except WRONG_JSON as error:
            raise SceneError(
                f"{start.path}: {INDEX_NAME} is not that of a streamed SOG ({repr(error)[:200]}). Export the scene "
                "again."
            ) from error
        parts = [_part(start.path, opened, folder, *entry) for folder, entry in folders.items()]
    levels = sorted({part.level for part in parts if part.level is not None})
    if not levels:
        raise SceneError(f"{start.path}: {INDEX_NAME} refers to no Gaussians. Export the scene again.")
    scene = [part for part in parts if part.level in (levels[0], None)]
    ends = (0, *accumulate(part.header.count for part in scene))
    if read_bytes(start.path, 0, 4) == ZIP_MAGIC and ends[-1] > GAUSSIANS_PER_BYTE * start.size:
        raise SceneError(f"{start.path}: declares {ends[-1]} Gaussians, more than it can hold. Export the scene again.")
    notes = (f"the finest of {len(levels)} levels of detail is read; a .zip of it has all of them, with its colors",)
    return StreamedHeader(
        STREAMED_SOG,
        ends[-1],
        max(part.header.coefficients for part in scene),
        (*scene, *(part for part in parts if part.level not in (levels[0], None))),
        ends,
        notes=opened.surplus + (notes if len(levels) > 1 else ()),
        tag=scene[0].header.tag,
    )


def _levels(index: dict[str, Any]) -> dict[str, tuple[int | None, list[tuple[int, int]]]]:
    """Return the level of each part, and the ranges of it that the tree refers to, by the part's folder.

    Errors of `WRONG_JSON` mean that a value is missing or wrong.
    """
    if index.get("version", 1) != 1:
        raise ValueError(f"version: {index['version']}")
    names, most = index["filenames"], index["lodLevels"]
    if len(names) > _MAX_PARTS:
        raise ValueError(f"{len(names)} files, of at most {_MAX_PARTS}")
    ranges: dict[tuple[str, int], list[tuple[int, int]]] = defaultdict(list)
    nodes = [index["tree"]]
    while nodes:
        node = nodes.pop()
        nodes += node.get("children", [])
        for level, range_ in node.get("lods", {}).items():
            file, offset, count = numbers = [range_[name] for name in ("file", "offset", "count")]
            if not all(type(value) is int and value >= 0 for value in numbers) or not 0 <= int(level) < most:
                raise ValueError(f"level {level} of {most}: {range_}")
            ranges[_folder(names[file]), int(level)].append((offset, count))
    totals: dict[int, int] = defaultdict(int)
    for (_, own), spans in ranges.items():
        totals[own] += sum(size for _, size in spans)
    for own, count in enumerate(index.get("counts", [])):
        if totals[own] != count:
            raise ValueError(f"level {own} has {totals[own]} Gaussians in place of {count}")
    order = {name: number for number, name in enumerate(map(_folder, names))}
    parts: dict[str, tuple[int | None, list[tuple[int, int]]]] = {
        folder: (level, spans) for (folder, level), spans in sorted(ranges.items(), key=lambda item: order[item[0][0]])
    }
    if len(parts) != len(ranges):
        raise ValueError("a file has several levels")
    if index.get("environment"):
        folder = _folder(index["environment"])
        if folder in parts:
            raise ValueError(f"environment: {folder}")
        parts[folder] = None, []
    return parts


def _folder(name: str) -> str:
    """Return the folder of a part, with a slash at its end, given the path of its meta.json."""
    match = _PART.fullmatch(name)
    if match is None:
        raise ValueError(f"file {name[:100]!r}: not the {META_NAME} of a folder beside {INDEX_NAME}")
    return match[1]


def _part(path: Path, opened: _Opened, folder: str, level: int | None, ranges: list[tuple[int, int]]) -> _Part:
    """Return a part, after checking that the tree refers to each of its Gaussians once."""
    header = sog_header(opened.part(folder))
    end = 0
    for offset, count in sorted(ranges):
        end = end + count if offset == end else -1
    if level is not None and end != header.count:
        raise SceneError(
            f"{path}: {folder}{META_NAME} has {header.count} Gaussians, but {INDEX_NAME} does not refer to each once. "
            "Export the scene again."
        )
    return _Part(folder, level, header)


def _read(file: OpenScene, header: SceneHeader, into: Arrays) -> SceneHeader:
    assert isinstance(header, StreamedHeader)
    with _opened(file.path) as opened:
        for part, rows in header.rows:
            arrays = {name: array[rows] for name, array in into.items()}
            if "sh_rest" in arrays:
                arrays["sh_rest"][:, part.header.coefficients :] = 0
                arrays["sh_rest"] = arrays["sh_rest"][:, : part.header.coefficients]
            read_sog(opened.part(part.folder), part.header, arrays)
    notes = (note for part, _ in header.rows for note in part.header.notes)
    return replace(header, notes=tuple(dict.fromkeys((*header.notes, *notes))))


def pack(index: Path, target: Path) -> None:
    """Write a streamed SOG to an archive, given its index in a folder.

    Raises:
        SceneError: If it is no streamed SOG, or a file is missing.
    """
    header = _read_header(FileStart(index, b"", index.stat().st_size))
    with _opened(index) as opened, zipfile.ZipFile(target, "w") as archive:
        for part in header.parts:
            unchanged = np.zeros((part.header.count, 3), np.float32)
            for name, data in recolored(opened.part(part.folder), part.header, unchanged).items():
                archive.writestr(zipfile.ZipInfo(part.folder + name), data)
        archive.writestr(zipfile.ZipInfo(INDEX_NAME), opened.index)


def write_recolored(
    original: Path,
    header: StreamedHeader,
    means: NDArray[np.float32],
    colors: NDArray[np.float32],
    archive: zipfile.ZipFile,
) -> None:
    """Archive a streamed SOG with the colors of a scene that is its finest level with other colors.

    A Gaussian of a coarser level takes the change of the nearest one of the finest level. All but colors keeps its
    bytes, and everything does in parts in which none changes.

    Args:
        original: Streamed SOG: its index or an archive.
        means, colors: Positions and SH coefficients of degree 0 of the scene, [n, 3].
        archive: Open archive that gets the files; the index comes last.

    Raises:
        SceneError: If `original` cannot be read.
        OutputError: If the scene has other Gaussians.
    """
    from scipy.spatial import cKDTree

    with _opened(original) as opened:
        own: Arrays = {name: np.empty((header.count, 3), np.float32) for name in ("means", "sh_dc")}
        for part, rows in header.rows:
            read_positions(opened.part(part.folder), part.header, own["means"][rows])
            read_colors(opened.part(part.folder), part.header, own["sh_dc"][rows])
        if not np.array_equal(means, own["means"]):
            raise OutputError(
                f"the scene's Gaussians are not those of the finest level of {original}, in the same order. Give that "
                "level with other colors, as a PLY, without --refine."
            )
        change, tree = colors - own["sh_dc"], cKDTree(means)
        rows_of = {part.folder: rows for part, rows in header.rows}
        for part in header.parts:
            files = opened.part(part.folder)
            if part.folder in rows_of:
                changed = change[rows_of[part.folder]]
            else:
                positions = np.empty((part.header.count, 3), np.float32)
                read_positions(files, part.header, positions)
                changed = change[tree.query(np.nan_to_num(positions))[1]]
            for name, data in recolored(files, part.header, changed).items():
                archive.writestr(zipfile.ZipInfo(part.folder + name), data)
        archive.writestr(zipfile.ZipInfo(INDEX_NAME), opened.index)


STREAMED_SOG = SceneFormat("zip", "streamed SOG", 14, _matches, _read_header, _read, media_type="application/zip")
