"""Reader and writer of scenes in any format, and writer of stylized PLYs that changes only the colors.

PLYs may have any order and numeric type of the properties, and further ones; `write_stylized` returns them unchanged.
Stylized scenes from other formats are written as PLYs with the layout of 3DGS trainers.
"""

from __future__ import annotations

import io
import itertools
import re
import warnings
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
import torch
from numpy.typing import NDArray
from plyfile import PlyData, PlyParseError
from torch import Tensor

from sgsst_core.errors import OutputError, SceneError
from sgsst_core.files.atomic import atomic_path
from sgsst_core.files.formats import read_scene_header
from sgsst_core.files.formats.ply import PLY, PROPERTIES, PlySceneHeader
from sgsst_core.files.formats.ply_header import PlyHeader, element_offsets
from sgsst_core.files.formats.scene_format import SceneFormat, SceneHeader
from sgsst_core.files.sh_attenuation import ShAttenuation, check_sh_attenuation
from sgsst_core.refine.split import Refinement, piece_counts
from sgsst_core.scene.gaussians import Scene
from sgsst_core.scene.stored_harmonics import RowFile, RowLayout, StoredHarmonics, changed, held

#: Number of rows per block. 64k rows of 62 floats take only 16 MB. The columns of a block are copied from the CPU
#: cache, instead of in one pass over the file per column.
BLOCK_ROWS = 1 << 16

#: Number of bytes per read. They stay in a core's L2 cache while they are split into columns.
READ_BYTES = 1 << 20
#: Maximum bytes of SH coefficients above degree 0 in memory: those of 1.4 million Gaussians of degree 3.
HELD_BYTES = 1 << 28

_DC = PROPERTIES["sh_dc"]
#: Properties that differ between the pieces of a split Gaussian.
_SHAPE = (*PROPERTIES["means"], "opacity", *PROPERTIES["scales"])
#: Order of the properties in messages; f_rest_* follow.
_ORDER = (*itertools.chain(*PROPERTIES.values()), "opacity")


@dataclass(frozen=True)
class SceneFile:
    """Scene together with the information to write it back.

    Attributes:
        path: Path of the file.
        scene: Gaussians of the file, without dropped ones.
        header: PLY header, whose file `write_stylized` preserves; None for other formats.
        kept: Mask [rows] bool of the file's rows that the scene contains; None if it contains all.
        stamp: Size in bytes and modification time in ns of the file when it was read.
        format: Name of the file's format.
        copies: Number of pieces that each original Gaussian was split into, [N] int64; None if no Gaussian was split.
    """

    path: Path
    scene: Scene
    header: PlyHeader | None
    kept: NDArray[np.bool_] | None
    stamp: tuple[int, int]
    format: str = PLY.name
    copies: NDArray[np.int64] | None = None

    def refined(self, refinement: Refinement | None) -> SceneFile:
        """Return the file with its scene refined; the file itself if no Gaussian was split.

        Raises:
            SceneError: If the file stores positions, opacities or scales as integers.
        """
        if refinement is None or not refinement.split:
            return self
        if self.header is not None:
            kinds = {prop.name: prop.kind for prop in self.header.vertex.properties}
            whole = [name for name in _SHAPE if kinds[name][0] != "f"]
            if whole:
                raise SceneError(
                    f"{self.path}: {', '.join(whole)} are stored as integers; smaller Gaussians need float or double. "
                    "Convert the scene first, or leave --refine out."
                )
        scene, copies = refinement.of(self.scene), piece_counts(refinement.pieces)
        return replace(self, scene=scene, copies=copies.numpy())

    @property
    def dropped(self) -> int:
        """Return the number of the file's Gaussians that were dropped."""
        return 0 if self.kept is None else int(len(self.kept) - self.kept.sum())


def read_scene(path: Path, *, drop_invalid: bool = False, held_bytes: int | None = None) -> SceneFile:
    """Read a 3DGS scene of SH degree 0 to 3. The format is detected from the file's content.

    PLYs may be text or binary, with any order and numeric type of the properties. Compressed PLY, SPZ and .splat are
    decompressed into memory.

    Args:
        path: Path of the file.
        drop_invalid: Whether to drop Gaussians with NaN or infinite values, or with a quaternion of length 0, from the
            scene and the stylized file. If False, such a file is refused. Properties that 3DGS does not use are not
            checked.
        held_bytes: Maximum bytes of SH coefficients above degree 0 in memory. If they take more, they stay in the file
            (`StoredHarmonics`), provided that its layout allows this; see `stays_in_file`. None for `HELD_BYTES`.

    Raises:
        SceneError: If the file cannot be read, is truncated, is not a 3DGS scene, has a wrong header, no Gaussians or
            invalid values, or has changed while it was read.
    """
    declared = read_scene_header(path)
    if not isinstance(declared, PlySceneHeader):
        return _read_arrays(path, declared, drop_invalid)
    header = declared.ply
    offset = element_offsets(path, header).get("vertex", 0)
    file = RowFile(path)
    stamp = file.stamp
    stored = _row_layout(path, header, stamp, offset) if stays_in_file(declared, held_bytes) else None
    into = _Columns(header.vertex.count, 0 if stored else declared.coefficients, stored)
    if header.text:
        rows = text_vertices(path, header)
        for start in range(0, len(rows), BLOCK_ROWS):
            into.take(start, rows[start : start + BLOCK_ROWS])
    else:
        _read_binary(file, header, offset, into)
    file.check_unchanged(stamp)
    kept = _valid_rows(path, header.vertex.count, into.flaws, drop_invalid)
    arrays: dict[str, Any] = {name: torch.from_numpy(array) for name, array in into.arrays.items()}
    if stored:
        arrays["sh_rest"] = StoredHarmonics(stored, file=file)
    scene = Scene(**arrays)
    return SceneFile(path, scene if kept is None else scene.subset(torch.from_numpy(kept)), header, kept, stamp)


def _read_arrays(path: Path, header: SceneHeader, drop_invalid: bool) -> SceneFile:
    """Read a scene in any format other than PLY."""
    file = RowFile(path)
    stamp = file.stamp
    into = _Columns(header.count, header.coefficients, None)
    assert header.format.read is not None
    header.format.read(file, header, into.arrays)
    file.check_unchanged(stamp)
    for start in range(0, header.count, BLOCK_ROWS):
        into.check(start, min(BLOCK_ROWS, header.count - start))
    kept = _valid_rows(path, header.count, into.flaws, drop_invalid)
    scene = Scene(**{name: torch.from_numpy(array) for name, array in into.arrays.items()})
    if kept is not None:
        scene = scene.subset(torch.from_numpy(kept))
    return SceneFile(path, scene, None, kept, stamp, header.format.name)


def stays_in_file(declared: SceneHeader, held_bytes: int | None = None) -> bool:
    """Return whether a scene's SH coefficients above degree 0 stay in its file, rather than being loaded into memory.

    They do if they would take more than `held_bytes` and the file has the layout of 3DGS trainers: binary
    little-endian, float32 coefficients, in order.
    """
    if not isinstance(declared, PlySceneHeader) or not declared.coefficients:
        return False
    header = declared.ply
    names = [prop.name for prop in header.vertex.properties]
    if header.text or header.byte_order != "<" or "f_rest_0" not in names:
        return False
    limit = HELD_BYTES if held_bytes is None else held_bytes
    dtype = header.vertex.dtype("<")
    count = sum(name.startswith("f_rest_") for name in names)
    first = names.index("f_rest_0")
    plain = names[first : first + count] == [f"f_rest_{i}" for i in range(count)]
    plain &= all(dtype[name] == np.dtype("<f4") for name in names[first : first + count])
    offset = dtype.fields["f_rest_0"][1] if dtype.fields else 0
    return plain and dtype.itemsize % 4 == 0 and offset % 4 == 0 and 4 * count * header.vertex.count > limit


def write_stylized(source: SceneFile, target: Path, sh_dc: Tensor, *, sh_attenuation: float = 0.0) -> None:
    """Write the PLY of a scene with new f_dc_0..2, atomically. All other bytes stay as in the source file.

    A color keeps its bytes too if its float32 value does not change. The rest of the file changes in three cases:

    - With an SH attenuation, f_rest_* change.
    - Dropped rows are absent, and the count in the header is adjusted.
    - Each piece of a split Gaussian has a row with its own position, scale and opacity, and the count is adjusted.

    A scene in another format is written as a PLY by `write_scene`.

    Args:
        source: File from `read_scene`.
        target: File to write; may be the source itself.
        sh_dc: Finite coefficients, [N, 3] with N = len(source.scene).
        sh_attenuation: SH attenuation of f_rest_*, 0 to 1; see `Scene.attenuated`.

    Raises:
        SceneError: If the source file has changed since it was read, or cannot store attenuated coefficients.
        OutputError: If the target cannot be written.
        ValueError: If sh_dc has the wrong shape or non-finite values.
    """
    if sh_dc.shape != source.scene.sh_dc.shape or not bool(torch.isfinite(sh_dc).all()):
        raise ValueError(f"sh_dc must be finite and {tuple(source.scene.sh_dc.shape)}, got {tuple(sh_dc.shape)}")
    if file_stamp(source.path) != source.stamp:
        raise changed(source.path)
    if source.header is None:
        write_scene(
            target, replace(source.scene.attenuated(sh_attenuation), sh_dc=sh_dc.detach().to("cpu", torch.float32))
        )
        return
    check_sh_attenuation(source.path, source.header, sh_attenuation)
    attenuation = ShAttenuation.of(source.header, sh_attenuation)
    columns = _new_columns(source, sh_dc.detach().to("cpu", torch.float32))
    with atomic_path(target) as temporary, source.path.open("rb") as file, temporary.open("wb") as output:
        output.write(_header_for(source, source.header))
        if source.header.text:
            _write_text(source, source.header, columns, attenuation, file, output)
        else:
            _write_binary(source, source.header, columns, attenuation, file, output)


def write_scene(path: Path, scene: Scene, format: SceneFormat = PLY) -> None:
    """Write a scene to a file, atomically; see `encode_scene`.

    Raises:
        OutputError: If the file cannot be written, or the format cannot represent the scene.
    """
    with atomic_path(path) as temporary, temporary.open("wb") as output:
        encode_scene(output, scene, format, path)


def encode_scene(output: BinaryIO, scene: Scene, format: SceneFormat, target: Path) -> None:
    """Write a scene to a stream.

    Formats other than PLY omit SH bands that are 0 in all Gaussians, and may change the order of the Gaussians.

    Args:
        output: Stream to write to.
        scene: Scene to write.
        format: One of `RESULT_FORMATS`.
        target: Path of the output, for messages.

    Raises:
        OutputError: If the format cannot represent the scene.
    """
    assert format.write is not None
    if format is not PLY:
        scene = scene.without_zero_bands()
    arrays = {field.name: held(getattr(scene, field.name)).detach().cpu().float().numpy() for field in fields(scene)}
    try:
        format.write(output, arrays)
    except OutputError as error:
        raise OutputError(f"{target}: {error}") from error


def _row_layout(path: Path, header: PlyHeader, stamp: tuple[int, int], offset: int) -> RowLayout:
    """Return the layout of the SH coefficients in a file for which `stays_in_file` is True."""
    fields = header.vertex.dtype(header.byte_order).fields
    assert fields is not None
    count = sum(re.fullmatch(r"f_rest_\d+", name) is not None for name in fields)
    size = header.vertex.dtype(header.byte_order).itemsize
    return RowLayout(path, stamp, offset, header.vertex.count, size, fields["f_rest_0"][1], count // 3)


@dataclass(frozen=True)
class _Flaws:
    """Invalid values in a block of rows.

    Attributes:
        start: First row of the block.
        valid: Mask [n] bool of rows with valid values only.
        counts: Numbers of NaN and of infinite values, for each property that has any.
        unrotated: Mask [n] bool of rows with a quaternion of length 0, which is not a rotation.
    """

    start: int
    valid: NDArray[np.bool_]
    counts: dict[str, tuple[int, int]]
    unrotated: NDArray[np.bool_]


class _Columns:
    """Arrays of a scene, filled block by block from the rows of a file, and the invalid values found in them.

    Args:
        count: Number of rows.
        coefficients: Number of SH coefficients per color channel to load.
        stored: Layout of SH coefficients that stay in the file and are only checked; None if there are none.

    Attributes:
        arrays: float32 arrays by the names of the scene's tensors.
        flaws: Invalid values of each block that contains any.
    """

    def __init__(self, count: int, coefficients: int, stored: RowLayout | None) -> None:
        self._stored = stored
        self.arrays: dict[str, NDArray[Any]] = {
            name: np.empty((count, len(names)), np.float32) for name, names in PROPERTIES.items()
        }
        self.arrays["opacities"] = np.empty(count, np.float32)
        self.arrays["sh_rest"] = np.empty((count, coefficients, 3), np.float32)
        self._targets = {
            prop: self.arrays[name][:, i] for name, names in PROPERTIES.items() for i, prop in enumerate(names)
        }
        self._targets["opacity"] = self.arrays["opacities"]
        for i in range(3 * coefficients):
            self._targets[f"f_rest_{i}"] = self.arrays["sh_rest"][:, i % coefficients, i // coefficients]
        self.flaws: list[_Flaws] = []

    def take(self, start: int, rows: NDArray[Any]) -> None:
        """Copy a structured block of rows to the arrays from row `start` on. Thread-safe for different blocks."""
        part = slice(start, start + len(rows))
        with np.errstate(over="ignore"):  # a double too large for float32 becomes infinite and is reported as such
            for name, target in self._targets.items():
                target[part] = rows[name]
        self.check(start, len(rows), rows)

    def check(self, start: int, count: int, rows: NDArray[Any] | None = None) -> None:
        """Record invalid values of `count` rows from `start` on.

        `rows` is required if SH coefficients stay in the file.
        """
        part = slice(start, start + count)
        blocks = [array[part] for array in self.arrays.values()]
        if self._stored is not None and rows is not None:
            table = rows.view(np.uint8).view("<f4").reshape(len(rows), -1)
            first = self._stored.column // 4
            blocks.append(table[:, first : first + 3 * self._stored.coefficients])
        rotated = self.arrays["quats"][part].any(axis=1)
        if not (rotated.all() and all(bool(np.isfinite(block).all()) for block in blocks)):
            self.flaws.append(self._flaws_of(start, count, rows))

    def _flaws_of(self, start: int, count: int, rows: NDArray[Any] | None) -> _Flaws:
        unrotated: NDArray[np.bool_] = np.logical_not(self.arrays["quats"][start : start + count].any(axis=1))
        valid, counts = np.logical_not(unrotated), {}
        columns = {name: target[start : start + count] for name, target in self._targets.items()}
        if self._stored is not None and rows is not None:
            columns |= {name: rows[name] for name in map("f_rest_{}".format, range(3 * self._stored.coefficients))}
        for name, column in columns.items():
            good = np.isfinite(column)
            valid &= good
            nans = int(np.isnan(column).sum())
            if not good.all():
                counts[name] = nans, int((~good).sum()) - nans
        return _Flaws(start, valid, counts, unrotated)


def _read_binary(file: RowFile, header: PlyHeader, offset: int, into: _Columns) -> None:
    """Read the vertex element in blocks. Large files are read with as many threads as PyTorch uses."""
    dtype, count = header.vertex.dtype(header.byte_order), header.vertex.count
    step = max(1, READ_BYTES // dtype.itemsize)

    def read(starts: range) -> None:
        buffer = np.empty(min(step, count) * dtype.itemsize, np.uint8)
        for start in starts:
            part = buffer[: min(step, count - start) * dtype.itemsize]
            file.read(offset + start * dtype.itemsize, part)
            into.take(start, part.view(dtype))

    threads = torch.get_num_threads()
    if threads == 1 or count <= 4 * step:
        read(range(0, count, step))
        return
    with ThreadPoolExecutor(threads, thread_name_prefix="scene") as pool:
        for done in [pool.submit(read, range(i * step, count, threads * step)) for i in range(threads)]:
            done.result()


class _AsciiHeader(io.BufferedReader):
    """File that replaces non-ASCII characters in a PLY header, which plyfile does not accept.

    Such characters may occur in comments.
    """

    def __init__(self, path: Path, header_bytes: int) -> None:
        super().__init__(io.FileIO(path))
        self._header_bytes = header_bytes

    def read(self, size: int | None = -1, /) -> bytes:
        data = super().read(size)
        return re.sub(rb"[\x80-\xff]", b"?", data) if self.tell() <= self._header_bytes else data


def text_vertices(path: Path, header: PlyHeader) -> NDArray[Any]:
    """Read the vertex element of a text file as a structured array [rows]."""
    with path.open("rb") as file:
        file.seek(len(header.raw))
        if any(b"_" in block for block in iter(lambda: file.read(READ_BYTES), b"")):  # Python parses 1_0 as 10
            raise SceneError(
                f"{path}: cannot be read as PLY: there is a '_' among its numbers. Export the scene again."
            )
    try:
        with _AsciiHeader(path, len(header.raw)) as stream, warnings.catch_warnings():
            warnings.filterwarnings("ignore", "loadtxt: input contained no data")  # for an empty list in text
            vertices: NDArray[Any] = PlyData.read(stream)["vertex"].data
            return vertices
    except (PlyParseError, ValueError, OverflowError) as error:
        raise SceneError(f"{path}: cannot be read as PLY: {error}. Export the scene again.") from error


def _valid_rows(path: Path, count: int, flaws: list[_Flaws], drop_invalid: bool) -> NDArray[np.bool_] | None:
    """Return the mask [count] bool of valid rows, or None if all are valid.

    Raises SceneError if invalid rows may not be dropped, or if no valid rows remain.
    """
    if not flaws:
        return None
    kept = np.ones(count, dtype=np.bool_)
    totals: dict[str, list[int]] = {}
    unrotated = np.concatenate([flaw.start + np.flatnonzero(flaw.unrotated) for flaw in flaws])
    for flaw in flaws:
        kept[flaw.start : flaw.start + len(flaw.valid)] = flaw.valid
        for name, (nans, infinite) in flaw.counts.items():
            total = totals.setdefault(name, [0, 0])
            total[0] += nans
            total[1] += infinite
    rest = sorted((name for name in totals if name not in _ORDER), key=lambda name: int(name.removeprefix("f_rest_")))
    found = []
    for name in [*(name for name in _ORDER if name in totals), *rest]:
        counts = dict(zip(("NaN", "infinite"), totals[name], strict=True))
        found.append(f"{name} ({', '.join(f'{number} {what}' for what, number in counts.items() if number)})")
    bad = int((~kept).sum())
    flawed = [f"hold NaN or infinite values: {', '.join(found)}"] if found else []
    if len(unrotated):
        flawed += [
            f"have a quaternion of length 0, not a rotation ({len(unrotated)}, first: Gaussian {min(unrotated)})"
        ]
    summary = f"{path}: {bad} of {len(kept)} Gaussians {', or '.join(flawed)}"
    if bad == len(kept):
        raise SceneError(f"{summary}. No valid Gaussians remain. Train or export the scene again.")
    if not drop_invalid:
        raise SceneError(f"{summary}. Use --drop-invalid to drop these Gaussians.")
    return kept


def file_stamp(path: Path) -> tuple[int, int]:
    """Return the size in bytes and the modification time in ns of a file, to detect changes."""
    try:
        status = path.stat()
    except OSError as error:
        raise SceneError(f"{path}: cannot be read: {error.strerror}. Check the path.") from error
    return status.st_size, status.st_mtime_ns


def _header_for(source: SceneFile, header: PlyHeader) -> bytes:
    """Return the source's header, with the new number of rows if Gaussians were dropped or split."""
    raw = header.raw
    if source.kept is None and source.copies is None:
        return raw
    start, stop = header.vertex.count_span
    return raw[:start] + str(len(source.scene)).encode() + raw[stop:]


#: New values of all Gaussians, by property name.
_NewColumns = dict[str, NDArray[np.float32]]


def _new_columns(source: SceneFile, colors: Tensor) -> _NewColumns:
    """Return the columns that may differ from the file: colors and, if Gaussians were split, their shapes."""
    columns = dict(zip(_DC, colors.numpy().T, strict=True))
    if source.copies is not None:
        columns["opacity"] = source.scene.opacities.numpy()
        for names, values in ((PROPERTIES["means"], source.scene.means), (PROPERTIES["scales"], source.scene.scales)):
            columns |= dict(zip(names, values.numpy().T, strict=True))
    return columns


def _blocks(source: SceneFile, rows: int) -> Iterator[tuple[int, NDArray[np.int64], slice]]:
    """Yield, for each block of file rows, its length, the number of copies of each row, and the slice of Gaussians."""
    position = gaussian = 0
    for start in range(0, rows, BLOCK_ROWS):
        count = min(BLOCK_ROWS, rows - start)
        times = np.ones(count, np.int64)
        if source.kept is not None:
            times[:] = source.kept[start : start + count]
        if source.copies is not None:
            own = times.nonzero()[0]
            times[own] = source.copies[position : position + len(own)]
            position += len(own)
        following = gaussian + int(times.sum())
        yield count, times, slice(gaussian, following)
        gaussian = following


def _write_binary(
    source: SceneFile,
    header: PlyHeader,
    columns: _NewColumns,
    attenuation: ShAttenuation | None,
    file: io.BufferedReader,
    output: BinaryIO,
) -> None:
    dtype = header.vertex.dtype(header.byte_order)
    before = element_offsets(source.path, header)["vertex"] - len(header.raw)
    file.seek(len(header.raw))
    _copy(file, output, before)
    buffer = bytearray(min(BLOCK_ROWS, header.vertex.count) * dtype.itemsize)
    for count, times, gaussians in _blocks(source, header.vertex.count):
        part = memoryview(buffer)[: count * dtype.itemsize]
        if file.readinto(part) != len(part):
            raise changed(source.path)
        rows = np.frombuffer(part, dtype)
        if not (times == 1).all():
            rows = np.repeat(rows, times)
        for name, values in columns.items():
            column = values[gaussians]
            different = rows[name].astype(np.float32) != column
            rows[name][different] = column[different]
        if attenuation is not None:
            attenuation.apply(rows)
        output.write(rows.view(np.uint8).data)
    _copy(file, output)
    if file_stamp(source.path) != source.stamp:
        raise changed(source.path)


def _copy(file: BinaryIO, output: BinaryIO, count: int | None = None) -> None:
    """Copy `count` bytes, or all remaining bytes if it is None."""
    while count is None or count > 0:
        data = file.read(1 << 20 if count is None else min(count, 1 << 20))
        if not data:
            return
        output.write(data)
        count = None if count is None else count - len(data)


def _write_text(
    source: SceneFile,
    header: PlyHeader,
    columns: _NewColumns,
    attenuation: ShAttenuation | None,
    file: BinaryIO,
    output: BinaryIO,
) -> None:
    vertex = header.vertex
    before = header.elements[: header.elements.index(vertex)]
    order = [prop.name for prop in vertex.properties]
    names = (*columns, *(attenuation.names if attenuation else ()))
    slots = [(order.index(name), vertex.properties[order.index(name)].kind) for name in names]
    file.seek(len(header.raw))
    # latin-1 preserves every byte, and newline="" every line end
    lines = io.TextIOWrapper(file, "latin-1", newline="")
    for _ in range(sum(element.count for element in before)):
        output.write(lines.readline().encode("latin-1"))
    for _, times, gaussians in _blocks(source, vertex.count):
        values = iter(np.stack([column[gaussians] for column in columns.values()], axis=1))
        for copies in times:
            line = lines.readline()
            for _ in range(copies):
                output.write(_changed_line(line, slots, next(values), attenuation).encode("latin-1"))
    for line in lines:
        output.write(line.encode("latin-1"))


def _changed_line(
    line: str, slots: list[tuple[int, str]], values: NDArray[Any], attenuation: ShAttenuation | None
) -> str:
    """Return a row of text with new values. Tokens whose value does not change, and all spacing, stay as they are.

    Args:
        line: Row of text.
        slots: Token index and NumPy type code of each value to replace: those of `values` first, then those to
            attenuate.
        values: New values of the first slots.
        attenuation: SH attenuation of the remaining slots; None if there are none.
    """
    tokens = list(re.finditer(r"\S+", line))
    if attenuation is not None:
        old = np.array([tokens[slot][0] for slot, _ in slots[len(values) :]], dtype=np.float32)
        values = np.concatenate([values, attenuation.attenuated(old)])
    for (slot, kind), value in sorted(zip(slots, values, strict=True), key=lambda pair: -pair[0][0]):
        token = tokens[slot]
        if np.float32(token[0]) != value:
            # shortest text that parses to the same number in the precision that the file declares
            text = str(value) if kind == "f4" else repr(float(value))
            line = line[: token.start()] + text + line[token.end() :]
    return line
