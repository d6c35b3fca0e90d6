"""Reader and writer of PlayCanvas' SOG: a ZIP archive, or a folder, with meta.json and WebP images.

Pixel i of each image belongs to Gaussian i. Positions are 16-bit steps on a logarithmic scale, in two images. Scales
and colors are indices into codebooks of 256 values. Rotations have three components of 8 bits. SH coefficients are a
palette of up to 65,536 vectors. Version 1 has linear steps between bounds in place of codebooks. The layout is that of
https://developer.playcanvas.com/user-manual/gaussian-splatting/formats/sog. Axes are those of the PLY. The field
`model` of meta.json is the render mode, as splat-transform writes it. Written files have their blur in `extras`, which
is for programs' own values.
"""

from __future__ import annotations

import io
import json
import math
import re
import struct
import zipfile
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any, BinaryIO

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from sgsst_core.constants import SH_DEGREES
from sgsst_core.errors import OutputError, SceneError
from sgsst_core.files.advice import converted, is_checkpoint, is_usdz
from sgsst_core.files.formats.codebooks import VALUES, nearest_entries, palette, value_codebook
from sgsst_core.files.formats.quantized import (
    OPACITY_LOGITS,
    along_curve,
    opacity_bytes,
    to_steps,
    with_largest,
    without_largest,
)
from sgsst_core.files.formats.scene_format import (
    COEFFICIENTS,
    Arrays,
    FileStart,
    OpenScene,
    SceneFormat,
    SceneHeader,
    about_surplus,
    blocks,
    extras_of,
    extras_tag,
    json_numbers,
    read_bytes,
    without_padding,
)
from sgsst_core.scene.rendering import Rendering

#: Name of the file that describes a scene, in an archive or a folder.
META_NAME = "meta.json"
_ZIP_MAGIC = b"PK\x03\x04"
#: Record at the end of a ZIP archive, and its signature; archives above 4 GB have a locator of another record before.
_END = struct.Struct("<4s4H2LH")
_END_MAGIC, _LOCATOR_MAGIC, _LOCATOR_BYTES = b"PK\x05\x06", b"PK\x06\x07", 20
_MAX_COMMENT_BYTES = 1 << 16
#: Maximum number of files in an archive, and bytes of their list and of meta.json.
_MAX_ENTRIES = 256
_MAX_LIST_BYTES = 1 << 18
_MAX_META_BYTES = 1 << 20
#: Maximum number of Gaussians per byte of the images. Real scenes take ten bytes per Gaussian.
_GAUSSIANS_PER_BYTE = 16
#: Maximum pixels of an image for a number of Gaussians. Writers round width and height up.
_PIXELS_PER_GAUSSIAN, _MORE_PIXELS = 2, 1 << 16
#: Bytes that a lossless image may take beyond 4 per pixel.
_IMAGE_OVERHEAD = 1 << 16
#: Largest width and height of a WebP image.
_MAX_SIDE = 16383

#: Palette vectors in a row of their image, and maximum number of vectors.
_PALETTE_COLUMNS = 64
_MAX_PALETTE = 1 << 16
#: Number of vectors below which a palette is not worth its loss.
_MIN_PALETTE = 1 << 14
_PALETTE_PIXELS = _MAX_PALETTE * COEFFICIENTS[3]
_COEFFICIENTS_BY_WIDTH = {_PALETTE_COLUMNS * number: number for number in COEFFICIENTS.values() if number}
#: Alpha of the rotations' image for w as the omitted component; x, y and z follow.
_FIRST_TAG = 252

#: Number and kind of images by property.
_IMAGES = {"means": 2, "scales": 1, "quats": 1, "sh0": 1, "shN": 2}
#: File names: without folders, so that no other files are read.
_NAME = re.compile(r"[\w-][\w.-]{0,99}")
#: Errors of a meta.json with missing or wrong values.
_WRONG_META = (ValueError, TypeError, KeyError, IndexError, AttributeError, RecursionError, OverflowError)

#: Effort of lossless compression, 0 to 100.
_EFFORT = 50


@dataclass(frozen=True)
class SogHeader(SceneHeader):
    """Header of a SOG scene.

    Attributes:
        names: File names of the images, by property.
        bounds: Lowest and highest positions on the logarithmic scale, [2, 3].
        scales: Log scale of each byte, by axis, [3, 256].
        colors: SH coefficient of degree 0 of each byte, by channel, [3, 256].
        opacities: Logit of each byte, [256].
        harmonics: SH coefficient of each byte of the palette, [256]; None without spherical harmonics.
    """

    names: dict[str, list[str]]
    bounds: NDArray[np.float64]
    scales: NDArray[np.float64]
    colors: NDArray[np.float64]
    opacities: NDArray[Any]
    harmonics: NDArray[np.float64] | None


class _Files:
    """Files of a SOG scene: those of an archive, or those beside meta.json.

    Attributes:
        path: Path of the archive or of meta.json.
        surplus: Note on bytes before or after the archive.
    """

    def __init__(self, path: Path) -> None:
        self._archived = read_bytes(path, 0, 4) == _ZIP_MAGIC
        self.path = path
        self.surplus = _check_end(path) if self._archived else ()

    def meta(self) -> bytes:
        """Return the content of meta.json."""
        return self.load(META_NAME if self._archived else self.path.name, _MAX_META_BYTES)

    def size(self, name: str) -> int:
        """Return an upper bound for the bytes of a file: its size, or that of the archive, whose list may be wrong."""
        try:
            return (self.path if self._archived else self.path.with_name(name)).stat().st_size
        except OSError as error:
            raise self._unreadable(name, error) from error

    def load(self, name: str, limit: int, *, whole: bool = True) -> bytes:
        """Return the content of a file of at most `limit` bytes, or its first `limit` bytes if `whole` is False."""
        try:
            with self._open(name) as file:
                data = file.read(limit + whole)
        except KeyError as error:
            raise SceneError(
                f"{self.path}: is a ZIP archive without {name}, so no SOG scene. Unpack it, and give the scene in it."
            ) from error
        except OSError as error:
            raise self._unreadable(name, error) from error
        except (zipfile.BadZipFile, zlib.error, EOFError, RuntimeError, ValueError, struct.error) as error:
            raise SceneError(f"{self.path}: {name} is damaged: {error}. Copy or export the scene again.") from error
        if len(data) > limit:
            raise SceneError(
                f"{self.path}: {name} has more than {limit} bytes, too many for this scene. Export it again."
            )
        return data

    def _unreadable(self, name: str, error: OSError) -> SceneError:
        return SceneError(f"{self.path}: {name} cannot be read: {error.strerror}. Give the whole folder, or a .sog.")

    @contextmanager
    def _open(self, name: str) -> Iterator[IO[bytes]]:
        if not self._archived:
            with self.path.with_name(name).open("rb") as file:
                yield file
            return
        with zipfile.ZipFile(self.path) as archive:
            if archive.getinfo(name).compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
                raise zipfile.BadZipFile("its compression is not supported")
            with archive.open(name) as member:
                yield member

    def dimensions(self, name: str, least: int, most: int | None = None) -> tuple[int, int]:
        """Return width and height of a WebP image, from its first bytes alone.

        Args:
            name: Name of the image.
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
        if size is None or head[:4] != b"RIFF" or head[8:12] != b"WEBP":
            raise SceneError(f"{self.path}: {name} is not a lossless WebP image. Export the scene again.")
        if not least <= size[0] * size[1] <= (_PIXELS_PER_GAUSSIAN * least + _MORE_PIXELS if most is None else most):
            raise SceneError(
                f"{self.path}: {name} has {size[0]} x {size[1]} pixels, which do not fit {least} Gaussians: meta.json "
                "or the image is wrong. Export the scene again."
            )
        return size

    def pixels(self, name: str, least: int, most: int | None = None) -> NDArray[np.uint8]:
        """Return an image [height, width, 4] uint8. Arguments are those of `dimensions`."""
        size = self.dimensions(name, least, most)
        data = self.load(name, 4 * size[0] * size[1] + _IMAGE_OVERHEAD)
        try:
            with Image.open(io.BytesIO(data), formats=["WEBP"]) as image:
                if image.size != size or getattr(image, "n_frames", 1) != 1:
                    raise ValueError("it is animated, or its sizes differ")
                return np.asarray(image.convert("RGBA"))
        except (OSError, ValueError, SyntaxError, Image.DecompressionBombError) as error:
            raise SceneError(
                f"{self.path}: {name} is not a readable WebP image: {error}. Export the scene again."
            ) from error


def _check_end(path: Path) -> tuple[str, ...]:
    """Check the end of an archive before its list of files is read, and return the note on bytes around the archive."""
    with path.open("rb") as file:
        size = file.seek(0, io.SEEK_END)
        file.seek(max(0, size - _LOCATOR_BYTES - _END.size - _MAX_COMMENT_BYTES))
        tail = file.read()
    position = tail.rfind(_END_MAGIC)
    if position < 0 or position + _END.size > len(tail):
        raise SceneError(f"{path}: is a truncated ZIP archive. Copy or export the scene again.")
    entries, list_bytes, list_offset, comment_bytes = _END.unpack_from(tail, position)[4:]
    if (
        entries > _MAX_ENTRIES
        or list_bytes > _MAX_LIST_BYTES
        or tail[max(0, position - _LOCATOR_BYTES) : position].startswith(_LOCATOR_MAGIC)
    ):
        raise SceneError(f"{path}: is a ZIP archive of {entries} files, so no SOG scene. Unpack it first.")
    before = size - len(tail) + position - list_bytes - list_offset
    after = without_padding(tail[position + _END.size + comment_bytes :])
    return about_surplus(max(0, before) + len(after), "byte")


def _matches(start: FileStart) -> bool:
    head = start.head
    archive = head.startswith(_ZIP_MAGIC) and not is_checkpoint(head) and not is_usdz(head)
    return archive or (head.lstrip().startswith(b"{") and b'"means"' in head)


def _read_header(start: FileStart) -> SogHeader:
    files = _Files(start.path)
    text = files.meta()
    try:
        header = _parsed(files, json.loads(text))
    except _WRONG_META as error:
        raise SceneError(
            f"{start.path}: meta.json is not that of a SOG scene ({repr(error)[:200]}). Export the scene again."
        ) from error
    name = header.names["means"][0]
    files.dimensions(name, header.count)
    if header.count > _GAUSSIANS_PER_BYTE * files.size(name):
        raise SceneError(
            f"{start.path}: meta.json declares {header.count} Gaussians, more than {files.size(name)} bytes can hold: "
            "the file is truncated or meta.json is wrong. Copy or export the scene again."
        )
    return header


def _parsed(files: _Files, meta: dict[str, Any]) -> SogHeader:
    """Parse meta.json. Errors of `_WRONG_META` mean that a value is missing or wrong."""
    version = meta.get("version", 1)
    if version not in (1, 2):
        raise SceneError(
            f"{files.path}: is SOG of version {str(version)[:20]}, which cannot be read. {converted('scene.sog')}"
        )
    names = {name: meta[name]["files"] for name in _IMAGES if name in meta or name != "shN"}
    for name, own in names.items():
        if type(own) is not list or len(own) != _IMAGES[name] or not all(_NAME.fullmatch(each) for each in own):
            raise ValueError(f"files of {name}: {own}")
    count = meta["count"] if version == 2 else meta["means"]["shape"][0]
    if type(count) is not int or count < 1:
        raise ValueError(f"count: {count}")
    bounds = np.stack([json_numbers(meta["means"][side], 3) for side in ("mins", "maxs")])
    table = _codebook if version == 2 else _steps
    scales, colors = table(meta["scales"], 3), table(meta["sh0"], 4)
    opacities = OPACITY_LOGITS if version == 2 else colors[3]
    coefficients, harmonics = 0, None
    if "shN" in names:
        width, _ = files.dimensions(names["shN"][0], 1, _PALETTE_PIXELS)
        if width not in _COEFFICIENTS_BY_WIDTH:
            raise ValueError(f"width of {names['shN'][0]}: {width}")
        coefficients, harmonics = _COEFFICIENTS_BY_WIDTH[width], table(meta["shN"], 1)[0]
        if COEFFICIENTS.get(meta["shN"].get("bands"), coefficients) != coefficients:
            raise ValueError(f"bands: {meta['shN']['bands']} with {coefficients} coefficients")
    extras = meta["extras"] if isinstance(meta.get("extras"), dict) else {}
    tag = extras_tag({**extras, "model": meta.get("model", "default")}, "meta.json")
    bytes_of = (scales[:3], colors[:3], opacities, harmonics)
    return SogHeader(SOG, count, coefficients, names, bounds, *bytes_of, notes=files.surplus, tag=tag)


def _codebook(entry: dict[str, Any], channels: int) -> NDArray[np.float64]:
    """Return the values of each byte, the same for all channels, [channels, 256]. Missing values are NaN.

    Older writers left the first value of a codebook empty (null). As in PlayCanvas' reader, it is the second value less
    the mean step of the others.
    """
    codebook = entry["codebook"]
    if not 0 < len(codebook) <= VALUES:
        raise ValueError(f"codebook of {len(codebook)} values")
    numbers = json_numbers(codebook, len(codebook))
    if len(numbers) > 1 and codebook[0] is None:
        numbers[0] = numbers[1] + (numbers[1] - numbers[-1]) / (VALUES - 1)
    values = np.pad(numbers, (0, VALUES - len(numbers)), constant_values=np.nan)
    return np.tile(values, (channels, 1))


def _steps(entry: dict[str, Any], channels: int) -> NDArray[np.float64]:
    """Return the values of each byte in version 1 by channel, [channels, 256]."""
    low, high = (json_numbers(entry[side], channels)[:, None] for side in ("mins", "maxs"))
    with np.errstate(over="ignore", invalid="ignore"):  # non-finite results are reported later
        return low + (high - low) * (np.arange(VALUES) / 255)


def _read(file: OpenScene, header: SceneHeader, into: Arrays) -> tuple[str, ...]:
    """Fill the arrays of a scene, and return the note on pixels after the last Gaussian that are no padding."""
    assert isinstance(header, SogHeader)
    path, files = file.path, _Files(file.path)

    def whole(name: str, index: int = 0) -> NDArray[np.uint8]:
        return files.pixels(header.names[name][index], header.count).reshape(-1, 4)

    def image(name: str, index: int = 0) -> NDArray[np.uint8]:
        return whole(name, index)[: header.count]

    low, high = image("means"), image("means", 1)
    for block in blocks(header.count):
        steps = (low[block, :3] | high[block, :3].astype(np.uint16) << 8) / 65535
        values = header.bounds[0] + (header.bounds[1] - header.bounds[0]) * steps
        with np.errstate(over="ignore", invalid="ignore"):  # non-finite results are reported later
            into["means"][block] = np.sign(values) * np.expm1(np.abs(values))
    quats = whole("quats")
    surplus = int((quats[header.count :, 3] >= _FIRST_TAG).sum())  # padding has no valid rotations
    quats = quats[: header.count]
    for block in blocks(header.count):
        index = quats[block, 3].astype(np.int64) - _FIRST_TAG
        if index.min() < 0:
            raise SceneError(f"{path}: {header.names['quats'][0]} has no valid rotations. Export the scene again.")
        into["quats"][block] = with_largest(index, (quats[block, :3] / 255 - 0.5) * np.sqrt(2))
    scales, colors = image("scales"), image("sh0")
    with np.errstate(over="ignore", invalid="ignore"):
        for axis in range(3):
            into["scales"][:, axis] = header.scales[axis].astype(np.float32)[scales[:, axis]]
            into["sh_dc"][:, axis] = header.colors[axis].astype(np.float32)[colors[:, axis]]
        into["opacities"][:] = header.opacities.astype(np.float32)[colors[:, 3]]
        if header.harmonics is not None:
            vectors = files.pixels(header.names["shN"][0], 1, _PALETTE_PIXELS)[..., :3]
            colors_of = header.harmonics.astype(np.float32)[vectors.reshape(-1, header.coefficients, 3)]
            labels = image("shN", 1)[:, :2].astype(np.int64) @ np.array([1, 256])
            if labels.max() >= len(colors_of):
                raise SceneError(
                    f"{path}: {header.names['shN'][1]} refers to vector {labels.max()} of {len(colors_of)}. Export the "
                    "scene again."
                )
            into["sh_rest"][:] = colors_of[labels]
    return about_surplus(surplus, "Gaussian")


def _write(output: BinaryIO, arrays: Arrays, rendering: Rendering) -> None:
    """Write a SOG archive. Gaussians are sorted along a space-filling curve, which compresses better."""
    count, coefficients = arrays["sh_rest"].shape[:2]
    if count > _MAX_SIDE**2:
        raise OutputError(f"SOG cannot hold {count} Gaussians. Write a PLY, or a .compressed.ply.")
    steps, bounds = _encoded_positions(arrays["means"])
    # the order of what is written, so that a scene from a SOG file stays in order
    order = along_curve(steps.astype(np.float32))
    sorted_arrays = {name: array[order] for name, array in arrays.items()}
    images = {
        "means_l.webp": (steps[order] & 255).astype(np.uint8),
        "means_u.webp": (steps[order] >> 8).astype(np.uint8),
    }
    largest, three = without_largest(sorted_arrays["quats"])
    quats = to_steps(three / np.sqrt(2) + 0.5, 255).astype(np.uint8)
    images["quats.webp"] = np.column_stack([quats, (_FIRST_TAG + largest).astype(np.uint8)])
    scales, colors = value_codebook(arrays["scales"]), value_codebook(arrays["sh_dc"])
    images["scales.webp"] = nearest_entries(sorted_arrays["scales"], scales)
    images["sh0.webp"] = np.column_stack(
        [nearest_entries(sorted_arrays["sh_dc"], colors), opacity_bytes(sorted_arrays["opacities"])]
    )
    meta: dict[str, Any] = {
        "version": 2,
        "count": count,
        "means": {"mins": bounds[0].tolist(), "maxs": bounds[1].tolist(), "files": ["means_l.webp", "means_u.webp"]},
        "scales": {"codebook": scales.tolist(), "files": ["scales.webp"]},
        "quats": {"files": ["quats.webp"]},
        "sh0": {"codebook": colors.tolist(), "files": ["sh0.webp"]},
    }
    extras = extras_of(rendering)
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
    return to_steps((values - low) / np.where(high > low, high - low, 1), 65535), np.stack([low, high])


def _webp(pixels: NDArray[np.uint8], width: int) -> bytes:
    """Encode pixels [n, 3 or 4] as a lossless WebP image, whose last pixels are 0."""
    height = -(-len(pixels) // width)
    padded = np.zeros((height * width, pixels.shape[1]), np.uint8)
    padded[: len(pixels)] = pixels
    file = io.BytesIO()
    # "exact" preserves the colors of transparent pixels, which are Gaussians of low opacity
    Image.fromarray(padded.reshape(height, width, -1)).save(file, "WEBP", lossless=True, exact=True, quality=_EFFORT)
    return file.getvalue()


SOG = SceneFormat("sog", "SOG", 14, _matches, _read_header, _read, _write)
