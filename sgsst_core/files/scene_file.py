"""Reader and writer of scenes in any format, and writer of OpenUSD files.

PLYs may have any order and numeric type of the properties, and further ones; `stylized_ply` returns them unchanged.
"""

from __future__ import annotations

import importlib.util
import io
import itertools
import os
import tempfile
import zipfile
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
import torch
from numpy.typing import NDArray
from plyfile import PlyData, PlyParseError
from torch import Tensor

from sgsst_core.constants import COLOR_OFFSET, SH_C0
from sgsst_core.errors import OutputError, SceneError, reading_scene
from sgsst_core.files.atomic import DISK_FULL, atomic_path
from sgsst_core.files.formats import read_scene_header, scene_path
from sgsst_core.files.formats.ply import (
    FILTER_3D,
    PLY,
    PROPERTIES,
    RGB,
    PlyHeader,
    PlySceneHeader,
    element_offsets,
    is_flat,
    surplus,
    write_ply,
)
from sgsst_core.files.formats.scene_format import (
    COEFFICIENTS,
    OPACITY_LOGITS,
    UNTAGGED,
    Y_UP,
    Arrays,
    Frame,
    RenderTag,
    SceneFormat,
    SceneHeader,
    blocks,
    check_units,
)
from sgsst_core.files.formats.sog import INDEX_NAME, META_NAME, SOG, StreamedHeader, write_recolored
from sgsst_core.files.formats.spz import SpzAxes, SpzHeader
from sgsst_core.refine import Refinement, piece_counts
from sgsst_core.scene.gaussians import TENSORS, Scene
from sgsst_core.scene.rendering import RenderMode
from sgsst_core.scene.stored_harmonics import RowFile, RowLayout, StoredHarmonics, changed, held

#: Number of bytes per read. They stay in a core's L2 cache while they are split into columns.
READ_BYTES = 1 << 20
#: Maximum bytes of SH coefficients above degree 0 in memory: those of 1.4 million Gaussians of degree 3.
HELD_BYTES = 1 << 28

#: Standard 3DGS properties by their names in PLY files: field of `Scene`, and column of its tensor.
_STANDARD = {name: (field, column) for field, names in PROPERTIES.items() for column, name in enumerate(names)} | {
    "opacity": ("opacities", 0)
}
#: Distance between positions, relative to a Gaussian's standard deviation, above which rounding moves it visibly.
_COARSE = 4.0
#: Names of arrays in notes.
_TITLES = {"scales": "log scales", "sh_dc": "colors (f_dc)", "sh_rest": "spherical harmonics"}
#: Properties that differ between the pieces of a split Gaussian.
_SHAPE = (*PROPERTIES["means"], "opacity", *PROPERTIES["scales"], FILTER_3D)


@dataclass(frozen=True)
class SceneFile:
    """Scene together with the information to write it back.

    Attributes:
        scene: Gaussians of the file, without dropped ones.
        header: PLY header, whose file `write_stylized` preserves; None for other formats and variants of PLY.
        retained: Mask [rows] bool of the file's rows that the scene contains; None if it contains all.
        stamp: Size in bytes and modification time in ns of the file when it was read.
        clamped: Number of infinite opacities that were replaced by finite ones. The stylized PLY keeps them.
        notes: Notes on contents of the file that are not read, or not read as stored.
        tag: Render mode that the file states. `scene.rendering` is another one if it was requested.
        copies: Number of pieces that each original Gaussian was split into, [N] int64; None if no Gaussian was split.
        sh_attenuation: SH attenuation that the scene has, but not the file.
        axes: Axes that the scene has in an SPZ: those of the file, else RUB.
    """

    path: Path
    scene: Scene
    header: PlyHeader | None
    retained: NDArray[np.bool_] | None
    stamp: tuple[int, int]
    format: str = PLY.name
    clamped: int = 0
    notes: tuple[str, ...] = ()
    tag: RenderTag = UNTAGGED
    copies: NDArray[np.int64] | None = None
    sh_attenuation: float = 0.0
    axes: str = "rub"

    def refined(self, refinement: Refinement | None) -> SceneFile:
        """Return the file with its scene refined; the file itself if no Gaussian was split.

        Raises:
            SceneError: If the file stores positions, opacities or scales as integers, or Gaussians are split already.
        """
        if refinement is None or not refinement.split:
            return self
        if self.copies is not None:
            raise SceneError(f"{self.path}: its Gaussians are split already. Save the result, and load it again.")
        kinds = self.header.vertex.kinds if self.header is not None else {}
        integers = [name for name in _SHAPE if kinds.get(name, "f")[0] != "f"]
        if integers:
            raise SceneError(
                f"{self.path}: {', '.join(integers)} are stored as integers; smaller Gaussians need float or double. "
                "Convert the scene first, or leave --refine out."
            )
        return replace(self, scene=refinement.of(self.scene), copies=piece_counts(refinement.pieces).numpy())

    def stylized(self, scene: Scene, refinement: Refinement | None, sh_attenuation: float) -> SceneFile:
        """Return the file with a stylized scene in place of its own.

        Args:
            refinement: Refinement of the stylized scene; None if there was none.
            sh_attenuation: SH attenuation of the stylized scene, in addition to the file's own.
        """
        attenuation = 1 - (1 - self.sh_attenuation) * (1 - sh_attenuation)
        return replace(self.refined(refinement), scene=scene, sh_attenuation=attenuation)

    def rendered(self, mode: RenderMode, eps2d: float | None) -> SceneFile:
        """Return the file with a requested render mode and blur; "auto" and None keep what the file states."""
        rendering = self.scene.rendering.requested(mode, eps2d)
        return replace(self, scene=replace(self.scene, rendering=rendering))

    @property
    def dropped(self) -> int:
        """Return the number of the file's Gaussians that were dropped."""
        return 0 if self.retained is None else int(len(self.retained) - self.retained.sum())


def read_scene(
    path: Path, *, drop_invalid: bool = False, held_bytes: int | None = None, spz_axes: SpzAxes = "auto"
) -> SceneFile:
    """Read a 3DGS scene of SH degree 0 to 4, of which 0 to 3 are used. The format is detected from the file's content.

    Scenes of other formats than PLY are decompressed into memory.

    Args:
        drop_invalid: Whether to drop Gaussians with NaN or infinite values, or with a quaternion of length 0, from the
            scene and the stylized file. If False, such a file is refused. Infinite opacities are clamped instead.
            Properties that 3DGS does not use are not checked.
        held_bytes: Maximum bytes of SH coefficients above degree 0 in memory. If they take more, they stay in the file
            (`StoredHarmonics`), provided that its layout allows this; see `stays_in_file`. None for `HELD_BYTES`.
        spz_axes: Axes of an SPZ file, "rub" or "rdf"; "auto" for those that the file states, else "rub".

    Raises:
        SceneError: If the file cannot be read, is truncated, is not a 3DGS scene, has a wrong header, no Gaussians or
            invalid values, or has changed while it was read.
    """
    path = scene_path(path)
    header = read_scene_header(path)
    if isinstance(header, SpzHeader):
        header = replace(header, requested=spz_axes)
    ply = header.ply if isinstance(header, PlySceneHeader) else None
    offset = element_offsets(path, ply).get("vertex", 0) if ply else 0
    file = RowFile(path)
    stamp = file.stamp
    stored = None
    if isinstance(header, PlySceneHeader) and stays_in_file(header, held_bytes):
        row = header.ply.vertex.dtype
        column = row.fields["f_rest_0"][1] if row.fields else 0
        stored = RowLayout(path, stamp, offset, header.count, row.itemsize, column, header.stored_coefficients)
    columns = SceneColumns(header, stored)
    about_rest = surplus(path, ply) if ply else ()
    if header.format.read is not None:
        header = header.format.read(file, header, columns.arrays) or header
        for block in blocks(header.count):
            columns.check(block.start, block.stop - block.start)
    elif ply is not None and ply.text:
        columns.take(0, text_vertices(path, ply))
    elif ply is not None:
        _read_binary(file, ply, offset, columns)
    file.check_unchanged(stamp)
    retained = columns.valid_rows(path, drop_invalid, about_rest)
    notes = (*header.notes, *about_rest)
    notes += check_units(path, columns.arrays, FLAT, logits_stored=header.format is PLY)
    if ply is not None and ply.has_double_positions:
        notes += about_rounded_positions(columns.arrays["means"], columns.arrays["scales"])
    arrays: dict[str, Any] = {name: torch.from_numpy(array) for name, array in columns.arrays.items()}
    if stored:
        arrays["sh_rest"] = StoredHarmonics(stored, coefficients=header.coefficients, file=file)
    scene = Scene(**arrays, rendering=header.tag.rendering, up=header.up)
    if retained is not None:
        scene = scene.subset(torch.from_numpy(retained))
    if isinstance(header, PlySceneHeader) and header.sources:
        ply = None
    return SceneFile(
        *(path, scene, ply, retained, stamp, header.format.name, sum(columns.clamped), notes, header.tag),
        axes=header.axes,
    )


def stays_in_file(declared: SceneHeader, held_bytes: int | None = None) -> bool:
    """Return whether a scene's SH coefficients above degree 0 stay in its file, rather than being loaded into memory.

    They do if they would take more than `held_bytes` and the file has the layout of 3DGS trainers: binary
    little-endian, float32 coefficients, in order.
    """
    if not isinstance(declared, PlySceneHeader) or not declared.coefficients or declared.sources:
        return False
    vertex = declared.ply.vertex
    rest = [(f"f_rest_{i}", "f4") for i in range(3 * declared.stored_coefficients)]
    first = [*vertex.kinds].index("f_rest_0")
    plain = declared.ply.byte_order == "<" and [*vertex.kinds.items()][first : first + len(rest)] == rest
    dtype = vertex.dtype
    offset = dtype.fields["f_rest_0"][1] if dtype.fields else 0
    limit = HELD_BYTES if held_bytes is None else held_bytes
    return plain and dtype.itemsize % 4 == 0 and offset % 4 == 0 and 4 * len(rest) * vertex.count > limit


def write_scene(path: Path, scene: Scene, format: SceneFormat = PLY, axes: str = "rub") -> None:
    """Write a scene to a file, atomically; see `encode_scene`.

    Raises:
        OutputError: If the file cannot be written, or the format cannot represent the scene.
    """
    with atomic_path(path) as temporary, temporary.open("wb") as output:
        encode_scene(output, scene, format, path, axes=axes)


def losses(scene: Scene, format: SceneFormat) -> tuple[str, ...]:
    """Return notes that count the Gaussians that a format cannot hold: values that it clips, or rounds too much."""
    arrays, notes = arrays_of(scene), []
    scales = arrays["scales"].max(axis=1)  # a Gaussian that is thin in one axis looks the same
    for name, (low, high) in format.ranges.items():
        values = (scales if name == "scales" else arrays[name]).reshape(len(scene), -1)
        clipped = int(((values < low) | (values > high)).any(axis=1).sum())
        if clipped:
            title = f"{_TITLES[name]} outside {low:.3g} to {high:.3g}, which {format.title} clips"
            notes.append(f"{clipped:,} of {len(scene):,} Gaussians have {title}")
    if format.step is not None:
        coarse = int((format.step(arrays["means"]) > _COARSE * np.exp(scales.astype(np.float64))).sum())
        if coarse:
            moved = f"{format.title} moves {coarse:,} of {len(scene):,} Gaussians"
            notes.append(f"{moved} by up to more than their size, because others are far away")
    return tuple(notes)


def write_levels(target: Path, scene: Scene, original: Path) -> int:
    """Write a streamed SOG with the colors of a scene that is its finest level with other colors.

    Coarser levels take the changes of their nearest Gaussians; see `write_recolored`. Return the bytes of all files.

    Args:
        target: `INDEX_NAME` in a folder, or an archive.
        original: Streamed SOG that the scene is from.

    Raises:
        SceneError: If `original` is no streamed SOG, or cannot be read.
        OutputError: If the scene has other Gaussians than it, or a file cannot be written.
    """
    original = scene_path(original)
    header = read_scene_header(original)
    if not isinstance(header, StreamedHeader):
        raise SceneError(f"{original}: is no streamed SOG. Give the {INDEX_NAME} or the archive of one.")
    arrays = arrays_of(scene)
    with ExitStack() as stack:
        # a folder gets its files when the last part of the original has been read
        to_folder = target.name == INDEX_NAME
        if to_folder:
            output = Path(stack.enter_context(tempfile.TemporaryDirectory()), "levels.zip")
        else:
            output = stack.enter_context(atomic_path(target))
        with zipfile.ZipFile(output, "w") as archive:
            write_recolored(original, header, arrays["means"], arrays["sh_dc"], archive)
        if to_folder:
            with zipfile.ZipFile(output) as archive:
                for info in archive.infolist():
                    file = target.parent / info.filename
                    file.parent.mkdir(parents=True, exist_ok=True)
                    with atomic_path(file) as temporary:
                        temporary.write_bytes(archive.read(info))
    return sum(info.file_size for info in archive.infolist())


def write_sog_folder(folder: Path, scene: Scene) -> int:
    """Write a scene as an unpacked SOG, whose meta.json comes last. Return the bytes of its files.

    Raises:
        OutputError: If a file cannot be written, or SOG cannot represent the scene.
    """
    stream = io.BytesIO()
    encode_scene(stream, scene, SOG, folder / META_NAME)
    with zipfile.ZipFile(stream) as archive:
        for entry in archive.infolist():
            with atomic_path(folder / entry.filename) as temporary:
                temporary.write_bytes(archive.read(entry))
        return sum(entry.file_size for entry in archive.infolist())


def encode_scene(
    output: BinaryIO, scene: Scene, format: SceneFormat, target: Path, *, pad_sh: bool = False, axes: str = "rub"
) -> None:
    """Write a scene to a stream.

    Formats other than PLY omit SH bands that are 0 in all Gaussians, and may change the order of the Gaussians.

    Args:
        format: One of `RESULT_FORMATS`.
        pad_sh: Whether a PLY has the coefficients of degree 3, with zeros for missing ones; ignored for other formats.
        axes: Axes of an SPZ; ignored for other formats.

    Raises:
        OutputError: If the format cannot represent the scene.
    """
    assert format.write is not None
    try:
        if format is PLY:
            write_ply(output, arrays_of(scene), scene.rendering, COEFFICIENTS[3] if pad_sh else 0)
        else:
            scene = scene.without_zero_bands()
            format.write(output, arrays_of(scene), scene.rendering, *([axes] if format.has_axes else []))
    except OutputError as error:
        raise OutputError(f"{target}: {error}") from error


def arrays_of(scene: Scene) -> Arrays:
    """Return the arrays of a scene for a writer, which share memory with its tensors."""
    return {name: held(getattr(scene, name)).detach().cpu().float().numpy() for name in TENSORS}


def _read_binary(file: RowFile, header: PlyHeader, offset: int, into: SceneColumns) -> None:
    """Read the vertex element in blocks. Large files are read with as many threads as PyTorch uses.

    plyfile would map the file, which takes as long, but kills the process if another program truncates the file.
    """
    dtype, count = header.vertex.dtype, header.vertex.count
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


def text_vertices(path: Path, header: PlyHeader) -> NDArray[Any]:
    """Read the vertex element of a text file as a structured array [rows]."""
    with path.open("rb") as file:
        file.seek(len(header.raw))
        if any(b"_" in block for block in iter(lambda: file.read(READ_BYTES), b"")):  # Python parses 1_0 as 10
            raise SceneError(
                f"{path}: cannot be read as PLY: there is a '_' among its numbers. Export the scene again."
            )
    try:
        # plyfile accepts ASCII alone, but comments may hold any characters
        with path.open(encoding="ascii", errors="backslashreplace", newline="") as stream:
            vertices: NDArray[Any] = PlyData.read(stream)["vertex"].data
            return vertices
    except (PlyParseError, ValueError, OverflowError) as error:
        raise SceneError(f"{path}: cannot be read as PLY: {error}. Export the scene again.") from error


def file_stamp(path: Path) -> tuple[int, int]:
    """Return the size in bytes and the modification time in ns of a file, to detect changes."""
    with reading_scene(path):
        status = path.stat()
    return status.st_size, status.st_mtime_ns


def read_property(file: SceneFile, name: str) -> Tensor:
    """Return a property of the scene's Gaussians, [N].

    Standard 3DGS properties are float32. Other properties keep the file's dtype, except that integers become float64.

    Raises:
        SceneError: If the file has no such numeric property, or has changed since it was read.
    """
    if name in _STANDARD:
        field, column = _STANDARD[name]
        values: Tensor = getattr(file.scene, field).reshape(len(file.scene), -1)
        return values[:, column]
    header = file.header
    if header is None or name not in header.vertex.kinds:
        known = sorted({*_STANDARD, *(header.vertex.kinds if header else ())})
        raise SceneError(f"{file.path}: its Gaussians have no property {name!r}. There are {', '.join(known)}.")
    if header.text:
        rows = text_vertices(file.path, header)[name]
    else:
        offset = element_offsets(file.path, header)["vertex"]
        rows = np.array(np.memmap(file.path, header.vertex.dtype, "r", offset, (header.vertex.count,))[name])
    if file_stamp(file.path) != file.stamp:
        raise changed(file.path)
    if file.retained is not None:
        rows = rows[file.retained]
    return torch.from_numpy(rows.astype(np.float64 if rows.dtype.kind != "f" else rows.dtype.newbyteorder("=")))


#: Log scale of the missing axis of flat Gaussians. In any scene, their thickness is far below rounding errors.
FLAT = -40.0
#: Rounding error of positions, relative to the median standard deviation of Gaussians, above which it is noted.
MAX_ROUNDED = 0.1


@np.errstate(over="ignore")
def about_rounded_positions(means: NDArray[Any], scales: NDArray[Any]) -> tuple[str, ...]:
    """Return a note if positions in double precision are too large for float32.

    Args:
        means: Positions [N, 3] float32.
        scales: Log scales [N, 3].
    """
    error = 0.5 * float(np.spacing(np.nanmedian(np.abs(means), axis=0)).max())
    fraction = error / max(float(np.exp(np.nanmedian(scales))), 1e-30)
    if not fraction > MAX_ROUNDED:
        return ()
    return (
        f"positions are rounded to float32 by up to {error:.2g}, {fraction:.1f} times the size of a typical Gaussian; "
        "subtract an offset from the positions of Gaussians and cameras first",
    )


class SceneColumns:
    """Arrays of a scene, filled block by block from the rows of a file, and the invalid values found in them.

    Args:
        stored: Layout of SH coefficients that stay in the file and are only checked; None if there are none.

    Attributes:
        arrays: float32 arrays by the names of the scene's tensors.
        retained: Mask [count] bool of valid rows.
        clamped: Number of infinite opacities in each block that contains any. They are replaced by the logits of
            almost 0 and 1 that compressed formats use, because exporters write an alpha of 255 as infinity.
    """

    def __init__(self, header: SceneHeader, stored: RowLayout | None) -> None:
        ply = header if isinstance(header, PlySceneHeader) else None
        count, coefficients = header.count, 0 if stored else header.coefficients
        self._stored = stored
        self._sources = ply.sources if ply else {}
        self.arrays: dict[str, NDArray[Any]] = {
            name: np.empty((count, len(columns)), np.float32) for name, columns in PROPERTIES.items()
        }
        self.arrays["opacities"] = np.empty(count, np.float32)
        self.arrays["sh_rest"] = np.empty((count, coefficients, 3), np.float32)
        self._targets = {
            prop: self.arrays[name][:, i] for name, columns in PROPERTIES.items() for i, prop in enumerate(columns)
        }
        self._targets["opacity"] = self.arrays["opacities"]
        stride = ply.stored_coefficients if ply else coefficients
        for channel, i in itertools.product(range(3), range(coefficients)):
            self._targets[f"f_rest_{channel * stride + i}"] = self.arrays["sh_rest"][:, i, channel]
        if ply and is_flat(ply.ply.vertex.kinds) and "scale_2" not in self._sources:
            self._targets.pop("scale_2")[:] = FLAT
        self.retained = np.ones(count, np.bool_)
        self.clamped: list[int] = []
        self._stored_flaws: list[NDArray[np.int64]] = []

    @np.errstate(over="ignore")  # a double too large for float32 becomes infinite and is reported as such
    def take(self, start: int, rows: NDArray[Any]) -> None:
        """Copy a structured block of rows to the arrays from row `start` on. Thread-safe for different blocks."""
        block = slice(start, start + len(rows))
        for name, target in self._targets.items():
            source = self._sources.get(name, name)
            target[block] = (rows[source] / 255 - COLOR_OFFSET) / SH_C0 if source in RGB else rows[source]
        if FILTER_3D in (rows.dtype.names or ()):
            apply_filter(self.arrays["scales"][block], self.arrays["opacities"][block], rows[FILTER_3D])
        self.check(start, len(rows), rows)

    def check(self, start: int, count: int, rows: NDArray[Any] | None = None) -> None:
        """Record invalid values of `count` rows from `start` on.

        `rows` is required if SH coefficients stay in the file.
        """
        block = slice(start, start + count)
        opacities = self.arrays["opacities"][block]
        infinite = np.isinf(opacities)
        if infinite.any():
            self.clamped.append(int(infinite.sum()))
            np.clip(opacities, OPACITY_LOGITS[0], OPACITY_LOGITS[-1], out=opacities, where=infinite)
        tables = [array[block].reshape(count, -1) for array in self.arrays.values()]
        if self._stored is not None and rows is not None:
            first = self._stored.column // 4
            table = rows.view(np.uint8).view("<f4").reshape(count, -1)
            tables.append(table[:, first : first + 3 * self._stored.coefficients])
        valid = (self.arrays["quats"][block] != 0).any(axis=1)
        if valid.all() and all(bool(np.isfinite(table).all()) for table in tables):
            return
        self.retained[block] = valid & np.all([np.isfinite(table).all(axis=1) for table in tables], axis=0)
        if self._stored is not None:
            self._stored_flaws.append(np.stack([np.isnan(tables[-1]).sum(axis=0), np.isinf(tables[-1]).sum(axis=0)]))

    def valid_rows(self, path: Path, drop_invalid: bool, surplus: tuple[str, ...]) -> NDArray[np.bool_] | None:
        """Return the mask [count] bool of valid rows; None if all are valid.

        Args:
            drop_invalid: Whether rows may be invalid.
            surplus: Note on content after the rows. With it, invalid rows mean that the header does not fit them.

        Raises:
            SceneError: If invalid rows may not be dropped, or no valid rows remain.
        """
        if self.retained.all():
            return None
        counts = {name: (np.isnan(values).sum(), np.isinf(values).sum()) for name, values in self._targets.items()}
        if self._stored_flaws:
            counts |= {f"f_rest_{i}": numbers for i, numbers in enumerate(np.sum(self._stored_flaws, axis=0).T)}
        invalid = []
        for name, numbers in counts.items():
            kinds = [f"{number} {what}" for number, what in zip(numbers, ("NaN", "infinite"), strict=True) if number]
            invalid += [f"{name} ({', '.join(kinds)})"] if kinds else []
        unrotated = np.flatnonzero((self.arrays["quats"] == 0).all(axis=1))
        bad = int((~self.retained).sum())
        flawed = [f"hold NaN or infinite values: {', '.join(invalid)}"] if invalid else []
        if len(unrotated):
            flawed += [
                f"have a quaternion of length 0, not a rotation ({len(unrotated)}, first: Gaussian {unrotated[0]})"
            ]
        summary = f"{path}: {bad} of {len(self.retained)} Gaussians {', or '.join(flawed)}"
        if surplus:
            raise SceneError(f"{summary}. Its rows are not as the header declares: {surplus[0]}.")
        if bad == len(self.retained):
            raise SceneError(f"{summary}. No valid Gaussians remain. Train or export the scene again.")
        if not drop_invalid:
            raise SceneError(f"{summary}. Use --drop-invalid to drop these Gaussians.")
        return self.retained


@np.errstate(divide="ignore", invalid="ignore", over="ignore")  # invalid values are reported later
def apply_filter(scales: NDArray[np.float32], opacities: NDArray[np.float32], deviations: NDArray[Any]) -> None:
    """Convolve Gaussians with the 3D filters of Mip-Splatting, in place.

    A filter limits the detail of a Gaussian to what its training views could sample. Trainers keep its deviation beside
    the Gaussian (property `filter_3D`), which is drawn convolved, at an opacity that keeps its integral. Variances
    along the axes become s^2 + f^2, and the opacity is multiplied by the square root of the ratio of the determinants
    before and after. Both are computed from logarithms, so that nothing over- or underflows.

    Args:
        scales: [n, 3], log scales.
        opacities: [n], logits.
        deviations: [n], deviation f of each filter, in world units; 0 leaves the Gaussian unchanged.
    """
    before, logits = scales.astype(np.float64), opacities.astype(np.float64)
    filters = 2 * np.log(np.abs(deviations.astype(np.float64)))
    after = np.logaddexp(2 * before, filters[:, None]) / 2
    ratio = (before - after).sum(axis=1)
    log_opacity = ratio - np.logaddexp(0, -logits)
    filtered = log_opacity - np.log(-np.expm1(log_opacity))
    scales[:] = after
    opacities[:] = np.where(ratio < 0, filtered, logits)


#: Suffixes of USD files: binary, text, and binary.
USD_SUFFIXES = (".usdc", ".usda", ".usd")
#: Standard deviations within the written extent.
_REACH = 3


def check_usd(out: Path) -> None:
    """Check that USD files can be written.

    Raises:
        OutputError: If usd-core is not installed, or too old.
    """
    if importlib.util.find_spec("pxr") is not None:
        from pxr import UsdVol

        if hasattr(UsdVol, "ParticleField3DGaussianSplat"):
            return
    raise OutputError(
        f"{out}: is a USD file, which the extra `usd` writes. Run `pip install 'sgsst-service[usd]'`, or write a .glb."
    )


@np.errstate(over="ignore")
def write_usd(path: Path, scene: Scene) -> None:
    """Write a scene as a USD stage with y up, atomically. Standard deviations and opacities are stored as they are.

    Raises:
        OutputError: If the file cannot be written.
    """
    from pxr import Tf, Usd, UsdGeom, UsdVol, Vt

    scene = scene.without_zero_bands()
    arrays = {name: array.astype(np.float32) for name, array in arrays_of(scene).items()}
    Frame.of(Y_UP).apply(arrays)
    quats = arrays["quats"].astype(np.float64)
    quats /= np.linalg.norm(quats, axis=1, keepdims=True)
    scales = np.exp(arrays["scales"].astype(np.float64)).astype(np.float32)
    opacities = (1 / (1 + np.exp(-arrays["opacities"].astype(np.float64)))).astype(np.float32)
    reach = _REACH * scales.max(axis=1, keepdims=True)
    bounds = np.stack([(arrays["means"] - reach).min(axis=0), (arrays["means"] + reach).max(axis=0)])
    harmonics = np.concatenate([arrays["sh_dc"][:, None], arrays["sh_rest"]], axis=1).reshape(-1, 3)

    stage = Usd.Stage.CreateInMemory()
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.y)
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    splats = UsdVol.ParticleField3DGaussianSplat.Define(stage, "/Gaussians")
    stage.SetDefaultPrim(splats.GetPrim())
    splats.CreateExtentAttr(Vt.Vec3fArray.FromNumpy(bounds.astype(np.float32)))
    for name, values in {
        "positions": Vt.Vec3fArray.FromNumpy(arrays["means"]),
        "orientations": Vt.QuatfArray.FromNumpy(np.roll(quats, -1, axis=1).astype(np.float32)),
        "scales": Vt.Vec3fArray.FromNumpy(scales),
        "opacities": Vt.FloatArray.FromNumpy(opacities),
        "radiance:sphericalHarmonicsDegree": scene.sh_degree,
        "radiance:sphericalHarmonicsCoefficients": Vt.Vec3fArray.FromNumpy(harmonics),
    }.items():
        splats.GetPrim().GetAttribute(name).Set(values)
    with atomic_path(path) as temporary:
        try:
            written = stage.GetRootLayer().Export(str(temporary))
        except Tf.ErrorException as error:
            full = next((code for code in DISK_FULL if os.strerror(code) in str(error)), None)
            if full:  # reported by `atomic_path`
                raise OSError(full, os.strerror(full)) from error
            raise OutputError(f"{path}: cannot be written: {error}. Free some space, or name another file.") from error
        if not written:
            raise OutputError(f"{path}: cannot be written. Free some space, or name another file.")
