"""Readers and writers of images as float32 tensors [H, W, 3] of sRGB values in 0..1; photos and masks of cameras.

Colors are converted to sRGB by ICC profiles. Photos and masks are found by name, checked by their headers, and read as
their pinhole cameras see them.
"""

import functools
import io
import math
import os
import re
import unicodedata
import warnings
from collections.abc import Callable, Collection, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path, PurePath, PurePosixPath
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image, ImageCms, PngImagePlugin, UnidentifiedImageError
from torch import Tensor

from sgsst_core.errors import ImageError
from sgsst_core.files.advice import POINTER, refuse_known
from sgsst_core.files.atomic import atomic_path
from sgsst_core.files.camera_folder import label
from sgsst_core.scene.camera import Camera

#: Maximum number of pixels: Pillow's limit against decompression bombs, which is twice its warning threshold. These 179
#: megapixels exceed the largest camera sensors, and take 2 GB as float32.
MAX_PIXELS = 2 * ((1 << 30) // 4 // 3)
#: Accepted formats, whose decoding time is bounded by the number of pixels and bytes of a file. Pillow's other formats
#: are refused, because some are decoded in Python or by external programs.
FORMATS = ("JPEG", "PNG", "GIF", "BMP", "WEBP", "TIFF", "AVIF")
#: Suffixes of HEIC images, which pillow-heif reads (the extra `heif`), and the brands at their beginning.
HEIF_SUFFIXES = (".heic", ".heif", ".hif")
_HEIF_BRANDS = {b"heic", b"heix", b"heim", b"heis", b"hevc", b"hevx", b"hevm", b"hevs", b"mif1", b"msf1"}
#: Maximum number of scans of a progressive JPEG. A scan of a few bytes makes the decoder process all pixels again.
#: Encoders write about 10.
MAX_JPEG_SCANS = 100

#: sRGB color, each channel in 0..1.
Color = tuple[float, float, float]
BLACK: Color = (0.0, 0.0, 0.0)
WHITE: Color = (1.0, 1.0, 1.0)

#: Formats whose further images are no frames, but previews or maps of the brightness.
_STILL = ("JPEG", "MPO", "HEIF")
_JPEG_QUALITY = 95
#: Largest pixel of a gray image with more than 8 bits, relative to white. Resampling and sharpening overshoot; in an
#: image with larger values, white is the largest one.
_OVERSHOOT = 2.0
_EXIF_ORIENTATION = 0x0112
#: What makes an image upright, by its EXIF orientation.
_UPRIGHT = {
    2: Image.Transpose.FLIP_LEFT_RIGHT,
    3: Image.Transpose.ROTATE_180,
    4: Image.Transpose.FLIP_TOP_BOTTOM,
    5: Image.Transpose.TRANSPOSE,
    6: Image.Transpose.ROTATE_270,
    7: Image.Transpose.TRANSVERSE,
    8: Image.Transpose.ROTATE_90,
}
_JPEG_MARKER = re.compile(rb"\xff([\x01-\xfe])")
_START_OF_SCAN, _END_OF_IMAGE = 0xDA, 0xD9
#: Markers without a segment: TEM, restarts and the start of the image.
_BARE_MARKERS = {0x01, *range(0xD0, 0xD9)}
#: Maximum length of a compressed text or profile of a PNG; Pillow's own limit, 1 MiB, is too low for some profiles.
PngImagePlugin.MAX_TEXT_CHUNK = 16 << 20
#: Maximum number of such texts and profiles, all of which Pillow inflates. Programs write less than ten.
MAX_PNG_TEXTS = 64
_PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"


class ImageWarning(UserWarning):
    """Part of an image that is not used, such as a broken color profile."""


def load_image(
    path: str | Path,
    *,
    background: Color = WHITE,
    oriented: bool = True,
    color_managed: bool = True,
    warn: Callable[[str], None] | None = None,
    max_pixels: int = MAX_PIXELS,
) -> Tensor:
    """Read an image in one of `FORMATS` or HEIC, or the first frame of an animated one.

    Colors are converted to sRGB by the image's ICC profile; images without one are taken for sRGB, with a warning if
    the chunks of a PNG state another space. Palettes, gray, 16 bits and CMYK are converted to RGB.

    Args:
        background: sRGB color behind transparent parts, in 0..1; white by default.
        oriented: Whether the EXIF orientation is applied.
        color_managed: Whether colors are converted. Masks hold no colors.
        warn: Callback for a color profile or frames that are ignored; None to issue an `ImageWarning`.
        max_pixels: Number of pixels above which the image is reduced, by averaging squares of whole pixels, before it
            is converted to floats, which take four times the memory.

    Returns:
        Image [H, W, 3] float32 in 0..1, sRGB values (not linear).

    Raises:
        ImageError: If the file is missing, not an image or truncated, is HEIC without the extra `heif`, or has more
            than MAX_PIXELS pixels or (JPEG) MAX_JPEG_SCANS scans. Both limits are checked before decoding.

    Example:
        >>> image = load_image("style.png")
        >>> image.dtype, image.shape[2]
        (torch.float32, 3)
    """
    path, warn = Path(path), warn or (lambda text: warnings.warn(text, ImageWarning, stacklevel=3))
    with _opened(path) as image:
        if image.format in ("JPEG", "MPO"):
            _check_scans(path)
        if image.format not in _STILL and getattr(image, "is_animated", False):
            warn(f"{path.name}: only its first frame is used")
        upright = _UPRIGHT.get(_orientation(image)) if oriented else None
        factor = _reduction(image, max_pixels)
        if factor > 1:
            image.draft(None, (image.width // factor, image.height // factor))  # JPEG is decoded at a lower resolution
        image.load()
        profile = _profile_of(path, image, warn) if color_managed else None
        small = _reduced(image, _reduction(image, max_pixels))
        pixels = _to_rgb(path, small if upright is None else small.transpose(upright), profile, background)
        return torch.from_numpy(pixels)


def _reduction(image: Image.Image, max_pixels: int) -> int:
    """Return the side of the squares of pixels to average, so that an image has at most so many pixels."""
    return math.ceil(math.sqrt(image.width * image.height / max_pixels))


def _reduced(image: Image.Image, factor: int) -> Image.Image:
    """Average squares of pixels; with transparency, colors are weighted by it."""
    if factor <= 1:
        return image
    if image.mode.startswith("I;16"):
        image = image.convert("I")
    elif image.has_transparency_data:
        image = image.convert("RGBA")
    elif image.mode in ("1", "P"):
        image = image.convert("RGB")
    return image.reduce(factor)


def image_size(path: Path) -> tuple[int, int]:
    """Return width and height of an image with EXIF orientation applied, from its header alone.

    See `stored_size` for the size without it.

    Raises:
        ImageError: If the file is missing or not an image, or has more than MAX_PIXELS pixels.
    """
    (width, height), orientation = stored_size(path)
    return (height, width) if orientation >= 5 else (width, height)


def stored_size(path: Path) -> tuple[tuple[int, int], int]:
    """Return width and height of an image as stored, and its EXIF orientation (1 to 8; 1 if it has none).

    Raises:
        ImageError: If the file is missing or not an image, or has more than MAX_PIXELS pixels.
    """
    with _opened(path) as image:
        return image.size, _orientation(image)


def _orientation(image: Image.Image) -> int:
    """Return the EXIF orientation that the header of an image states, 1 to 8; 1 if it has none."""
    if image.format == "TIFF":  # Pillow makes it upright itself
        return 1
    # that of a PNG would decode all pixels to find EXIF data behind them
    exif = Image.Image.getexif(image) if image.format == "PNG" else image.getexif()
    orientation = exif.get(_EXIF_ORIENTATION, 1)
    return orientation if orientation in range(1, 9) else 1


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
        with path.open("rb") as file:
            head = file.read(12)
        if head.startswith(_PNG_SIGNATURE):
            _check_texts(path)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", Image.DecompressionBombWarning)  # checked below with our own limit
            opened = Image.open(path, formats=[*FORMATS, *_heif_format(path, head)])
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
        refuse_known(path, [POINTER], ImageError)
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
    while (marker := _JPEG_MARKER.search(data, position)) and marker[1][0] != _END_OF_IMAGE:
        position = marker.end()
        if marker[1][0] not in _BARE_MARKERS:
            scans += marker[1][0] == _START_OF_SCAN
            position += max(2, int.from_bytes(data[position : position + 2], "big"))
        if scans > MAX_JPEG_SCANS:
            raise ImageError(f"{path}: is a progressive JPEG of more than {MAX_JPEG_SCANS} scans. Save it as PNG.")


def _check_texts(path: Path) -> None:
    """Check the number of compressed texts and profiles of a PNG file."""
    texts = 0
    with path.open("rb") as file:
        file.seek(len(_PNG_SIGNATURE))
        while len(header := file.read(8)) == 8:
            texts += header[4:] in (b"zTXt", b"iTXt", b"iCCP")
            if texts > MAX_PNG_TEXTS:
                raise ImageError(f"{path}: is a PNG of more than {MAX_PNG_TEXTS} compressed texts. Save it without.")
            file.seek(int.from_bytes(header[:4], "big") + 4, os.SEEK_CUR)


def _heif_format(path: Path, head: bytes) -> tuple[str, ...]:
    """Return the name of Pillow's format for a HEIC file, and nothing for other files.

    HEIC begins with a file type box of ISO/IEC 14496-12; its brands are those of ISO/IEC 23008-12.
    """
    if head[4:8] != b"ftyp" or head[8:12] not in _HEIF_BRANDS:
        return ()
    try:
        from pillow_heif import register_heif_opener
    except ImportError as error:
        raise ImageError(
            f"{path}: is a HEIC image, which the extra `heif` reads. Run `pip install 'sgsst-service[heif]'`, or save "
            "it as JPEG."
        ) from error
    register_heif_opener()
    return ("HEIF",)


def _profile_of(path: Path, image: Image.Image, warn: Callable[[str], None]) -> "ColorProfile | None":
    """Return the color profile of an image; None if it has none that changes colors."""
    data = image.info.get("icc_profile")
    if not data:
        stated = (image.info.get("gamma", _SRGB_CHUNKS[0]), *image.info.get("chromaticity", _SRGB_CHUNKS[1:]))
        if "srgb" not in image.info and not np.allclose(stated, _SRGB_CHUNKS, 0, _CHUNK_ROUNDING):
            warn(
                f"{path.name}: its colors are taken for sRGB, although its chunks state another space: save it as sRGB"
            )
        return None
    gray = image.mode in ("1", "L", "LA") or image.mode.startswith(("I", "F"))
    mode = "L" if gray else "CMYK" if image.mode == "CMYK" else "RGB"
    try:
        profile = ColorProfile(data, mode)
    except ValueError as error:
        warn(f"{path.name}: its color profile is ignored, because {error}")
        return None
    return profile if profile.changes else None


def _to_rgb(path: Path, image: Image.Image, profile: "ColorProfile | None", background: Color) -> NDArray[np.float32]:
    """Convert a decoded image of any mode to RGB, [H, W, 3]."""
    if image.mode.startswith(("I", "F")):  # gray with more than 8 bits; Pillow would clip it at 255
        values: NDArray[np.float32] = np.asarray(image, dtype=np.float32)
        if not np.isfinite(values).all():
            raise ImageError(f"{path}: holds NaN or infinite pixels. Use another image.")
        white = np.float32(1 if image.mode == "F" else 65535)
        white = white if values.max() <= _OVERSHOOT * white else values.max()
        gray = np.clip(values / white, 0, 1)
        if profile is None:
            colors = np.repeat(gray[:, :, None], 3, axis=2)
            if isinstance(key := image.info.get("transparency"), int):
                colors[values == key] = background
            return colors
        image = Image.fromarray(np.rint(255 * gray).astype(np.uint8))
    transparent = image.has_transparency_data
    if transparent:
        image = image.convert("RGBA")
    if profile:
        stored, image = image, profile.to_srgb(image)
        if transparent:
            image.putalpha(stored.getchannel("A"))
    if transparent:
        rgb = tuple(round(255 * channel) for channel in background)
        image = Image.alpha_composite(Image.new("RGBA", image.size, rgb), image)
    pixels: NDArray[np.float32] = np.divide(np.asarray(image.convert("RGB")), 255, dtype=np.float32)
    return pixels


def _save(path: Path, image: Tensor, **options: Any) -> None:
    if image.ndim != 3 or image.shape[2] != 3 or bool(torch.isnan(image).any()):
        raise ValueError(f"an image must be [H, W, 3] without NaN, got {tuple(image.shape)}")
    with atomic_path(path) as temporary:
        to_image(image).save(temporary, **options)


def to_image(image: Tensor) -> Image.Image:
    """Return an image [H, W, 3] in 0..1 with 8 bits per channel."""
    values = (image.detach().to("cpu", torch.float32).clamp(0, 1) * 255).round().to(torch.uint8)
    return Image.fromarray(values.numpy())


#: Maximum size of a profile in bytes. Those of printing processes have up to 3 MB.
MAX_PROFILE_BYTES = 4 << 20
#: Modes of images by the color spaces of profiles.
_MODES = {"RGB": "RGB", "GRAY": "L", "CMYK": "CMYK"}
#: Maximum change of 8-bit values by a profile that counts as sRGB. Published sRGB profiles differ in the last digits.
_ROUNDING = 1
#: What the chunks gAMA and cHRM of a PNG state for sRGB: the exponent, then xy of white, red, green and blue.
_SRGB_CHUNKS, _CHUNK_ROUNDING = (0.45455, 0.3127, 0.3290, 0.64, 0.33, 0.30, 0.60, 0.15, 0.06), 0.005
#: Spacing of the 8-bit colors for which a profile is compared with sRGB.
_PROBE_STEP = 15


class ColorProfile:
    """ICC profile of an image.

    Args:
        mode: Mode of the image that it belongs to: "L", "RGB" or "CMYK".

    Attributes:
        changes: Whether the profile differs from sRGB, so that colors change.

    Raises:
        ValueError: If the profile is broken, too large, or not for such images. The message is the reason.
    """

    def __init__(self, data: bytes, mode: str) -> None:
        if len(data) > MAX_PROFILE_BYTES:
            raise ValueError(f"it has more than {MAX_PROFILE_BYTES >> 20} MiB")
        try:
            profile = ImageCms.ImageCmsProfile(io.BytesIO(_without_float_conversions(data)))
        except (ImageCms.PyCMSError, OSError) as error:
            raise ValueError("it is broken") from error
        space = profile.profile.xcolor_space.strip()
        self._mode = _MODES.get(space, "")
        if self._mode != mode and (self._mode, mode) != ("RGB", "L"):
            raise ValueError(f"it is for {space or 'unknown'} colors")
        # By default, LittleCMS combines a conversion into one table in advance, which may be wrong by 10/255. Only that
        # of a matrix is exact to 8 bits.
        precise = self._mode == "RGB" and profile.profile.is_matrix_shaper
        flags = ImageCms.Flags.NONE if precise else ImageCms.Flags.NOOPTIMIZE
        try:
            self._transform = ImageCms.buildTransform(
                profile, _srgb(), self._mode, "RGB", ImageCms.Intent.PERCEPTUAL, flags
            )
        except ImageCms.PyCMSError as error:
            raise ValueError("it lacks what a conversion to sRGB needs") from error
        self.changes = self._mode == "CMYK" or self._differs_from_srgb()

    def to_srgb(self, image: Image.Image) -> Image.Image:
        """Convert an image to sRGB, in mode RGB. Transparency is dropped."""
        converted = ImageCms.applyTransform(image.convert(self._mode), self._transform)
        assert converted is not None  # it is None only for conversions in place
        return converted

    def _differs_from_srgb(self) -> bool:
        """Return whether the profile changes a grid of colors, by more than rounding."""
        axis = np.arange(0, 256, _PROBE_STEP, dtype=np.uint8)
        if self._mode == "L":
            probe = Image.fromarray(axis[None])
        else:
            probe = Image.fromarray(np.stack(np.meshgrid(axis, axis, axis), axis=3).reshape(len(axis), -1, 3))
        change = np.asarray(self.to_srgb(probe), np.int16) - np.asarray(probe.convert("RGB"), np.int16)
        return int(np.abs(change).max()) > _ROUNDING


def _without_float_conversions(data: bytes) -> bytes:
    """Rename the tags of a profile's optional floating-point conversions, D2B0 to D2B3, so that they are not used.

    They may have any number of steps: a profile of 1 MB would take hours. Every profile has another conversion, by
    tables or a matrix, with a fixed number of steps (ICC.1:2010, section 8).
    """
    profile = bytearray(data)
    tags = int.from_bytes(profile[128:132], "big")
    for position in range(132, min(132 + 12 * tags, len(profile)), 12):
        if profile[position : position + 3] == b"D2B":
            profile[position] = ord("x")
    return bytes(profile)


@functools.cache
def _srgb() -> ImageCms.ImageCmsProfile:
    """Return an sRGB profile of ICC version 2.

    With version 4, the perceptual intent would map the darkest ink of a printing process to black. ImageMagick and most
    viewers do not.
    """
    data = bytearray(ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes())
    data[8] = 2
    return ImageCms.ImageCmsProfile(io.BytesIO(bytes(data)))


#: Maximum relative difference between the aspect ratios of a photo and its camera. A larger difference indicates a
#: wrong or cropped photo.
ASPECT_TOLERANCE = 0.01
#: Largest fraction of the cameras that may lack a photo.
MAX_MISSING = 0.5

_NAMES_IN_MESSAGE = 10
_BY_NAME = "Files are found by the cameras' names, with or without extension: give the folder that holds exactly these."


@dataclass(frozen=True)
class Photo:
    """Photo of a camera.

    Attributes:
        oriented: Whether the EXIF orientation is applied. COLMAP ignores it, so it is used only if the photo does not
            fit its camera otherwise.
        ambiguous: Whether the photo would fit its camera in both orientations.
    """

    path: Path
    oriented: bool = False
    ambiguous: bool = False


class PhotoFolder:
    """Image files in a folder and its subfolders, found by the names of cameras.

    A name matches a file with or without its extension. Leading folders of the name are dropped until a file matches:
    "images/cam0/0001.png" matches FOLDER/images/cam0/0001.png, else FOLDER/cam0/0001.jpg, else FOLDER/0001.jpg.
    If nothing matches, upper and lower case count as the same, unless that would match several files.

    Args:
        masks: Whether the files are masks, which may also be named as those of COLMAP (0001.jpg.png) and RealityScan
            (0001.jpg.mask.png) if no file has a camera's name.
    """

    def __init__(self, folder: Path, *, masks: bool = False) -> None:
        self._folder = folder
        self._extensions = {*Image.registered_extensions(), *HEIF_SUFFIXES}
        #: Files by every trailing part of their relative path, without extension.
        self._index: dict[tuple[str, ...], list[Path]] = {}
        #: Masks by their names without `.mask`, and without the extension of a photo.
        self._masks: dict[tuple[str, ...], list[Path]] = {}
        #: Files by their names in lower case.
        self._folded: dict[tuple[str, ...], list[Path]] = {}
        for path in sorted(folder.rglob("*")):
            if path.suffix.lower() in self._extensions and not path.name.startswith(".") and path.is_file():
                stem = _normalized(str(path.relative_to(folder))).with_suffix("")
                _add(self._index, stem, path)
                _add(self._folded, PurePath(str(stem).casefold()), path)
                if masks:
                    photo = stem.with_suffix("") if stem.suffix.lower() == ".mask" else stem
                    for name in {photo, self._without_extension(photo)}:
                        _add(self._masks, name, path)

    def named(self, name: str) -> list[Path]:
        """Return the files that match a camera's name best.

        The longest matching path wins, then files outside deeper subfolders, then files with the exact extension.
        """
        wanted = _normalized(name)
        stem = self._without_extension(wanted)
        for index, key in ((self._index, stem), (self._masks, wanted), (self._masks, stem)):
            paths = self._best(index, key, wanted.suffix)
            if paths:
                return paths
        paths = self._best(self._folded, PurePosixPath(str(stem).casefold()), wanted.suffix)
        return paths if len(paths) == 1 else []

    def strangers(self, names: Collection[str]) -> list[str]:
        """Return the paths of files with the name of no camera, in any folder and case; hidden files are left out."""
        matching: set[Path] = set()
        for name in names:
            wanted = PurePath(_normalized(name).name)
            stem = str(self._without_extension(wanted))
            for index, key in ((self._folded, stem.casefold()), (self._masks, str(wanted)), (self._masks, stem)):
                matching.update(index.get((key,), ()))
        others = (path for path in sorted(self._folder.rglob("*")) if path.is_file() and path not in matching)
        return [str(_normalized(str(path.relative_to(self._folder)))) for path in others if path.name[0] != "."]

    def _best(self, index: dict[tuple[str, ...], list[Path]], name: PurePath, suffix: str) -> list[Path]:
        parts = tuple(part for part in name.parts if part not in ("..", "/"))
        for start in range(len(parts)):
            paths = index.get(parts[start:], [])
            if paths:
                depth = len(self._folder.parts) + len(parts) - start
                direct = [path for path in paths if len(path.parts) == depth] or paths
                return [path for path in direct if path.suffix == suffix] or direct
        return []

    def _without_extension(self, name: PurePath) -> PurePath:
        """Return a name without the extension of an image."""
        return name.with_suffix("") if name.suffix.lower() in self._extensions else name


def _add(index: dict[tuple[str, ...], list[Path]], name: PurePath, path: Path) -> None:
    """Add a file to an index under every trailing part of its name."""
    parts = name.parts
    for start in range(len(parts)):
        index.setdefault(parts[start:], []).append(path)


def _normalized(name: str) -> PurePosixPath:
    """Return a name of a camera or file in the form in which they are compared.

    Accents are composed, since macOS stores them decomposed; names that are not UTF-8 are those of `label`; and
    separators are those of Windows or POSIX.
    """
    return PurePosixPath(unicodedata.normalize("NFC", label(os.fsencode(name)).replace("\\", "/")))


def check_photos(folder: Path, cameras: Sequence[Camera]) -> list[Photo | None]:
    """Find the photo of each camera (see `PhotoFolder`), and check it.

    Only headers are read, so that errors occur before long work starts.

    Returns:
        Photos in the order of the cameras, for `load_photo`; None for a camera without one.

    Raises:
        ImageError: If a photo cannot be read or its aspect differs from its camera's, if more than half of the photos
            are missing, or if one is ambiguous. The message names the views.
    """
    matches = _matches(folder, cameras, "photo")
    missing = [photo_name(camera) for camera, paths in zip(cameras, matches, strict=True) if not paths]
    if len(missing) > MAX_MISSING * len(cameras):
        raise ImageError(
            f"{folder}: holds no photo for {len(missing)} of {len(cameras)} views: {some_names(missing)}. {_BY_NAME}"
        )
    return [_fitting(paths[0], camera) if paths else None for camera, paths in zip(cameras, matches, strict=True)]


def _matches(folder: Path, cameras: Sequence[Camera], kind: str) -> list[list[Path]]:
    """Return the file that matches each camera's name, or none.

    Args:
        kind: "photo" or "mask".

    Raises:
        ImageError: If there is no such folder, or a camera has several files.
    """
    if not folder.is_dir():
        raise ImageError(f"{folder}: is not a folder of {kind}s. Give the folder that the cameras' names refer to.")
    files = PhotoFolder(folder, masks=kind == "mask")
    matches = [files.named(photo_name(camera)) for camera in cameras]
    several = {photo_name(camera): paths for camera, paths in zip(cameras, matches, strict=True) if len(paths) > 1}
    if several:
        first = " and ".join(str(path.relative_to(folder)) for path in next(iter(several.values()))[:2])
        raise ImageError(
            f"{folder}: holds more than one {kind} for {len(several)} of {len(cameras)} views: "
            f"{some_names([*several])} (such as {first}). {_BY_NAME}"
        )
    return matches


def check_names(folder: Path, names: Sequence[str], *, masks: bool = False) -> None:
    """Check that every file of a folder has the name of a camera (see `PhotoFolder`).

    The command line reads what it needs of a folder. Who sends files to the service means all of them.

    Raises:
        ImageError: If a file belongs to no camera.
    """
    strangers = PhotoFolder(folder, masks=masks).strangers(names)
    if strangers:
        raise ImageError(
            f"{some_names(strangers)}: {len(strangers)} of the {'masks' if masks else 'photos'} have the name of none "
            f"of {len(names)} cameras: {some_names(names)}. Name them as the cameras do, or leave them out."
        )


def some_names(names: Sequence[str]) -> str:
    """Return the first different names of a list, separated by commas."""
    different = list(dict.fromkeys(names))  # the faces of a panorama have one photo
    return ", ".join(different[:_NAMES_IN_MESSAGE]) + (", ..." if len(different) > _NAMES_IN_MESSAGE else "")


def find_masks(folder: Path, cameras: Sequence[Camera]) -> list[Photo | None]:
    """Find the masks of cameras by name (see `PhotoFolder`). Only headers are read.

    Returns:
        Mask of each camera; None for a camera without one.

    Raises:
        ImageError: If no camera has a mask, a camera has several, or the aspect of a mask differs from its camera's.
    """
    matches = _matches(folder, cameras, "mask")
    masks = [_fitting(paths[0], camera) if paths else None for camera, paths in zip(cameras, matches, strict=True)]
    if not any(masks):
        raise ImageError(
            f"{folder}: holds no mask for any of {len(cameras)} views. Masks are found by the cameras' names, with or "
            f"without extension, or with `.png` or `.mask.png` behind it, such as {photo_name(cameras[0])}."
        )
    return masks


def load_photo(photo: Photo, camera: Camera, *, background: Color = BLACK, color_managed: bool = True) -> Tensor:
    """Read a photo as its pinhole camera sees it: [height, width, 3] float32 in 0..1.

    If the camera has a lens, its distortion is removed (`undistort`), and a cube face is taken from its panorama.
    Otherwise the photo is resized to the camera's size (antialiased bicubic).

    Args:
        photo: Photo of the camera, from `check_photos` or `find_masks`.
        camera: Camera at the size of the result.
        background: sRGB color behind transparent parts, in 0..1; black, as in masks and renders, by default.
        color_managed: Whether the ICC profile is applied. Masks hold no colors.

    Raises:
        ImageError: If the photo cannot be read (see `load_image`), or its aspect differs from the camera's.
    """
    pixels = load_image(photo.path, background=background, oriented=photo.oriented, color_managed=color_managed)
    if not fits((pixels.shape[1], pixels.shape[0]), camera):
        raise _misfit(photo.path, (pixels.shape[1], pixels.shape[0]), camera)
    if camera.lens is not None:
        return undistort(pixels, camera)
    if pixels.shape[:2] == (camera.height, camera.width):
        return pixels
    planes = pixels.permute(2, 0, 1)[None]
    small = torch.nn.functional.interpolate(
        planes, (camera.height, camera.width), mode="bicubic", antialias=True, align_corners=False
    )
    return small[0].permute(1, 2, 0).clamp(0, 1).contiguous()  # bicubic interpolation overshoots at edges


def undistort(photo: Tensor, camera: Camera) -> Tensor:
    """Return a photo as the pinhole camera would have taken it, by one bilinear sampling: [height, width, 3] float32.

    A photo with more pixels than the camera is reduced first, so that sampling does not alias.

    Args:
        photo: Original photo [H, W, 3] float32, of the lens's aspect ratio.
    """
    lens = camera.lens
    assert lens is not None
    planes = photo.permute(2, 0, 1)[None]
    density = min(1.0, camera.fx / lens.fx * lens.width / photo.shape[1])
    if density < 1:
        size = [max(1, round(side * density)) for side in photo.shape[:2]]
        planes = torch.nn.functional.interpolate(planes, size, mode="bicubic", antialias=True, align_corners=False)
    x = (torch.arange(camera.width, dtype=torch.float64) + 0.5 - camera.cx) / camera.fx
    y = (torch.arange(camera.height, dtype=torch.float64) + 0.5 - camera.cy) / camera.fy
    u, v = lens.positions(*torch.meshgrid(x, y, indexing="xy"))
    if camera.panorama is not None:  # beyond a pole is the other side, beyond the right edge the left one
        above, below = planes[:, :, [0, -1]].roll(planes.shape[3] // 2, dims=3).split(1, dim=2)
        planes = torch.cat([above, planes, below], dim=2)
        planes = torch.nn.functional.pad(planes, (1, 1, 0, 0), mode="circular")
        u = (u - 0.5) * (1 - 2 / planes.shape[3]) + 0.5
        v = (v - 0.5) * (1 - 2 / planes.shape[2]) + 0.5
    grid = (2 * torch.stack([u, v], dim=2) - 1).float()[None]
    sampled = torch.nn.functional.grid_sample(planes, grid, "bilinear", "border", align_corners=False)
    return sampled[0].permute(1, 2, 0).clamp(0, 1).contiguous()


def fits(size: tuple[int, int], camera: Camera) -> bool:
    """Return whether an image of this width and height has the aspect ratio of a camera's photos."""
    width, height = photo_size(camera)
    # a camera's size is rounded to whole pixels, which changes the aspect ratio of a small camera
    allowed = ASPECT_TOLERANCE + 0.5 / min(width, height)
    return abs(size[0] * height / (size[1] * width) - 1) <= allowed


def photo_name(camera: Camera) -> str:
    """Return the name of a camera's photo: its own, or that of the panorama of which it is a face."""
    return camera.panorama or camera.name


def photo_size(camera: Camera) -> tuple[int, int]:
    """Return width and height of a camera's photos: its own, or those of its lens."""
    frame = camera.lens or camera
    return frame.width, frame.height


def _fitting(path: Path, camera: Camera) -> Photo:
    """Return the photo in the orientation that fits the camera."""
    stored, orientation = stored_size(path)
    rotated = (stored[1], stored[0]) if orientation >= 5 else stored
    if fits(stored, camera):
        return Photo(path, ambiguous=orientation != 1 and fits(rotated, camera))
    if not fits(rotated, camera):
        raise _misfit(path, stored, camera)
    return Photo(path, oriented=True)


def _misfit(path: Path, size: tuple[int, int], camera: Camera) -> ImageError:
    width, height = photo_size(camera)
    return ImageError(
        f"{path}: is {size[0]} x {size[1]}, but its camera {camera.name!r} {width} x {height}, another aspect ratio. "
        "Give the photos that the cameras were computed from, neither cropped nor rotated."
    )
