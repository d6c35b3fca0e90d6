"""Files of cameras: which file of a folder holds them, and COLMAP sparse models. PyTorch is not imported.

COLMAP's models are read, binary or text, as its "Output Format" page defines them. Only `cameras` and `images` are
read, which contain everything that a view needs: COLMAP writes the pose of each image into `images`, even if `rigs` and
`frames` also determine it. `points3D`, `rigs` and `frames` are never opened.
"""

import codecs
import json
import mmap
import re
import struct
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

from sgsst_core.errors import CameraError
from sgsst_core.files.advice import CAMERAS, POINTER, refuse_camera_folder, refuse_known

FORMATS = "an INRIA cameras.json, a COLMAP sparse model or a nerfstudio/Blender transforms.json"
#: Names of JSON files with cameras, in order of preference. Any other name is read if it is the only one.
_JSON_NAMES = ("transforms.json", "transforms_train.json", "cameras.json")
#: JSON files of a folder that are searched.
_SEARCHED_FILES = 100


def find_cameras(path: Path) -> Path:
    """Return the JSON file or the folder of a COLMAP model that a file or folder stands for.

    A folder may be a COLMAP model, may hold such a model in sparse/0, sparse or another folder of sparse, or may hold a
    transforms.json, transforms_train.json, cameras.json, a model in colmap/sparse, or one other JSON file with cameras.

    Raises:
        CameraError: If a folder holds no cameras, or several files with cameras. The message says what it holds.
    """
    if not path.is_dir():
        is_model = path.suffix in (".bin", ".txt") and path.name.startswith(("cameras", "images", "points3D"))
        return path.parent if is_model else path
    return _named(path) or _only_json(path)


def cameras_beside(scene: Path) -> Path | None:
    """Return the folder or JSON file of the cameras that belong to a scene; None if none lie beside it.

    They are in the folder of the scene, or in RUN if the scene is RUN/point_cloud/iteration_N/point_cloud.ply, as the
    original 3DGS code writes it. The names are those of `find_cameras`.

    Raises:
        CameraError: If a folder holds several files with cameras, none of which has a usual name.
    """
    folder = scene.absolute().parent
    folders = (folder, folder.parent.parent) if folder.parent.name == "point_cloud" else (folder,)
    held = (find_cameras(each) for each in folders if _named(each) or _holding(each))
    return next(held, None)


def has_model(folder: Path) -> bool:
    """Return whether a folder holds the cameras of a COLMAP model."""
    return (folder / "cameras.bin").is_file() or (folder / "cameras.txt").is_file()


def _named(folder: Path) -> Path | None:
    """Return the first COLMAP model or JSON file in a folder that has one of the usual names; None if there is none."""
    sparse = folder / "sparse"
    files = [folder / name for name in _JSON_NAMES]
    numbered = (path for path in sparse.glob("[0-9]*") if path.is_dir())  # COLMAP writes its models in such folders
    models = [folder, sparse / "0", sparse, *sorted(numbered, key=lambda path: (len(path.name), path))]
    usual = [*models, *files, folder / "colmap" / "sparse" / "0"]
    return next((each for each in usual if has_model(each) or (each in files and each.is_file())), None)


def load_json(path: Path) -> Any:
    """Return the content of a JSON file.

    Raises:
        CameraError: If the file cannot be read, is not JSON, or is in a known format that cannot be read.
    """
    try:
        refuse_known(path, CAMERAS, CameraError)
        return json.loads(path.read_text(encoding="utf-8-sig"))
    except OSError as error:
        raise CameraError(f"{path}: cannot be read: {error.strerror}. Check the path, or give {FORMATS}.") from error
    except (ValueError, RecursionError) as error:  # invalid JSON, or bytes that are not UTF-8
        raise CameraError(f"{path}: is neither JSON nor a COLMAP model ({error}). Give {FORMATS}.") from error


def _only_json(folder: Path) -> Path:
    """Return the only JSON file in a folder that holds cameras."""
    files, holding = _json_files(folder), _holding(folder)
    if len(holding) > 1:
        names = ", ".join(path.name for path in holding)
        raise CameraError(f"{folder}: holds several files with cameras: {names}. Give one of them.")
    if holding:
        return holding[0]
    refuse_camera_folder(folder)
    if len(files) == 1:
        return files[0]  # its reader says what is wrong with it
    raise CameraError(f"{folder}: holds no cameras in a known format. Give {FORMATS}.")


def _json_files(folder: Path) -> list[Path]:
    """Return the JSON files in a folder that are searched."""
    return [path for path in sorted(folder.glob("*.json"))[:_SEARCHED_FILES] if path.is_file()]


def _holding(folder: Path) -> list[Path]:
    """Return the JSON files in a folder that hold cameras."""
    return [path for path in _json_files(folder) if _holds_cameras(path)]


def _holds_cameras(path: Path) -> bool:
    """Return whether a JSON file begins as one of the formats that can be read."""
    try:
        content = load_json(path)
    except CameraError:
        return False
    if isinstance(content, dict):
        frames = content.get("frames")
        return isinstance(frames, list) and bool(frames) and isinstance(frames[0], dict) and "file_path" in frames[0]
    first = content[0] if isinstance(content, list) and content else None
    return isinstance(first, dict) and {"rotation", "position"} <= first.keys()


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
#: Numbers of parameters by name in text files. Programs that had panoramas before COLMAP call them SPHERICAL.
_PARAMETERS = {**dict(_MODELS.values()), "SPHERICAL": 2}
#: Stricter than `int` and `float`, which accept `1_0` and digits of other scripts.
_INTEGER = re.compile("[0-9]{1,18}")
_NUMBER = re.compile(r"[+-]?([0-9]+(\.[0-9]*)?|\.[0-9]+)([eE][+-]?[0-9]+)?")
#: Line of points: x, y and ID of the 3D point of each. The possessive quantifiers keep the time linear.
_POINTS = re.compile(rb"(?:(?:(?:[-+.0-9eE]++|-?nan|-?inf)(?:\s++|$)){3}+)++")


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
    rotation: Sequence[float]
    translation: Sequence[float]


def read_model(folder: Path) -> tuple[dict[int, ColmapCamera], list[ColmapImage]]:
    """Read the cameras by ID, and the registered images in the file's order.

    Binary files take precedence over text files, as in COLMAP.

    Raises:
        CameraError: If a file is missing, truncated, or has an invalid value. The message names the file.
    """
    cameras, images = folder / "cameras.bin", folder / "images.bin"
    if cameras.is_file():
        return (
            _by_id(cameras, _binary(cameras, _binary_camera)),
            list(_by_id(images, _binary(images, _binary_image)).values()),
        )
    cameras, images = folder / "cameras.txt", folder / "images.txt"
    return _by_id(cameras, _text_cameras(cameras)), list(_by_id(images, _text_images(images)).values())


def _by_id(path: Path, entries: Iterator[tuple[int, T]]) -> dict[int, T]:
    by_id: dict[int, T] = {}
    try:
        refuse_known(path, [POINTER], CameraError)
        for number, entry in entries:
            if number in by_id:
                raise CameraError(f"{path}: has id {number} twice. Export the model again.")
            by_id[number] = entry
    except OSError as error:
        raise CameraError(f"{path}: cannot be read: {error.strerror}. Copy the model again.") from error
    except KeyError as error:
        raise CameraError(f"{path}: has an unknown COLMAP camera model, number {error}. {_CONVERT}.") from error
    except (struct.error, ValueError) as error:
        raise CameraError(f"{path}: is truncated or corrupt. Copy the model again.") from error
    return by_id


def _binary(path: Path, read: Callable[[mmap.mmap, int], tuple[int, T, int]]) -> Iterator[tuple[int, T]]:
    """Yield as many entries as the file declares."""
    with path.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
        position, count = 8, struct.unpack_from("<Q", data)[0]
        for done in range(count):
            try:
                number, entry, position = read(data, position)
            except (struct.error, EOFError):
                position = len(data) + 1
            if position > len(data):
                raise CameraError(
                    f"{path}: is truncated or corrupt: it declares {count:,} {path.stem} and ends after {done:,}. Copy "
                    "the model again."
                )
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
    name = label(data[position + 64 : end_of_name])
    points: int = struct.unpack_from("<Q", data, end_of_name + 1)[0]
    return number, ColmapImage(name, camera, pose[:4], pose[4:]), end_of_name + 9 + 24 * points


def _text_cameras(path: Path) -> Iterator[tuple[int, ColmapCamera]]:
    """Yield cameras from lines of ID, model name, width, height and parameters."""
    for where, line in _lines(path):
        words = [label(word) for word in line.split()]
        model = words[1] if len(words) > 1 else ""
        if not words:
            continue
        if model not in _PARAMETERS or len(words) != 4 + _PARAMETERS[model]:
            raise CameraError(
                f"{where}: expected id, COLMAP camera model, width, height and its parameters. {_EXPORT_AGAIN}"
            )
        number, width, height = (_integer(where, word) for word in (words[0], *words[2:4]))
        yield number, ColmapCamera(model, width, height, tuple(_number(where, word) for word in words[4:]))


def _text_images(path: Path) -> Iterator[tuple[int, ColmapImage]]:
    """Yield images from lines of ID, quaternion, translation, camera ID and name.

    Each may be followed by a line of points, which is skipped. Some programs leave out such lines if they are empty.
    """
    may_be_points = False
    for where, line in _lines(path):
        words = [label(word) for word in line.split(maxsplit=9)]
        if not line or (may_be_points and _POINTS.fullmatch(line)):
            may_be_points = False
            continue
        if len(words) != 10:
            raise CameraError(
                f"{where}: expected id, 7 numbers of the pose, camera id and name, or the points of the image above as "
                f"x, y and id. {_EXPORT_AGAIN}"
            )
        pose = [_number(where, word) for word in words[1:8]]
        yield _integer(where, words[0]), ColmapImage(words[9], _integer(where, words[8]), pose[:4], pose[4:])
        may_be_points = True


def _lines(path: Path) -> Iterator[tuple[str, bytes]]:
    """Yield the location of each line (for error messages) and its text without blanks around it, except comments."""
    with path.open("rb") as file:
        for number, data in enumerate(file, start=1):
            line = data.removeprefix(codecs.BOM_UTF8).strip()
            if not line.startswith(b"#"):
                yield f"{path}: line {number}", line


def _integer(where: str, word: str) -> int:
    if not _INTEGER.fullmatch(word):
        raise CameraError(f"{where}: {word[:40]!r} is not a whole number. {_EXPORT_AGAIN}")
    return int(word)


def _number(where: str, word: str) -> float:
    if not _NUMBER.fullmatch(word):
        raise CameraError(f"{where}: {word[:40]!r} is not a number. {_EXPORT_AGAIN}")
    return float(word)


def label(name: bytes) -> str:
    """Return a name as text that can be printed and stored.

    A name that is not UTF-8, such as one in CP949 or GBK, gets one character per byte (ISO 8859-1): different names
    stay different.
    """
    try:
        return name.decode()
    except UnicodeDecodeError:
        return name.decode("latin-1")
