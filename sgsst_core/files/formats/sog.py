"""Reader and writer of PlayCanvas' SOG: a ZIP archive, or a folder, with meta.json and WebP images, or PNGs.

Pixel i of each image belongs to Gaussian i; pixels after the last one mean nothing. Positions are 16-bit steps on a
logarithmic scale, in two images. Scales and colors are indices into codebooks of 256 values. Rotations have three
components of 8 bits. SH coefficients are a palette of up to 65,536 vectors. Version 1 has linear steps between bounds
in place of codebooks. The layout is that of https://developer.playcanvas.com/user-manual/gaussian-
splatting/formats/sog. Axes are those of the PLY. The field `model` of meta.json is the render mode, as splat-transform
writes it; `antialias` was its older form. Written files have their blur in `extras`, which is for programs' own values.
"""

from __future__ import annotations

import io
import json
import math
import re
import struct
import zipfile
from dataclasses import dataclass
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from sgsst_core.constants import SH_DEGREES
from sgsst_core.errors import OutputError, SceneError
from sgsst_core.files.advice import SCENES, converted, known_kind, refuse_changed_meaning
from sgsst_core.files.formats.archive import ZIP_MAGIC, FilesOfScene
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
    Limits,
    OpenScene,
    SceneFormat,
    SceneHeader,
    blocks,
    extras_of,
    extras_tag,
    json_numbers,
)
from sgsst_core.scene.rendering import Rendering

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
_PNG_MAGIC = b"\x89PNG\r\n\x1a\n"

#: Number and kind of images by property.
_IMAGES = {"means": 2, "scales": 1, "quats": 1, "sh0": 1, "shN": 2}
#: File names: without folders, so that no other files are read.
_NAME = re.compile(r"[\w-][\w.-]{0,99}")
#: Errors of a JSON document with missing or wrong values.
WRONG_JSON = (ValueError, TypeError, KeyError, IndexError, AttributeError, RecursionError, OverflowError)

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
        vectors: Declared number of vectors of the palette; None if the file does not state it.
    """

    names: dict[str, list[str]]
    bounds: NDArray[np.float64]
    scales: NDArray[np.float64]
    colors: NDArray[np.float64]
    opacities: NDArray[Any]
    harmonics: NDArray[np.float64] | None
    vectors: int | None


class SogFiles(FilesOfScene):
    """Files of a SOG scene, or of a part of a streamed SOG."""

    def meta(self) -> bytes:
        """Return the content of meta.json."""
        name = META_NAME if self.is_archived or self.folder else self.path.name
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


def _matches(start: FileStart) -> bool:
    head = start.head
    archive = head.startswith(ZIP_MAGIC) and known_kind(start.path, head, SCENES) is None
    return archive or (head.lstrip().startswith(b"{") and b'"means"' in head)


def _read_header(start: FileStart) -> SogHeader:
    return sog_header(SogFiles(start.path))


def sog_header(files: SogFiles) -> SogHeader:
    """Return the checked header of a SOG scene."""
    text, where = files.meta(), f"{files.path}: {files.folder}{META_NAME}"
    try:
        header = _parsed(files, json.loads(text))
    except WRONG_JSON as error:
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
    count = meta["count"] if version == 2 else meta["means"]["shape"][0]
    if type(count) is not int or count < 1:
        raise ValueError(f"count: {count}")
    bounds = np.stack([json_numbers(meta["means"][side], 3) for side in ("mins", "maxs")])
    table = _codebook if version == 2 else _steps
    scales, colors = table(meta["scales"], 3), table(meta["sh0"], 4)
    opacities = OPACITY_LOGITS if version == 2 else colors[3]
    coefficients, harmonics, vectors = 0, None, None
    if "shN" in names:
        width, _ = files.dimensions(names["shN"][0], 1, _PALETTE_PIXELS)
        if width not in _COEFFICIENTS_BY_WIDTH:
            raise ValueError(f"width of {names['shN'][0]}: {width}")
        coefficients, harmonics = _COEFFICIENTS_BY_WIDTH[width], table(meta["shN"], 1)[0]
        vectors = meta["shN"].get("count")
        if vectors is not None and (type(vectors) is not int or vectors < 1):
            raise ValueError(f"count of shN: {vectors}")
        if COEFFICIENTS.get(meta["shN"].get("bands"), coefficients) != coefficients:
            raise ValueError(f"bands: {meta['shN']['bands']} with {coefficients} coefficients")
    extras = meta["extras"] if isinstance(meta.get("extras"), dict) else {}
    model = meta.get("model", "antialiased" if meta.get("antialias") is True else "default")
    tag = extras_tag({**extras, "model": model}, "meta.json")
    more = {name for name, value in meta.items() if isinstance(value, dict) and "files" in value} - names.keys()
    notes = (f"{', '.join(sorted(more))[:80]} of meta.json are unknown and left out",) if more else ()
    bytes_of = (scales[:3], colors[:3], opacities, harmonics, vectors)
    return SogHeader(SOG, count, coefficients, names, bounds, *bytes_of, notes=(*files.surplus, *notes), tag=tag)


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


def _read(file: OpenScene, header: SceneHeader, into: Arrays) -> None:
    assert isinstance(header, SogHeader)
    read_sog(SogFiles(file.path), header, into)


def read_sog(files: SogFiles, header: SogHeader, into: Arrays) -> None:
    """Fill the arrays of a scene."""
    where = f"{files.path}: {files.folder}"
    read_positions(files, header, into["means"])
    quats = _pixels(files, header, "quats")[: header.count]
    for block in blocks(header.count):
        index = quats[block, 3].astype(np.int64) - _FIRST_TAG
        if index.min() < 0:
            raise SceneError(f"{where}{header.names['quats'][0]} has no valid rotations. Export the scene again.")
        into["quats"][block] = with_largest(index, (quats[block, :3] / 255 - 0.5) * np.sqrt(2))
    scales, colors = (_pixels(files, header, name)[: header.count] for name in ("scales", "sh0"))
    with np.errstate(over="ignore", invalid="ignore"):
        for axis in range(3):
            into["scales"][:, axis] = header.scales[axis].astype(np.float32)[scales[:, axis]]
        into["sh_dc"][:] = _colors(header, colors)
        into["opacities"][:] = header.opacities.astype(np.float32)[colors[:, 3]]
        if header.harmonics is not None:
            stored = files.pixels(header.names["shN"][0], 1, _PALETTE_PIXELS)[..., :3]
            entries = header.harmonics.astype(np.float32)[stored.reshape(-1, header.coefficients, 3)]
            labels = _pixels(files, header, "shN", 1)[: header.count, :2].astype(np.int64) @ np.array([1, 256])
            vectors = min(len(entries), header.vectors or len(entries))
            if labels.max() >= vectors:
                raise SceneError(
                    f"{where}{header.names['shN'][1]} refers to vector {labels.max()} of {vectors}. Export the scene "
                    "again."
                )
            into["sh_rest"][:] = entries[labels]


def _pixels(files: SogFiles, header: SogHeader, name: str, index: int = 0) -> NDArray[np.uint8]:
    """Return the pixels of an image of a property, [at least the number of Gaussians, 4] uint8."""
    return files.pixels(header.names[name][index], header.count).reshape(-1, 4)


def read_positions(files: SogFiles, header: SogHeader, into: NDArray[np.float32]) -> None:
    """Fill an array [n, 3] with the positions of a scene."""
    low, high = (_pixels(files, header, "means", index)[: header.count] for index in (0, 1))
    for block in blocks(header.count):
        steps = (low[block, :3] | high[block, :3].astype(np.uint16) << 8) / 65535
        values = header.bounds[0] + (header.bounds[1] - header.bounds[0]) * steps
        with np.errstate(over="ignore", invalid="ignore"):  # non-finite results are reported later
            into[block] = np.sign(values) * np.expm1(np.abs(values))


def read_colors(files: SogFiles, header: SogHeader, into: NDArray[np.float32]) -> None:
    """Fill an array [n, 3] with the SH coefficients of degree 0 of a scene."""
    into[:] = _colors(header, _pixels(files, header, "sh0")[: header.count])


def _colors(header: SogHeader, pixels: NDArray[np.uint8]) -> NDArray[np.float32]:
    """Return the SH coefficients of degree 0 of pixels [n, 4] of their image, [n, 3]."""
    with np.errstate(over="ignore", invalid="ignore"):
        return np.stack([header.colors[axis].astype(np.float32)[pixels[:, axis]] for axis in range(3)], axis=1)


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
        raise OutputError(f"{files.folder} of it is SOG of version 1. Write it again with splat-transform.")
    image = files.pixels(name, header.count)
    pixels = image.reshape(-1, 4).copy()
    colors = _colors(header, pixels[: header.count]) + change
    codebook = value_codebook(colors)
    pixels[: header.count, :3] = nearest_entries(colors, codebook)
    meta["sh0"]["codebook"] = codebook.tolist()
    return stored | {name: _webp(pixels, image.shape[1]), META_NAME: json.dumps(meta).encode()}


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


def _step(means: NDArray[np.float32]) -> NDArray[np.float64]:
    """Return the distance between positions that can be stored at each Gaussian, [n]."""
    low, high = _encoded_positions(means)[1]
    return np.max((high - low) / 65535 * (1 + np.abs(means)), axis=1)  # type: ignore[no-any-return]


SOG = SceneFormat("sog", "SOG", 14, _matches, _read_header, _read, _write, limits=Limits(step=_step))
