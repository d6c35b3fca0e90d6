"""Readers and writers of images as float32 tensors [H, W, 3] of sRGB values in 0..1."""

from __future__ import annotations

import re
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image, ImageOps, UnidentifiedImageError
from torch import Tensor

from sgsst_core.errors import ImageError
from sgsst_core.files.atomic import atomic_path
from sgsst_core.scene.camera import Camera

#: Maximum number of pixels: Pillow's limit against decompression bombs, which is twice its warning threshold. These 179
#: megapixels exceed the largest camera sensors, and take 2 GB as float32.
MAX_PIXELS = 2 * ((1 << 30) // 4 // 3)
#: Accepted formats, whose decoding time is bounded by the number of pixels and bytes of a file. Pillow's other formats
#: are refused, because some are decoded in Python or by external programs.
FORMATS = ("JPEG", "PNG", "GIF", "BMP", "WEBP", "TIFF", "AVIF")
#: Maximum number of scans of a progressive JPEG. A scan of a few bytes makes the decoder process all pixels again.
#: Encoders write about 10.
MAX_JPEG_SCANS = 100
#: Maximum relative difference between the aspect ratios of a photo and its camera. A larger difference indicates a
#: wrong or cropped photo.
ASPECT_TOLERANCE = 0.01

_JPEG_QUALITY = 95
_EXIF_ORIENTATION = 0x0112
_JPEG_MARKER = re.compile(rb"\xff([\x01-\xfe])")
_START_OF_SCAN, _END_OF_IMAGE = 0xDA, 0xD9
#: Markers without a segment: TEM, restarts and the start of the image.
_BARE_MARKERS = {0x01, *range(0xD0, 0xD9)}
_NAMES_IN_MESSAGE = 10


def load_image(path: Path) -> Tensor:
    """Read an image in one of `FORMATS`, or the first frame of an animated one.

    The EXIF orientation is applied, and transparent images are composited on white. Palettes, gray, 16 bits and CMYK
    are converted to RGB.

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
        return torch.from_numpy(_to_rgb(path, ImageOps.exif_transpose(image)))


def image_size(path: Path) -> tuple[int, int]:
    """Return width and height of an image with EXIF orientation applied, from its header alone.

    Raises:
        ImageError: If the file is missing or not an image, or has more than MAX_PIXELS pixels.
    """
    with _opened(path) as image:
        width, height = image.size
        # the EXIF data of a PNG may follow its pixels, and Pillow would decode all of them to find it
        known = "exif" in image.info or image.format != "PNG"
        swapped = known and image.getexif().get(_EXIF_ORIENTATION, 1) in (5, 6, 7, 8)  # these swap width and height
        return (height, width) if swapped else (width, height)


def check_photos(folder: Path, cameras: Sequence[Camera]) -> list[Path]:
    """Find and check the photo of each camera. Only headers are read, so that errors occur before long work starts.

    A camera's name matches a file with or without its extension. Leading folders of the name are dropped until a file
    matches: "images/cam0/0001.png" matches FOLDER/images/cam0/0001.png, else FOLDER/cam0/0001.jpg, else
    FOLDER/0001.jpg.

    Returns:
        Paths of the photos in the order of the cameras, for `load_photo`.

    Raises:
        ImageError: If a photo cannot be read or its aspect differs from its camera's, or if photos are missing or
            ambiguous. The message names the views.
    """
    if not folder.is_dir():
        raise ImageError(f"{folder}: is not a folder of photos. Give the folder that the cameras' names refer to.")
    index = _index_photos(folder)
    matches = [_matching(index, folder, camera.name) for camera in cameras]
    for what, wrong in (("no photo", lambda n: n == 0), ("more than one photo", lambda n: n > 1)):
        names = [camera.name for camera, found in zip(cameras, matches, strict=True) if wrong(len(found))]
        if names:
            shown = ", ".join(names[:_NAMES_IN_MESSAGE]) + (", ..." if len(names) > _NAMES_IN_MESSAGE else "")
            raise ImageError(
                f"{folder}: holds {what} for {len(names)} of {len(cameras)} views: {shown}. Photos are found by the "
                "cameras' names, with or without extension: give the folder that holds exactly these."
            )
    paths = [found[0] for found in matches]
    for path, camera in zip(paths, cameras, strict=True):
        _check_aspect(path, image_size(path), camera)
    return paths


def find_masks(folder: Path, cameras: Sequence[Camera]) -> list[Path | None]:
    """Find the masks of cameras by name, as `check_photos` finds photos. Only headers are read.

    Returns:
        Path of each camera's mask; None for a camera without one.

    Raises:
        ImageError: If no camera has a mask, a camera has several, or the aspect of a mask differs from its camera's.
    """
    if not folder.is_dir():
        raise ImageError(f"{folder}: is not a folder of masks. Give the folder that the cameras' names refer to.")
    index = _index_photos(folder)
    found: list[Path | None] = []
    for camera in cameras:
        paths = _matching(index, folder, camera.name)
        if len(paths) > 1:
            raise ImageError(f"{folder}: holds more than one mask for view {camera.name}. Leave one.")
        found += paths or [None]
        if paths:
            _check_aspect(paths[0], image_size(paths[0]), camera)
    if not any(found):
        raise ImageError(
            f"{folder}: holds no mask for any of {len(cameras)} views. Masks are found by the cameras' names, with or "
            f"without extension, such as {cameras[0].name}."
        )
    return found


def load_photo(path: Path, camera: Camera) -> Tensor:
    """Read a photo and resize it to its camera's size (antialiased bicubic): [height, width, 3] float32 in 0..1.

    Raises:
        ImageError: If the photo cannot be read (see `load_image`), or its aspect differs from the camera's.
    """
    photo = load_image(path)
    _check_aspect(path, (photo.shape[1], photo.shape[0]), camera)
    if photo.shape[:2] == (camera.height, camera.width):
        return photo
    planes = photo.permute(2, 0, 1)[None]
    small = torch.nn.functional.interpolate(
        planes, (camera.height, camera.width), mode="bicubic", antialias=True, align_corners=False
    )
    return small[0].permute(1, 2, 0).clamp(0, 1).contiguous()  # bicubic interpolation overshoots at edges


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


def _index_photos(folder: Path) -> dict[tuple[str, ...], list[Path]]:
    """Index all image files below a folder by every trailing part of their relative path, without extension."""
    extensions = Image.registered_extensions()
    index: dict[tuple[str, ...], list[Path]] = {}
    for path in sorted(folder.rglob("*")):
        if path.suffix.lower() in extensions and not path.name.startswith(".") and path.is_file():
            parts = path.relative_to(folder).with_suffix("").parts
            for start in range(len(parts)):
                index.setdefault(parts[start:], []).append(path)
    return index


def _matching(index: dict[tuple[str, ...], list[Path]], folder: Path, name: str) -> list[Path]:
    """Return the photos that match a camera's name best.

    The longest matching path wins, then files outside deeper subfolders, then files with the exact extension.
    """
    wanted = PurePosixPath(name.replace("\\", "/"))
    known = wanted.suffix.lower() in Image.registered_extensions()
    parts = tuple(part for part in (wanted.with_suffix("") if known else wanted).parts if part not in ("..", "/"))
    for start in range(len(parts)):
        found = index.get(parts[start:], [])
        if found:
            direct = [path for path in found if path.parent == folder.joinpath(*parts[start:-1])] or found
            return [path for path in direct if path.suffix == wanted.suffix] or direct
    return []


def _check_aspect(path: Path, size: tuple[int, int], camera: Camera) -> None:
    # a camera's size is rounded to whole pixels, which changes the aspect ratio of a small camera
    allowed = ASPECT_TOLERANCE + 0.5 / min(camera.width, camera.height)
    if abs(size[0] * camera.height / (size[1] * camera.width) - 1) > allowed:
        raise ImageError(
            f"{path}: is {size[0]} x {size[1]}, but its camera {camera.name!r} {camera.width} x {camera.height}, "
            "another aspect ratio. Give the photos that the cameras were computed from, neither cropped nor rotated."
        )


def _save(path: Path, image: Tensor, **options: Any) -> None:
    if image.ndim != 3 or image.shape[2] != 3 or bool(torch.isnan(image).any()):
        raise ValueError(f"an image must be [H, W, 3] without NaN, got {tuple(image.shape)}")
    values = (image.detach().to("cpu", torch.float32).clamp(0, 1) * 255).round().to(torch.uint8)
    with atomic_path(path) as temporary:
        Image.fromarray(values.numpy()).save(temporary, **options)
