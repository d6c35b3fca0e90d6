"""Reader and writer of PlayCanvas' compressed PLY.

A Gaussian takes 16 bytes, and one byte per SH coefficient above degree 0. Positions and log scales are quantized to 11,
10 and 11 bits, and colors to 8 bits per channel, within bounds shared by a chunk of 256 Gaussians. Opacities have 8
bits. Rotations have three components of 10 bits each. SH coefficients are bytes that cover the range -4 to 4. The
layout is that of `splat-transform` (https://github.com/playcanvas/splat-transform).
"""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from sgsst_core.constants import COLOR_OFFSET, SH_C0
from sgsst_core.errors import SceneError
from sgsst_core.files.advice import refuse_changed_meaning
from sgsst_core.files.formats.ply_header import (
    PlyElement,
    PlyHeader,
    comment_lines,
    element_offsets,
    ply_tag,
    read_header,
    stated_up,
    surplus,
)
from sgsst_core.files.formats.quantized import (
    OPACITY_LOGITS,
    along_curve,
    opacity_bytes,
    to_steps,
    with_largest,
    without_largest,
)
from sgsst_core.files.formats.scene_format import (
    Arrays,
    FileStart,
    Limits,
    OpenScene,
    SceneFormat,
    SceneHeader,
    blocks,
    read_rows,
)
from sgsst_core.scene.rendering import Rendering

#: Number of Gaussians per chunk. Each chunk has its own quantization bounds.
CHUNK_ROWS = 256


def bounds(prefix: str, axes: str) -> tuple[str, ...]:
    """Return the names of a compressed PLY's bounds, the lower bounds of all axes first."""
    return tuple(f"{side}_{prefix}{axis}" for side in ("min", "max") for axis in axes)


_PACKED = ("packed_position", "packed_rotation", "packed_scale", "packed_color")
_BOUNDS = (*bounds("", "xyz"), *bounds("scale_", "xyz"), *bounds("", "rgb"))
#: Maximum absolute log scale; other writers of the format clamp to it too.
_LARGEST_SCALE = 20.0
#: SH coefficient for each byte: the center of its quantization step, or an end of the range for 0 and 255.
_HARMONICS = (8 * (np.array([0, *(np.arange(1, 255) + 0.5) / 256, 1]) - 0.5)).astype(np.float32)


@dataclass(frozen=True)
class CompressedPlyHeader(SceneHeader):
    """Header of a compressed PLY."""

    ply: PlyHeader


def _matches(start: FileStart) -> bool:
    return start.head.startswith(b"ply") and re.search(rb"[\r\n]property \w+ packed_position\s", start.head) is not None


def _read_header(start: FileStart) -> CompressedPlyHeader:
    path = start.path
    header = read_header(start)
    vertex, chunk, harmonics = map(header.elements.get, ("vertex", "chunk", "sh"))
    if vertex is None:
        raise SceneError(f"{path}: is a compressed PLY without element 'vertex'. Export it again.")
    if header.text:
        raise SceneError(f"{path}: is a compressed PLY as text, which no program writes. Export it again as binary.")
    _check_kinds(path, vertex, "u4", _PACKED)
    refuse_changed_meaning(path, vertex.kinds)
    if chunk is None:
        raise SceneError(f"{path}: is a compressed PLY without element 'chunk', its bounds. Export it again.")
    _check_kinds(path, chunk, "f4", (*bounds("", "xyz"), *bounds("scale_", "xyz")))
    if "min_r" in chunk.kinds:
        _check_kinds(path, chunk, "f4", bounds("", "rgb"))
    if not vertex.count:
        raise SceneError(f"{path}: holds no Gaussians (element vertex 0). Export the scene again.")
    expected = -(-vertex.count // CHUNK_ROWS)
    if chunk.count != expected:
        raise SceneError(
            f"{path}: the header declares {chunk.count} chunks, but {vertex.count} Gaussians make {expected}: it is "
            "wrong. Export the scene again."
        )
    number = len(harmonics.kinds) if harmonics else 0
    if harmonics:
        if number not in (9, 24, 45) or harmonics.count != vertex.count:
            raise SceneError(
                f"{path}: element 'sh' has {harmonics.count} rows of {number} properties; there should be "
                f"{vertex.count} of 9, 24 or 45. Export the scene again."
            )
        _check_kinds(path, harmonics, "u1", tuple(f"f_rest_{i}" for i in range(number)))
    element_offsets(path, header)
    tag, up = ply_tag(header), stated_up(header)
    return CompressedPlyHeader(COMPRESSED_PLY, vertex.count, number // 3, header, tag=tag, up=up)


def _check_kinds(path: Path, element: PlyElement, kind: str, names: tuple[str, ...]) -> None:
    wrong = [name for name in names if element.kinds.get(name) != kind or name in element.lists]
    if wrong or element.lists:
        what = f"{', '.join(wrong)} missing or of another type" if wrong else "a list"
        raise SceneError(
            f"{path}: is not a readable compressed PLY: element {element.name!r} has {what}. Export it again."
        )


def _read(file: OpenScene, header: SceneHeader, into: Arrays) -> SceneHeader:
    """Fill the arrays of a scene, and return the header with the note on bytes after the last element."""
    assert isinstance(header, CompressedPlyHeader)
    notes = surplus(file.path, header.ply)
    starts = element_offsets(file.path, header.ply)
    kinds = {name: element.dtype for name, element in header.ply.elements.items()}

    def rows(name: str, first: int, count: int) -> NDArray[Any]:
        return read_rows(file, kinds[name], starts[name] + first * kinds[name].itemsize, count)

    for block in blocks(header.count):
        start, count = block.start, block.stop - block.start
        chunks = rows("chunk", start // CHUNK_ROWS, -(-count // CHUNK_ROWS))
        _unpack(rows("vertex", start, count), chunks, {name: array[block] for name, array in into.items()})
        if header.coefficients:
            harmonics = rows("sh", start, count)
            for i in range(3 * header.coefficients):
                channel, index = divmod(i, header.coefficients)
                into["sh_rest"][block, index, channel] = _HARMONICS[harmonics[f"f_rest_{i}"]]
    return replace(header, notes=(*header.notes, *notes))


def _unpack(rows: NDArray[Any], chunks: NDArray[Any], into: Arrays) -> None:
    position, rotation, scale, color = (rows[name].astype(np.uint32) for name in _PACKED)
    chunk = np.arange(len(rows)) // CHUNK_ROWS

    def between(prefix: str, axes: str, fraction: NDArray[np.float64]) -> NDArray[np.float64]:
        names = bounds(prefix, axes)
        low, high = (
            np.stack([chunks[name].astype(np.float64) for name in side], axis=1)[chunk]
            for side in (names[:3], names[3:])
        )
        with np.errstate(invalid="ignore", over="ignore"):  # non-finite results are reported later
            return low * (1 - fraction) + high * fraction

    with np.errstate(over="ignore"):
        into["means"][:] = between("", "xyz", _three(position))
        into["scales"][:] = between("scale_", "xyz", _three(scale))
        fraction = np.stack([(color >> shift) & 255 for shift in (24, 16, 8)], axis=1) / 255
        colors = between("", "rgb", fraction) if "min_r" in (chunks.dtype.names or ()) else fraction
        into["sh_dc"][:] = (colors - COLOR_OFFSET) / SH_C0
    into["opacities"][:] = OPACITY_LOGITS[color & 255]
    components = np.stack([(rotation >> shift) & 1023 for shift in (20, 10, 0)], axis=1) / 1023
    into["quats"][:] = with_largest(rotation >> 30, (components - 0.5) * np.sqrt(2))


def _three(packed: NDArray[np.uint32]) -> NDArray[np.float64]:
    """Unpack 11, 10 and 11 bits to values in 0..1, [n, 3]."""
    return np.stack([(packed >> 21) / 2047, ((packed >> 11) & 1023) / 1023, (packed & 2047) / 2047], axis=1)


def _write(output: BinaryIO, arrays: Arrays, rendering: Rendering) -> None:
    """Write a compressed PLY.

    Gaussians are sorted along a space-filling curve, so that chunks are compact and their bounds are tight.
    """
    count, coefficients = arrays["sh_rest"].shape[:2]
    order = along_curve(arrays["means"])
    output.write(_header(count, coefficients, rendering))
    parts = [order[block] for block in blocks(count)]
    packed = []
    for rows in parts:
        bounds_of, values = _pack({name: array[rows] for name, array in arrays.items() if name != "sh_rest"})
        output.write(bounds_of.astype("<f4").tobytes())
        packed.append(values.astype("<u4"))
    for values in packed:
        output.write(values.tobytes())
    if coefficients:
        for rows in parts:
            # channel-major, as in PLY
            rest = arrays["sh_rest"][rows].astype(np.float64).transpose(0, 2, 1)
            output.write(np.clip(np.floor(rest * 32 + 128), 0, 255).astype(np.uint8).tobytes())


def _header(count: int, coefficients: int, rendering: Rendering) -> bytes:
    lines = ["ply", "format binary_little_endian 1.0", *comment_lines(rendering)]
    lines += [f"element chunk {-(-count // CHUNK_ROWS)}"]
    lines += [f"property float {name}" for name in _BOUNDS]
    lines += [f"element vertex {count}", *(f"property uint {name}" for name in _PACKED)]
    if coefficients:
        lines += [f"element sh {count}", *(f"property uchar f_rest_{i}" for i in range(3 * coefficients))]
    return "\n".join([*lines, "end_header", ""]).encode()


def _pack(arrays: Arrays) -> tuple[NDArray[np.float32], NDArray[np.uint32]]:
    """Return the bounds [chunks, 18] and compressed values [n, 4] of Gaussians that start at a chunk boundary."""
    starts = np.arange(0, len(arrays["means"]), CHUNK_ROWS)
    chunk = np.arange(len(arrays["means"])) // CHUNK_ROWS
    scales = np.clip(arrays["scales"], -_LARGEST_SCALE, _LARGEST_SCALE)
    bounds_of, fractions = [], []
    for values in (
        arrays["means"],
        scales,
        (arrays["sh_dc"].astype(np.float64) * SH_C0 + COLOR_OFFSET).astype(np.float32),
    ):
        low, high = np.minimum.reduceat(values, starts), np.maximum.reduceat(values, starts)
        bounds_of += [low, high]
        extent = high.astype(np.float64) - low
        fractions.append((values.astype(np.float64) - low[chunk]) / np.where(extent > 0, extent, 1)[chunk])
    color = [to_steps(fractions[2][:, i], 255) for i in range(3)]
    packed = np.stack(
        [
            _pack_three(fractions[0]),
            _pack_rotations(arrays["quats"]),
            _pack_three(fractions[1]),
            color[0] << 24 | color[1] << 16 | color[2] << 8 | opacity_bytes(arrays["opacities"]).astype(np.uint32),
        ],
        axis=1,
    )
    return np.concatenate(bounds_of, axis=1), packed


def _pack_three(fractions: NDArray[np.float64]) -> NDArray[Any]:
    x, y, z = (to_steps(fractions[:, i], maximum) for i, maximum in enumerate((2047, 1023, 2047)))
    packed: NDArray[np.uint32] = x << np.uint32(21) | y << np.uint32(11) | z
    return packed


def _pack_rotations(quats: NDArray[np.float32]) -> NDArray[Any]:
    largest, three = without_largest(quats)
    a, b, c = (to_steps(three[:, i] / np.sqrt(2) + 0.5, 1023) for i in range(3))
    packed: NDArray[np.uint32] = largest.astype(np.uint32) << np.uint32(30)
    packed |= a << np.uint32(20) | b << np.uint32(10) | c
    return packed


def _step(means: NDArray[np.float32]) -> NDArray[np.float64]:
    """Return the largest distance between positions that can be stored in the chunk of each Gaussian, [n]."""
    order = along_curve(means)
    starts = np.arange(0, len(means), CHUNK_ROWS)
    ends = (side.reduceat(means[order].astype(np.float64), starts) for side in (np.maximum, np.minimum))
    steps = np.empty(len(means))
    steps[order] = (np.subtract(*ends) / (2047, 1023, 2047)).max(axis=1)[np.arange(len(means)) // CHUNK_ROWS]
    return steps


COMPRESSED_PLY = SceneFormat(
    *("compressed.ply", "compressed PLY", 61, _matches, _read_header, _read, _write),
    limits=Limits({"scales": (-_LARGEST_SCALE, _LARGEST_SCALE), "sh_rest": (-4.0, 4.0)}, _step),
)
