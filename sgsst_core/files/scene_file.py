"""Reader and writers of scenes in any format, of stylized PLYs, of OpenUSD files and of colors; blends of scenes.

PLYs may have any order and numeric type of the properties, and further ones. Stylized PLYs keep all but the colors.

With an SH attenuation, `f_rest_*` are multiplied by one factor in float32. The written coefficients equal those that
the job optimized with, because `Scene.attenuated` multiplies the same float32 values by the same factor.

Scenes that differ only in color are blended as weighted means of their spherical harmonics.
"""

from __future__ import annotations

import importlib.util
import io
import itertools
import math
import os
import re
import shutil
import tempfile
import zipfile
from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from plyfile import PlyData, PlyParseError
from torch import Tensor

from sgsst_core.constants import COLOR_OFFSET, SH_C0
from sgsst_core.errors import OutputError, SceneError, SettingsError, reading_scene
from sgsst_core.files.atomic import DISK_FULL, atomic_path, ensure_writable_folder
from sgsst_core.files.formats import read_scene_header, scene_format, scene_path
from sgsst_core.files.formats.ply import (
    FILTER_3D,
    PLY,
    PROPERTIES,
    RGB,
    PlyHeader,
    PlySceneHeader,
    element_offsets,
    is_flat,
    retagged,
    surplus,
    write_ply,
)
from sgsst_core.files.formats.sog import INDEX_NAME, META_NAME, SOG, StreamedHeader, write_recolored
from sgsst_core.files.formats.spz import SpzAxes, SpzHeader
from sgsst_core.refine import Refinement, piece_counts
from sgsst_core.scene.gaussians import TENSORS, Scene, attenuation_factor
from sgsst_core.scene.rendering import RenderMode

#: Rows of a PLY per block: a megabyte of a scene of SH degree 3 stays in a core's L2 cache while columns are copied.
BLOCK_ROWS = 1 << 12
_REST = re.compile(r"f_rest_\d+")
#: Largest finite float16 value.
_FLOAT16_MAX = 65504.0

#: Standard 3DGS properties by their names in PLY files: field of `Scene`, and column of its tensor.
_STANDARD = {name: (field, column) for field, names in PROPERTIES.items() for column, name in enumerate(names)} | {
    "opacity": ("opacities", 0)
}
#: Distance between positions, relative to a Gaussian's standard deviation, above which rounding moves it visibly.
_COARSE = 4.0
#: Names of arrays in notes.
_TITLES = {"scales": "log scales", "sh_dc": "colors (f_dc)", "sh_rest": "spherical harmonics"}


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
    tag: scene_format.RenderTag = scene_format.UNTAGGED
    copies: NDArray[np.int64] | None = None
    sh_attenuation: float = 0.0
    axes: str = "rub"

    def refined(self, refinement: Refinement | None) -> SceneFile:
        """Return the file with its scene refined; the file itself if no Gaussian was split.

        Raises:
            SceneError: If Gaussians are split already.
        """
        if refinement is None or not refinement.split:
            return self
        if self.copies is not None:
            raise SceneError(f"{self.path}: its Gaussians are split already. Save the result, and load it again.")
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


def read_scene(path: Path, *, drop_invalid: bool = False, spz_axes: SpzAxes = "auto") -> SceneFile:
    """Read a 3DGS scene of SH degree 0 to 4, of which 0 to 3 are used. The format is detected from the file's content.

    Args:
        drop_invalid: Whether to drop Gaussians with NaN or infinite values, or with a quaternion of length 0, from the
            scene and the stylized file. If False, such a file is refused. Infinite opacities are clamped instead.
            Properties that 3DGS does not use are not checked.
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
    stamp = file_stamp(path)
    columns = SceneColumns(header)
    about_rest = surplus(path, ply) if ply else ()
    with reading_scene(path), path.open("rb") as stream:
        file = scene_format.OpenScene(path, stream)
        if header.format.read is not None:
            header = header.format.read(file, header, columns.arrays) or header
        elif ply is not None and ply.text:
            columns.take(0, text_vertices(path, ply))
        elif ply is not None:
            # plyfile would map the file, which takes as long
            kind, offset = ply.vertex.dtype, element_offsets(path, ply)["vertex"]
            for start in range(0, header.count, BLOCK_ROWS):
                rows = min(BLOCK_ROWS, header.count - start)
                columns.take(start, scene_format.read_rows(file, kind, offset + start * kind.itemsize, rows))
    check_unchanged(path, stamp)
    clamped, retained = columns.clamp_opacities(), columns.valid_rows(path, drop_invalid, about_rest)
    scene_format.check_units(path, columns.arrays, logits_stored=header.format is PLY)
    arrays: dict[str, Any] = {name: torch.from_numpy(array) for name, array in columns.arrays.items()}
    scene = Scene(**arrays, rendering=header.tag.rendering)
    if retained is not None:
        scene = scene.subset(torch.from_numpy(retained))
    if isinstance(header, PlySceneHeader) and header.sources:
        ply = None
    notes = (*header.notes, *about_rest)
    return SceneFile(
        *(path, scene, ply, retained, stamp, header.format.name, clamped, notes, header.tag), axes=header.axes
    )


def write_scene(path: Path, scene: Scene, format: scene_format.SceneFormat = PLY, axes: str = "rub") -> None:
    """Write a scene to a file, atomically; see `encode_scene`.

    Raises:
        OutputError: If the file cannot be written, or the format cannot represent the scene.
    """
    with atomic_path(path) as temporary, temporary.open("wb") as output:
        encode_scene(output, scene, format, path, axes=axes)


def losses(scene: Scene, format: scene_format.SceneFormat) -> tuple[str, ...]:
    """Return notes that count the Gaussians whose values a format clips, or whose positions it makes coarse."""
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
            _unpack(output, target.parent)
    return sum(info.file_size for info in archive.infolist())


def write_sog_folder(folder: Path, scene: Scene) -> int:
    """Write a scene as an unpacked SOG, whose meta.json comes last. Return the bytes of its files.

    Raises:
        OutputError: If a file cannot be written, or SOG cannot represent the scene.
    """
    stream = io.BytesIO()
    encode_scene(stream, scene, SOG, folder / META_NAME)
    return _unpack(stream, folder)


def _unpack(file: Path | BinaryIO, folder: Path) -> int:
    """Write the files of an archive to a folder, in their order. Return their bytes."""
    with zipfile.ZipFile(file) as archive:
        for entry in archive.infolist():
            target = folder / entry.filename
            ensure_writable_folder(target.parent)
            with atomic_path(target) as temporary:
                temporary.write_bytes(archive.read(entry))
        return sum(entry.file_size for entry in archive.infolist())


def encode_scene(
    output: BinaryIO,
    scene: Scene,
    format: scene_format.SceneFormat,
    target: Path,
    *,
    pad_sh: bool = False,
    axes: str = "rub",
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
            write_ply(output, arrays_of(scene), scene.rendering, scene_format.COEFFICIENTS[3] if pad_sh else 0)
        else:
            scene = scene.without_zero_bands()
            format.write(output, arrays_of(scene), scene.rendering, *([axes] if format.has_axes else []))
    except OutputError as error:
        raise OutputError(f"{target}: {error}") from error


def arrays_of(scene: Scene) -> scene_format.Arrays:
    """Return the arrays of a scene for a writer, which share memory with its tensors."""
    return {name: getattr(scene, name).detach().cpu().float().numpy() for name in TENSORS}


def text_vertices(path: Path, header: PlyHeader) -> NDArray[Any]:
    """Read the vertex element of a text file as a structured array [rows]."""
    with path.open("rb") as file:
        file.seek(len(header.raw))
        if any(b"_" in block for block in iter(lambda: file.read(1 << 20), b"")):  # Python parses 1_0 as 10
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


def check_unchanged(path: Path, stamp: tuple[int, int]) -> None:
    """Raise SceneError if a file's size or modification time differs from an earlier `stamp`."""
    if file_stamp(path) != stamp:
        raise scene_format.changed(path)


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
    check_unchanged(file.path, file.stamp)
    if file.retained is not None:
        rows = rows[file.retained]
    return torch.from_numpy(rows.astype(np.float64 if rows.dtype.kind != "f" else rows.dtype.newbyteorder("=")))


#: Log scale of the missing axis of flat Gaussians. In any scene, their thickness is far below rounding errors.
FLAT = -40.0


class SceneColumns:
    """Arrays of a scene, filled block by block from the rows of a file, and the invalid values found in them.

    Attributes:
        arrays: float32 arrays by the names of the scene's tensors.
    """

    def __init__(self, header: scene_format.SceneHeader) -> None:
        ply = header if isinstance(header, PlySceneHeader) else None
        count, coefficients = header.count, header.coefficients
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

    @np.errstate(over="ignore")  # a double too large for float32 becomes infinite and is reported as such
    def take(self, start: int, rows: NDArray[Any]) -> None:
        """Copy a structured block of rows to the arrays from row `start` on."""
        block = slice(start, start + len(rows))
        for name, target in self._targets.items():
            source = self._sources.get(name, name)
            target[block] = (rows[source] / 255 - COLOR_OFFSET) / SH_C0 if source in RGB else rows[source]
        if FILTER_3D in (rows.dtype.names or ()):
            apply_filter(self.arrays["scales"][block], self.arrays["opacities"][block], rows[FILTER_3D])

    def clamp_opacities(self) -> int:
        """Replace infinite opacities, and return their number.

        They become the logits of almost 0 and 1 that compressed formats use, because exporters write an alpha of 255
        as infinity.
        """
        opacities = self.arrays["opacities"]
        infinite = np.isinf(opacities)
        np.clip(
            opacities, scene_format.OPACITY_LOGITS[0], scene_format.OPACITY_LOGITS[-1], out=opacities, where=infinite
        )
        return int(infinite.sum())

    def valid_rows(self, path: Path, drop_invalid: bool, surplus: tuple[str, ...]) -> NDArray[np.bool_] | None:
        """Return the mask [count] bool of valid rows; None if all are valid.

        Args:
            drop_invalid: Whether rows may be invalid.
            surplus: Note on content after the rows. With it, invalid rows mean that the header does not fit them.

        Raises:
            SceneError: If invalid rows may not be dropped, or no valid rows remain.
        """
        valid: NDArray[np.bool_] = (self.arrays["quats"] != 0).any(axis=1)
        for block in scene_format.blocks(len(valid)):
            for array in self.arrays.values():
                valid[block] &= np.isfinite(array[block]).reshape(block.stop - block.start, -1).all(axis=1)
        if valid.all():
            return None
        flawed = [name for name, values in self._targets.items() if not np.isfinite(values).all()]
        flawed += ["quaternions of length 0"] if (self.arrays["quats"] == 0).all(axis=1).any() else []
        bad = int((~valid).sum())
        summary = f"{path}: {bad} of {len(valid)} Gaussians hold NaN or infinite values or no rotation: "
        summary += ", ".join(flawed)
        if surplus:
            raise SceneError(f"{summary}. Its rows are not as the header declares: {surplus[0]}.")
        if bad == len(valid):
            raise SceneError(f"{summary}. No valid Gaussians remain. Train or export the scene again.")
        if not drop_invalid:
            raise SceneError(f"{summary}. Use --drop-invalid to drop these Gaussians.")
        return valid


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


class _Changes(NamedTuple):
    """Changes of the rows of a PLY.

    Attributes:
        columns: New values of all Gaussians, by property.
    """

    columns: dict[str, NDArray[np.float32]]
    attenuated: list[str]
    factor: float

    def times(self, values: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return attenuated coefficients in float32; positive zeros if the factor is 0."""
        return values * np.float32(self.factor) if self.factor else np.zeros_like(values)


def write_stylized(
    source: SceneFile, target: Path, sh_dc: Tensor, *, sh_attenuation: float = 0.0, pad_sh: bool = False
) -> None:
    """Write the PLY of a scene with new f_dc_0..2, atomically. All other bytes stay as in the source file.

    plyfile would change them: it moves `obj_info` behind comments, writes other line ends, names of types and numbers
    in text, refuses comments that are not ASCII, and drops what follows the last element.

    A color keeps its bytes too if its float32 value does not change. The rest of the file changes in these cases:

    - With an SH attenuation, f_rest_* change.
    - Colors of 8 bits in red, green and blue, for programs that show only points, become those of f_dc_*.
    - Dropped rows are absent, and the count in the header is adjusted.
    - Each piece of a split Gaussian has a row with its own position, scale and opacity, and the count is adjusted.
    - If the requested render mode differs from the file's, it is written to comments of the header.

    A scene in another format is written as a PLY by `encode_scene`, and so is one with `pad_sh`.

    Args:
        source: File from `read_scene`.
        target: File to write; may be the source itself.
        sh_dc: Finite coefficients, [N, 3] with N = len(source.scene).
        sh_attenuation: SH attenuation of f_rest_*, 0 to 1; see `Scene.attenuated`.
        pad_sh: Whether to write the usual properties alone, with SH coefficients of degree 3; see `encode_scene`.

    Raises:
        SceneError: If the source file has changed since it was read.
        OutputError: If the target cannot be written.
        ValueError: If sh_dc has the wrong shape or non-finite values.

    Example:
        >>> source = load_scene("scene.ply")
        >>> write_stylized(source, Path("gray.ply"), torch.zeros_like(source.scene.sh_dc))
        >>> bool(load_scene("gray.ply").scene.sh_dc.any())
        False
    """
    with atomic_path(target) as temporary, temporary.open("wb") as output:
        encode_stylized(output, source, sh_dc, target, sh_attenuation=sh_attenuation, pad_sh=pad_sh)


def encode_stylized(
    output: BinaryIO,
    source: SceneFile,
    sh_dc: Tensor,
    target: Path,
    *,
    sh_attenuation: float = 0.0,
    pad_sh: bool = False,
) -> None:
    """Write the PLY of a scene with new colors to a stream; see `write_stylized`. `target` is named in messages."""
    if sh_dc.shape != source.scene.sh_dc.shape or not bool(torch.isfinite(sh_dc).all()):
        raise ValueError(f"sh_dc must be finite and {tuple(source.scene.sh_dc.shape)}, got {tuple(sh_dc.shape)}")
    check_unchanged(source.path, source.stamp)
    colors = sh_dc.detach().to("cpu", torch.float32)
    if source.header is None or pad_sh:
        scene = replace(source.scene.attenuated(sh_attenuation), sh_dc=colors)
        encode_scene(output, scene, PLY, target, pad_sh=pad_sh)
        return
    factor = attenuation_factor(sh_attenuation)
    rest = [] if factor == 1 else [name for name in source.header.vertex.kinds if _REST.fullmatch(name)]
    changes = _Changes(_new_columns(source, source.header, colors), rest, factor)
    raw = source.header.raw
    if source.retained is not None or source.copies is not None:
        start, stop = source.header.vertex.count_span
        raw = raw[:start] + str(len(source.scene)).encode() + raw[stop:]
    with source.path.open("rb") as file:
        output.write(retagged(raw, source.header, source.scene.rendering))
        write = _write_text if source.header.text else _write_binary
        write(source, source.header, changes, file, output)


def _new_columns(source: SceneFile, header: PlyHeader, colors: Tensor) -> dict[str, NDArray[np.float32]]:
    """Return the columns that may differ from the file: colors and, if Gaussians were split, their shapes.

    Colors that the file also has with 8 bits are among them.
    """
    columns, kinds = dict(zip(PROPERTIES["sh_dc"], colors.numpy().T, strict=True)), header.vertex.kinds
    if all(kinds.get(name) == "u1" for name in RGB):
        shown = (255 * (COLOR_OFFSET + SH_C0 * colors.double()).clamp(0, 1)).round().float()
        columns |= dict(zip(RGB, shown.numpy().T, strict=True))
    if source.copies is not None:
        columns["opacity"] = source.scene.opacities.numpy()
        for names, values in ((PROPERTIES["means"], source.scene.means), (PROPERTIES["scales"], source.scene.scales)):
            columns |= dict(zip(names, values.numpy().T, strict=True))
        columns[FILTER_3D] = np.zeros(len(source.scene), np.float32)  # the shapes are those after the filter
    return {name: values for name, values in columns.items() if name in kinds}


def _row_blocks(source: SceneFile, rows: int) -> Iterator[tuple[int, NDArray[np.int64], slice]]:
    """Yield, for each block of file rows, its length, the number of copies of each row, and the slice of Gaussians."""
    times = np.ones(rows, np.int64) if source.retained is None else source.retained.astype(np.int64)
    if source.copies is not None:
        times[times > 0] = source.copies
    ends = np.append(0, times.cumsum())
    for start in range(0, rows, BLOCK_ROWS):
        stop = min(start + BLOCK_ROWS, rows)
        yield stop - start, times[start:stop], slice(ends[start], ends[stop])


def _write_binary(
    source: SceneFile, header: PlyHeader, changes: _Changes, file: io.BufferedReader, output: BinaryIO
) -> None:
    dtype = header.vertex.dtype
    before = element_offsets(source.path, header)["vertex"] - len(header.raw)
    file.seek(len(header.raw))
    output.write(file.read(before))
    buffer = bytearray(min(BLOCK_ROWS, header.vertex.count) * dtype.itemsize)
    for count, times, gaussians in _row_blocks(source, header.vertex.count):
        part = memoryview(buffer)[: count * dtype.itemsize]
        if file.readinto(part) != len(part):
            raise scene_format.changed(source.path)
        rows = np.frombuffer(part, dtype)
        if not (times == 1).all():
            rows = np.repeat(rows, times)
        for name, values in changes.columns.items():
            column = values[gaussians]
            different = rows[name].astype(np.float32) != column
            rows[name][different] = column[different]
        for name in changes.attenuated:
            rows[name] = changes.times(rows[name].astype(np.float32))
        output.write(rows.view(np.uint8).data)
    shutil.copyfileobj(file, output)
    check_unchanged(source.path, source.stamp)


def _write_text(
    source: SceneFile, header: PlyHeader, changes: _Changes, file: io.BufferedReader, output: BinaryIO
) -> None:
    vertex = header.vertex
    before = itertools.takewhile(lambda element: element is not vertex, header.elements.values())
    order = [*vertex.kinds]
    slots = [(order.index(name), vertex.kinds[name]) for name in (*changes.columns, *changes.attenuated)]
    file.seek(len(header.raw))
    # latin-1 preserves every byte, and newline="" every line end
    lines = io.TextIOWrapper(file, "latin-1", newline="")
    for _ in range(sum(element.count for element in before)):
        output.write(lines.readline().encode("latin-1"))
    for _, times, gaussians in _row_blocks(source, vertex.count):
        values = iter(np.stack([column[gaussians] for column in changes.columns.values()], axis=1))
        for copies in times:
            line = lines.readline()
            for _ in range(copies):
                output.write(_changed_line(line, slots, next(values), changes).encode("latin-1"))
    for line in lines:
        output.write(line.encode("latin-1"))


def _changed_line(line: str, slots: list[tuple[int, str]], values: NDArray[Any], changes: _Changes) -> str:
    """Return a row of text with new values. Tokens whose value does not change, and all spacing, are copied.

    Args:
        line: Row of text.
        slots: Token index and NumPy type code of each value to replace: those of `values` first, then those to
            attenuate.
        values: New values of the first slots.
    """
    tokens = list(re.finditer(r"\S+", line))
    old = np.array([tokens[slot][0] for slot, _ in slots[len(values) :]], dtype=np.float32)
    values = np.concatenate([values, changes.times(old)])
    for (slot, kind), value in sorted(zip(slots, values, strict=True), key=lambda pair: -pair[0][0]):
        token = tokens[slot]
        if np.float32(token[0]) != value:
            # shortest text that parses to the same number in the precision that the file declares
            text = str(value) if kind == "f4" else str(int(value)) if kind == "u1" else repr(float(value))
            line = line[: token.start()] + text + line[token.end() :]
    return line


def write_colors(path: Path, sh_dc: Tensor) -> None:
    """Write f_dc_0..2 of each Gaussian in order, as an N x 3 array of little-endian float16 without a header.

    Values are rounded to the nearest float16. The relative error is at most 2^-11, or the absolute error at most 2^-25
    for values below 2^-14. For displayable colors, the error is less than 0.04 of an 8-bit level. Values beyond +-65504
    are clamped. The file is written atomically.

    Raises:
        OutputError: If the file cannot be written.
    """
    values = sh_dc.detach().cpu().numpy()
    with atomic_path(path) as temporary, temporary.open("wb") as output:
        for block in scene_format.blocks(len(values)):
            output.write(np.clip(values[block], -_FLOAT16_MAX, _FLOAT16_MAX).astype("<f2").data)


#: Largest absolute weight after normalization. Larger ones amplify the rounding errors of the files.
MAX_WEIGHT = 10.0
#: Fields in which all scenes must be equal, and what they are called in messages.
_SAME = {"means": "positions", "quats": "rotations", "scales": "scales", "opacities": "opacities"}


def blend_scenes(files: Sequence[SceneFile], weights: Sequence[float]) -> SceneFile:
    """Return the weighted mean of scenes that differ only in their spherical harmonics.

    Colors before clamping are linear in the coefficients, so the blend's renders are exact blends as long as no color
    is clamped. A weight below 0 moves the blend away from its scene.

    Args:
        files: Scenes from `read_scene`, with the same Gaussians in the same order.
        weights: Weight of each scene. They are divided by their sum.

    Returns:
        First file with the blended scene, for `save`. If only its degree-0 coefficients differ, a PLY keeps all its
        other bytes.

    Raises:
        SettingsError: If a weight is not finite, their sum is not positive, or one is too far from the others.
        SceneError: If the scenes differ in more than color.
    """
    fractions = normalized(weights)
    first = files[0]
    for file in files[1:]:
        check_same_shape(first, file)
    scenes = [file.scene for file in files]
    scene = replace(first.scene, sh_dc=_weighted_sum([scene.sh_dc for scene in scenes], fractions))
    rests = common_rests(scenes)
    if all(torch.equal(rest, rests[0]) for rest in rests[1:]):
        return replace(first, scene=scene)
    # `write_stylized`, which preserves the bytes of a PLY, changes only colors
    return replace(first, scene=replace(scene, sh_rest=_weighted_sum(rests, fractions)), header=None)


def encode_blend(output: BinaryIO, blend: SceneFile, format: scene_format.SceneFormat, target: Path) -> None:
    """Write a scene from `blend_scenes` to a stream as `save` would; `target` is named in messages.

    Raises:
        OutputError: If the format cannot represent the scene.
        SceneError: If the first scene's file has changed since it was read.
    """
    if format is PLY:
        encode_stylized(output, blend, blend.scene.sh_dc, target)
    else:
        encode_scene(output, blend.scene, format, target, axes=blend.axes)


def normalized(weights: Sequence[float]) -> list[float]:
    """Return weights divided by their sum.

    Raises:
        SettingsError: If a weight is not finite, their sum is not positive, or a result is larger than `MAX_WEIGHT`.
    """
    text = ", ".join(f"{weight:g}" for weight in weights)
    usable = all(math.isfinite(weight) and abs(weight) <= 1e100 for weight in weights)  # sums remain finite
    total = math.fsum(weights) if usable else 0.0
    if not total > 0 or max(map(abs, weights)) > MAX_WEIGHT * total:
        raise SettingsError(
            f"The weights {text} cannot be used. Give finite numbers whose sum is above 0, none of them more than "
            f"{MAX_WEIGHT:g} times as large as the sum."
        )
    return [weight / total for weight in weights]


def check_same_shape(first: SceneFile, file: SceneFile) -> None:
    """Raise a SceneError if two scenes differ in more than color."""
    if len(file.scene) != len(first.scene):
        raise SceneError(
            f"{file.path}: has {len(file.scene):,} Gaussians, but {first.path} has {len(first.scene):,}. Give scenes "
            "with the same Gaussians; refining splits some."
        )
    for name, title in _SAME.items():
        if not torch.equal(getattr(file.scene, name), getattr(first.scene, name)):
            raise SceneError(
                f"{file.path}: its Gaussians have other {title} than those of {first.path}. Give a scene and its "
                "results, all in the same format."
            )


def common_rests(scenes: Sequence[Scene]) -> list[Tensor]:
    """Return the coefficients above degree 0 of each scene, with zeros for bands that only others have."""
    rests = [scene.sh_rest for scene in scenes]
    missing = [max(rest.shape[1] for rest in rests) - rest.shape[1] for rest in rests]
    return [
        torch.nn.functional.pad(rest, (0, 0, 0, more)) if more else rest
        for rest, more in zip(rests, missing, strict=True)
    ]


def _weighted_sum(tensors: Sequence[Tensor], weights: Sequence[float]) -> Tensor:
    """Return the weighted sum of float32 tensors of one shape, computed in float64."""
    result = torch.empty_like(tensors[0])
    largest = torch.finfo(result.dtype).max
    for rows in scene_format.blocks(len(result)):
        total = torch.zeros(result[rows].shape, dtype=torch.float64)
        for tensor, weight in zip(tensors, weights, strict=True):
            total += weight * tensor[rows].double()
        result[rows] = total.clamp(-largest, largest)
    return result


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
    scene_format.Frame.of(scene_format.Y_UP).apply(arrays)
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
