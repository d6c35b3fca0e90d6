"""3DGS scenes in PLY files: reading them, and writing them back with new colours and nothing else changed.

The properties are those of Kerbl et al., "3D Gaussian Splatting for Real-Time Radiance Field Rendering" (2023): x y z,
f_dc_0..2, f_rest_* (channel-major: all coefficients of red first), opacity (logit), scale_0..2 (log), rot_0..3 (wxyz).
They may come in any order and numeric type, among any others.
"""

from __future__ import annotations

import io
import re
import warnings
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
import torch
from numpy.typing import NDArray
from plyfile import PlyData, PlyElement, PlyParseError
from torch import Tensor

from sgsst_core.errors import SceneError
from sgsst_core.files.atomic import atomic_path
from sgsst_core.files.ply_header import PlyHeader, element_offsets, read_header
from sgsst_core.scene.gaussians import Scene

#: Rows handled at a time: 64k rows of 62 floats are 16 MB, so that memory stays small and the columns of a block are
#: taken from the processor's cache instead of one pass over the file each.
BLOCK_ROWS = 1 << 16

_DC = ("f_dc_0", "f_dc_1", "f_dc_2")
_BASE = {
    "means": ("x", "y", "z"),
    "quats": ("rot_0", "rot_1", "rot_2", "rot_3"),
    "scales": ("scale_0", "scale_1", "scale_2"),
    "sh_dc": _DC,
}
_REST_DEGREES = {0: 0, 9: 1, 24: 2, 45: 3}


@dataclass(frozen=True)
class SceneFile:
    """A scene together with what is needed to write it back.

    Attributes:
        path: the PLY file.
        scene: its Gaussians, without dropped ones.
        header: the file's header.
        kept: [rows] bool, which rows of the file the scene holds; None where it holds all.
        stamp: size in bytes and time of last change (ns) of the file when it was read.
    """

    path: Path
    scene: Scene
    header: PlyHeader
    kept: NDArray[np.bool_] | None
    stamp: tuple[int, int]

    @property
    def dropped(self) -> int:
        """How many Gaussians of the file are not in the scene."""
        return 0 if self.kept is None else int(len(self.kept) - self.kept.sum())


def read_scene(path: Path, *, drop_invalid: bool = False) -> SceneFile:
    """Read a 3DGS PLY: SH degree 0 to 3, text or binary, any order and numeric type of the properties.

    Args:
        path: the file.
        drop_invalid: leave Gaussians with NaN or infinite values out, of the scene and later of the stylized file,
            instead of refusing the file. Properties that 3DGS does not use are not looked at.

    Raises:
        SceneError: missing, truncated or lying file, not a 3DGS scene, no Gaussians, non-finite values.
    """
    header = read_header(path)
    degree = _check_properties(path, header)
    element_offsets(path, header)
    stamp = _stamp(path)
    arrays, columns = _allocate(header.vertex.count, degree)
    rows = _read_vertices(path, header)
    with np.errstate(over="ignore"):  # a double too large for float32 becomes infinite, and is counted below
        for start in range(0, len(rows), BLOCK_ROWS):
            block = rows[start : start + BLOCK_ROWS]
            for name, column in columns.items():
                column[start : start + BLOCK_ROWS] = block[name]
    kept = _finite_rows(path, arrays, columns, drop_invalid)
    if kept is not None:
        arrays = {name: array[kept] for name, array in arrays.items()}
    scene = Scene(**{name: torch.from_numpy(array) for name, array in arrays.items()})
    return SceneFile(path, scene, header, kept, stamp)


def write_stylized(source: SceneFile, target: Path, sh_dc: Tensor) -> None:
    """Write the scene's file again with new f_dc_0..2; every other byte comes back as it was.

    Where a value is still what the file holds (in float32), its bytes stay too. Rows that were dropped at reading
    are absent, which also changes the count in the header. The file appears whole or not at all.

    Args:
        source: what `read_scene` gave.
        target: file to write; may be the source itself.
        sh_dc: [N, 3], finite, N = len(source.scene).

    Raises:
        SceneError: the source file was changed since it was read.
        OutputError: the target cannot be written.
        ValueError: sh_dc has the wrong shape or non-finite values.
    """
    if sh_dc.shape != source.scene.sh_dc.shape or not bool(torch.isfinite(sh_dc).all()):
        raise ValueError(f"sh_dc must be finite and {tuple(source.scene.sh_dc.shape)}, got {tuple(sh_dc.shape)}")
    if _stamp(source.path) != source.stamp:
        raise SceneError(
            f"{source.path}: was changed after it was read; the new colours may belong to other Gaussians. "
            "Put the original file back and run again."
        )
    colours = sh_dc.detach().to("cpu", torch.float32).contiguous().numpy()
    with atomic_path(target) as temporary, source.path.open("rb") as file, temporary.open("wb") as output:
        output.write(_header_for(source))
        if source.header.text:
            _write_text(source, colours, file, output)
        else:
            _write_binary(source, colours, file, output)


def write_scene(path: Path, scene: Scene) -> None:
    """Write a scene as a binary little-endian float32 3DGS PLY with the usual order of properties (normals are 0).

    Raises:
        OutputError: the file cannot be written.
    """
    coefficients = int(scene.sh_rest.shape[1])
    columns = {name: scene.means[:, i] for i, name in enumerate(_BASE["means"])}
    columns |= dict.fromkeys(("nx", "ny", "nz"), torch.zeros(len(scene)))
    columns |= {name: scene.sh_dc[:, i] for i, name in enumerate(_DC)}
    for i in range(3 * coefficients):
        columns[f"f_rest_{i}"] = scene.sh_rest[:, i % coefficients, i // coefficients]
    columns["opacity"] = scene.opacities
    columns |= {name: scene.scales[:, i] for i, name in enumerate(_BASE["scales"])}
    columns |= {name: scene.quats[:, i] for i, name in enumerate(_BASE["quats"])}
    rows = np.empty(len(scene), dtype=[(name, "<f4") for name in columns])
    for name, column in columns.items():
        rows[name] = column.detach().cpu().numpy()
    with atomic_path(path) as temporary:
        PlyData([PlyElement.describe(rows, "vertex")], byte_order="<").write(str(temporary))


def _check_properties(path: Path, header: PlyHeader) -> int:
    """SH degree of the scene; refuses what is no 3DGS scene before any data is read."""
    vertex = header.vertex if "vertex" in header.names else None
    kinds = {prop.name: prop.kind for prop in vertex.properties if not prop.length_kind} if vertex else {}
    missing = [name for names in (*_BASE.values(), ("opacity",)) for name in names if name not in kinds]
    if vertex is None or missing:
        raise SceneError(f"{path}: is not a 3DGS scene but {_what_else(header)}; missing: {', '.join(missing)}.")
    if vertex.count == 0:
        raise SceneError(f"{path}: holds no Gaussians (element vertex 0). Export the scene again.")
    if vertex.has_lists:
        name = next(prop.name for prop in vertex.properties if prop.length_kind)
        raise SceneError(
            f"{path}: vertex property {name!r} is a list, which 3DGS scenes do not have. Export without it."
        )
    for name in _DC:
        if kinds[name][0] != "f":
            raise SceneError(
                f"{path}: {name} is stored as integers; new colours need float or double. Convert it first."
            )
    rest = [name for name in kinds if re.fullmatch(r"f_rest_\d+", name)]
    if len(rest) not in _REST_DEGREES:
        raise SceneError(
            f"{path}: has {len(rest)} f_rest properties; SH degree 0, 1, 2, 3 have 0, 9, 24, 45. Export it again."
        )
    absent = [f"f_rest_{i}" for i in range(len(rest)) if f"f_rest_{i}" not in kinds]
    if absent:
        raise SceneError(
            f"{path}: f_rest properties are not numbered 0 to {len(rest) - 1}; missing: {', '.join(absent)}."
        )
    return _REST_DEGREES[len(rest)]


def _what_else(header: PlyHeader) -> str:
    """Best guess at what a PLY without Gaussians is, and what to do about it."""
    vertex = header.vertex if "vertex" in header.names else None
    names = {prop.name for prop in vertex.properties} if vertex else set()
    if "packed_position" in names:
        return "a compressed PLY (decompress it first, for instance with SuperSplat or splat-transform)"
    if "face" in header.names:
        return "a mesh (it has faces)"
    if {"x", "y", "z"} <= names and not names & {"opacity", "scale_0", "rot_0", "f_dc_0"}:
        return "a point cloud (train Gaussians on it first)"
    return "something else" if vertex else "a PLY without vertices"


def _allocate(count: int, degree: int) -> tuple[dict[str, NDArray[Any]], dict[str, NDArray[Any]]]:
    """The scene's arrays (float32, uninitialised), and per PLY property the view [count] that it fills."""
    coefficients = (degree + 1) ** 2 - 1
    arrays: dict[str, NDArray[Any]] = {name: np.empty((count, len(names)), np.float32) for name, names in _BASE.items()}
    arrays["opacities"] = np.empty(count, np.float32)
    arrays["sh_rest"] = np.empty((count, coefficients, 3), np.float32)
    columns = {prop: arrays[name][:, i] for name, names in _BASE.items() for i, prop in enumerate(names)}
    columns["opacity"] = arrays["opacities"]
    for i in range(3 * coefficients):
        columns[f"f_rest_{i}"] = arrays["sh_rest"][:, i % coefficients, i // coefficients]
    return arrays, columns


class _AsciiHeader(io.BufferedReader):
    """The file as plyfile wants it: it refuses headers with other than ASCII characters, which comments do have."""

    def __init__(self, path: Path, header_bytes: int) -> None:
        super().__init__(io.FileIO(path))
        self._header_bytes = header_bytes

    def read(self, size: int | None = -1, /) -> bytes:
        data = super().read(size)
        return re.sub(rb"[\x80-\xff]", b"?", data) if self.tell() <= self._header_bytes else data


def _read_vertices(path: Path, header: PlyHeader) -> NDArray[Any]:
    """[rows] structured array of element vertex, memory-mapped for binary files."""
    try:
        with _AsciiHeader(path, len(header.raw)) as stream, warnings.catch_warnings():
            warnings.filterwarnings("ignore", "loadtxt: input contained no data")  # an empty list in text
            vertices: NDArray[Any] = PlyData.read(stream)["vertex"].data
            return vertices
    except (PlyParseError, ValueError, OverflowError) as error:
        raise SceneError(f"{path}: cannot be read as PLY: {error}. Export the scene again.") from error


def _finite_rows(
    path: Path, arrays: dict[str, NDArray[Any]], columns: dict[str, NDArray[Any]], drop_invalid: bool
) -> NDArray[np.bool_] | None:
    """Which rows to keep, None for all; raises unless the others may be dropped."""
    if all(bool(np.isfinite(array).all()) for array in arrays.values()):
        return None
    kept = np.ones(len(arrays["opacities"]), dtype=np.bool_)
    found = []
    for name, column in columns.items():
        finite = np.isfinite(column)
        kept &= finite
        if not finite.all():
            nans = int(np.isnan(column).sum())
            counts = {"NaN": nans, "infinite": int((~finite).sum()) - nans}
            found.append(f"{name} ({', '.join(f'{count} {what}' for what, count in counts.items() if count)})")
    bad = int((~kept).sum())
    summary = f"{path}: {bad} of {len(kept)} Gaussians hold NaN or infinite values: {', '.join(found)}"
    if bad == len(kept):
        raise SceneError(f"{summary}. None is left: train or export the scene again.")
    if not drop_invalid:
        raise SceneError(f"{summary}. Give --drop-invalid to leave these Gaussians out.")
    return kept


def _stamp(path: Path) -> tuple[int, int]:
    try:
        status = path.stat()
    except OSError as error:
        raise SceneError(f"{path}: cannot be read: {error.strerror}. Check the path.") from error
    return status.st_size, status.st_mtime_ns


def _header_for(source: SceneFile) -> bytes:
    """The source's header, with the number of rows left where some were dropped."""
    raw = source.header.raw
    if source.kept is None:
        return raw
    start, stop = source.header.vertex.count_span
    return raw[:start] + str(len(source.scene)).encode() + raw[stop:]


def _blocks(source: SceneFile, colours: NDArray[Any]) -> Iterator[tuple[int, NDArray[np.bool_], NDArray[Any]]]:
    """For each block of file rows: their number, which of them are kept, and the colours of those."""
    rows = source.header.vertex.count
    position = 0
    for start in range(0, rows, BLOCK_ROWS):
        count = min(BLOCK_ROWS, rows - start)
        kept = np.ones(count, np.bool_) if source.kept is None else source.kept[start : start + count]
        following = position + int(kept.sum())
        yield count, kept, colours[position:following]
        position = following


def _write_binary(source: SceneFile, colours: NDArray[Any], file: BinaryIO, output: BinaryIO) -> None:
    dtype = source.header.vertex.dtype(source.header.byte_order)
    before = element_offsets(source.path, source.header)["vertex"] - len(source.header.raw)
    file.seek(len(source.header.raw))
    _copy(file, output, before)
    for count, kept, new in _blocks(source, colours):
        rows = np.frombuffer(bytearray(file.read(count * dtype.itemsize)), dtype)[kept]
        for name, column in zip(_DC, new.T, strict=True):
            changed = rows[name].astype(np.float32) != column
            rows[name][changed] = column[changed]
        output.write(rows.tobytes())
    _copy(file, output)


def _copy(file: BinaryIO, output: BinaryIO, count: int | None = None) -> None:
    """Copy `count` bytes, or all that are left."""
    while count is None or count > 0:
        data = file.read(1 << 20 if count is None else min(count, 1 << 20))
        if not data:
            return
        output.write(data)
        count = None if count is None else count - len(data)


def _write_text(source: SceneFile, colours: NDArray[Any], file: BinaryIO, output: BinaryIO) -> None:
    vertex = source.header.vertex
    before = source.header.elements[: source.header.elements.index(vertex)]
    order = [prop.name for prop in vertex.properties]
    slots = [(order.index(name), vertex.properties[order.index(name)].kind) for name in _DC]
    file.seek(len(source.header.raw))
    # latin-1 gives every byte back as it came, newline="" every line end
    lines = io.TextIOWrapper(file, "latin-1", newline="")
    for _ in range(sum(element.count for element in before)):
        output.write(lines.readline().encode("latin-1"))
    for count, kept, new in _blocks(source, colours):
        values = iter(new)
        for index in range(count):
            line = lines.readline()
            if kept[index]:
                output.write(_recoloured(line, slots, next(values)).encode("latin-1"))
    for line in lines:
        output.write(line.encode("latin-1"))


def _recoloured(line: str, slots: list[tuple[int, str]], values: NDArray[Any]) -> str:
    """A row of text with its three colour tokens replaced where their value changes; all spacing stays."""
    tokens = list(re.finditer(r"\S+", line))
    for (slot, kind), value in sorted(zip(slots, values, strict=True), key=lambda pair: -pair[0][0]):
        token = tokens[slot]
        if np.float32(token[0]) != value:
            # shortest text that reads back as the same number, in the precision that the file declares
            text = str(value) if kind == "f4" else repr(float(value))
            line = line[: token.start()] + text + line[token.end() :]
    return line
