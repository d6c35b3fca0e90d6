"""PlayCanvas' SOG, a ZIP archive or a folder with meta.json and WebP images, or PNGs, and streamed SOG.

Pixel i of each image belongs to Gaussian i; pixels after the last one mean nothing. Positions are 16-bit steps on a
logarithmic scale, in two images. Scales and colors are indices into codebooks of 256 values. Rotations have three
components of 8 bits. SH coefficients are a palette of up to 65,536 vectors. Version 1 has linear steps between bounds
in place of codebooks. The layout is that of https://developer.playcanvas.com/user-manual/gaussian-
splatting/formats/sog. Axes are those of the PLY. The field `model` of meta.json is the render mode, as splat-transform
writes it; `antialias` was its older form. Written files have their blur in `extras`, which is for programs' own values.

Codebook and palette are found by Lloyd's algorithm (k-means) from deterministic starts. If there are no more distinct
values than entries, the codebook holds them exactly, in an order that depends on the values alone, so a scene that was
read from codebooks is written without further loss.

A streamed SOG is read at its finest level, and written with other colors. lod-meta.json lists SOG scenes in folders of
their own, each with Gaussians of one level of detail, and has a tree whose leaves refer to ranges of them. The layout
is that of https://developer.playcanvas.com/user-manual/gaussian-splatting/formats/streamed-sog; early files lack its
version. The environment, which is drawn beside any level, is part of the scene. All files may be in a ZIP archive.
"""

import io
import json
import math
import re
import struct
import zipfile
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from itertools import accumulate, pairwise
from pathlib import Path
from typing import IO, Any, BinaryIO

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from sgsst_core.constants import SH_DEGREES
from sgsst_core.errors import OutputError, SceneError, reading_scene
from sgsst_core.files.advice import SCENES, converted, known_kind, refuse_changed_meaning
from sgsst_core.files.formats import scene_format
from sgsst_core.scene.rendering import Rendering

ZIP_MAGIC = b"PK\x03\x04"
#: Record at the end of a ZIP archive, and its signature; archives above 4 GB have a locator of another record before.
_END = struct.Struct("<4s4H2LH")
_END_MAGIC, _LOCATOR_MAGIC, _LOCATOR_BYTES = b"PK\x05\x06", b"PK\x06\x07", 20
_MAX_COMMENT_BYTES = 1 << 16
#: Maximum bytes of the list of an archive's files.
_MAX_LIST_BYTES = 1 << 21


def archive_list(path: Path) -> bytes:
    """Return the list of an archive's files, not parsed.

    Raises:
        SceneError: If it is truncated, larger than 4 GB, or lists too many files.
    """
    with path.open("rb") as file:
        size = file.seek(0, io.SEEK_END)
        file.seek(max(0, size - _LOCATOR_BYTES - _END.size - _MAX_COMMENT_BYTES))
        tail = file.read()
        position = tail.rfind(_END_MAGIC)
        if position < 0 or position + _END.size > len(tail):
            raise SceneError(f"{path}: is a truncated ZIP archive. Copy or export the scene again.")
        entries, list_bytes = _END.unpack_from(tail, position)[4:6]
        if tail[max(0, position - _LOCATOR_BYTES) : position].startswith(_LOCATOR_MAGIC):
            raise SceneError(f"{path}: is a ZIP archive of more than 4 GB, which cannot be read. Unpack it first.")
        if list_bytes > _MAX_LIST_BYTES:
            raise SceneError(f"{path}: is a ZIP archive of {entries} files, so no SOG scene. Unpack it first.")
        file.seek(max(0, size - len(tail) + position - list_bytes))
        return file.read(list_bytes)


#: Number of values of a codebook, one per byte.
VALUES = 256
_VALUE_ITERATIONS = 60
#: Maximum number of starts of a codebook. Only numbers with extreme values need more than one.
_VALUE_STARTS = 4

#: Clusters of the first level of a palette, rows that they are fitted to, and iterations per level.
_COARSE = 256
_COARSE_ROWS = 1 << 16
_COARSE_ITERATIONS = 8
_FINE_ITERATIONS = 6
#: Number of rows whose distances to all centers are in memory at a time.
_BLOCK_ROWS = 1 << 14


def value_codebook(values: NDArray[Any]) -> NDArray[np.float32]:
    """Return the codebook of numbers of any shape, [VALUES] float32 in ascending order, padded with its largest value.

    Lloyd's algorithm on sorted numbers: a cluster is an interval, whose mean follows from two cumulative sums. It
    starts with entries whose density is the cube root of that of the numbers, which is best for a fine quantizer. While
    extreme numbers leave most entries unused, these are moved to where the error is.
    """
    ordered = np.sort(values, axis=None).astype(np.float64)
    distinct = ordered[np.concatenate([[True], ordered[1:] != ordered[:-1]])]
    if len(distinct) <= VALUES:
        return _padded(distinct.astype(np.float32))
    origin = ordered.mean()  # sums of differences from the mean cancel less
    sums = np.concatenate([[0.0], np.cumsum(ordered - origin)])
    codebook = _companded(ordered)
    for _ in range(_VALUE_STARTS):
        for _ in range(_VALUE_ITERATIONS):
            edges = np.concatenate([[0], np.searchsorted(ordered, _middles(codebook)), [len(ordered)]])
            counts = np.diff(edges)
            means = origin + np.diff(sums[edges]) / np.maximum(counts, 1)
            codebook = np.sort(np.where(counts > 0, means, codebook))
        entries = codebook.astype(np.float32)
        used = entries[np.unique(nearest_entries(ordered, entries))]
        if len(used) >= VALUES // 2:
            break
        codebook = _with_unused_entries(ordered, used)
    return _padded(used)


def _with_unused_entries(ordered: NDArray[np.float64], used: NDArray[np.float32]) -> NDArray[np.float64]:
    """Add entries up to VALUES, in each cluster of sorted numbers in proportion to the cube root of its squared error.

    They are evenly spaced within the numbers of a cluster.
    """
    labels = nearest_entries(ordered, used)
    first = np.searchsorted(labels, np.arange(len(used)))
    last = np.append(first[1:], len(ordered)) - 1
    cumulative = np.cumsum(np.cbrt(np.bincount(labels, (ordered - used[labels]) ** 2)))
    bounds = np.repeat(np.append(0.0, cumulative), 2)[1:-1]
    shares = (np.arange(VALUES - len(used)) + 0.5) / (VALUES - len(used))
    added = np.interp(shares * cumulative[-1], bounds, np.stack([ordered[first], ordered[last]], axis=1).ravel())
    return np.sort(np.concatenate([used, added]))


def _padded(entries: NDArray[np.float32]) -> NDArray[np.float32]:
    return np.pad(entries, (0, VALUES - len(entries)), mode="edge")


def _companded(ordered: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return VALUES entries whose density is the cube root of that of sorted numbers."""
    bins = 4096
    counts, edges = np.histogram(ordered, bins)
    cumulative = np.concatenate([[0.0], np.cumsum(np.cbrt(counts))])
    shares = (np.arange(VALUES) + 0.5) / VALUES
    entries: NDArray[np.float64] = np.interp(shares * cumulative[-1], cumulative, edges)
    return entries


def _middles(codebook: NDArray[Any]) -> NDArray[np.float64]:
    wide = codebook.astype(np.float64)
    return (wide[1:] + wide[:-1]) / 2


def nearest_entries(values: NDArray[Any], codebook: NDArray[np.float32]) -> NDArray[np.uint8]:
    """Return the index of the nearest entry of an ascending codebook for each number, as uint8."""
    return np.searchsorted(_middles(codebook), values.astype(np.float64)).astype(np.uint8)


def palette(rows: NDArray[np.float32], size: int) -> tuple[NDArray[np.float32], NDArray[np.int64]]:
    """Return at most `size` vectors [K, D] that represent rows [n, D], and the index of each row's vector, [n].

    Rows are clustered in two levels: each of `_COARSE` clusters is divided into a number of clusters that is
    proportional to its squared error. A row is compared with some hundred centers rather than with all of them.
    """
    distinct, labels = _distinct_rows(rows, size)
    if distinct is not None:
        return distinct, labels
    sample = rows[:: max(1, len(rows) // _COARSE_ROWS)]
    coarse = _lloyd(sample, _start(sample, _COARSE), _COARSE_ITERATIONS)
    groups, distances = _nearest_rows(rows, coarse)
    counts = np.bincount(groups, minlength=len(coarse))
    errors = np.bincount(groups, weights=distances, minlength=len(coarse))
    shares = np.minimum(counts, np.maximum(1, np.floor((size - _COARSE) * errors / max(errors.sum(), 1e-30)) + 1))
    order = np.argsort(groups, kind="stable")
    centers: list[NDArray[np.float32]] = []
    first = 0
    for members, share in zip(np.split(order, np.cumsum(counts)[:-1]), shares.astype(int), strict=True):
        if not len(members):
            continue
        own = rows[members]
        own_centers = _lloyd(own, _start(own, share), _FINE_ITERATIONS)
        labels[members] = first + _nearest_rows(own, own_centers)[0]
        centers.append(own_centers)
        first += len(own_centers)
    return np.concatenate(centers), labels


def _distinct_rows(rows: NDArray[np.float32], size: int) -> tuple[NDArray[np.float32] | None, NDArray[np.int64]]:
    """Return the distinct rows and each row's index among them; None and zeros if there are more than `size`."""
    none = None, np.zeros(len(rows), np.int64)
    keys = np.ascontiguousarray(rows).view(np.dtype((np.void, rows.itemsize * rows.shape[1]))).reshape(-1)
    if len(np.unique(keys[: 2 * size])) > size:
        return none
    _, first, labels = np.unique(keys, return_index=True, return_inverse=True)
    return none if len(first) > size else (rows[first], labels.reshape(-1).astype(np.int64))


def _start(rows: NDArray[np.float32], count: int) -> NDArray[np.float32]:
    """Return `count` rows that are spread evenly along the direction of the largest variance."""
    middle = rows - rows.mean(axis=0)
    _, vectors = np.linalg.eigh(middle.T.astype(np.float64) @ middle)
    order = np.argsort(middle @ vectors[:, -1].astype(np.float32), kind="stable")
    return rows[order[((np.arange(count) + 0.5) / count * len(rows)).astype(np.int64)]]


def _lloyd(rows: NDArray[np.float32], centers: NDArray[np.float32], iterations: int) -> NDArray[np.float32]:
    """Return centers after some iterations of Lloyd's algorithm. Centers without rows stay."""
    if len(rows) <= len(centers):
        return centers
    for _ in range(iterations):
        labels, _ = _nearest_rows(rows, centers)
        order = np.argsort(labels, kind="stable")
        used, first = np.unique(labels[order], return_index=True)
        sums = np.add.reduceat(rows[order].astype(np.float64), first, axis=0)
        centers = centers.copy()
        centers[used] = sums / np.diff(np.append(first, len(rows)))[:, None]
    return centers


def _nearest_rows(
    rows: NDArray[np.float32], centers: NDArray[np.float32]
) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
    """Return the index of each row's nearest center, and its squared distance."""
    labels = np.empty(len(rows), np.int64)
    distances = np.empty(len(rows), np.float32)
    lengths = (centers**2).sum(axis=1)
    for start in range(0, len(rows), _BLOCK_ROWS):
        block = rows[start : start + _BLOCK_ROWS]
        scores = lengths - 2 * (block @ centers.T)
        nearest = scores.argmin(axis=1)
        labels[start : start + len(block)] = nearest
        distances[start : start + len(block)] = ((block - centers[nearest]) ** 2).sum(axis=1)
    return labels, distances


#: Name of the file that describes a scene, in an archive or a folder.
META_NAME = "meta.json"
#: Maximum bytes of meta.json, and of that of a part of a streamed SOG, which may have a thousand of them.
_MAX_META_BYTES, _MAX_PART_META_BYTES = 1 << 20, 1 << 16
#: Maximum number of Gaussians per byte of the images. Real scenes take ten bytes per Gaussian.
GAUSSIANS_PER_BYTE = 16
#: Maximum pixels of an image for a number of Gaussians. Writers round width and height up.
_PIXELS_PER_GAUSSIAN, _MORE_PIXELS = 2, 1 << 16
#: Bytes that a lossless image may take beyond 4 per pixel.
_IMAGE_OVERHEAD = 1 << 16

#: Palette vectors in a row of their image, and maximum number of vectors.
_PALETTE_COLUMNS = 64
_MAX_PALETTE = 1 << 16
#: Number of vectors below which a palette is not worth its loss.
_MIN_PALETTE = 1 << 14
_PALETTE_PIXELS = _MAX_PALETTE * scene_format.COEFFICIENTS[3]
_COEFFICIENTS_BY_WIDTH = {_PALETTE_COLUMNS * number: number for number in scene_format.COEFFICIENTS.values() if number}
#: Alpha of the rotations' image for w as the omitted component; x, y and z follow.
_FIRST_TAG = 252
_PNG_MAGIC = b"\x89PNG\r\n\x1a\n"

#: Number and kind of images by property.
_IMAGES = {"means": 2, "scales": 1, "quats": 1, "sh0": 1, "shN": 2}
#: File names: without folders, so that no other files are read.
_NAME = re.compile(r"[\w-][\w.-]{0,99}")

#: Effort of lossless compression, 0 to 100.
_EFFORT = 50


@dataclass(frozen=True)
class SogHeader(scene_format.SceneHeader):
    """Header of a SOG scene.

    Attributes:
        names: File names of the images, by property.
        bounds: Lowest and highest positions on the logarithmic scale, [2, 3].
        scales: Log scale of each byte, by axis, [3, 256].
        colors: SH coefficient of degree 0 of each byte, by channel, [3, 256].
        opacities: Logit of each byte, [256].
        harmonics: SH coefficient of each byte of the palette, [256]; None without spherical harmonics.
        vectors: Declared number of vectors of the palette; None if the file does not state it.
    """

    names: dict[str, list[str]]
    bounds: NDArray[np.float64]
    scales: NDArray[np.float64]
    colors: NDArray[np.float64]
    opacities: NDArray[Any]
    harmonics: NDArray[np.float64] | None
    vectors: int | None


class SogFiles:
    """Files of a SOG scene, of a streamed SOG, or of a part of one: those of an archive, or those in a folder.

    Args:
        path: Path of the archive, or of a file in the folder.
        archive: Open archive; None for a folder.
        folder: Prefix of all names, such as "0_0/".
    """

    def __init__(self, path: Path, archive: zipfile.ZipFile | None = None, folder: str = "") -> None:
        self.path, self.archive, self.folder = path, archive, folder

    def part(self, folder: str) -> "SogFiles":
        """Return the files with a further prefix."""
        return SogFiles(self.path, self.archive, self.folder + folder)

    def size(self, name: str) -> int:
        """Return an upper bound for the bytes of a file: its size, or that of the archive, whose list may be wrong."""
        with reading_scene(self.path):
            return (self.path if self.archive else self.path.parent / (self.folder + name)).stat().st_size

    def load(self, name: str, limit: int, *, whole: bool = True) -> bytes:
        """Return the content of a file of at most `limit` bytes, or its first `limit` bytes if `whole` is False."""
        where = self.folder + name
        try:
            with self._open(where) as file:
                data = file.read(limit + whole)
        except KeyError as error:
            raise SceneError(
                f"{self.path}: is a ZIP archive without {where}, so no SOG scene. Unpack it and give the scene in it, "
                "or export the scene again."
            ) from error
        except OSError as error:
            raise SceneError(
                f"{self.path}: {where} cannot be read: {error.strerror}. Give the whole folder, or an archive."
            ) from error
        except (zipfile.BadZipFile, zlib.error, EOFError, RuntimeError, ValueError, struct.error) as error:
            raise SceneError(f"{self.path}: {where} is damaged: {error}. Copy or export the scene again.") from error
        if len(data) > limit:
            raise SceneError(
                f"{self.path}: {where} has more than {limit} bytes, too many for this scene. Export it again."
            )
        return data

    def _open(self, where: str) -> IO[bytes]:
        if self.archive is None:
            return (self.path.parent / where).open("rb")
        if self.archive.getinfo(where).compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
            raise zipfile.BadZipFile("its compression is not supported")
        return self.archive.open(where)

    def meta(self) -> bytes:
        """Return the content of meta.json."""
        name = META_NAME if self.archive or self.folder else self.path.name
        return self.load(name, _MAX_PART_META_BYTES if self.folder else _MAX_META_BYTES)

    def dimensions(self, name: str, least: int, most: int | None = None) -> tuple[int, int]:
        """Return width and height of a WebP or PNG image, from its first bytes alone.

        Args:
            least: Minimum number of pixels.
            most: Maximum number of pixels; None for the largest image that a writer would create for `least` Gaussians.
        """
        head = self.load(name, 30, whole=False).ljust(30, b"\0")
        kind, size = head[12:16], None
        if kind == b"VP8L":
            bits = int.from_bytes(head[21:25], "little")
            size = (bits & 16383) + 1, (bits >> 14 & 16383) + 1
        elif kind == b"VP8X":
            size = int.from_bytes(head[24:27], "little") + 1, int.from_bytes(head[27:30], "little") + 1
        if head[:4] != b"RIFF" or head[8:12] != b"WEBP":
            size = struct.unpack_from(">2I", head, 16) if head.startswith(_PNG_MAGIC) else None
        if size is None:
            raise SceneError(
                f"{self.path}: {self.folder}{name} is no lossless WebP or PNG image. Export the scene again."
            )
        if not least <= size[0] * size[1] <= (_PIXELS_PER_GAUSSIAN * least + _MORE_PIXELS if most is None else most):
            raise SceneError(
                f"{self.path}: {self.folder}{name} has {size[0]} x {size[1]} pixels, which do not fit {least} "
                "Gaussians: meta.json or the image is wrong. Export the scene again."
            )
        return size

    def image(self, name: str, least: int, most: int | None = None) -> tuple[tuple[int, int], bytes]:
        """Return width and height of an image, and its file. Arguments are those of `dimensions`."""
        size = self.dimensions(name, least, most)
        return size, self.load(name, 4 * size[0] * size[1] + _IMAGE_OVERHEAD)

    def pixels(self, name: str, least: int, most: int | None = None) -> NDArray[np.uint8]:
        """Return an image [height, width, 4] uint8. Arguments are those of `dimensions`."""
        size, data = self.image(name, least, most)
        try:
            with Image.open(io.BytesIO(data), formats=["WEBP", "PNG"]) as image:
                if image.size != size or getattr(image, "n_frames", 1) != 1 or image.mode.startswith("I"):
                    raise ValueError("it is animated, its sizes differ, or it has more than 8 bits")
                return np.asarray(image.convert("RGBA"))
        except (OSError, ValueError, SyntaxError, Image.DecompressionBombError) as error:
            raise SceneError(
                f"{self.path}: {self.folder}{name} is not a readable WebP or PNG image: {error}. Export the scene "
                "again."
            ) from error


def _matches(start: scene_format.FileStart) -> bool:
    head = start.head
    archive = head.startswith(ZIP_MAGIC) and known_kind(start.path, head, SCENES) is None
    return archive or (head.lstrip().startswith(b"{") and b'"means"' in head)


@contextmanager
def _opened(path: Path) -> Iterator[SogFiles]:
    """Yield the files of a scene, given an archive, or a file in a folder."""
    if scene_format.read_bytes(path, 0, 4) != ZIP_MAGIC:
        yield SogFiles(path)
        return
    archive_list(path)
    try:
        archive = zipfile.ZipFile(path)
    except (OSError, zipfile.BadZipFile, NotImplementedError, ValueError, struct.error) as error:
        raise SceneError(f"{path}: is a damaged ZIP archive: {error}. Copy or export the scene again.") from error
    with archive:
        yield SogFiles(path, archive)


def _read_header(start: scene_format.FileStart) -> SogHeader:
    with _opened(start.path) as files:
        return sog_header(files)


def sog_header(files: SogFiles) -> SogHeader:
    """Return the checked header of a SOG scene."""
    text, where = files.meta(), f"{files.path}: {files.folder}{META_NAME}"
    try:
        header = _parsed(files, json.loads(text))
    except scene_format.WRONG_JSON as error:
        raise SceneError(
            f"{where} is not that of a SOG scene ({repr(error)[:200]}). Export the scene again."
        ) from error
    name = header.names["means"][0]
    files.dimensions(name, header.count)
    if header.count > GAUSSIANS_PER_BYTE * files.size(name):
        raise SceneError(
            f"{where} declares {header.count} Gaussians, more than {files.size(name)} bytes can hold: "
            "the file is truncated or meta.json is wrong. Copy or export the scene again."
        )
    return header


def _parsed(files: SogFiles, meta: dict[str, Any]) -> SogHeader:
    """Parse meta.json. Errors of `WRONG_JSON` mean that a value is missing or wrong."""
    refuse_changed_meaning(files.path, (*meta, str(meta.get("format"))))
    version = meta.get("version", 1)
    if version not in (1, 2):
        raise SceneError(
            f"{files.path}: is SOG of version {str(version)[:20]}, which cannot be read. {converted('scene.sog')}"
        )
    if "files" not in meta["means"] and "shape" in meta["means"]:
        raise SceneError(
            f"{files.path}: describes a scene that gsplat compressed (PngCompression), which has another layout. "
            "Decompress it with gsplat, and write a PLY with `gsplat.export_splats`."
        )
    names = {name: meta[name]["files"] for name in _IMAGES if name in meta or name != "shN"}
    for name, own in names.items():
        if type(own) is not list or len(own) != _IMAGES[name] or not all(_NAME.fullmatch(each) for each in own):
            raise ValueError(f"files of {name}: {own}")
    count = scene_format.whole_number("count", meta["count"] if version == 2 else meta["means"]["shape"][0], 1)
    bounds = np.stack([scene_format.json_numbers(meta["means"][side], 3) for side in ("mins", "maxs")])
    table = _codebook if version == 2 else _steps
    scales, colors = table(meta["scales"], 3), table(meta["sh0"], 4)
    opacities = scene_format.OPACITY_LOGITS if version == 2 else colors[3]
    coefficients, harmonics, vectors = 0, None, None
    if "shN" in names:
        width, _ = files.dimensions(names["shN"][0], 1, _PALETTE_PIXELS)
        if width not in _COEFFICIENTS_BY_WIDTH:
            raise ValueError(f"width of {names['shN'][0]}: {width}")
        coefficients, harmonics = _COEFFICIENTS_BY_WIDTH[width], table(meta["shN"], 1)[0]
        if meta["shN"].get("count") is not None:
            vectors = scene_format.whole_number("count of shN", meta["shN"]["count"], 1)
    extras = meta["extras"] if isinstance(meta.get("extras"), dict) else {}
    model = meta.get("model", "antialiased" if meta.get("antialias") is True else "default")
    tag = scene_format.extras_tag({**extras, "model": model}, "meta.json")
    return SogHeader(
        *(SOG, count, coefficients, names, bounds, scales[:3], colors[:3], opacities, harmonics, vectors),
        tag=tag,
    )


def _codebook(entry: dict[str, Any], channels: int) -> NDArray[np.float64]:
    """Return the values of each byte, the same for all channels, [channels, 256]. Missing values are NaN.

    Older writers left the first value of a codebook empty (null). As in PlayCanvas' reader, it is the second value less
    the mean step of the others.
    """
    codebook = entry["codebook"]
    if not 0 < len(codebook) <= VALUES:
        raise ValueError(f"codebook of {len(codebook)} values")
    numbers = scene_format.json_numbers(codebook, len(codebook))
    if len(numbers) > 1 and codebook[0] is None:
        numbers[0] = numbers[1] + (numbers[1] - numbers[-1]) / (VALUES - 1)
    values = np.pad(numbers, (0, VALUES - len(numbers)), constant_values=np.nan)
    return np.tile(values, (channels, 1))


@np.errstate(over="ignore", invalid="ignore")  # non-finite results are reported later
def _steps(entry: dict[str, Any], channels: int) -> NDArray[np.float64]:
    """Return the values of each byte in version 1 by channel, [channels, 256]."""
    low, high = (scene_format.json_numbers(entry[side], channels)[:, None] for side in ("mins", "maxs"))
    return low + (high - low) * (np.arange(VALUES) / 255)


def _read(file: scene_format.OpenScene, header: scene_format.SceneHeader, into: scene_format.Arrays) -> None:
    assert isinstance(header, SogHeader)
    with _opened(file.path) as files:
        read_sog(files, header, into)


@np.errstate(over="ignore", invalid="ignore")  # non-finite results are reported later
def read_sog(files: SogFiles, header: SogHeader, into: scene_format.Arrays) -> None:
    """Fill the arrays of a scene."""
    where = f"{files.path}: {files.folder}"
    read_positions(files, header, into["means"])
    quats = _pixels(files, header, "quats")
    for block in scene_format.blocks(header.count):
        index = quats[block, 3].astype(np.int64) - _FIRST_TAG
        if index.min() < 0:
            raise SceneError(f"{where}{header.names['quats'][0]} has no valid rotations. Export the scene again.")
        into["quats"][block] = scene_format.with_largest(index, (quats[block, :3] / 255 - 0.5) * np.sqrt(2))
    colors = _pixels(files, header, "sh0")
    into["scales"][:] = _looked_up(header.scales, _pixels(files, header, "scales"))
    into["sh_dc"][:] = _looked_up(header.colors, colors)
    into["opacities"][:] = header.opacities.astype(np.float32)[colors[:, 3]]
    if header.harmonics is not None:
        stored = files.pixels(header.names["shN"][0], 1, _PALETTE_PIXELS)[..., :3]
        entries = header.harmonics.astype(np.float32)[stored.reshape(-1, header.coefficients, 3)]
        labels = _pixels(files, header, "shN", 1)[:, :2].astype(np.int64) @ np.array([1, 256])
        vectors = min(len(entries), header.vectors or len(entries))
        if labels.max() >= vectors:
            raise SceneError(
                f"{where}{header.names['shN'][1]} refers to vector {labels.max()} of {vectors}. Export the scene again."
            )
        into["sh_rest"][:] = entries[labels]


def _pixels(files: SogFiles, header: SogHeader, name: str, index: int = 0) -> NDArray[np.uint8]:
    """Return the pixels of an image of a property, [number of Gaussians, 4] uint8."""
    return files.pixels(header.names[name][index], header.count).reshape(-1, 4)[: header.count]


@np.errstate(over="ignore", invalid="ignore")  # non-finite results are reported later
def read_positions(files: SogFiles, header: SogHeader, into: NDArray[np.float32]) -> None:
    """Fill an array [n, 3] with the positions of a scene."""
    low, high = (_pixels(files, header, "means", index) for index in (0, 1))
    for block in scene_format.blocks(header.count):
        steps = (low[block, :3] | high[block, :3].astype(np.uint16) << 8) / 65535
        values = header.bounds[0] + (header.bounds[1] - header.bounds[0]) * steps
        into[block] = np.sign(values) * np.expm1(np.abs(values))


@np.errstate(over="ignore", invalid="ignore")  # non-finite results are reported later
def _looked_up(tables: NDArray[np.float64], pixels: NDArray[np.uint8]) -> NDArray[np.float32]:
    """Return the values of pixels [n, 4] in a table for each of three channels, [n, 3]."""
    return np.stack([tables[axis].astype(np.float32)[pixels[:, axis]] for axis in range(3)], axis=1)


def recolored(files: SogFiles, header: SogHeader, change: NDArray[np.float32]) -> dict[str, bytes]:
    """Return the files of a SOG scene with other colors, by name. All but these keep their bytes.

    Args:
        change: Change of the SH coefficients of degree 0, [n, 3].

    Raises:
        OutputError: If colors change, and the scene is SOG of version 1, which has no codebooks.
    """
    stored = {
        name: files.image(name, *((1, _PALETTE_PIXELS) if (role, index) == ("shN", 0) else (header.count,)))[1]
        for role, names in header.names.items()
        for index, name in enumerate(names)
    } | {META_NAME: files.meta()}
    if not change.any():
        return stored
    meta, (name,) = json.loads(stored[META_NAME]), header.names["sh0"]
    if meta.get("version") != 2:
        raise OutputError(
            f"{files.path}: {files.folder}{META_NAME} is SOG of version 1. Write it again with splat-transform."
        )
    image = files.pixels(name, header.count)
    pixels = image.reshape(-1, 4).copy()
    colors = _looked_up(header.colors, pixels[: header.count]) + change
    codebook = value_codebook(colors)
    pixels[: header.count, :3] = nearest_entries(colors, codebook)
    meta["sh0"]["codebook"] = codebook.tolist()
    return stored | {name: _webp(pixels, image.shape[1]), META_NAME: json.dumps(meta).encode()}


def _write(output: BinaryIO, arrays: scene_format.Arrays, rendering: Rendering) -> None:
    """Write a SOG archive. Gaussians are sorted along a space-filling curve, which compresses better."""
    count, coefficients = arrays["sh_rest"].shape[:2]
    steps, bounds = _encoded_positions(arrays["means"])
    # the order of what is written, so that a scene from a SOG file stays in order
    order = scene_format.along_curve(steps.astype(np.float32))
    sorted_arrays = {name: array[order] for name, array in arrays.items()}
    images = {
        "means_l.webp": (steps[order] & 255).astype(np.uint8),
        "means_u.webp": (steps[order] >> 8).astype(np.uint8),
    }
    largest, three = scene_format.without_largest(sorted_arrays["quats"])
    quats = scene_format.to_steps(three / np.sqrt(2) + 0.5, 255).astype(np.uint8)
    images["quats.webp"] = np.column_stack([quats, (_FIRST_TAG + largest).astype(np.uint8)])
    scales, colors = value_codebook(arrays["scales"]), value_codebook(arrays["sh_dc"])
    images["scales.webp"] = nearest_entries(sorted_arrays["scales"], scales)
    images["sh0.webp"] = np.column_stack(
        [nearest_entries(sorted_arrays["sh_dc"], colors), scene_format.opacity_bytes(sorted_arrays["opacities"])]
    )
    meta: dict[str, Any] = {
        "version": 2,
        "count": count,
        "means": {"mins": bounds[0].tolist(), "maxs": bounds[1].tolist(), "files": ["means_l.webp", "means_u.webp"]},
        "scales": {"codebook": scales.tolist(), "files": ["scales.webp"]},
        "quats": {"files": ["quats.webp"]},
        "sh0": {"codebook": colors.tolist(), "files": ["sh0.webp"]},
    }
    extras = scene_format.extras_of(rendering)
    meta |= {"model": extras.pop("model")} if "model" in extras else {}
    meta |= {"extras": extras} if extras else {}
    if coefficients:
        size = min(_MAX_PALETTE, max(_MIN_PALETTE, 1 << (count.bit_length() - 1)))
        vectors, labels = palette(sorted_arrays["sh_rest"].reshape(count, -1), size)
        harmonics = value_codebook(vectors)
        vectors, merged = palette(harmonics[nearest_entries(vectors, harmonics)], len(vectors))
        labels = merged[labels]
        images["shN_labels.webp"] = np.column_stack([labels & 255, labels >> 8, 0 * labels]).astype(np.uint8)
        images["shN_centroids.webp"] = nearest_entries(vectors, harmonics).reshape(-1, 3)
        meta["shN"] = {
            "count": len(vectors),
            "bands": SH_DEGREES[coefficients],
            "codebook": harmonics.tolist(),
            "files": ["shN_centroids.webp", "shN_labels.webp"],
        }
    side = -(-math.isqrt(count - 1) // 4) * 4 + 4 if count > 1 else 4
    with zipfile.ZipFile(output, "w") as archive:
        for name, pixels in images.items():
            width = _PALETTE_COLUMNS * coefficients if name == "shN_centroids.webp" else side
            archive.writestr(zipfile.ZipInfo(name), _webp(pixels, width))
        archive.writestr(zipfile.ZipInfo(META_NAME), json.dumps(meta))


def _encoded_positions(means: NDArray[np.float32]) -> tuple[NDArray[np.uint32], NDArray[np.float64]]:
    """Return positions as 16-bit steps, [n, 3], and their bounds on the logarithmic scale, [2, 3]."""
    values = np.sign(means) * np.log1p(np.abs(means.astype(np.float64)))
    low, high = values.min(axis=0), values.max(axis=0)
    return scene_format.to_steps((values - low) / np.where(high > low, high - low, 1), 65535), np.stack([low, high])


def _webp(pixels: NDArray[np.uint8], width: int) -> bytes:
    """Encode pixels [n, 3 or 4] as a lossless WebP image, whose last pixels are 0."""
    height = -(-len(pixels) // width)
    padded = np.zeros((height * width, pixels.shape[1]), np.uint8)
    padded[: len(pixels)] = pixels
    file = io.BytesIO()
    # "exact" preserves the colors of transparent pixels, which are Gaussians of low opacity
    Image.fromarray(padded.reshape(height, width, -1)).save(file, "WEBP", lossless=True, exact=True, quality=_EFFORT)
    return file.getvalue()


SOG = scene_format.SceneFormat("sog", "SOG", 14, _matches, _read_header, _read, _write)


#: Name of the index in a folder or an archive.
INDEX_NAME = "lod-meta.json"
_MAX_INDEX_BYTES = 1 << 21
#: Maximum number of SOG scenes; usual ones have half a million Gaussians.
_MAX_PARTS = 1024
#: Path of the meta.json of a part: in folders below the index, so that no other files are read.
_PART = re.compile(rf"((?:[\w-][\w.-]{{0,99}}/){{1,4}}){re.escape(META_NAME)}")


@dataclass(frozen=True)
class StreamedHeader(scene_format.SceneHeader):
    """Header of a streamed SOG.

    Attributes:
        parts: Headers of all parts by folder, those of the scene first: of its finest level, and of the environment.
        rows: Slices of the Gaussians of each part of the scene among those of the scene.
    """

    parts: dict[str, SogHeader]
    rows: dict[str, slice]


@contextmanager
def _opened_levels(path: Path) -> Iterator[tuple[SogFiles, bytes]]:
    """Yield the files of a streamed SOG, and its index."""
    with _opened(path) as files:
        name = path.name
        if files.archive is not None:
            names = [each for each in files.archive.namelist() if f"/{each}".endswith(f"/{INDEX_NAME}")]
            above = min(names, key=len, default="").removesuffix(INDEX_NAME)  # an archive may hold the folder
            files, name = files.part(above), INDEX_NAME
        yield files, files.load(name, _MAX_INDEX_BYTES)


def _matches_streamed(start: scene_format.FileStart) -> bool:
    if not start.head.startswith(ZIP_MAGIC):
        return start.head.lstrip().startswith(b"{") and b'"lodLevels"' in start.head
    if known_kind(start.path, start.head, SCENES):
        return False
    try:
        return INDEX_NAME.encode() in archive_list(start.path)
    except SceneError:  # raised again by the reader of SOG
        return False


def _read_streamed_header(start: scene_format.FileStart) -> StreamedHeader:
    with _opened_levels(start.path) as (files, text):
        try:
            folders = _levels(json.loads(text))
        except scene_format.WRONG_JSON as error:
            raise SceneError(
                f"{start.path}: {INDEX_NAME} is not that of a streamed SOG ({repr(error)[:200]}). Export the scene "
                "again."
            ) from error
        parts = {folder: _part(files, folder, *entry) for folder, entry in folders.items()}
    levels = sorted({level for level, _ in folders.values() if level is not None})
    if not levels:
        raise SceneError(f"{start.path}: {INDEX_NAME} refers to no Gaussians. Export the scene again.")
    scene = {folder: parts[folder] for folder, (level, _) in folders.items() if level in (levels[0], None)}
    ends = [0, *accumulate(part.count for part in scene.values())]
    if files.archive and ends[-1] > GAUSSIANS_PER_BYTE * start.size:
        raise SceneError(f"{start.path}: declares {ends[-1]} Gaussians, more than it can hold. Export the scene again.")
    notes = (f"the finest of {len(levels)} levels of detail is read; a .zip of it has all of them, with its colors",)
    return StreamedHeader(
        STREAMED_SOG,
        ends[-1],
        max(part.coefficients for part in scene.values()),
        scene | parts,
        {folder: slice(*span) for folder, span in zip(scene, pairwise(ends), strict=True)},
        notes=notes if len(levels) > 1 else (),
        tag=next(iter(scene.values())).tag,
    )


def _levels(index: dict[str, Any]) -> dict[str, tuple[int | None, list[tuple[int, int]]]]:
    """Return the level of each part, and the ranges of it that the tree refers to, by the part's folder.

    Errors of `WRONG_JSON` mean that a value is missing or wrong.
    """
    if index.get("version", 1) != 1:
        raise ValueError(f"version: {index['version']}")
    names, most = index["filenames"], index["lodLevels"]
    if len(names) > _MAX_PARTS:
        raise ValueError(f"{len(names)} files, of at most {_MAX_PARTS}")
    parts: dict[str, tuple[int | None, list[tuple[int, int]]]] = {}
    nodes = [index["tree"]]
    while nodes:
        node = nodes.pop()
        nodes += node.get("children", [])
        for level, range_ in node.get("lods", {}).items():
            file, offset, count = numbers = [range_[name] for name in ("file", "offset", "count")]
            if not all(type(value) is int and value >= 0 for value in numbers) or not 0 <= int(level) < most:
                raise ValueError(f"level {level} of {most}: {range_}")
            own, spans = parts.setdefault(_folder(names[file]), (int(level), []))
            if own != int(level):
                raise ValueError("a file has several levels")
            spans.append((offset, count))
    parts = {folder: parts[folder] for folder in map(_folder, names) if folder in parts}
    if index.get("environment"):
        folder = _folder(index["environment"])
        if folder in parts:
            raise ValueError(f"environment: {folder}")
        parts[folder] = None, []
    return parts


def _folder(name: str) -> str:
    """Return the folder of a part, with a slash at its end, given the path of its meta.json."""
    match = _PART.fullmatch(name)
    if match is None:
        raise ValueError(f"file {name[:100]!r}: not the {META_NAME} of a folder beside {INDEX_NAME}")
    return match[1]


def _part(files: SogFiles, folder: str, level: int | None, ranges: list[tuple[int, int]]) -> SogHeader:
    """Return the header of a part, after checking that the tree refers to each of its Gaussians once."""
    header = sog_header(files.part(folder))
    end = 0
    for offset, count in sorted(ranges):
        end = end + count if offset == end else -1
    if level is not None and end != header.count:
        raise SceneError(
            f"{files.path}: {folder}{META_NAME} has {header.count} Gaussians, but {INDEX_NAME} does not refer to each "
            "once. Export the scene again."
        )
    return header


def _read_streamed(
    file: scene_format.OpenScene, header: scene_format.SceneHeader, into: scene_format.Arrays
) -> scene_format.SceneHeader:
    assert isinstance(header, StreamedHeader)
    with _opened_levels(file.path) as (files, _):
        for folder, rows in header.rows.items():
            part = header.parts[folder]
            arrays = {name: array[rows] for name, array in into.items()}
            arrays["sh_rest"][:, part.coefficients :] = 0
            arrays["sh_rest"] = arrays["sh_rest"][:, : part.coefficients]
            read_sog(files.part(folder), part, arrays)
    notes = (note for folder in header.rows for note in header.parts[folder].notes)
    return replace(header, notes=tuple(dict.fromkeys((*header.notes, *notes))))


def pack(index: Path, target: Path) -> None:
    """Write a streamed SOG to an archive, given its index in a folder.

    Raises:
        SceneError: If it is no streamed SOG, or a file is missing.
    """
    header = _read_streamed_header(scene_format.FileStart(index, b"", index.stat().st_size))
    with _opened_levels(index) as (files, text), zipfile.ZipFile(target, "w") as archive:
        for folder, part in header.parts.items():
            unchanged = np.zeros((part.count, 3), np.float32)
            for name, data in recolored(files.part(folder), part, unchanged).items():
                archive.writestr(zipfile.ZipInfo(folder + name), data)
        archive.writestr(zipfile.ZipInfo(INDEX_NAME), text)


def write_recolored(
    original: Path,
    header: StreamedHeader,
    means: NDArray[np.float32],
    colors: NDArray[np.float32],
    archive: zipfile.ZipFile,
) -> None:
    """Archive a streamed SOG with the colors of a scene that is its finest level with other colors.

    A Gaussian of a coarser level takes the change of the nearest one of the finest level. All but colors keeps its
    bytes, and everything does in parts in which none changes.

    Args:
        original: Streamed SOG: its index or an archive.
        means, colors: Positions and SH coefficients of degree 0 of the scene, [n, 3].
        archive: Open archive that gets the files; the index comes last.

    Raises:
        SceneError: If `original` cannot be read.
        OutputError: If the scene has other Gaussians.
    """
    from scipy.spatial import cKDTree

    with _opened_levels(original) as (files, text):
        own: scene_format.Arrays = {name: np.empty((header.count, 3), np.float32) for name in ("means", "sh_dc")}
        for folder, rows in header.rows.items():
            part = header.parts[folder]
            read_positions(files.part(folder), part, own["means"][rows])
            own["sh_dc"][rows] = _looked_up(part.colors, _pixels(files.part(folder), part, "sh0"))
        if not np.array_equal(means, own["means"]):
            raise OutputError(
                f"The scene's Gaussians are not those of the finest level of {original}, in the same order. Give that "
                "level with other colors, as a PLY, without --refine."
            )
        change, tree = colors - own["sh_dc"], cKDTree(means)
        for folder, part in header.parts.items():
            if folder in header.rows:
                changed = change[header.rows[folder]]
            else:
                positions = np.empty((part.count, 3), np.float32)
                read_positions(files.part(folder), part, positions)
                changed = change[tree.query(np.nan_to_num(positions))[1]]
            for name, data in recolored(files.part(folder), part, changed).items():
                archive.writestr(zipfile.ZipInfo(folder + name), data)
        archive.writestr(zipfile.ZipInfo(INDEX_NAME), text)


STREAMED_SOG = scene_format.SceneFormat(
    "zip", "streamed SOG", 14, _matches_streamed, _read_streamed_header, _read_streamed, media_type="application/zip"
)
