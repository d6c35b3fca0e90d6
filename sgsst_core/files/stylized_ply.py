"""Writers of stylized PLYs, which change only the colors, and of the colors alone; blends of stylized scenes.

With an SH attenuation, `f_rest_*` are multiplied by one factor in float32. The written coefficients equal those that
the job optimized with, because `Scene.attenuated` multiplies the same float32 values by the same factor.

Scenes that differ only in color are blended as weighted means of their spherical harmonics.
"""

from __future__ import annotations

import io
import itertools
import math
import re
import shutil
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from sgsst_core.constants import COLOR_OFFSET, SH_C0
from sgsst_core.errors import SceneError, SettingsError
from sgsst_core.files.atomic import atomic_path
from sgsst_core.files.formats.ply import FILTER_3D, PLY, PROPERTIES, RGB, PlyHeader, element_offsets, retagged
from sgsst_core.files.formats.scene_format import SceneFormat, blocks
from sgsst_core.files.scene_file import SceneFile, encode_scene, file_stamp
from sgsst_core.scene.gaussians import Scene, attenuation_factor
from sgsst_core.scene.stored_harmonics import changed, held

#: Rows per block: a megabyte of a scene of SH degree 3 stays in a core's L2 cache while its columns change.
BLOCK_ROWS = 1 << 12
_REST = re.compile(r"f_rest_\d+")
#: Largest finite float16 value.
_FLOAT16_MAX = 65504.0


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
        SceneError: If the source file has changed since it was read, or cannot store attenuated coefficients.
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
    if file_stamp(source.path) != source.stamp:
        raise changed(source.path)
    colors = sh_dc.detach().to("cpu", torch.float32)
    if source.header is None or pad_sh:
        scene = replace(source.scene.attenuated(sh_attenuation), sh_dc=colors)
        encode_scene(output, scene, PLY, target, pad_sh=pad_sh)
        return
    check_sh_attenuation(source, sh_attenuation)
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


def check_sh_attenuation(source: SceneFile, attenuation: float) -> None:
    """Check that a file can store attenuated coefficients. Scenes of other formats than PLY become a float32 PLY.

    Raises:
        SceneError: If the coefficients are stored as integers.
    """
    if source.header is None or not attenuation:
        return
    kinds = source.header.vertex.kinds
    integers = [name for name, kind in kinds.items() if _REST.fullmatch(name) and kind[0] != "f"]
    if integers:
        raise SceneError(
            f"{source.path}: {integers[0]} is stored as integers, which cannot be attenuated. Convert it to float "
            "first, or leave --sh-attenuation out."
        )


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


def _blocks(source: SceneFile, rows: int) -> Iterator[tuple[int, NDArray[np.int64], slice]]:
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
    for count, times, gaussians in _blocks(source, header.vertex.count):
        part = memoryview(buffer)[: count * dtype.itemsize]
        if file.readinto(part) != len(part):
            raise changed(source.path)
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
    if file_stamp(source.path) != source.stamp:
        raise changed(source.path)


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
    for _, times, gaussians in _blocks(source, vertex.count):
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
        for block in blocks(len(values)):
            output.write(np.clip(values[block], -_FLOAT16_MAX, _FLOAT16_MAX).astype("<f2").data)


#: Largest absolute weight after normalization. Larger ones amplify the rounding errors of the files.
MAX_WEIGHT = 10.0
#: Fields in which all scenes must be equal, and what they are called in messages.
_SHAPE = {"means": "positions", "quats": "rotations", "scales": "scales", "opacities": "opacities"}


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


def encode_blend(output: BinaryIO, blend: SceneFile, format: SceneFormat, target: Path) -> None:
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
    if not all(math.isfinite(weight) and abs(weight) <= 1e100 for weight in weights):  # sums remain finite
        raise SettingsError(f"The weights {text} are not all finite numbers. Give one for each scene, such as 0.7.")
    total = math.fsum(weights)
    if not total > 0:
        raise SettingsError(f"The weights {text} have the sum {total:g}. Give weights whose sum is greater than 0.")
    if max(map(abs, weights)) > MAX_WEIGHT * total:
        raise SettingsError(
            f"The weights {text} are too large for their sum {total:g}: each must be at most {MAX_WEIGHT:g} times as "
            "large. Give weights closer to each other."
        )
    return [weight / total for weight in weights]


def check_same_shape(first: SceneFile, file: SceneFile) -> None:
    """Raise a SceneError if two scenes differ in more than color."""
    if len(file.scene) != len(first.scene):
        raise SceneError(
            f"{file.path}: has {len(file.scene):,} Gaussians, but {first.path} has {len(first.scene):,}. Give scenes "
            "with the same Gaussians; refining splits some."
        )
    for name, title in _SHAPE.items():
        if not torch.equal(getattr(file.scene, name), getattr(first.scene, name)):
            raise SceneError(
                f"{file.path}: its Gaussians have other {title} than those of {first.path}. Give a scene and its "
                "results, all in the same format."
            )


def common_rests(scenes: Sequence[Scene]) -> list[Tensor]:
    """Return the coefficients above degree 0 of each scene, with zeros for bands that only others have."""
    rests = [held(scene.sh_rest) for scene in scenes]
    missing = [max(rest.shape[1] for rest in rests) - rest.shape[1] for rest in rests]
    return [
        torch.nn.functional.pad(rest, (0, 0, 0, more)) if more else rest
        for rest, more in zip(rests, missing, strict=True)
    ]


def _weighted_sum(tensors: Sequence[Tensor], weights: Sequence[float]) -> Tensor:
    """Return the weighted sum of float32 tensors of one shape, computed in float64."""
    result = torch.empty_like(tensors[0])
    largest = torch.finfo(result.dtype).max
    for rows in blocks(len(result)):
        total = torch.zeros(result[rows].shape, dtype=torch.float64)
        for tensor, weight in zip(tensors, weights, strict=True):
            total += weight * tensor[rows].double()
        result[rows] = total.clamp(-largest, largest)
    return result
