"""Readers of camera files: INRIA `cameras.json`, COLMAP sparse models, nerfstudio and Blender `transforms.json`.

All formats are converted to `Camera`: a pinhole camera with a world-to-camera pose, axes x right, y down, z forward,
and pixel centers at half-integers. This is COLMAP's convention; the JSON formats share it for the principal point. A
camera with lens distortion is the pinhole with the same focal lengths and principal point, and has a `Lens`. A
panorama becomes the cameras of its cube faces.
"""

import json
import math
from collections import ChainMap
from collections.abc import Callable, Iterable, Mapping, Sequence
from itertools import zip_longest
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from sgsst_core.errors import CameraError, ImageError
from sgsst_core.files.advice import refuse_camera_json
from sgsst_core.files.camera_folder import FORMATS, ColmapCamera, find_cameras, load_json, read_model
from sgsst_core.files.images import PhotoFolder, image_size
from sgsst_core.scene.camera import COEFFICIENTS, FORMULAS, Camera, Lens, cube_faces
from sgsst_core.scene.gaussians import exact_rotation

#: Largest deviation of a size from whole pixels that is attributed to rounding: 119.99999 is 120.
_WHOLE_TOLERANCE = 0.01

#: Largest deviation of a quaternion's length from 1 that is attributed to rounding in the file.
_QUATERNION_TOLERANCE = 0.01

#: Names of the camera model of 360-degree panoramas.
_PANORAMAS = ("EQUIRECTANGULAR", "SPHERICAL")
#: Other camera models without a focal length.
_NO_PINHOLES = ("ORTHOPHOTO", "OMNIDIRECTIONALSTEREO_L", "OMNIDIRECTIONALSTEREO_R")
#: Offset of a principal point from the middle of an image, relative to half its sides, above which an image counts as
#: resized if the file gives no sizes.
_OFF_CENTER = 0.1
#: COLMAP's camera models with a single focal length; the others have two.
_ONE_FOCAL = (
    *("SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE", "SIMPLE_FISHEYE"),
    "SIMPLE_DIVISION",
)


def read_cameras(path: Path, photos: Path | None = None) -> list[Camera]:
    """Detect the format of a camera file or folder (see `find_cameras`), and read its cameras.

    Cameras from JSON keep their order; COLMAP's images are sorted by name. A panorama has its front face in its place;
    the other faces of all panoramas follow, one direction after the other, so that evenly spread views look around.

    nerfstudio trains in a coordinate frame of its own. To match a scene exported by nerfstudio, cameras must be
    transformed by the `dataparser_transforms.json` of its training run. If that file lies beside the transforms.json,
    it is applied as in nerfstudio, along with `applied_transform` and `applied_scale`. Otherwise poses are used
    unchanged, which is correct for scenes trained in the coordinate frame of the camera file.

    Args:
        photos: Folder of the photos, whose sizes cameras get if the file states none. None looks for them beside the
            file, at the paths that it states.

    Raises:
        CameraError: If the file is missing, its format is unknown, it holds no cameras, a camera cannot be a pinhole,
            or a value is invalid. The message names the file and the camera.
    """
    file = find_cameras(path)
    if file.is_dir():
        return _read_colmap(file)
    content = load_json(file)
    refuse_camera_json(file, content)
    if isinstance(content, list):
        return _convert_entries(file, content, lambda where, entry: [_inria_camera(where, entry)])
    if isinstance(content, dict) and isinstance(content.get("frames"), list):
        return _read_transforms(file, content, photos)
    raise CameraError(f"{file}: is in no known camera format. Give {FORMATS}.")


def _convert_entries(
    path: Path, entries: list[Any], convert: Callable[[str, dict[str, Any]], list[Camera]]
) -> list[Camera]:
    """Convert the entries of a JSON list; error messages name the entry by its index."""
    if not entries:
        raise CameraError(f"{path}: holds no cameras. Export them again.")
    cameras = []
    for index, entry in enumerate(entries):
        where = f"{path}: camera {index}"
        if not isinstance(entry, dict):
            raise CameraError(f"{where}: is not an object with named values. Give {FORMATS}.")
        cameras.append(convert(where, entry))
    return _by_face(cameras)


def _by_face(cameras: Iterable[list[Camera]]) -> list[Camera]:
    """Return the cameras of images, of which a panorama has several: the first of each image, then the others."""
    return [camera for faces in zip_longest(*cameras) for camera in faces if camera is not None]


def _stated(values: Mapping[str, Any]) -> dict[str, Any]:
    """Return the values that are not null."""
    return {key: value for key, value in values.items() if value is not None}


def _inria_camera(where: str, entry: Mapping[str, Any]) -> Camera:
    entry = _stated(entry)
    name = _name(where, entry, "img_name", "id")
    where = f"{where} ({name!r})"
    pose = np.eye(4)
    pose[:3, :3] = _array(where, entry, "rotation", (3, 3))
    pose[:3, 3] = _array(where, entry, "position", (3,))
    width, height = _size(where, entry, "width", "height")
    fx, fy = (_number(where, entry, key) for key in ("fx", "fy"))
    cx, cy = (_number(where, entry, key) if key in entry else side / 2 for key, side in (("cx", width), ("cy", height)))
    return _camera(where, name, (width, height), (fx, fy, cx, cy), _inverse(where, pose))


def _read_transforms(path: Path, content: dict[str, Any], photos: Path | None) -> list[Camera]:
    files = PhotoFolder(photos) if photos is not None and photos.is_dir() else None
    common = _stated(content)
    change, scale = _training_frame(path, common)

    def convert(where: str, frame: dict[str, Any]) -> list[Camera]:
        name = str(PurePosixPath(_name(where, frame, "file_path").replace("\\", "/")))
        where = f"{where} ({name!r})"
        values = ChainMap(_stated(frame), common)  # a copy of the common values per frame could take hours
        size = _transforms_size(where, path.parent / name, values, files)
        pose = np.eye(4)
        pose[:3] = _array(where, values, "transform_matrix", (4, 4), (3, 4))[:3]
        pose = change @ pose
        pose[:3, 3] *= scale
        pose[:3, 1:3] *= -1  # from OpenGL's axes (x right, y up, z backward) to those of `Camera`
        model = _transforms_model(where, values)
        if model in _PANORAMAS:
            return _panorama(where, name, size, _inverse(where, pose))
        pinhole = _transforms_intrinsics(where, values, size)
        keys = COEFFICIENTS[FORMULAS.get(model)]
        coefficients = [_number(where, values, key) if values.get(key) is not None else 0.0 for key in keys]
        lens = Lens.of(model, coefficients, size, pinhole)
        return [_camera(where, name, size, pinhole, _inverse(where, pose), lens)]

    return _convert_entries(path, content["frames"], convert)


def _transforms_model(where: str, values: Mapping[str, Any]) -> str:
    """Return the name of the camera model; empty if the file gives none."""
    for key, kind, expected in (("camera_model", (str,), "a name"), ("is_fisheye", (bool, int), "true or false")):
        if key in values and not isinstance(values[key], kind):
            raise _wrong(where, key, values[key], expected)
    model = str(values.get("camera_model") or ("OPENCV_FISHEYE" if values.get("is_fisheye") else "")).upper()
    if model in _NO_PINHOLES or model.startswith("VR180"):
        raise CameraError(
            f"{where}: has camera model {model[:40]}, which is neither a pinhole with a lens nor a 360-degree panorama "
            "(EQUIRECTANGULAR). Give the cameras of such images."
        )
    return model


def _transforms_size(where: str, image: Path, values: Mapping[str, Any], files: PhotoFolder | None) -> tuple[int, int]:
    """Return width and height as given in the file, or else those of the image.

    Blender's format omits both the sizes and the extensions of image files.
    """
    if "w" in values and "h" in values:
        return _size(where, values, "w", "h")
    if files is None:
        candidates = [image, *(image.with_name(image.name + suffix) for suffix in (".png", ".jpg", ".jpeg"))]
    else:
        candidates = files.named(_name(where, values, "file_path"))
    for candidate in candidates:
        if candidate.is_file():
            try:
                return image_size(candidate)
            except ImageError as error:
                raise CameraError(f"{where}: gives no size, and its image does not either: {error}") from error
    raise CameraError(
        f"{where}: gives no size, and there is no image {image if files is None else 'of its name among the photos'}. "
        "Add the sizes as 'w' and 'h'."
    )


def _transforms_intrinsics(
    where: str, values: Mapping[str, Any], size: tuple[int, int]
) -> tuple[float, float, float, float]:
    focals: list[float | None] = []
    for focal, angle, side in (("fl_x", "camera_angle_x", size[0]), ("fl_y", "camera_angle_y", size[1])):
        if focal in values:
            focals.append(_number(where, values, focal))
        elif angle in values:
            radians = _number(where, values, angle)
            if not 0 < radians < math.pi:
                raise CameraError(f"{where}: {angle} is {radians}; an angle of view lies between 0 and pi. Correct it.")
            focals.append(side / 2 / math.tan(radians / 2))
        else:
            focals.append(None)
    fx, fy = focals
    if fx is None:
        raise CameraError(f"{where}: gives neither fl_x nor camera_angle_x. Add one.")
    cx = _number(where, values, "cx") if "cx" in values else size[0] / 2
    cy = _number(where, values, "cy") if "cy" in values else size[1] / 2
    off_center = min(abs(2 * cx / size[0] - 1), abs(2 * cy / size[1] - 1)) > _OFF_CENTER
    if off_center and not ("w" in values and "h" in values):
        raise CameraError(
            f"{where}: gives no size, its image has {size[0]} x {size[1]}, and its principal point is at {cx:g}, "
            f"{cy:g}. The image seems to be resized; add the sizes of the original images as 'w' and 'h'."
        )
    return fx, fx if fy is None else fy, cx, cy


def _training_frame(path: Path, content: Mapping[str, Any]) -> tuple[NDArray[Any], float]:
    """Return the matrix [4, 4] and the scale from the file's poses to those that nerfstudio trained with.

    nerfstudio stores T = T0 A and S = s0 a, where A and a (`applied_transform`, `applied_scale`) are already part of
    the file's poses. The training poses are s0 T0 pose.
    """
    dataparser = path.with_name("dataparser_transforms.json")
    if not dataparser.is_file():
        return np.eye(4), 1.0
    values = load_json(dataparser)
    if not isinstance(values, dict):
        raise CameraError(f"{dataparser}: needs a JSON object with `transform` and `scale`. Copy it again.")
    applied, stored = np.eye(4), np.eye(4)
    stored[:3] = _array(str(dataparser), values, "transform", (3, 4))
    if "applied_transform" in content:
        applied[:3] = _array(str(path), content, "applied_transform", (3, 4), (4, 4))[:3]
    scale = _number(str(dataparser), values, "scale")
    if "applied_scale" in content:
        scale /= _positive(str(path), "applied_scale", _number(str(path), content, "applied_scale"))
    change = stored @ np.linalg.inv(exact_rotation(f"{path}: applied_transform", applied))
    return change, _positive(str(dataparser), "scale", scale)


def _read_colmap(folder: Path) -> list[Camera]:
    lenses, images = read_model(folder)
    cameras = []
    for image in sorted(images, key=lambda image: image.name):
        where = f"{folder}: image {image.name!r}"
        lens = lenses.get(image.camera)
        if lens is None:
            raise CameraError(f"{where}: has camera {image.camera}, which the model lacks. Export the model again.")
        matrix = np.eye(4)
        matrix[:3, :3] = _rotation_matrix(where, image.rotation)
        matrix[:3, 3] = image.translation
        size = (lens.width, lens.height)
        if lens.model in _PANORAMAS:
            if lens.parameters != size:
                raise CameraError(
                    f"{where}: is a panorama of {size[0]} x {size[1]}, but the parameters of its camera state another "
                    "size. Export the model again."
                )
            cameras.append(_panorama(where, image.name, size, matrix))
        else:
            of_photos = _colmap_lens(where, lens)
            pinhole = (of_photos.fx, of_photos.fy, of_photos.cx, of_photos.cy)
            cameras.append([_camera(where, image.name, size, pinhole, matrix, of_photos)])
    if not cameras:
        raise CameraError(f"{folder}: the COLMAP model has no registered image. Run `colmap mapper` again.")
    return _by_face(cameras)


def _colmap_lens(where: str, camera: ColmapCamera) -> Lens:
    if camera.model in _ONE_FOCAL:
        fx, cx, cy, *rest = camera.parameters
        pinhole = (fx, fx, cx, cy)
    else:
        pinhole, rest = camera.parameters[:4], list(camera.parameters[4:])  # type: ignore[assignment]
    size = (camera.width, camera.height)
    if not np.isfinite(rest).all():
        raise CameraError(f"{where}: its camera holds NaN or infinite values. Export the cameras again.")
    return Lens.of(camera.model, rest, size, pinhole)


def _rotation_matrix(where: str, quaternion: Sequence[float]) -> NDArray[Any]:
    """Convert a unit quaternion wxyz to a matrix [3, 3], with the same rounding as COLMAP."""
    w, x, y, z = quaternion
    if not abs(math.hypot(w, x, y, z) - 1) <= _QUATERNION_TOLERANCE:  # length 0 would give the identity
        raise CameraError(f"{where}: its quaternion has length {math.hypot(w, x, y, z):.3g}, not 1. Export it again.")
    x2, y2, z2 = 2 * x, 2 * y, 2 * z
    return np.array(
        [
            [1 - (y2 * y + z2 * z), y2 * x - z2 * w, z2 * x + y2 * w],
            [y2 * x + z2 * w, 1 - (x2 * x + z2 * z), z2 * y - x2 * w],
            [z2 * x - y2 * w, z2 * y + x2 * w, 1 - (x2 * x + y2 * y)],
        ]
    )


def _camera(
    where: str,
    name: str,
    size: tuple[int, int],
    intrinsics: tuple[float, float, float, float],
    world_to_camera: NDArray[Any],
    lens: Lens | None = None,
) -> Camera:
    """Check values as required for all formats, and return the camera."""
    fx, fy = intrinsics[:2]
    for key, value in (("width", size[0]), ("height", size[1]), ("focal length x", fx), ("focal length y", fy)):
        _positive(where, key, value)
    if not (np.isfinite(world_to_camera).all() and np.isfinite(intrinsics).all()):
        raise CameraError(f"{where}: holds NaN or infinite values. Export the cameras again.")
    matrix = torch.from_numpy(exact_rotation(where, world_to_camera))
    return Camera(name, *size, *intrinsics, matrix, lens=lens if lens and lens.distorts else None)


def _panorama(where: str, name: str, size: tuple[int, int], world_to_camera: NDArray[Any]) -> list[Camera]:
    """Return the cube faces of a panorama, after the checks of `_camera`."""
    checked = _camera(where, name, size, (1.0, 1.0, 0.0, 0.0), world_to_camera)
    return cube_faces(name, *size, checked.world_to_camera)


def _inverse(where: str, pose: NDArray[Any]) -> NDArray[Any]:
    """Convert a pose from camera-to-world to world-to-camera.

    The 3x3 block is replaced by the nearest rotation; the camera's position does not change.
    """
    rotation = exact_rotation(where, pose)[:3, :3]
    inverse = np.eye(4)
    inverse[:3, :3] = rotation.T
    inverse[:3, 3] = -rotation.T @ pose[:3, 3]
    return inverse


def _name(where: str, entry: Mapping[str, Any], *keys: str) -> str:
    key = next((key for key in keys if entry.get(key) is not None), None)
    if key is None or entry[key] == "":
        raise CameraError(f"{where}: has no name ({' or '.join(map(repr, keys))}). Give {FORMATS}.")
    if isinstance(entry[key], bool) or not isinstance(entry[key], (str, int)):
        raise _wrong(where, key, entry[key], "a name")
    return str(entry[key])


def _wrong(where: str, key: str, value: Any, expected: str, verb: str = "is") -> CameraError:
    """Return the error about a value of another kind than expected, as JSON shows it."""
    shown = json.dumps(value, ensure_ascii=False)[:40]
    return CameraError(f"{where}: {key!r} {verb} {shown}, not {expected}. Export the cameras again.")


def _array(where: str, values: Mapping[str, Any], key: str, *shapes: tuple[int, ...]) -> NDArray[Any]:
    if key not in values:
        raise CameraError(f"{where}: has no {key!r}. Give {FORMATS}.")
    if not isinstance(values[key], list):
        raise _wrong(where, key, values[key], "a list of numbers")
    array = np.array(values[key], dtype=object)  # NumPy would parse text as numbers, even `1_0`
    if array.shape not in shapes:
        raise CameraError(f"{where}: {key!r} has shape {array.shape}, not {' or '.join(map(str, shapes))}.")
    return np.array([_number(where, {key: entry}, key, "holds") for entry in array.flat]).reshape(array.shape)


def _number(where: str, values: Mapping[str, Any], key: str, verb: str = "is") -> float:
    if key not in values:
        raise CameraError(f"{where}: has no {key!r}. Give {FORMATS}.")
    value = values[key]
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        raise _wrong(where, key, value, "a number", verb)
    # no length or angle exceeds 1e100, and an integer in JSON may be too long for a float
    if not abs(value) < 1e100:
        raise CameraError(f"{where}: {key!r} {verb} {str(value)[:40]}, not a finite number. Export the cameras again.")
    return float(value)


def _size(where: str, values: Mapping[str, Any], *keys: str) -> tuple[int, int]:
    stated = [_number(where, values, key) for key in keys]
    width, height = (round(side) for side in stated)
    if max(abs(stated[0] - width), abs(stated[1] - height)) > _WHOLE_TOLERANCE:
        raise CameraError(f"{where}: a size of {stated[0]} x {stated[1]} is not in whole pixels. Correct it.")
    return width, height


def _positive(where: str, key: str, value: float) -> float:
    if not (math.isfinite(value) and value > 0):
        raise CameraError(f"{where}: {key} is {value}; it must be positive. Export the cameras again.")
    return value
