"""Images: style pictures and photos in, PNG and JPEG out; float32 [H, W, 3] of sRGB values in 0..1 in between."""

from __future__ import annotations

import re
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path, PurePosixPath

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image, ImageOps, UnidentifiedImageError
from torch import Tensor

from sgsst_core.errors import ImageError
from sgsst_core.files.atomic import atomic_path
from sgsst_core.scene.camera import Camera

#: Pillow's own bound against decompression bombs (twice its warning level of 2^30 / 4 / 3 pixels): 179 megapixels, more
#: than the largest camera backs have, and 2 GB as float32.
MAX_PIXELS = 2 * ((1 << 30) // 4 // 3)
#: Formats whose decoding time is bounded by the pixels and bytes of a file. Others of Pillow's are not read: some have
#: decoders in Python, or start other programs.
FORMATS = ("JPEG", "PNG", "GIF", "BMP", "WEBP", "TIFF", "AVIF")
#: Each scan of a progressive JPEG goes over all of its pixels again, for a few bytes. Encoders write about 10.
MAX_JPEG_SCANS = 100
#: How far the aspect of a photo may be off its camera's before it must be another photo, or a cropped one.
ASPECT_TOLERANCE = 0.01

_JPEG_QUALITY = 95
_EXIF_ORIENTATION = 0x0112
_JPEG_MARKER = re.compile(rb"\xff([\x01-\xfe])")
_START_OF_SCAN, _END_OF_IMAGE = 0xDA, 0xD9
#: Markers that no segment follows: TEM, restarts and the start of the image.
_BARE_MARKERS = {0x01, *range(0xD0, 0xD9)}
_SHOWN = 10


def load_image(path: Path) -> Tensor:
    """Read an image in one of `FORMATS`; of an animated one, the first frame.

    EXIF orientation is applied, transparency composited on white; palettes, gray, 16 bit and CMYK become RGB.

    Returns:
        [H, W, 3] float32 in 0..1, sRGB values as stored (no linearization, no color profile).

    Raises:
        ImageError: missing, not an image, truncated, more than MAX_PIXELS, or a JPEG of more than MAX_JPEG_SCANS; size
            and scans are checked before decoding.
    """
    with _opened(path) as image:
        if image.format in ("JPEG", "MPO"):
            _check_scans(path)
        image.load()
        return torch.from_numpy(_to_rgb(path, ImageOps.exif_transpose(image)))


def image_size(path: Path) -> tuple[int, int]:
    """Width and height of an image as it is shown (EXIF orientation applied), from its header alone.

    Raises:
        ImageError: missing, not an image, or more than MAX_PIXELS.
    """
    with _opened(path) as image:
        width, height = image.size
        # a PNG's EXIF may come behind its pixels, and Pillow would decode them all to look for it
        known = "exif" in image.info or image.format != "PNG"
        turned = known and image.getexif().get(_EXIF_ORIENTATION, 1) in (5, 6, 7, 8)  # those that swap the sides
        return (height, width) if turned else (width, height)


def check_photos(folder: Path, cameras: Sequence[Camera]) -> list[Path]:
    """Find each camera's photo before long work starts; only headers are read.

    A camera's name matches a file with or without its extension, and with as many of its folders as it takes:
    "images/cam0/0001.png" matches FOLDER/images/cam0/0001.png, else FOLDER/cam0/0001.jpg, else FOLDER/0001.jpg.

    Returns:
        The photos' paths in the cameras' order, for `load_photo`.

    Raises:
        ImageError: photos are missing or ambiguous (the message says for which views), cannot be read, or have another
            aspect than their camera.
    """
    if not folder.is_dir():
        raise ImageError(f"{folder}: is not a folder of photos. Give the folder that the cameras' names refer to.")
    index = _index_photos(folder)
    matches = [_matching(index, folder, camera.name) for camera in cameras]
    for what, wrong in (("no photo", lambda n: n == 0), ("more than one photo", lambda n: n > 1)):
        names = [camera.name for camera, found in zip(cameras, matches, strict=True) if wrong(len(found))]
        if names:
            shown = ", ".join(names[:_SHOWN]) + (", ..." if len(names) > _SHOWN else "")
            raise ImageError(
                f"{folder}: holds {what} for {len(names)} of {len(cameras)} views: {shown}. Photos are found by the "
                "cameras' names, with or without extension: give the folder that holds exactly these."
            )
    paths = [found[0] for found in matches]
    for path, camera in zip(paths, cameras, strict=True):
        _check_aspect(path, image_size(path), camera)
    return paths


def find_masks(folder: Path, cameras: Sequence[Camera]) -> list[Path | None]:
    """The mask of each camera that has one, found by its name as photos are (`check_photos`); only headers are read.

    Raises:
        ImageError: there is none for any camera, or more than one for one, or one has another aspect than its camera.
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
    """Read a photo at its camera's size (antialiased bicubic): [height, width, 3] float32 in 0..1.

    Raises:
        ImageError: as `load_image`, or another aspect than the camera's.
    """
    photo = load_image(path)
    _check_aspect(path, (photo.shape[1], photo.shape[0]), camera)
    if photo.shape[:2] == (camera.height, camera.width):
        return photo
    planes = photo.permute(2, 0, 1)[None]
    small = torch.nn.functional.interpolate(
        planes, (camera.height, camera.width), mode="bicubic", antialias=True, align_corners=False
    )
    return small[0].permute(1, 2, 0).clamp(0, 1).contiguous()  # bicubic overshoots at edges


def save_png(path: Path, image: Tensor) -> None:
    """Write [H, W, 3] as 8-bit PNG, clamped to 0..1 and rounded; the file appears whole or not at all.

    Raises:
        OutputError: the file cannot be written.
        ValueError: another shape, or NaN.
    """
    _save(path, image, lambda picture, target: picture.save(target, format="PNG"))


def save_jpg(path: Path, image: Tensor) -> None:
    """Write [H, W, 3] as JPEG of high quality with full color resolution; otherwise as `save_png`."""
    _save(
        path, image, lambda picture, target: picture.save(target, format="JPEG", quality=_JPEG_QUALITY, subsampling=0)
    )


@contextmanager
def _opened(path: Path) -> Iterator[Image.Image]:
    """The image with its header read and its size checked; every way in which decoding fails is an ImageError."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", Image.DecompressionBombWarning)  # the bound below is ours
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
    except Exception as error:  # Pillow's decoders raise whatever their format's parser runs into
        if isinstance(error, OSError) and error.strerror:
            raise ImageError(f"{path}: cannot be read: {error.strerror}. Check the path.") from error
        raise ImageError(f"{path}: is truncated or corrupt ({error}). Use an intact copy.") from error


def _check_scans(path: Path) -> None:
    """Count the scans of a JPEG file; entropy-coded data holds no markers but restarts."""
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
    """[H, W, 3] of a decoded image of any mode."""
    if image.mode.startswith(("I", "F")):  # more than 8 bits, always gray: Pillow would cut them off at 255
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
    """The value that is white. Only float and 32-bit images leave it open: then the usual range that holds them."""
    if mode.startswith("I;16"):
        return 65535.0
    ranges = (1.0, 255.0, 65535.0) if mode == "F" else (65535.0,)
    return next((full for full in ranges if largest <= full), max(largest, 1.0))


def _index_photos(folder: Path) -> dict[tuple[str, ...], list[Path]]:
    """Every image file below the folder, by every tail of its relative path without extension."""
    extensions = Image.registered_extensions()
    index: dict[tuple[str, ...], list[Path]] = {}
    for path in sorted(folder.rglob("*")):
        if path.suffix.lower() in extensions and not path.name.startswith(".") and path.is_file():
            parts = path.relative_to(folder).with_suffix("").parts
            for start in range(len(parts)):
                index.setdefault(parts[start:], []).append(path)
    return index


def _matching(index: dict[tuple[str, ...], list[Path]], folder: Path, name: str) -> list[Path]:
    """The photos that fit a camera's name best: the longest tail first, then the exact extension, then no subfolder."""
    whole = PurePosixPath(name.replace("\\", "/"))
    known = whole.suffix.lower() in Image.registered_extensions()
    parts = tuple(part for part in (whole.with_suffix("") if known else whole).parts if part not in ("..", "/"))
    for start in range(len(parts)):
        found = index.get(parts[start:], [])
        if found:
            direct = [path for path in found if path.parent == folder.joinpath(*parts[start:-1])] or found
            return [path for path in direct if path.suffix == whole.suffix] or direct
    return []


def _check_aspect(path: Path, size: tuple[int, int], camera: Camera) -> None:
    # the camera's sides are whole pixels, so that a small one is off by up to half a pixel by itself
    allowed = ASPECT_TOLERANCE + 0.5 / min(camera.width, camera.height)
    if abs(size[0] * camera.height / (size[1] * camera.width) - 1) > allowed:
        raise ImageError(
            f"{path}: is {size[0]} x {size[1]}, but its camera {camera.name!r} {camera.width} x {camera.height}, "
            "another aspect. Give the photos that the cameras were computed from, neither cropped nor rotated."
        )


def _save(path: Path, image: Tensor, write: Callable[[Image.Image, Path], None]) -> None:
    if image.ndim != 3 or image.shape[2] != 3 or bool(torch.isnan(image).any()):
        raise ValueError(f"an image must be [H, W, 3] without NaN, got {tuple(image.shape)}")
    values = (image.detach().to("cpu", torch.float32).clamp(0, 1) * 255).round().to(torch.uint8)
    with atomic_path(path) as temporary:
        write(Image.fromarray(values.numpy()), temporary)
