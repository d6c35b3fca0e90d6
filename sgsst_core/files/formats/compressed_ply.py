"""Reader and writer of PlayCanvas' compressed PLY.

A Gaussian takes 16 bytes, and one byte per SH coefficient above degree 0. Positions and log scales are quantized to 11,
10 and 11 bits, and colors to 8 bits per channel, within bounds shared by a chunk of 256 Gaussians. Opacities have 8
bits. Rotations have three components of 10 bits each. SH coefficients are bytes that cover the range -4 to 4. The
layout is that of `splat-transform` (https://github.com/playcanvas/splat-transform).
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from sgsst_core.files.formats.ply_header import element_offsets
from sgsst_core.files.formats.quantized import (
    OPACITY_LOGITS,
    SH_C0,
    byte_table,
    opacity_bytes,
    to_steps,
    with_largest,
    without_largest,
)
from sgsst_core.files.scene_headers import CHUNK_ROWS, SceneHeader, bounds
from sgsst_core.scene.stored_harmonics import RowFile

Arrays = dict[str, NDArray[np.float32]]

_BLOCK_ROWS = 256 * CHUNK_ROWS
_PACKED = ("packed_position", "packed_rotation", "packed_scale", "packed_color")
_BOUNDS = (*bounds("", "xyz"), *bounds("scale_", "xyz"), *bounds("", "rgb"))
#: Largest absolute log scale: other writers of the format also clamp scales to e^-20..e^20.
_LARGEST_SCALE = 20.0


def _harmonics() -> NDArray[np.float64]:
    """Return the SH coefficient for each byte.

    It is the center of the byte's quantization step, or an end of the range for 0 and 255.
    """
    middle = (np.arange(256) + 0.5) / 256
    middle[0], middle[-1] = 0, 1
    return 8 * (middle - 0.5)


_HARMONICS = byte_table(_harmonics())


def read_compressed_ply(path: Path, file: RowFile, header: SceneHeader, into: Arrays) -> None:
    """Read a compressed PLY into the arrays of a scene.

    Args:
        path: Path of the file.
        file: Open file.
        header: Header of the file.
        into: float32 arrays to fill, by the names of `Scene`'s tensors.

    Raises:
        SceneError: If the file has changed since its header was read.
    """
    assert header.ply is not None
    starts = element_offsets(path, header.ply)
    kinds = {element.name: element.dtype(header.ply.byte_order) for element in header.ply.elements}
    for start in range(0, header.count, _BLOCK_ROWS):
        part = slice(start, min(start + _BLOCK_ROWS, header.count))

        def rows(name: str, first: int, count: int) -> NDArray[Any]:
            data = np.empty(count * kinds[name].itemsize, np.uint8)
            file.read(starts[name] + first * kinds[name].itemsize, data)
            return data.view(kinds[name])

        count = part.stop - start
        chunks = rows("chunk", start // CHUNK_ROWS, -(-count // CHUNK_ROWS))
        _unpack(rows("vertex", start, count), chunks, {name: array[part] for name, array in into.items()})
        if header.sh_degree:
            _unpack_harmonics(rows("sh", start, count), into["sh_rest"][part])


def _unpack(rows: NDArray[Any], chunks: NDArray[Any], into: Arrays) -> None:
    position, rotation, scale, color = (rows[name].astype(np.uint32) for name in _PACKED)
    chunk = np.arange(len(rows)) // CHUNK_ROWS

    def between(prefix: str, axes: str, share: NDArray[np.float64]) -> NDArray[np.float64]:
        names = bounds(prefix, axes)
        low, high = (
            np.stack([chunks[name].astype(np.float64) for name in side], axis=1)[chunk]
            for side in (names[:3], names[3:])
        )
        with np.errstate(invalid="ignore", over="ignore"):  # non-finite results are reported later
            return low * (1 - share) + high * share

    with np.errstate(over="ignore"):
        into["means"][:] = between("", "xyz", _three(position))
        into["scales"][:] = between("scale_", "xyz", _three(scale))
        share = np.stack([(color >> shift) & 255 for shift in (24, 16, 8)], axis=1) / 255
        shown = between("", "rgb", share) if "min_r" in (chunks.dtype.names or ()) else share
        into["sh_dc"][:] = (shown - 0.5) / SH_C0
    into["opacities"][:] = OPACITY_LOGITS[color & 255]
    parts = np.stack([(rotation >> shift) & 1023 for shift in (20, 10, 0)], axis=1) / 1023
    into["quats"][:] = with_largest(rotation >> 30, (parts - 0.5) * np.sqrt(2))


def _three(packed: NDArray[np.uint32]) -> NDArray[np.float64]:
    """Unpack 11, 10 and 11 bits to values in 0..1, [n, 3]."""
    return np.stack([(packed >> 21) / 2047, ((packed >> 11) & 1023) / 1023, (packed & 2047) / 2047], axis=1)


def _unpack_harmonics(rows: NDArray[Any], into: NDArray[np.float32]) -> None:
    coefficients = into.shape[1]
    for i in range(3 * coefficients):
        into[:, i % coefficients, i // coefficients] = _HARMONICS[rows[f"f_rest_{i}"]]


def write_compressed_ply(output: BinaryIO, arrays: Arrays) -> None:
    """Write the arrays of a scene as a compressed PLY.

    Gaussians are sorted along a space-filling curve, so that chunks are compact and their bounds are tight.
    """
    count, coefficients = arrays["sh_rest"].shape[:2]
    order = _along_curve(arrays["means"])
    output.write(_header(count, coefficients))
    blocks = [order[start : start + _BLOCK_ROWS] for start in range(0, count, _BLOCK_ROWS)]
    packed = []
    for rows in blocks:
        bounds_of, values = _pack({name: array[rows] for name, array in arrays.items() if name != "sh_rest"})
        output.write(bounds_of.astype("<f4").tobytes())
        packed.append(values.astype("<u4"))
    for values in packed:
        output.write(values.tobytes())
    if coefficients:
        for rows in blocks:
            # channel-major, as in PLY
            rest = arrays["sh_rest"][rows].astype(np.float64).transpose(0, 2, 1)
            output.write(np.clip(np.floor(rest * 32 + 128), 0, 255).astype(np.uint8).tobytes())


def _along_curve(means: NDArray[np.float32]) -> NDArray[np.int64]:
    """Return the indices that sort Gaussians along a Z-order curve with 21 bits per axis."""
    low, high = means.min(axis=0).astype(np.float64), means.max(axis=0).astype(np.float64)
    cells = np.where(high > low, high - low, 1)
    code = np.zeros(len(means), np.uint64)
    for axis in range(3):
        values = to_steps((means[:, axis] - low[axis]) / cells[axis], (1 << 21) - 1).astype(np.uint64)
        # insert two empty bits after each bit
        for shift, mask in (
            (32, 0x1F00000000FFFF),
            (16, 0x1F0000FF0000FF),
            (8, 0x100F00F00F00F00F),
            (4, 0x10C30C30C30C30C3),
            (2, 0x1249249249249249),
        ):
            values = (values | (values << np.uint64(shift))) & np.uint64(mask)
        code |= values << np.uint64(axis)
    return code.argsort(kind="stable")


def _header(count: int, coefficients: int) -> bytes:
    lines = ["ply", "format binary_little_endian 1.0", f"element chunk {-(-count // CHUNK_ROWS)}"]
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
    found, shares = [], []
    for values in (arrays["means"], scales, (arrays["sh_dc"].astype(np.float64) * SH_C0 + 0.5).astype(np.float32)):
        low, high = np.minimum.reduceat(values, starts), np.maximum.reduceat(values, starts)
        found += [low, high]
        extent = high.astype(np.float64) - low
        shares.append((values.astype(np.float64) - low[chunk]) / np.where(extent > 0, extent, 1)[chunk])
    color = [to_steps(shares[2][:, i], 255) for i in range(3)]
    packed = np.stack(
        [
            _pack_three(shares[0]),
            _pack_rotations(arrays["quats"]),
            _pack_three(shares[1]),
            color[0] << 24 | color[1] << 16 | color[2] << 8 | opacity_bytes(arrays["opacities"]).astype(np.uint32),
        ],
        axis=1,
    )
    return np.concatenate(found, axis=1), packed


def _pack_three(shares: NDArray[np.float64]) -> NDArray[Any]:
    x, y, z = (to_steps(shares[:, i], most) for i, most in enumerate((2047, 1023, 2047)))
    packed: NDArray[np.uint32] = x << np.uint32(21) | y << np.uint32(11) | z
    return packed


def _pack_rotations(quats: NDArray[np.float32]) -> NDArray[Any]:
    largest, three = without_largest(quats)
    a, b, c = (to_steps(three[:, i] / np.sqrt(2) + 0.5, 1023) for i in range(3))
    packed: NDArray[np.uint32] = largest.astype(np.uint32) << np.uint32(30)
    packed |= a << np.uint32(20) | b << np.uint32(10) | c
    return packed
