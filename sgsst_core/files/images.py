"""Readers and writers of images as float32 tensors [H, W, 3] of sRGB values in 0..1."""

from __future__ import annotations

import re
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image, ImageOps, UnidentifiedImageError
from torch import Tensor

from sgsst_core.errors import ImageError
from sgsst_core.files.atomic import atomic_path

#: Maximum number of pixels: Pillow's limit against decompression bombs, which is twice its warning threshold. These 179
#: megapixels exceed the largest camera sensors, and take 2 GB as float32.
MAX_PIXELS = 2 * ((1 << 30) // 4 // 3)
#: Accepted formats, whose decoding time is bounded by the number of pixels and bytes of a file. Pillow's other formats
#: are refused, because some are decoded in Python or by external programs.
FORMATS = ("JPEG", "PNG", "GIF", "BMP", "WEBP", "TIFF", "AVIF")
#: Maximum number of scans of a progressive JPEG. A scan of a few bytes makes the decoder process all pixels again.
#: Encoders write about 10.
MAX_JPEG_SCANS = 100
_JPEG_QUALITY = 95
_EXIF_ORIENTATION = 0x0112
#: EXIF orientations that swap width and height.
_SWAPPING = (5, 6, 7, 8)
_JPEG_MARKER = re.compile(rb"\xff([\x01-\xfe])")
_START_OF_SCAN, _END_OF_IMAGE = 0xDA, 0xD9
#: Markers without a segment: TEM, restarts and the start of the image.
_BARE_MARKERS = {0x01, *range(0xD0, 0xD9)}


def load_image(path: Path, *, oriented: bool = True) -> Tensor:
    """Read an image in one of `FORMATS`, or the first frame of an animated one.

    The EXIF orientation is applied (unless `oriented` is False), and transparent images are composited on white.
    Palettes, gray, 16 bits and CMYK are converted to RGB.

    Returns:
        Image [H, W, 3] float32 in 0..1, sRGB values as stored (no linearization, no color profile).

    Raises:
        ImageError: If the file is missing, not an image or truncated, or has more than MAX_PIXELS pixels or (JPEG)
            MAX_JPEG_SCANS scans. Both limits are checked before decoding.

    Example:
        >>> image = load_image(Path("style.png"))
        >>> image.dtype, image.shape[2]
        (torch.float32, 3)
    """
    with _opened(path) as image:
        if image.format in ("JPEG", "MPO"):
            _check_scans(path)
        image.load()
        return torch.from_numpy(_to_rgb(path, ImageOps.exif_transpose(image) if oriented else image))


def image_size(path: Path) -> tuple[int, int]:
    """Return width and height of an image with EXIF orientation applied, from its header alone.

    See `stored_size` for the size without it.

    Raises:
        ImageError: If the file is missing or not an image, or has more than MAX_PIXELS pixels.
    """
    (width, height), orientation = stored_size(path)
    return (height, width) if orientation in _SWAPPING else (width, height)


def stored_size(path: Path) -> tuple[tuple[int, int], int]:
    """Return width and height of an image as stored, and its EXIF orientation (1 to 8; 1 if it has none).

    Raises:
        ImageError: If the file is missing or not an image, or has more than MAX_PIXELS pixels.
    """
    with _opened(path) as image:
        # the EXIF data of a PNG may follow its pixels, and Pillow would decode all of them to find it
        known = "exif" in image.info or image.format != "PNG"
        orientation = image.getexif().get(_EXIF_ORIENTATION, 1) if known else 1
        return image.size, orientation if orientation in range(1, 9) else 1


def save_png(path: Path, image: Tensor) -> None:
    """Write an image [H, W, 3] as an 8-bit PNG, atomically. Values are clamped to 0..1 and rounded.

    Raises:
        OutputError: If the file cannot be written.
        ValueError: If the image has another shape, or NaN values.
    """
    _save(path, image, format="PNG")


def save_jpg(path: Path, image: Tensor) -> None:
    """Write an image [H, W, 3] as a high-quality JPEG without chroma subsampling; otherwise like `save_png`."""
    _save(path, image, format="JPEG", quality=_JPEG_QUALITY, subsampling=0)


@contextmanager
def _opened(path: Path) -> Iterator[Image.Image]:
    """Open an image and check its size. Decoding errors inside the block are raised as ImageError."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", Image.DecompressionBombWarning)  # checked below with our own limit
            opened = Image.open(path, formats=FORMATS)
        with opened as image:
            if image.width * image.height > MAX_PIXELS:
                raise Image.DecompressionBombError
            yield image
    except (ImageError, MemoryError):
        raise
    except Image.DecompressionBombError as error:
        raise ImageError(
            f"{path}: has more than {MAX_PIXELS // 10**6} megapixels; refused before decoding. Scale it down first."
        ) from error
    except UnidentifiedImageError as error:
        raise ImageError(f"{path}: is not an image that can be read. Give a PNG or JPEG.") from error
    except Exception as error:  # Pillow's decoders raise many types
        if isinstance(error, OSError) and error.strerror:
            raise ImageError(f"{path}: cannot be read: {error.strerror}. Check the path.") from error
        raise ImageError(f"{path}: is truncated or corrupt ({error}). Use an intact copy.") from error


def _check_scans(path: Path) -> None:
    """Check the number of scans of a JPEG file.

    Searching for markers is reliable, because entropy-coded data contains no markers except restarts.
    """
    data = path.read_bytes()
    scans = position = 0
    while (found := _JPEG_MARKER.search(data, position)) and found[1][0] != _END_OF_IMAGE:
        position = found.end()
        if found[1][0] not in _BARE_MARKERS:
            scans += found[1][0] == _START_OF_SCAN
            position += max(2, int.from_bytes(data[position : position + 2], "big"))
        if scans > MAX_JPEG_SCANS:
            raise ImageError(f"{path}: is a progressive JPEG of more than {MAX_JPEG_SCANS} scans. Save it as PNG.")


def _to_rgb(path: Path, image: Image.Image) -> NDArray[np.float32]:
    """Convert a decoded image of any mode to RGB, [H, W, 3]."""
    if image.mode.startswith(("I", "F")):  # gray with more than 8 bits; Pillow would clip it at 255
        values: NDArray[np.float32] = np.asarray(image, dtype=np.float32)
        if not np.isfinite(values).all():
            raise ImageError(f"{path}: holds NaN or infinite pixels. Use another image.")
        gray = np.clip(values / np.float32(_full_scale(image.mode, float(values.max()))), 0, 1)
        key = image.info.get("transparency")
        if isinstance(key, int):
            gray[values == key] = 1
        return np.repeat(gray[:, :, None], 3, axis=2)
    if image.has_transparency_data:
        image = image.convert("RGBA")
        image = Image.alpha_composite(Image.new("RGBA", image.size, "white"), image)
    pixels: NDArray[np.float32] = np.divide(np.asarray(image.convert("RGB")), 255, dtype=np.float32)
    return pixels


def _full_scale(mode: str, largest: float) -> float:
    """Return the pixel value of white.

    For float and 32-bit images, it is the smallest common maximum (1, 255 or 65535) that no pixel exceeds.
    """
    if mode.startswith("I;16"):
        return 65535.0
    ranges = (1.0, 255.0, 65535.0) if mode == "F" else (65535.0,)
    return next((full for full in ranges if largest <= full), max(largest, 1.0))


def _save(path: Path, image: Tensor, **options: Any) -> None:
    if image.ndim != 3 or image.shape[2] != 3 or bool(torch.isnan(image).any()):
        raise ValueError(f"an image must be [H, W, 3] without NaN, got {tuple(image.shape)}")
    values = (image.detach().to("cpu", torch.float32).clamp(0, 1) * 255).round().to(torch.uint8)
    with atomic_path(path) as temporary:
        Image.fromarray(values.numpy()).save(temporary, **options)
