"""Reader and writer of Niantic's SPZ.

A Gaussian takes 16 to 20 bytes before compression, and one byte per SH coefficient above degree 0. Positions are 24-bit
fixed-point numbers. Log scales, colors, opacities and SH coefficients have 8 bits. Rotations have three components of 8
bits, or of 10 bits from version 3 on. The file stores one attribute after the other. Attributes are converted during
decompression, so the decompressed data is never in memory as a whole. The layout is that of
https://github.com/nianticlabs/spz. Versions 1 to 3 are one gzip stream, which a few programs leave out. Version 4 has
an uncompressed header and one zstd stream per attribute. SH coefficients of degree 4 are skipped.

Axes are a matter of convention: 16 of them have numbers, by the directions of x, y and z. The format's library stores
RUB (x right, y up, z backward) unless an extension record states others, which many readers ignore. Some programs store
those of the PLY (RDF: x right, y down, z forward) without saying so. Scenes keep the axes of the SPZ that they come
from; others get RUB. Files of version 3 have no record, because readers refuse what follows the Gaussians.

A flag states that a scene was trained antialiased. Spark sets it for all scenes. It writes versions up to 3 without
extension records and with the fractional bits of the format's library, so the flag counts in other files only.
"""

import itertools
import struct
import zlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, BinaryIO, Literal

import numpy as np
from backports import zstd
from numpy.typing import NDArray

from sgsst_core.constants import SH_DEGREES
from sgsst_core.errors import OutputError, SceneError
from sgsst_core.files.formats import scene_format
from sgsst_core.scene.rendering import Rendering

#: Requested axes; "auto" for those that the file states, else RUB.
SpzAxes = Literal["auto", "rub", "rdf"]

_MAGIC = b"NGSP"
_GZIP_MAGIC = b"\x1f\x8b"
#: Version field of files of one stream.
_OLD_VERSIONS = tuple(struct.pack("<I", version) for version in (1, 2, 3))
#: Maximum compression ratio of deflate: 258 bytes for every two bits.
_DEFLATE_RATIO = 1032

_READ_BYTES = 1 << 18
#: Maximum bytes of extensions.
_EXTENSION_BYTES = 1 << 20
#: Maximum window of zstd, the default limit of its command-line program: 2^27 bytes.
_ZSTD_OPTIONS: dict[int, int] = {zstd.DecompressionParameter.window_log_max: 27}
#: Maximum compression ratio of zstd: a block of at most 128 KiB takes at least four bytes (RFC 8878, section 3.1.1.2).
_ZSTD_RATIO = (1 << 17) // 4

#: Type of the extension record that states the axes, and its numbers for them; 0 stands for the library's default.
_AXES_EXTENSION = 0xADBE0003
_AXES = [
    *("rub", "ldb", "rdb", "lub", "rub", "ldf", "rdf", "luf", "ruf"),
    *("lfd", "rfd", "lfu", "rfu", "lbd", "rbd", "lbu", "rbu"),
]
#: Directions of axes in those of a PLY, by the letters of names.
_DIRECTIONS = {"r": (1, 0, 0), "l": (-1, 0, 0), "d": (0, 1, 0), "u": (0, -1, 0), "f": (0, 0, 1), "b": (0, 0, -1)}
_ANTIALIASED, _HAS_EXTENSIONS, _LEVELS = 1, 2, 0x80
#: Fractional bits that the format's library and Spark write.
_USUAL_BITS = 12
_ENDS_EARLY = "the data ends before all Gaussians that the header declares"
_ASSUMED_AXES = "axes: read as rub; the file states none. If the scene is upside down, pass --spz-axes rdf"

_SCALES = (np.arange(256) / 16 - 10).astype(np.float32)
#: SH coefficient of degree 0 for each byte. Their range exceeds that of colors in 0..1.
_COLORS = ((np.arange(256) / 255 - 0.5) / 0.15).astype(np.float32)
_HARMONICS = ((np.arange(256) - 128) / 128).astype(np.float32)
_FIRST_BYTES = (np.arange(256) / 127.5 - 1).astype(np.float32)

#: Maximum number of fractional bits in written positions. With 20 bits, positions in a scene of a few units are finer
#: than in float32.
_MAX_FRACTIONAL_BITS = 20

#: Compression level. Files are 2 % larger than at zlib's default level 6 but take a third of the time, because
#: spherical harmonics are almost noise.
_DEFLATE_LEVEL = 4
_ZSTD_LEVEL = 6

Take = Callable[[int], bytes]


@dataclass(frozen=True)
class SpzHeader(scene_format.SceneHeader):
    """Header of an SPZ file.

    Attributes:
        version: Version of the format, 1 to 4.
        fractional_bits: Fractional bits of the fixed-point positions; unused in version 1, which has 16-bit floats.
        degree: SH degree of the file, 0 to 4.
        sections: Decompressed sizes in bytes of positions, opacities, colors, scales, rotations and spherical
            harmonics.
        streams: Byte offsets and sizes of the streams of version 4, one per section that is not empty. Empty for other
            versions, which have one stream.
        zipped: Whether the stream of version 1 to 3 is compressed by gzip.
        extended: Whether there are extension records; they follow the Gaussians of version 1 to 3.
        stated_axes: Axes that a file of version 4 states; None if it does not, and for other versions.
        requested: Requested axes.
    """

    size: int
    version: int
    degree: int
    fractional_bits: int
    sections: tuple[int, ...]
    streams: tuple[tuple[int, int], ...] = ()
    zipped: bool = True
    extended: bool = False
    stated_axes: str | None = None
    requested: SpzAxes = "auto"

    @property
    def may_state_axes(self) -> bool:
        """Return whether the file states its axes, or may state them after the Gaussians."""
        return self.stated_axes is not None or (self.extended and not self.streams)


def _is_version_4(start: scene_format.FileStart) -> bool:
    """Return whether a file is SPZ of version 4, or of one that cannot be read."""
    return start.head.startswith(_MAGIC) and start.head[4:8] not in _OLD_VERSIONS


def _is_old_version(start: scene_format.FileStart) -> bool:
    """Return whether a file is SPZ of version 1 to 3, or another gzip stream."""
    return start.head.startswith(_GZIP_MAGIC) or (start.head.startswith(_MAGIC) and not _is_version_4(start))


def _old_header(file_start: scene_format.FileStart) -> SpzHeader:
    """Read the header of version 1 to 3, which stores header and sections in one stream."""
    path, head = file_start.path, file_start.head
    zipped = head.startswith(_GZIP_MAGIC)
    try:
        start = zlib.decompressobj(31).decompress(head, 16) if zipped else head[:16]
    except zlib.error as error:
        raise SceneError(f"{path}: is a damaged gzip file: {error}. Copy or export it again.") from error
    if not start.startswith(_MAGIC) and not _MAGIC.startswith(start):
        raise SceneError(f"{path}: is a gzip file, but no SPZ scene. Unpack it first (gunzip), and give what is in it.")
    header = _shared_fields(file_start, start, 16, (1, 2, 3))
    needed = 16 + sum(header.sections)
    if needed > (_DEFLATE_RATIO if zipped else 1) * header.size:
        declared = f"the header declares {header.count} Gaussians, which take {needed} bytes"
        raise scene_format.truncated(path, f"{declared}, more than the file's {header.size} bytes can hold")
    return replace(header, format=SPZ_3, zipped=zipped, tag=_tag(start[14], header))


def _zstd_header(file_start: scene_format.FileStart) -> SpzHeader:
    """Read the header of version 4, which is uncompressed and followed by one zstd stream per section."""
    path, head, size = file_start.path, file_start.head, file_start.size
    header = _shared_fields(file_start, head, 32, (4,))
    number, table = head[15], int.from_bytes(head[16:20], "little")
    expected = [section for section in header.sections if section]
    if number != len(expected) or table < 32 or table + 16 * number > size:
        declared = f"the SPZ header declares {number} streams with their table at byte {table}"
        raise scene_format.truncated(path, f"{declared}; expected {len(expected)} streams in {size} bytes")
    records = scene_format.read_bytes(path, 32, min(table, 32 + _EXTENSION_BYTES))
    axes, _ = _parsed_extensions(path, records, header)
    position = table + 16 * number
    streams, listed = [], list(struct.iter_unpack("<QQ", scene_format.read_bytes(path, table, position)))
    for (compressed, decompressed), wanted in zip(listed, expected, strict=True):
        if decompressed != wanted or position + compressed > size or wanted > _ZSTD_RATIO * compressed:
            declared = f"the SPZ header declares a stream of {compressed} bytes that become {decompressed}"
            needed = f"{wanted} belong to {header.count} Gaussians, and {size - position} bytes are left"
            raise scene_format.truncated(path, f"{declared}; {needed}")
        streams.append((position, compressed))
        position += compressed
    return replace(header, streams=tuple(streams), stated_axes=axes, tag=_tag(head[14], header))


def _tag(flags: int, header: SpzHeader) -> scene_format.RenderTag:
    """Return the render mode that the flags state; if the flag is ignored, return the default mode with a warning."""
    if not flags & _ANTIALIASED:
        return scene_format.UNTAGGED
    if header.version > 3 or header.extended or header.fractional_bits != _USUAL_BITS:
        return scene_format.stated("antialiased", "the file's flag")
    reason = (
        "the file's flag says antialiased, but Spark sets it for all scenes; if the scene was trained so, add "
        "--render-mode antialiased"
    )
    return scene_format.RenderTag(warnings=(("classic", reason),))


def _parsed_extensions(path: Path, data: bytes, spz: SpzHeader) -> tuple[str | None, bytes]:
    """Parse extension records: type (uint32), length in bytes (uint32) and content.

    Returns:
        Stated axes, None if there are none, and what stands in place of records, or after them.
    """
    axes, position = None, 0
    while spz.extended and position + 8 <= len(data):
        kind, length = struct.unpack_from("<II", data, position)
        if position + 8 + length > len(data):
            break
        position += 8 + length
        if kind == _AXES_EXTENSION and axes is None and length >= 4:
            (number,) = struct.unpack_from("<I", data, position - length)
            if number >= len(_AXES):
                raise SceneError(
                    f"{path}: has the axes of SPZ's coordinate system {number}; 0 to {len(_AXES) - 1} can be read. "
                    "Export it with one of these."
                )
            axes = _AXES[number]
    return axes, data[position:]


def _shared_fields(start: scene_format.FileStart, head: bytes, least: int, versions: tuple[int, ...]) -> SpzHeader:
    """Parse the fields that all versions share, of a header of at least some bytes."""
    path = start.path
    if len(head) < least:
        raise SceneError(f"{path}: ends within its SPZ header: the file is truncated. Copy or export it again.")
    version, count, degree, fractional_bits = struct.unpack_from("<IIBB", head, 4)
    if version not in versions:
        raise SceneError(
            f"{path}: is SPZ of version {version}{' in a gzip stream' * (version == 4)}, which cannot be read. Export "
            "it as SPZ 4 or 3, or as PLY."
        )
    if degree not in scene_format.STORED_COEFFICIENTS:
        raise SceneError(f"{path}: has SH degree {degree}; 0 to 4 can be read. Export it as PLY.")
    if head[14] & _LEVELS:
        raise SceneError(
            f"{path}: holds the levels of detail of Spark, whose Gaussians stand for each other. Give the scene that "
            "it was made of."
        )
    if not count:
        raise SceneError(f"{path}: holds no Gaussians. Export the scene again.")
    if version > 1 and not fractional_bits <= 24:
        raise SceneError(
            f"{path}: SPZ header: fractional bits must be at most 24, not {fractional_bits}. Export it again."
        )
    sections = (
        (6 if version == 1 else 9) * count,
        count,
        3 * count,
        3 * count,
        (3 if version < 3 else 4) * count,
        3 * scene_format.STORED_COEFFICIENTS[degree] * count,
    )
    drawn, extended = scene_format.COEFFICIENTS[min(degree, 3)], bool(head[14] & _HAS_EXTENSIONS)
    notes = ("SH bands above degree 3 are left out",) if degree > 3 else ()
    return SpzHeader(
        *(SPZ, count, drawn, start.size, version, degree, fractional_bits, sections),
        extended=extended,
        notes=notes,
    )


def _read(file: scene_format.OpenScene, spz: scene_format.SceneHeader, into: scene_format.Arrays) -> SpzHeader:
    """Fill the arrays of a scene, and return the header with its axes, and further notes."""
    assert isinstance(spz, SpzHeader)
    path = file.path
    decoders: list[tuple[NDArray[np.float32], Callable[[NDArray[np.uint8]], NDArray[Any]]]] = [
        (into["means"], lambda data: _positions(data, spz)),
        (into["opacities"], lambda data: scene_format.OPACITY_LOGITS[data]),
        (into["sh_dc"], lambda data: _COLORS[data].reshape(-1, 3)),
        (into["scales"], lambda data: _SCALES[data].reshape(-1, 3)),
        (into["quats"], _smallest_three if spz.version >= 3 else _first_three),
        (
            into["sh_rest"],
            lambda data: _HARMONICS[data].reshape(-1, scene_format.STORED_COEFFICIENTS[spz.degree], 3)[
                :, : scene_format.COEFFICIENTS[3]
            ],
        ),
    ]
    stream = _Stream(file, spz)
    takes: Iterator[Take] = _sections_of_streams(path, file, spz)
    if not spz.streams:
        takes = itertools.repeat(partial(_taken, path, stream.read))
        _taken(path, stream.read, 16)
    for (array, decode), size in zip(decoders, spz.sections, strict=True):
        if not size:
            continue
        take = next(takes)
        row_bytes = size // spz.count
        for block in scene_format.blocks(spz.count):
            array[block] = decode(np.frombuffer(take((block.stop - block.start) * row_bytes), np.uint8))
    next(takes, None)  # reach the end of the last stream, where its checksum is verified
    axes, notes = spz.stated_axes, spz.notes
    if not spz.streams:
        axes = _extensions(path, stream, spz)
    if spz.requested != "auto":
        axes = spz.requested
    elif axes is None:
        notes += (_ASSUMED_AXES,)
    axes = axes or _AXES[0]
    if axes != "rdf":
        for name, array in into.items():
            for block in scene_format.blocks(len(array)):
                array[block] = _with_axes(name, array[block], _matrix(axes))
    return replace(spz, axes=axes, notes=notes)


def _matrix(axes: str) -> NDArray[np.float64]:
    """Return the matrix [3, 3] that converts vectors of other axes to those of a PLY: a permutation with signs."""
    return np.array([_DIRECTIONS[letter] for letter in axes], np.float64).T


def _with_axes(name: str, values: NDArray[Any], matrix: NDArray[np.float64]) -> NDArray[Any]:
    """Return the values of an array of a scene in other axes.

    Args:
        matrix: Permutation with signs, [3, 3]; it may mirror.
    """
    order, signs = np.abs(matrix).argmax(axis=1), matrix.sum(axis=1).astype(values.dtype)
    match name:
        case "means":
            values = values[:, order] * signs
        case "scales":
            values = values[:, order]
        case "quats":  # the axis of a rotation is mirrored the other way
            values = np.hstack([values[:, :1], values[:, 1:][:, order] * signs * round(np.linalg.det(matrix))])
        case "sh_rest":
            harmonics = scene_format.harmonics_matrix(matrix, values.shape[1]).astype(values.dtype)
            flips = np.array_equal(np.abs(harmonics), np.eye(len(harmonics)))
            values = values * harmonics.diagonal()[:, None] if flips else harmonics @ values
    return values


class _Part:
    """Byte range of a file, with the method `read` of binary files.

    Attributes:
        position: Byte offset of what is read next.
    """

    def __init__(self, file: scene_format.OpenScene, offset: int, size: int) -> None:
        self.position = offset
        self._file, self._end = file, offset + size

    def read(self, size: int = -1) -> bytes:
        left = self._end - self.position
        data = scene_format.read_rows(
            self._file, np.dtype(np.uint8), self.position, left if size < 0 else min(size, left)
        )
        self.position += len(data)
        return data.tobytes()


class _Stream:
    """Content of a file of version 1 to 3: one stream, compressed by gzip or not.

    Attributes:
        inflate: Decompressor; None for a stream that is not compressed.
    """

    def __init__(self, file: scene_format.OpenScene, spz: SpzHeader) -> None:
        self.source = _Part(file, 0, spz.size)
        self.inflate = zlib.decompressobj(31) if spz.zipped else None

    def read(self, count: int) -> bytes:
        """Return the next `count` bytes, or those that are left."""
        if self.inflate is None:
            return self.source.read(count)
        content = bytearray()
        while len(content) < count and not self.inflate.eof:
            data = self.inflate.unconsumed_tail or self.source.read(_READ_BYTES)
            content += self.inflate.decompress(data, count - len(content))
            if not data and len(content) < count:
                break
        return bytes(content)


def _extensions(path: Path, stream: _Stream, spz: SpzHeader) -> str | None:
    """Return the axes that a file of version 1 to 3 states after its sections; None if it does not."""
    content = _taken(path, stream.read, _EXTENSION_BYTES, least=0)
    if _taken(path, stream.read, 1, least=0):
        raise _too_much(path)
    if stream.inflate and not stream.inflate.eof:
        raise scene_format.truncated(path, _ENDS_EARLY)
    axes, rest = _parsed_extensions(path, content, spz)
    if len(rest.strip(b"\0")) >= sum(spz.sections) // spz.count:
        raise _too_much(path)
    return axes


def _sections_of_streams(path: Path, file: scene_format.OpenScene, spz: SpzHeader) -> Iterator[Take]:
    """Yield, for each section of version 4, a function that reads its own stream; check that the stream ends there."""
    for offset, size in spz.streams:
        part: Any = _Part(file, offset, size)  # its only method is `read`
        with zstd.ZstdFile(part, options=_ZSTD_OPTIONS) as stream:
            yield partial(_taken, path, stream.read)
            if _taken(path, stream.read, 1, least=0):
                raise _too_much(path)


def _taken(path: Path, read: Take, count: int, least: int | None = None) -> bytes:
    """Return bytes of a stream, `count` of them, or at least `least`."""
    try:
        content = read(count)
    except EOFError:
        content = b""
    except (zlib.error, zstd.ZstdError) as error:
        raise SceneError(f"{path}: the compressed data is damaged: {error}. Copy or export it again.") from error
    if len(content) < (count if least is None else least):
        raise scene_format.truncated(path, _ENDS_EARLY)
    return content


def _too_much(path: Path) -> SceneError:
    return SceneError(
        f"{path}: the data continues after all Gaussians that the header declares: the header is wrong. "
        "Export it again."
    )


def _positions(data: NDArray[np.uint8], spz: SpzHeader) -> NDArray[Any]:
    """Decode positions: 16-bit floats in version 1, and 24-bit fixed-point numbers later."""
    if spz.version == 1:
        return data.view("<f2").reshape(-1, 3).astype(np.float32)
    low, middle, high = data.reshape(-1, 3).astype(np.int32).T
    values = (low | middle << 8 | high << 16) << 8 >> 8  # bit 23 is the sign
    return np.ldexp(values.astype(np.float32), -spz.fractional_bits).reshape(-1, 3)


def _first_three(data: NDArray[np.uint8]) -> NDArray[Any]:
    xyz = _FIRST_BYTES[data].reshape(-1, 3).astype(np.float64)
    return scene_format.with_largest(np.zeros(len(xyz), np.int64), xyz)


def _smallest_three(data: NDArray[np.uint8]) -> NDArray[Any]:
    """Decode rotations of version 3 and later: a sign bit and 9 bits of magnitude per component, in the order xyzw."""
    packed = data.view("<u4")
    three = np.stack([packed >> shift & 1023 for shift in (20, 10, 0)], axis=1)
    values = np.where(three & 512, -1.0, 1.0) * (three & 511) / 511 * np.sqrt(0.5)
    return np.roll(scene_format.with_largest(packed >> 30, values), 1, axis=1)


def _write(output: BinaryIO, arrays: scene_format.Arrays, rendering: Rendering, axes: str = _AXES[0]) -> None:
    """Write SPZ version 4, the newest, with all 8 bits of SH coefficients, and a record of its axes."""
    bits = _fractional_bits(arrays["means"])
    streams = []
    for section in _encoded_sections(arrays, bits, axes):
        compressor, size = zstd.ZstdCompressor(level=_ZSTD_LEVEL), 0
        compressed = bytearray()
        for block in section:
            compressed += compressor.compress(block)
            size += len(block)
        compressed += compressor.flush()
        if size:
            streams.append((size, compressed))
    record = struct.pack("<III", _AXES_EXTENSION, 4, _AXES.index(axes, 1))
    head = _first_fields(4, arrays, bits, rendering, _HAS_EXTENSIONS)
    output.write(head + struct.pack("<BI12x", len(streams), 32 + len(record)) + record)
    for size, compressed in streams:
        output.write(struct.pack("<QQ", len(compressed), size))
    for _, compressed in streams:
        output.write(compressed)


def _write_version_3(output: BinaryIO, arrays: scene_format.Arrays, rendering: Rendering, axes: str = _AXES[0]) -> None:
    """Write SPZ version 3, for programs that cannot read version 4, with all 8 bits of SH coefficients.

    Axes other than RDF become RUB, because the file does not state them.
    """
    deflate = zlib.compressobj(_DEFLATE_LEVEL, wbits=31)
    bits = _fractional_bits(arrays["means"])
    output.write(deflate.compress(_first_fields(3, arrays, bits, rendering) + bytes(1)))
    for section in _encoded_sections(arrays, bits, axes if axes == "rdf" else _AXES[0]):
        for block in section:
            output.write(deflate.compress(block))
    output.write(deflate.flush())


def _first_fields(version: int, arrays: scene_format.Arrays, bits: int, rendering: Rendering, flags: int = 0) -> bytes:
    """Return the first 15 bytes of a header, which versions 2 to 4 share."""
    count, coefficients = arrays["sh_rest"].shape[:2]
    flags |= _ANTIALIASED if rendering.antialiased else 0
    return struct.pack("<4sIIBBB", _MAGIC, version, count, SH_DEGREES[coefficients], bits, flags)


def _encoded_sections(arrays: scene_format.Arrays, bits: int, axes: str) -> Iterator[Iterator[bytes]]:
    """Yield the blocks of each section of version 3 and 4."""
    encoders: dict[str, Callable[[NDArray[np.float64]], NDArray[Any]]] = {
        "means": lambda values: _encode_positions(values, bits),
        "opacities": scene_format.opacity_bytes,
        "sh_dc": lambda values: _to_byte(values * (0.15 * 255) + 127.5),
        "scales": lambda values: _to_byte((values + 10) * 16),
        "quats": _encode_rotations,
        "sh_rest": lambda values: _to_byte(values * 128 + 128),
    }
    matrix = _matrix(axes).T

    def encoded(name: str) -> Iterator[bytes]:
        for block in scene_format.blocks(len(arrays[name])):
            values = _with_axes(name, arrays[name][block].astype(np.float64), matrix)
            yield np.ascontiguousarray(encoders[name](values)).tobytes()

    return map(encoded, encoders)


def _fractional_bits(means: NDArray[np.float32]) -> int:
    """Return the largest number of fractional bits that can represent the position farthest from the origin."""
    farthest = max(float(np.abs(means).max()), 2.0**-30)
    bits = min(_MAX_FRACTIONAL_BITS, int(np.floor(np.log2((2**23 - 1) / farthest))))
    if bits < 1:
        raise OutputError(
            f"SPZ cannot hold a Gaussian {farthest:.3g} from the origin. Write a PLY, or a .compressed.ply."
        )
    return bits


def _encode_positions(means: NDArray[np.float64], bits: int) -> NDArray[Any]:
    values = np.rint(np.ldexp(means, bits)).astype(np.int32)
    return np.stack([values & 255, values >> 8 & 255, values >> 16 & 255], axis=-1).astype(np.uint8)


def _encode_rotations(quats: NDArray[np.float64]) -> NDArray[Any]:
    largest, three = scene_format.without_largest(np.roll(quats, -1, axis=1))
    components = np.stack([three < 0, np.abs(three) / np.sqrt(0.5)], axis=2).reshape(-1, 6)
    return scene_format.join_bits(np.column_stack([largest / 3, components]), (2, 1, 9, 1, 9, 1, 9)).astype("<u4")


def _to_byte(values: NDArray[np.float64]) -> NDArray[Any]:
    return np.clip(np.rint(values), 0, 255).astype(np.uint8)


SPZ = scene_format.SceneFormat(
    *("spz", "SPZ", 25, _is_version_4, _zstd_header, _read, _write),
    ranges={"scales": (_SCALES[0], _SCALES[-1]), "sh_dc": (_COLORS[0], _COLORS[-1]), "sh_rest": (-1.0, 1.0)},
    step=lambda means: np.ldexp(1.0, -_fractional_bits(means)),
    has_axes=True,
)
SPZ_3 = replace(
    SPZ, name="v3.spz", title="SPZ 3", matches=_is_old_version, read_header=_old_header, write=_write_version_3
)
