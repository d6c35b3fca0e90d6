"""Photos and masks of cameras: found by name, checked by their headers, and read as their pinhole cameras see them."""

from __future__ import annotations

import os
import unicodedata
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePath, PurePosixPath

import torch
from PIL import Image
from torch import Tensor

from sgsst_core.errors import ImageError
from sgsst_core.files.camera_folder import label
from sgsst_core.files.images import BLACK, HEIF_SUFFIXES, Color, load_image, stored_size
from sgsst_core.scene.camera import Camera

#: Maximum relative difference between the aspect ratios of a photo and its camera. A larger difference indicates a
#: wrong or cropped photo.
ASPECT_TOLERANCE = 0.01
#: Largest fraction of the cameras that may lack a photo.
MAX_MISSING = 0.5

_NAMES_IN_MESSAGE = 10


@dataclass(frozen=True)
class Photo:
    """Photo of a camera.

    Attributes:
        size: Width and height in pixels, in the orientation that is used.
        oriented: Whether the EXIF orientation is applied. COLMAP ignores it, so it is used only if the photo does not
            fit its camera otherwise.
        ambiguous: Whether the photo would fit its camera in both orientations.
    """

    path: Path
    size: tuple[int, int]
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

    def unreadable(self, names: Collection[str]) -> list[str]:
        """Return the suffixes of files that have these names of cameras, but no suffix of an image."""
        stems = {self._without_extension(_normalized(name)).name for name in names}
        return sorted({path.suffix for path in self._folder.rglob("*") if path.stem in stems} - self._extensions - {""})

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
    if not folder.is_dir():
        raise ImageError(f"{folder}: is not a folder of photos. Give the folder that the cameras' names refer to.")
    files = PhotoFolder(folder)
    names = [photo_name(camera) for camera in cameras]
    matches = [files.named(name) for name in names]
    missing = [name for name, paths in zip(names, matches, strict=True) if not paths]
    several = {name: paths for name, paths in zip(names, matches, strict=True) if len(paths) > 1}
    by_name = (
        "Photos are found by the cameras' names, with or without extension: give the folder that holds exactly these."
    )
    if len(missing) > MAX_MISSING * len(cameras):
        suffixes = files.unreadable(missing)
        advice = (
            f"Files of these names are {', '.join(suffixes)}: convert them to PNG or JPEG." if suffixes else by_name
        )
        raise ImageError(
            f"{folder}: holds no photo for {len(missing)} of {len(cameras)} views: {some_names(missing)}. {advice}"
        )
    if several:
        first = " and ".join(str(path.relative_to(folder)) for path in next(iter(several.values()))[:2])
        raise ImageError(
            f"{folder}: holds more than one photo for {len(several)} of {len(cameras)} views: {some_names([*several])} "
            f"(such as {first}). {by_name}"
        )
    return [_fitting(paths[0], camera) if paths else None for camera, paths in zip(cameras, matches, strict=True)]


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
    if not folder.is_dir():
        raise ImageError(f"{folder}: is not a folder of masks. Give the folder that the cameras' names refer to.")
    files = PhotoFolder(folder, masks=True)
    masks: list[Photo | None] = []
    for camera in cameras:
        paths = files.named(photo_name(camera))
        if len(paths) > 1:
            raise ImageError(f"{folder}: holds more than one mask for view {photo_name(camera)}. Leave one.")
        masks.append(_fitting(paths[0], camera) if paths else None)
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
        return Photo(path, stored, ambiguous=orientation != 1 and fits(rotated, camera))
    if not fits(rotated, camera):
        raise _misfit(path, stored, camera)
    return Photo(path, rotated, oriented=True)


def _misfit(path: Path, size: tuple[int, int], camera: Camera) -> ImageError:
    width, height = photo_size(camera)
    return ImageError(
        f"{path}: is {size[0]} x {size[1]}, but its camera {camera.name!r} {width} x {height}, another aspect ratio. "
        "Give the photos that the cameras were computed from, neither cropped nor rotated."
    )
