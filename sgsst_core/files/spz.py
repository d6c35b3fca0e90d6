"""Niantic's SPZ: 16 to 20 bytes for a Gaussian and one for each coefficient of its spherical harmonics, compressed.

Positions are fixed point numbers of 24 bits; logarithms of scales, colors, opacities and spherical harmonics have 8
bits, rotations 3 times 8 or, from version 3 on, 10. Values lie attribute by attribute, and are unpacked as they come
out of the stream: what it becomes is never in memory at once. The layout is that of https://github.com/nianticlabs/spz.

SPZ has x to the right, y up and z backwards, a 3DGS PLY y down and z forwards: positions, rotations and spherical
harmonics are turned by half a turn about x on the way in and out.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
import zstandard
from numpy.typing import NDArray

from sgsst_core.errors import OutputError, SceneError
from sgsst_core.files.compressed_ply import Arrays
from sgsst_core.files.quantized import OPACITY_LOGITS, byte_table, opacity_bytes, with_largest, without_largest
from sgsst_core.files.scene_headers import COEFFICIENTS, SceneHeader, SpzSection
from sgsst_core.scene.stored_harmonics import RowFile

_BLOCK_ROWS = 1 << 16
_READ_BYTES = 1 << 18
#: What may follow the Gaussians in a gzip stream: extensions, which are passed over.
_EXTENSION_BYTES = 1 << 20
#: Of zstd, as its own program takes at most without being told to.
_WINDOW_BYTES = 1 << 27

#: Signs of half a turn about x: of positions, of rotations (wxyz), and of real spherical harmonics of degree 1 to 3,
#: which are odd in y and z together as often as their polynomials have those factors.
_FLIP = np.array([1, -1, -1], np.float32)
_FLIP_QUATS = np.array([1, 1, -1, -1], np.float32)
_FLIP_HARMONICS = np.array([-1, -1, 1, -1, 1, 1, -1, 1, -1, 1, -1, -1, 1, -1, 1], np.float32)

_SCALES = byte_table(np.arange(256) / 16 - 10)
#: Degree 0; a wider range than 0..1 of colors.
_COLORS = byte_table((np.arange(256) / 255 - 0.5) / 0.15)
_HARMONICS = byte_table((np.arange(256) - 128) / 128)
_FIRST_BYTES = byte_table(np.arange(256) / 127.5 - 1)

#: Fractional bits that are written at most: finer than float32 is about the origin of a scene of a few units.
_MOST_BITS = 20

#: Files are 2 % larger than at zlib's own 6, in a third of the time: spherical harmonics are nearly noise.
_DEFLATE_LEVEL = 4

Take = Callable[[int], bytes]


def read_spz(path: Path, file: RowFile, header: SceneHeader, into: Arrays) -> None:
    """Fill the arrays of a scene (float32, by the names of `Scene`'s tensors).

    Raises:
        SceneError: a stream is damaged, ends early or holds more than the header declares, or the file was changed.
    """
    spz = header.spz
    assert spz is not None
    unpack: list[tuple[NDArray[np.float32], Callable[[NDArray[np.uint8]], NDArray[Any]]]] = [
        (into["means"], _halves if spz.version == 1 else lambda data: _fixed_point(data, spz.fractional_bits)),
        (into["opacities"], lambda data: OPACITY_LOGITS[data]),
        (into["sh_dc"], lambda data: _COLORS[data].reshape(-1, 3)),
        (into["scales"], lambda data: _SCALES[data].reshape(-1, 3)),
        (into["quats"], _smallest_three if spz.version >= 3 else _first_three),
        (into["sh_rest"], lambda data: _unpack_harmonics(data, header.sh_degree)),
    ]
    streams = (
        _zstd_streams(path, file, spz.streams)
        if spz.streams
        else _gzip_stream(path, file, header.size, sum(map(bool, spz.sections)))
    )
    for (array, values), size in zip(unpack, spz.sections, strict=True):
        if not size:
            continue
        take = next(streams)
        each = size // header.count
        for start in range(0, header.count, _BLOCK_ROWS):
            part = array[start : start + _BLOCK_ROWS]
            part[:] = values(np.frombuffer(take(len(part) * each), np.uint8))
    next(streams, None)  # the end of the last one, where its checksum is compared


def _gzip_stream(path: Path, file: RowFile, size: int, sections: int) -> Iterator[Take]:
    """The same stream for every section."""
    inflate = zlib.decompressobj(31)
    position = 0

    def take(count: int) -> bytes:
        nonlocal position
        found = bytearray()
        while len(found) < count and not inflate.eof:
            data = inflate.unconsumed_tail
            if not data:
                data = _read(file, position, min(_READ_BYTES, size - position))
                position += len(data)
            try:
                found += inflate.decompress(data, count - len(found))
            except zlib.error as error:
                raise _damaged(path, error) from error
            if position == size and not inflate.unconsumed_tail and not inflate.eof and len(found) < count:
                break
        return bytes(found)

    def whole(count: int) -> bytes:
        found = take(count)
        if len(found) < count:
            raise _ends_early(path)
        return found

    take(16)
    for _ in range(sections):
        yield whole
    if len(take(_EXTENSION_BYTES)) == _EXTENSION_BYTES and not inflate.eof:
        raise _too_much(path)
    if not inflate.eof:
        raise _ends_early(path)


def _zstd_streams(path: Path, file: RowFile, streams: tuple[SpzSection, ...]) -> Iterator[Take]:
    """A stream for each section; each has to end where its section does."""
    for stream in streams:
        decompressor = zstandard.ZstdDecompressor(max_window_size=_WINDOW_BYTES)
        with decompressor.stream_reader(_Part(file, stream), read_size=_READ_BYTES) as reader:  # type: ignore[arg-type]

            def take(count: int, reader: Any = reader) -> bytes:
                try:
                    found: bytes = reader.read(count)
                except zstandard.ZstdError as error:
                    raise _damaged(path, error) from error
                if len(found) < count:
                    raise _ends_early(path)
                return found

            yield take
            try:
                more = reader.read(1)
            except zstandard.ZstdError as error:
                raise _damaged(path, error) from error
            if more:
                raise _too_much(path)


class _Part:
    """Some bytes of a file, for a reader of streams."""

    def __init__(self, file: RowFile, part: SpzSection) -> None:
        self._file, self._position, self._end = file, part.offset, part.offset + part.compressed

    def read(self, size: int = -1) -> bytes:
        left = self._end - self._position
        data = _read(self._file, self._position, left if size < 0 else min(size, left))
        self._position += len(data)
        return data


def _read(file: RowFile, offset: int, count: int) -> bytes:
    data = np.empty(count, np.uint8)
    file.read(offset, data)
    return data.tobytes()


def _damaged(path: Path, error: Exception) -> SceneError:
    return SceneError(f"{path}: the compressed data is damaged: {error}. Copy or export it again.")


def _ends_early(path: Path) -> SceneError:
    return SceneError(
        f"{path}: the compressed data ends before all Gaussians that the header declares: the file is truncated or its "
        "header is wrong. Copy or export it again."
    )


def _too_much(path: Path) -> SceneError:
    return SceneError(
        f"{path}: the compressed data continues after all Gaussians that the header declares: the header is wrong. "
        "Export it again."
    )


def _halves(data: NDArray[np.uint8]) -> NDArray[Any]:
    return data.view("<f2").reshape(-1, 3).astype(np.float32) * _FLIP


def _fixed_point(data: NDArray[np.uint8], fractional_bits: int) -> NDArray[Any]:
    low, middle, high = data.reshape(-1, 3).astype(np.int32).T
    values = (low | middle << 8 | high << 16) << 8 >> 8  # the highest of 24 bits is the sign
    return np.ldexp(values.astype(np.float32), -fractional_bits).reshape(-1, 3) * _FLIP


def _first_three(data: NDArray[np.uint8]) -> NDArray[Any]:
    xyz = _FIRST_BYTES[data].reshape(-1, 3).astype(np.float64)
    return with_largest(np.zeros(len(xyz), np.int64), xyz) * _FLIP_QUATS


def _smallest_three(data: NDArray[np.uint8]) -> NDArray[Any]:
    """Sign and 9 bits each; the parts are in the order xyzw."""
    packed = data.view("<u4")
    three = np.stack([packed >> shift & 1023 for shift in (20, 10, 0)], axis=1)
    values = np.where(three & 512, -1.0, 1.0) * (three & 511) / 511 * np.sqrt(0.5)
    return np.roll(with_largest(packed >> 30, values), 1, axis=1) * _FLIP_QUATS


def _unpack_harmonics(data: NDArray[np.uint8], degree: int) -> NDArray[Any]:
    coefficients = COEFFICIENTS[degree]
    return _HARMONICS[data].reshape(-1, coefficients, 3) * _FLIP_HARMONICS[:coefficients, None]


def write_spz(output: BinaryIO, arrays: Arrays, target: Path) -> None:
    """Write a scene's arrays as version 3, which most programs read, with all 8 bits of the spherical harmonics.

    Args:
        target: for messages.

    Raises:
        OutputError: positions are too far from the origin.
    """
    count, coefficients = arrays["sh_rest"].shape[:2]
    bits = _fractional_bits(arrays["means"], target)
    degree = next(degree for degree, number in COEFFICIENTS.items() if number == coefficients)
    deflate = zlib.compressobj(_DEFLATE_LEVEL, wbits=31)
    output.write(deflate.compress(struct.pack("<4sIIBBBB", b"NGSP", 3, count, degree, bits, 0, 0)))
    pack: list[tuple[NDArray[np.float32], Callable[[NDArray[np.float64]], NDArray[Any]]]] = [
        (arrays["means"], lambda values: _pack_positions(values, bits)),
        (arrays["opacities"], opacity_bytes),
        (arrays["sh_dc"], lambda values: _to_byte(values * (0.15 * 255) + 127.5)),
        (arrays["scales"], lambda values: _to_byte((values + 10) * 16)),
        (arrays["quats"], _pack_rotations),
        (arrays["sh_rest"], lambda values: _to_byte(values * _FLIP_HARMONICS[:coefficients, None] * 128 + 128)),
    ]
    for array, packed in pack:
        for start in range(0, count, _BLOCK_ROWS):
            values = array[start : start + _BLOCK_ROWS].astype(np.float64)
            output.write(deflate.compress(np.ascontiguousarray(packed(values)).tobytes()))
    output.write(deflate.flush())


def _fractional_bits(means: NDArray[np.float32], target: Path) -> int:
    """As many as leave room for the position that is farthest from the origin."""
    farthest = max(float(np.abs(means).max()), 2.0**-30)
    bits = min(_MOST_BITS, int(np.floor(np.log2((2**23 - 1) / farthest))))
    if bits < 1:
        raise OutputError(
            f"{target}: SPZ cannot hold a Gaussian {farthest:.3g} from the origin. Write a PLY, or a .compressed.ply."
        )
    return bits


def _pack_positions(means: NDArray[np.float64], bits: int) -> NDArray[Any]:
    values = np.rint(np.ldexp(means * _FLIP, bits)).astype(np.int32)
    return np.stack([values & 255, values >> 8 & 255, values >> 16 & 255], axis=-1).astype(np.uint8)


def _pack_rotations(quats: NDArray[np.float64]) -> NDArray[Any]:
    largest, three = without_largest(np.roll(quats * _FLIP_QUATS, -1, axis=1))
    parts = np.rint(np.minimum(np.abs(three) / np.sqrt(0.5), 1) * 511).astype(np.uint32)
    parts |= np.where(three < 0, 512, 0).astype(np.uint32)
    packed: NDArray[np.uint32] = largest.astype(np.uint32) << np.uint32(30)
    packed |= parts[:, 0] << 20 | parts[:, 1] << 10 | parts[:, 2]
    return packed.astype("<u4")


def _to_byte(values: NDArray[np.float64]) -> NDArray[Any]:
    return np.clip(np.rint(values), 0, 255).astype(np.uint8)
