"""Reader of scene file headers, which detects the format and checks the header against the size of the file.

The formats are PLY, PlayCanvas' compressed PLY, Niantic's SPZ (versions 1 to 4) and antimatter15's .splat. Nothing is
allocated for the data, and PyTorch is not imported. The layouts follow the programs that define them:
https://github.com/playcanvas/splat-transform, https://github.com/nianticlabs/spz, https://github.com/antimatter15/splat.
"""

from __future__ import annotations

import math
import struct
import zlib
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from sgsst_core.errors import SceneError
from sgsst_core.files.formats.ply_header import PlyElement, PlyHeader, element_offsets, read_header

Form = Literal["ply", "compressed.ply", "spz", "splat"]
#: Compressed formats that can be written in addition to a PLY, named by their file extension.
PackedForm = Literal["compressed.ply", "spz"]
PACKED_FORMS: tuple[PackedForm, ...] = ("compressed.ply", "spz")

#: SH coefficients per color channel above degree 0, by SH degree.
COEFFICIENTS = {0: 0, 1: 3, 2: 8, 3: 15}
#: Number of Gaussians per chunk of a compressed PLY. Each chunk has its own quantization bounds.
CHUNK_ROWS = 256
#: Bytes per Gaussian in a .splat file.
SPLAT_BYTES = 32

#: Maximum compression ratio of deflate: 258 bytes for every two bits.
_DEFLATE_RATIO = 1032
_CONVERT = "Convert it first: `splat-transform scene.{form} scene.ply` (https://github.com/playcanvas/splat-transform)."
_SPZ_MAGIC = b"NGSP"
#: Number of leading bytes that are used to detect the format: 256 records of a .splat file.
_HEAD_BYTES = 256 * SPLAT_BYTES
_KSPLAT_HEADER_BYTES = 4096


def form_of_name(name: str) -> Form | None:
    """Return the format of an output file by its file extension; None if the extension is not supported."""
    lower = name.lower()
    packed: Form | None = next((form for form in PACKED_FORMS if lower.endswith(f".{form}")), None)
    return packed or ("ply" if lower.endswith(".ply") else None)


def packed_name(ply: str, form: PackedForm) -> str:
    """Return the name of the compressed file that accompanies a PLY."""
    return f"{ply.removesuffix('.ply')}.{form}"


@dataclass(frozen=True)
class SpzSection:
    """Compressed stream of an SPZ file of version 4: byte offset, compressed size and decompressed size."""

    offset: int
    compressed: int
    size: int


@dataclass(frozen=True)
class SpzHeader:
    """Header of an SPZ file.

    Attributes:
        version: Version of the format, 1 to 4.
        fractional_bits: Fractional bits of the fixed-point positions; unused in version 1, which has 16-bit floats.
        sections: Decompressed sizes in bytes of positions, opacities, colors, scales, rotations and spherical
            harmonics.
        streams: Streams of version 4, one per section that is not empty. Empty for other versions, which have one gzip
            stream.
    """

    version: int
    fractional_bits: int
    sections: tuple[int, ...]
    streams: tuple[SpzSection, ...] = ()


@dataclass(frozen=True)
class SceneHeader:
    """Header of a scene file in any format.

    Attributes:
        form: Format of the file.
        count: Number of Gaussians; 0 for a PLY without any, which `read_scene` refuses.
        sh_degree: SH degree, 0 to 3; always 0 for a plain PLY, whose SH degree is not determined here.
        size: Size of the file in bytes.
        ply: PLY header of a plain or compressed PLY; None for other formats.
        spz: SPZ header; None for other formats.
    """

    form: Form
    count: int
    sh_degree: int
    size: int
    ply: PlyHeader | None = None
    spz: SpzHeader | None = None

    @property
    def float_values(self) -> int:
        """Return the number of float values per Gaussian after decompression."""
        return 14 + 3 * COEFFICIENTS[self.sh_degree]


def read_scene_header(path: Path) -> SceneHeader:
    """Detect the format of a scene file from its content, and read its header.

    The size of a compressed scene is checked against its header. The size of a plain PLY is not checked here; see
    `element_offsets`.

    Raises:
        SceneError: If the file cannot be read, is truncated, has a wrong header, or has an unsupported format.
    """
    try:
        with path.open("rb") as file:
            head = file.read(_HEAD_BYTES)
        size = path.stat().st_size
    except OSError as error:
        raise SceneError(f"{path}: cannot be read: {error.strerror}. Check the path.") from error
    if head.startswith(b"ply"):
        return _ply(path, size)
    if head.startswith(b"\x1f\x8b"):
        return _gzipped_spz(path, head, size)
    if head.startswith(_SPZ_MAGIC):
        return _spz_4(path, head, size)
    _refuse_others(path, head, size)
    if _looks_like_splat(head):
        return _splat(path, size)
    raise SceneError(
        f"{path}: has no PLY header (it does not start with 'ply'), and is neither SPZ nor .splat. Give a 3DGS scene "
        "as .ply, .compressed.ply, .spz or .splat file."
    )


# --- PLY -----------------------------------------------------------------------------------------------------------


def _ply(path: Path, size: int) -> SceneHeader:
    header = read_header(path)
    vertex = header.vertex if "vertex" in header.names else None
    if vertex is None or "packed_position" not in {prop.name for prop in vertex.properties}:
        return SceneHeader("ply", vertex.count if vertex else 0, 0, size, ply=header)
    if header.text:
        raise SceneError(f"{path}: is a compressed PLY as text, which no program writes. Export it again as binary.")
    _check_kinds(path, vertex, "u4", ("packed_position", "packed_rotation", "packed_scale", "packed_color"))
    chunk = header.elements[header.names.index("chunk")] if "chunk" in header.names else None
    if chunk is None:
        raise SceneError(f"{path}: is a compressed PLY without element 'chunk', its bounds. Export it again.")
    _check_kinds(path, chunk, "f4", (*bounds("", "xyz"), *bounds("scale_", "xyz")))
    if "min_r" in {prop.name for prop in chunk.properties}:
        _check_kinds(path, chunk, "f4", bounds("", "rgb"))
    if not vertex.count:
        raise SceneError(f"{path}: holds no Gaussians (element vertex 0). Export the scene again.")
    expected = -(-vertex.count // CHUNK_ROWS)
    if chunk.count != expected:
        raise SceneError(
            f"{path}: the header declares {chunk.count} chunks, but {vertex.count} Gaussians make {expected}: it is "
            "wrong. Export the scene again."
        )
    degree = _sh_degree(path, header, vertex.count)
    element_offsets(path, header)
    return SceneHeader("compressed.ply", vertex.count, degree, size, ply=header)


def bounds(prefix: str, axes: str) -> tuple[str, ...]:
    """Return the names of a compressed PLY's bounds, the lower bounds of all axes first."""
    return tuple(f"{side}_{prefix}{axis}" for side in ("min", "max") for axis in axes)


def _check_kinds(path: Path, element: PlyElement, kind: str, names: tuple[str, ...]) -> None:
    found = {prop.name: prop.kind for prop in element.properties if not prop.length_kind}
    wrong = [name for name in names if found.get(name) != kind]
    if wrong or element.has_lists:
        what = f"{', '.join(wrong)} missing or of another type" if wrong else "a list"
        raise SceneError(
            f"{path}: is not a readable compressed PLY: element {element.name!r} has {what}. Export it again."
        )


def _sh_degree(path: Path, header: PlyHeader, count: int) -> int:
    """Return the SH degree of a compressed PLY, which follows from its element `sh`."""
    if "sh" not in header.names:
        return 0
    element = header.elements[header.names.index("sh")]
    degree = {3 * number: degree for degree, number in COEFFICIENTS.items()}.get(len(element.properties), 0)
    if not degree or element.count != count:
        raise SceneError(
            f"{path}: element 'sh' has {element.count} rows of {len(element.properties)} properties; there should be "
            f"{count} of 9, 24 or 45. Export the scene again."
        )
    _check_kinds(path, element, "u1", tuple(f"f_rest_{i}" for i in range(len(element.properties))))
    return degree


# --- SPZ -----------------------------------------------------------------------------------------------------------


def _gzipped_spz(path: Path, head: bytes, size: int) -> SceneHeader:
    """Read the header of version 1 to 3, which stores header and sections in one gzip stream."""
    try:
        start = zlib.decompressobj(31).decompress(head, 16)
    except zlib.error as error:
        raise SceneError(f"{path}: is a damaged gzip file: {error}. Copy or export it again.") from error
    if not start.startswith(_SPZ_MAGIC):
        raise SceneError(f"{path}: is a gzip file, but no SPZ scene. Unpack it first (gunzip), and give what is in it.")
    version, count, degree, fractional_bits, sections = _spz_header(path, start, (1, 2, 3))
    needed = 16 + sum(sections)
    if needed > _DEFLATE_RATIO * size:
        raise SceneError(
            f"{path}: the header declares {count} Gaussians, which take {needed} bytes, more than the file's {size} "
            "compressed bytes can hold: the file is truncated or its header is wrong. Copy or export it again."
        )
    return SceneHeader("spz", count, degree, size, spz=SpzHeader(version, fractional_bits, sections))


def _spz_4(path: Path, head: bytes, size: int) -> SceneHeader:
    """Read the header of version 4, which is uncompressed and followed by one zstd stream per section."""
    version, count, degree, fractional_bits, sections = _spz_header(path, head, (4,))
    if len(head) < 32:
        raise SceneError(f"{path}: ends within its SPZ header: the file is truncated. Copy or export it again.")
    number, table = head[15], int.from_bytes(head[16:20], "little")
    expected = [section for section in sections if section]
    if number != len(expected) or table < 32 or table + 16 * number > size:
        raise SceneError(
            f"{path}: the SPZ header declares {number} streams, listed at byte {table}; there should be "
            f"{len(expected)} in the {size} bytes. The file is truncated or its header is wrong. Copy it again."
        )
    with path.open("rb") as file:
        file.seek(table)
        listed = list(struct.iter_unpack("<QQ", file.read(16 * number)))
    streams, position = [], table + 16 * number
    for (compressed, becomes), wanted in zip(listed, expected, strict=True):
        if becomes != wanted or position + compressed > size:
            raise SceneError(
                f"{path}: the SPZ header declares a stream of {compressed} bytes that become {becomes}; {wanted} "
                f"belong to {count} Gaussians, and {size - position} bytes are left. The file is truncated or its "
                "header is wrong. Copy or export it again."
            )
        streams.append(SpzSection(position, compressed, becomes))
        position += compressed
    header = SpzHeader(version, fractional_bits, sections, tuple(streams))
    return SceneHeader("spz", count, degree, size, spz=header)


def _spz_header(path: Path, head: bytes, versions: tuple[int, ...]) -> tuple[int, int, int, int, tuple[int, ...]]:
    """Parse the header fields that all versions share.

    Returns version, number of Gaussians, SH degree, fractional bits, and the decompressed size of each section.
    """
    if len(head) < 16:
        raise SceneError(f"{path}: ends within its SPZ header: the file is truncated. Copy or export it again.")
    version, count, degree, fractional_bits = struct.unpack_from("<IIBB", head, 4)
    convert = _CONVERT.format(form="spz")
    if version not in versions:
        raise SceneError(f"{path}: is SPZ of version {version}, which cannot be read. {convert}")
    if degree not in COEFFICIENTS:
        raise SceneError(f"{path}: has SH degree {degree}; 0 to 3 can be read. {convert}")
    if not count:
        raise SceneError(f"{path}: holds no Gaussians. Export the scene again.")
    if version > 1 and not fractional_bits <= 24:
        raise SceneError(
            f"{path}: positions have {fractional_bits} fractional bits of 24: the SPZ header is wrong. Export it again."
        )
    sections = (
        (6 if version == 1 else 9) * count,
        count,
        3 * count,
        3 * count,
        (3 if version < 3 else 4) * count,
        3 * COEFFICIENTS[degree] * count,
    )
    return version, count, degree, fractional_bits, sections


# --- .splat, and unsupported formats ---------------------------------------------------------------------------------


def _looks_like_splat(head: bytes) -> bool:
    """Return whether the data looks like .splat records. The format has no header.

    Nearly all records must have finite positions, plausible sizes, and rotations of length 1.
    """
    rows = splat_rows(head[: len(head) // SPLAT_BYTES * SPLAT_BYTES])
    if not len(rows):
        return False
    length = np.linalg.norm((rows["rotation"].astype(np.float64) - 128) / 128, axis=1)
    fits = np.isfinite(rows["position"]).all(axis=1) & (np.abs(length - 1) < 0.05)
    fits &= ((rows["scale"] >= 0) & (rows["scale"] < 1e9)).all(axis=1)
    return bool(fits.mean() > 0.9)


def splat_rows(data: bytes | np.ndarray) -> np.ndarray:
    """Return .splat records: position and scale ([3] float32), color with alpha and rotation wxyz ([4] uint8)."""
    kinds = [("position", "<f4", 3), ("scale", "<f4", 3), ("color", "u1", 4), ("rotation", "u1", 4)]
    return np.frombuffer(data, np.dtype(kinds))


def _splat(path: Path, size: int) -> SceneHeader:
    if size % SPLAT_BYTES:
        raise SceneError(
            f"{path}: is a .splat file of {size // SPLAT_BYTES} Gaussians of {SPLAT_BYTES} bytes and "
            f"{size % SPLAT_BYTES} bytes more: it is truncated. Copy or export it again."
        )
    return SceneHeader("splat", size // SPLAT_BYTES, 0, size)


def _refuse_others(path: Path, head: bytes, size: int) -> None:
    """Raise an error that names a converter if the file has a known but unsupported format."""
    convert = _CONVERT.format(form="sog")
    if head.startswith(b"PK\x03\x04"):
        raise SceneError(f"{path}: is a ZIP archive, as .sog scenes are, which cannot be read. {convert}")
    if head.lstrip().startswith(b"{") and b'"means"' in head and b".webp" in head:
        convert = convert.replace("scene.sog", "meta.json")
        raise SceneError(f"{path}: is the meta.json of a SOG scene, which cannot be read. {convert}")
    if _looks_like_ksplat(head, size):
        raise SceneError(f"{path}: is a .ksplat scene, which cannot be read. {_CONVERT.format(form='ksplat')}")


def _looks_like_ksplat(head: bytes, size: int) -> bool:
    """Return whether the data looks like a .ksplat header.

    Its version is 0.x, its compression level is 0 to 2, and its numbers of sections and Gaussians fit the file size.
    """
    if size < _KSPLAT_HEADER_BYTES or head[0] != 0 or head[1] < 1:
        return False
    sections, filled, _, count, level = struct.unpack_from("<IIIIH", head, 4)
    center = struct.unpack_from("<3f", head, 24)
    fits = 0 < sections <= (size - _KSPLAT_HEADER_BYTES) // 1024 and filled <= sections and 0 < count <= size
    return fits and level <= 2 and all(map(math.isfinite, center))
