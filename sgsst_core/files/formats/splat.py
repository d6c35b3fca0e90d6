"""Readers of antimatter15's .splat and mkkellogg's .ksplat.

A .splat has 32 bytes per Gaussian, without spherical harmonics above degree 0. Positions and standard deviations are
float32. The components of color, opacity and rotation (wxyz) have 8 bits each.

A .ksplat has sections of Gaussians, at one of three compression levels. At level 0, values are float32. At level 1 and
2, positions are 16-bit steps about the center of a bucket of up to some hundred Gaussians, and other values are 16-bit
floats; level 2 stores SH coefficients in 8 bits. Colors and opacities have 8 bits at all levels. SH coefficients have
degree 0 to 2, one band after the other, channel-major in each. Axes are those of the PLY. The layout is that of
https://github.com/mkkellogg/GaussianSplats3D.
"""

import math
import struct
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sgsst_core.constants import COLOR_OFFSET, SH_C0
from sgsst_core.errors import SceneError
from sgsst_core.files.formats import scene_format

ROW = np.dtype([("position", "<f4", 3), ("scale", "<f4", 3), ("color", "u1", 4), ("rotation", "u1", 4)])


def _matches(start: scene_format.FileStart) -> bool:
    """Return whether the data looks like .splat records. The format has no header.

    Nearly all records must have finite positions, plausible sizes, and rotations of length 1.
    """
    rows = np.frombuffer(start.head[: len(start.head) // ROW.itemsize * ROW.itemsize], ROW)
    if not len(rows):
        return False
    length = np.linalg.norm((rows["rotation"].astype(np.float64) - 128) / 128, axis=1)
    fits = np.isfinite(rows["position"]).all(axis=1) & (np.abs(length - 1) < 0.05)
    fits &= (np.abs(rows["scale"]) < 1e9).all(axis=1)  # logarithms are refused when they are read
    return bool(fits.mean() > 0.9)


def _read_header(start: scene_format.FileStart) -> scene_format.SceneHeader:
    count, rest = divmod(start.size, ROW.itemsize)
    if rest:
        raise SceneError(
            f"{start.path}: is a .splat file of {count} Gaussians of {ROW.itemsize} bytes and {rest} bytes more: it "
            "is truncated. Copy or export it again."
        )
    return scene_format.SceneHeader(SPLAT, count, 0)


def _read(file: scene_format.OpenScene, header: scene_format.SceneHeader, into: scene_format.Arrays) -> None:
    """Fill the arrays of a scene. A standard deviation of 0 becomes a log scale of minus infinity."""
    for block, rows in scene_format.row_blocks(file, ROW, 0, header.count):
        into["means"][block] = rows["position"]
        into["scales"][block] = scene_format.logarithms(file.path, rows["scale"].astype(np.float64))
        into["sh_dc"][block] = (rows["color"][:, :3] / 255 - COLOR_OFFSET) / SH_C0
        into["opacities"][block] = scene_format.OPACITY_LOGITS[rows["color"][:, 3]]
        into["quats"][block] = (rows["rotation"].astype(np.float64) - 128) / 128


SPLAT = scene_format.SceneFormat("splat", ".splat", 32, _matches, _read_header, _read)

#: Version 0.1, the only one.
_MAGIC = b"\0\1\0\0"
_HEADER_BYTES = 4096
_MAX_SECTIONS = 1024
_MAX_DEGREE = 2
#: NumPy type codes of positions, of scales and rotations, and of SH coefficients, by compression level.
_TYPES = {0: ("<f4", "<f4", "<f4"), 1: ("<u2", "<f2", "<f2"), 2: ("<u2", "<f2", "u1")}
#: Default of the largest position step and of the range of SH coefficients at level 2.
_STEPS, _RANGE = 32767, 1.5
#: Positions of SH coefficients among those of a Gaussian, [8, 3]: one band after the other, channel-major in each.
_ORDER = np.concatenate([np.arange(9).reshape(3, 3).T, 9 + np.arange(15).reshape(3, 5).T])
#: Log scale of those that 16-bit floats round to 0: half of the smallest positive one.
_MIN_LOG_SCALE = math.log(2.0**-25)


#: Entry of a section: its Gaussians, and those that it has memory for; Gaussians of a full bucket; buckets; side of a
#: bucket; bytes of its center; steps from the least position in a bucket to its center; numbers of full buckets, which
#: come first, and of others; SH degree.
_SECTION = np.dtype(
    {
        "names": [
            *("count", "most", "bucket_size", "buckets", "side"),
            *("center_bytes", "steps", "full", "partial", "degree"),
        ],
        "formats": ["<u4", "<u4", "<u4", "<u4", "<f4", "<u2", "<u4", "<u4", "<u4", "<u2"],
        "offsets": [0, 4, 8, 12, 16, 20, 24, 32, 36, 40],
        "itemsize": 1024,
    }
)


@dataclass(frozen=True)
class KsplatHeader(scene_format.SceneHeader):
    """Header of a .ksplat file.

    Attributes:
        level: Compression level, 0 to 2.
        harmonics: Lowest and highest SH coefficient at level 2.
        sections: Entries of the sections, and the byte offsets of their `start` and `data`. A section has the numbers
            of Gaussians in buckets that are not full (uint32), the centers of the buckets (three float32 each), and
            the data of Gaussians.
    """

    level: int
    harmonics: tuple[float, float]
    sections: list[dict[str, Any]]


def _matches_ksplat(start: scene_format.FileStart) -> bool:
    """Return whether the data looks like a .ksplat header. The format has no magic number beyond its version."""
    head = start.head
    if not head.startswith(_MAGIC) or len(head) < _HEADER_BYTES:
        return False
    sections, filled, _, count, level = struct.unpack_from("<IIIIH", head, 4)
    center = struct.unpack_from("<3f", head, 24)
    return sections > 0 and filled <= sections and count > 0 and level in _TYPES and all(map(math.isfinite, center))


def _read_ksplat_header(start: scene_format.FileStart) -> KsplatHeader:
    path, head = start.path, start.head
    sections, _, _, count, level = struct.unpack_from("<IIIIH", head, 4)
    low, high = struct.unpack_from("<2f", head, 36)
    table_end = _HEADER_BYTES + _SECTION.itemsize * sections
    if sections > _MAX_SECTIONS or table_end > start.size:
        declared = f"the .ksplat header declares {sections} sections in {start.size} bytes"
        raise scene_format.truncated(path, f"{declared}; at most {_MAX_SECTIONS} can be read")
    table = np.frombuffer(scene_format.read_bytes(path, _HEADER_BYTES, table_end), _SECTION)
    read, position = [], table_end
    for index, entry in enumerate(table.tolist()):
        section: dict[str, Any] = dict(zip(_SECTION.names or (), entry, strict=True)) | {"start": position}
        degree, count_of, side = (section[name] for name in ("degree", "count", "side"))
        fits = degree <= _MAX_DEGREE and count_of <= section["most"] and math.isfinite(side)
        if level and count_of:
            fits &= section["center_bytes"] == 12 and section["full"] + section["partial"] <= section["buckets"]
        if fits:
            section["data"] = position + 4 * section["partial"] + section["center_bytes"] * section["buckets"]
            position = section["data"] + _row(level, degree).itemsize * section["most"]
        if not fits or position > start.size:
            raise scene_format.truncated(
                path, f"section {index} of the .ksplat file is wrong, or ends after its {start.size} bytes"
            )
        read.append(section)
    if sum(section["count"] for section in read) != count:
        raise SceneError(
            f"{path}: the .ksplat header declares {count} Gaussians, but its sections hold "
            f"{sum(section['count'] for section in read)}: it was not written completely. Export it again."
        )
    coefficients = scene_format.COEFFICIENTS[max(section["degree"] for section in read)]
    return KsplatHeader(KSPLAT, count, coefficients, level, (low or -_RANGE, high or _RANGE), read)


def _row(level: int, degree: int) -> np.dtype:
    """Return the dtype of a Gaussian."""
    position, value, harmonic = _TYPES[level]
    fields = [("position", position, 3), ("scale", value, 3), ("rotation", value, 4), ("color", "u1", 4)]
    return np.dtype([*fields, ("harmonics", harmonic, 3 * scene_format.COEFFICIENTS[degree])])


@np.errstate(divide="ignore", invalid="ignore", over="ignore")  # invalid values are reported later
def _read_ksplat(file: scene_format.OpenScene, header: scene_format.SceneHeader, into: scene_format.Arrays) -> None:
    """Fill the arrays of a scene. A standard deviation of 0 at level 0 becomes a log scale of minus infinity."""
    assert isinstance(header, KsplatHeader)
    into["sh_rest"][:] = 0
    first = 0
    for section in header.sections:
        buckets = _buckets(file, section) if header.level and section["count"] else None
        kind, steps = _row(header.level, section["degree"]), section["steps"] or _STEPS
        for part, rows in scene_format.row_blocks(file, kind, section["data"], section["count"]):
            block = slice(first + part.start, first + part.stop)
            positions = rows["position"].astype(np.float64)
            if buckets is not None:
                ends, centers = buckets
                owners = np.searchsorted(ends, np.arange(part.start, part.stop), side="right")
                if owners[-1] >= len(ends):
                    raise SceneError(
                        f"{file.path}: holds Gaussians beyond its buckets: it is damaged. Export it again."
                    )
                positions = (positions - steps) * (section["side"] / 2 / steps) + centers[owners]
            into["means"][block] = positions
            scales = scene_format.logarithms(file.path, rows["scale"].astype(np.float64))
            into["scales"][block] = np.maximum(scales, _MIN_LOG_SCALE) if header.level else scales
            into["quats"][block] = rows["rotation"]
            into["sh_dc"][block] = (rows["color"][:, :3] / 255 - COLOR_OFFSET) / SH_C0
            into["opacities"][block] = scene_format.OPACITY_LOGITS[rows["color"][:, 3]]
            harmonics = _harmonics(rows["harmonics"], header, scene_format.COEFFICIENTS[section["degree"]])
            into["sh_rest"][block, : harmonics.shape[1]] = harmonics
        first += section["count"]


def _buckets(file: scene_format.OpenScene, section: dict[str, Any]) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Return the end of each bucket, as an index of Gaussians, and the bucket's center, [buckets, 3]."""
    full, partial = section["full"], section["partial"]
    lengths = scene_format.read_rows(file, np.dtype("<u4"), section["start"], partial)
    centers = scene_format.read_rows(file, np.dtype("<f4"), section["start"] + 4 * partial, 3 * (full + partial))
    sizes = np.concatenate([np.full(full, section["bucket_size"], np.int64), lengths.astype(np.int64)])
    return sizes.cumsum(), centers.reshape(-1, 3).astype(np.float64)


def _harmonics(values: NDArray[np.generic], header: KsplatHeader, coefficients: int) -> NDArray[np.float64]:
    """Return SH coefficients [n, coefficients, 3]."""
    numbers = values.astype(np.float64)[:, _ORDER[:coefficients]]
    if header.level != 2:
        return numbers
    low, high = header.harmonics
    return low + (high - low) * (numbers / 255)


KSPLAT = scene_format.SceneFormat("ksplat", ".ksplat", 44, _matches_ksplat, _read_ksplat_header, _read_ksplat)
