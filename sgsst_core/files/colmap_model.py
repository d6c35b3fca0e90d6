"""Reader of cameras and poses in COLMAP sparse models, binary or text, as COLMAP's "Output Format" page defines them.

Only `cameras` and `images` are read, which contain everything that a view needs: COLMAP writes the pose of each image
into `images`, even if `rigs` and `frames` also determine it. `points3D`, `rigs` and `frames` are never opened.
"""

from __future__ import annotations

import mmap
import re
import struct
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

from sgsst_core.errors import CameraError

T = TypeVar("T")

_CONVERT = "Convert it with `colmap image_undistorter`, and give the OUT/sparse that it writes"
_EXPORT_AGAIN = "Export the model again."

#: COLMAP's camera models by number: name and number of parameters.
_MODELS = {
    0: ("SIMPLE_PINHOLE", 3),
    1: ("PINHOLE", 4),
    2: ("SIMPLE_RADIAL", 4),
    3: ("RADIAL", 5),
    4: ("OPENCV", 8),
    5: ("OPENCV_FISHEYE", 8),
    6: ("FULL_OPENCV", 12),
    7: ("FOV", 5),
    8: ("SIMPLE_RADIAL_FISHEYE", 4),
    9: ("RADIAL_FISHEYE", 5),
    10: ("THIN_PRISM_FISHEYE", 12),
    11: ("RAD_TAN_THIN_PRISM_FISHEYE", 16),
    12: ("SIMPLE_DIVISION", 4),
    13: ("DIVISION", 5),
    14: ("SIMPLE_FISHEYE", 3),
    15: ("FISHEYE", 4),
    16: ("EUCM", 6),
    17: ("EQUIRECTANGULAR", 2),
}
_PARAMETERS = dict(_MODELS.values())
#: Stricter than `int` and `float`, which accept `1_0` and digits of other scripts.
_INTEGER = re.compile("[0-9]{1,18}")
_NUMBER = re.compile(r"[+-]?([0-9]+(\.[0-9]*)?|\.[0-9]+)([eE][+-]?[0-9]+)?")


@dataclass(frozen=True)
class ColmapCamera:
    """Intrinsics of a camera: name of the model, size in pixels, and parameters in the model's order."""

    model: str
    width: int
    height: int
    parameters: tuple[float, ...]


@dataclass(frozen=True)
class ColmapImage:
    """Registered image with its pose.

    Attributes:
        name: Path of the image, relative to COLMAP's image folder.
        camera: ID of its camera.
        rotation: Quaternion wxyz, world to camera, as stored.
        translation: Translation, world to camera.
    """

    name: str
    camera: int
    rotation: tuple[float, float, float, float]
    translation: tuple[float, float, float]


def read_model(folder: Path) -> tuple[dict[int, ColmapCamera], list[ColmapImage]]:
    """Read the cameras by ID, and the registered images in the file's order.

    Binary files take precedence over text files, as in COLMAP.

    Raises:
        CameraError: If a file is missing, truncated, or has an invalid value. The message names the file.
    """
    if (folder / "cameras.bin").is_file():
        cameras = _by_id(folder / "cameras.bin", _binary(folder / "cameras.bin", _binary_camera))
        images = _by_id(folder / "images.bin", _binary(folder / "images.bin", _binary_image))
    else:
        cameras = _by_id(folder / "cameras.txt", _text_cameras(folder / "cameras.txt"))
        images = _by_id(folder / "images.txt", _text_images(folder / "images.txt"))
    return cameras, list(images.values())


def _by_id(path: Path, entries: Iterator[tuple[int, T]]) -> dict[int, T]:
    by_id: dict[int, T] = {}
    try:
        for number, entry in entries:
            if number in by_id:
                raise CameraError(f"{path}: has id {number} twice. Export the model again.")
            by_id[number] = entry
    except OSError as error:
        raise CameraError(f"{path}: cannot be read: {error.strerror}. Copy the model again.") from error
    except KeyError as error:
        raise CameraError(f"{path}: has an unknown COLMAP camera model, number {error}. {_CONVERT}.") from error
    except (struct.error, EOFError, ValueError) as error:
        raise CameraError(f"{path}: is truncated or corrupt. Copy the model again.") from error
    return by_id


def _binary(path: Path, read: Callable[[mmap.mmap, int], tuple[int, T, int]]) -> Iterator[tuple[int, T]]:
    """Yield as many entries as the file declares; raise EOFError for an entry beyond the end of the file."""
    with path.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
        position = 8
        for _ in range(struct.unpack_from("<Q", data)[0]):
            number, entry, position = read(data, position)
            if position > len(data):
                raise EOFError
            yield number, entry


def _binary_camera(data: mmap.mmap, position: int) -> tuple[int, ColmapCamera, int]:
    """Read a camera: ID (uint32), model (int32), width and height (uint64), parameters (float64)."""
    number, model, width, height = struct.unpack_from("<IiQQ", data, position)
    name, count = _MODELS[model]
    parameters = struct.unpack_from(f"<{count}d", data, position + 24)
    return number, ColmapCamera(name, width, height, parameters), position + 24 + 8 * count


def _binary_image(data: mmap.mmap, position: int) -> tuple[int, ColmapImage, int]:
    """Read an image: ID (uint32), pose (7 float64), camera (uint32), name (null-terminated), points.

    The points are a count (uint64) and 24 bytes each; they are skipped.
    """
    number, *pose, camera = struct.unpack_from("<I7dI", data, position)
    end_of_name = data.find(b"\0", position + 64)
    if end_of_name < 0:
        raise EOFError
    name = data[position + 64 : end_of_name].decode()
    points: int = struct.unpack_from("<Q", data, end_of_name + 1)[0]
    return number, _image(name, camera, pose), end_of_name + 9 + 24 * points


def _text_cameras(path: Path) -> Iterator[tuple[int, ColmapCamera]]:
    """Yield cameras from lines of ID, model name, width, height and parameters."""
    for where, line in _lines(path):
        words = line.split()
        model = words[1] if len(words) > 1 else ""
        if model not in _PARAMETERS or len(words) != 4 + _PARAMETERS[model]:
            raise CameraError(
                f"{where}: expected id, COLMAP camera model, width, height and its parameters. {_EXPORT_AGAIN}"
            )
        number, width, height = (_integer(where, word) for word in (words[0], *words[2:4]))
        yield number, ColmapCamera(model, width, height, tuple(_number(where, word) for word in words[4:]))


def _text_images(path: Path) -> Iterator[tuple[int, ColmapImage]]:
    """Yield images from pairs of lines.

    The first line holds ID, quaternion, translation, camera ID and name. The second holds points and is skipped.
    """
    lines = _lines(path, points_follow=True)
    for where, line in lines:
        words = line.split(maxsplit=9)
        if len(words) != 10:
            raise CameraError(f"{where}: expected id, 7 numbers of the pose, camera id and name. {_EXPORT_AGAIN}")
        pose = [_number(where, word) for word in words[1:8]]
        yield _integer(where, words[0]), _image(words[9], _integer(where, words[8]), pose)


def _lines(path: Path, *, points_follow: bool = False) -> Iterator[tuple[str, str]]:
    """Yield the location of each line (for error messages) and its text.

    Blank lines and comments are skipped. If `points_follow` is set, the line after each yielded line is skipped too.
    """
    with path.open("rb") as file:
        numbered = enumerate(file, start=1)
        for number, data in numbered:
            line = data.decode().strip()
            if line and not line.startswith("#"):
                yield f"{path}: line {number}", line
                if points_follow:
                    next(numbered, None)


def _image(name: str, camera: int, pose: Sequence[float]) -> ColmapImage:
    w, x, y, z, *translation = pose
    return ColmapImage(name, camera, (w, x, y, z), (translation[0], translation[1], translation[2]))


def _integer(where: str, word: str) -> int:
    if not _INTEGER.fullmatch(word):
        raise CameraError(f"{where}: {word[:40]!r} is not a whole number. {_EXPORT_AGAIN}")
    return int(word)


def _number(where: str, word: str) -> float:
    if not _NUMBER.fullmatch(word):
        raise CameraError(f"{where}: {word[:40]!r} is not a number. {_EXPORT_AGAIN}")
    return float(word)
