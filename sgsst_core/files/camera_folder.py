"""Search for camera files: which file of a folder holds the cameras. PyTorch is not imported."""

from __future__ import annotations

import contextlib
import json
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from sgsst_core.errors import CameraError
from sgsst_core.files.advice import CAMERAS, refuse_camera_folder, refuse_known
from sgsst_core.files.colmap_model import Warn, read_model

FORMATS = "an INRIA cameras.json, a COLMAP sparse model or a nerfstudio/Blender transforms.json"
#: Names of JSON files with cameras, in order of preference. Any other name is read if it is the only one.
_JSON_NAMES = ("transforms.json", "transforms_train.json", "cameras.json")
#: Levels of subfolders that are searched for a COLMAP model, and entries per folder and folders per level.
_SEARCHED_LEVELS, _SEARCHED_ENTRIES = 3, 100


class CameraWarning(UserWarning):
    """Cameras that may not be all, or not those that were meant."""


def issue_warning(text: str) -> None:
    """Issue a `CameraWarning`."""
    warnings.warn(text, CameraWarning, stacklevel=3)


def find_cameras(path: Path, warn: Warn) -> Path:
    """Return the JSON file or the folder of a COLMAP model that a file or folder stands for.

    A folder may be a COLMAP model, may hold such a model in sparse/0, sparse or another folder of sparse, or may hold a
    transforms.json, transforms_train.json, cameras.json, a model in colmap/sparse, or one other JSON file with cameras.

    Args:
        warn: Callback for a model that is smaller than one beside it.

    Raises:
        CameraError: If a folder holds no cameras, or several files with cameras. The message says what it holds.
    """
    if not path.is_dir():
        is_model = path.suffix in (".bin", ".txt") and path.name.startswith(("cameras", "images", "points3D"))
        return _model(path.parent, warn) if is_model else path
    named = _named(path) or _only_json(path)
    return _model(named, warn) if named.is_dir() else named


def cameras_beside(scene: Path) -> Path | None:
    """Return the folder or JSON file of the cameras that belong to a scene; None if none lie beside it.

    They are in the folder of the scene, or in RUN if the scene is RUN/point_cloud/iteration_N/point_cloud.ply, as the
    original 3DGS code writes it. The names are those of `find_cameras`.

    Raises:
        CameraError: If a folder holds several files with cameras, none of which has a usual name.
    """
    folder = scene.absolute().parent
    folders = (folder, folder.parent.parent) if folder.parent.name == "point_cloud" else (folder,)
    held = (find_cameras(each, lambda text: None) for each in folders if _named(each) or _holding(each))
    return next(held, None)


def has_model(folder: Path) -> bool:
    """Return whether a folder holds the cameras of a COLMAP model."""
    return (folder / "cameras.bin").is_file() or (folder / "cameras.txt").is_file()


def _named(folder: Path) -> Path | None:
    """Return the first COLMAP model or JSON file in a folder that has one of the usual names; None if there is none."""
    sparse = folder / "sparse"
    models = [model for model in (folder, sparse / "0", sparse, *_numbered(sparse)) if has_model(model)]
    files = [folder / name for name in _JSON_NAMES if (folder / name).is_file()]
    other = [model for model in (folder / "colmap" / "sparse" / "0",) if has_model(model)]
    return next(iter([*models, *files, *other]), None)


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


def _numbered(folder: Path) -> list[Path]:
    """Return the subfolders with numbers, in which COLMAP writes models, in their order."""
    return sorted((path for path in folder.glob("[0-9]*") if path.is_dir()), key=lambda path: (len(path.name), path))


def _model(folder: Path, warn: Warn) -> Path:
    """Return the folder of a model, with a warning if one beside it has more images."""
    beside = [model for model in _numbered(folder.absolute().parent) if has_model(model)]
    if folder.absolute() in beside and len(beside) > 1:
        larger = _largest(beside)
        count, most = _image_count(folder), _image_count(larger)
        if count < most:
            larger = folder.with_name(larger.name) if folder.name else larger
            warn(
                f"{folder} has {count:,} images, and the model {larger} beside it {most:,}. COLMAP writes several "
                f"models if it cannot connect all photos. Add --cameras {larger} if the scene was trained with that one"
            )
    return folder


def _largest(models: Sequence[Path]) -> Path:
    """Return the model with the most images, the first of several."""
    return max(models, key=_image_count)


def _image_count(model: Path) -> int:
    """Return the number of images of a model; 0 if it cannot be read."""
    with contextlib.suppress(CameraError):
        return len(read_model(model, lambda text: None)[1])
    return 0


def _only_json(folder: Path) -> Path:
    """Return the only JSON file in a folder that holds cameras."""
    files, holding = _json_files(folder), _holding(folder)
    if len(holding) > 1:
        names = ", ".join(path.name for path in holding)
        raise CameraError(f"{folder}: holds several files with cameras: {names}. Give one of them.")
    if holding:
        return holding[0]
    models = _models_below(folder)
    if models:
        raise CameraError(f"{folder}: holds no cameras, but {_largest(models)} has a COLMAP model. Give that folder.")
    refuse_camera_folder(folder)
    if len(files) == 1:
        return files[0]  # its reader says what is wrong with it
    looked_at = f" (looked at {', '.join(path.name for path in files)})" if files else ""
    raise CameraError(f"{folder}: holds no cameras in a known format{looked_at}. Give {FORMATS}.")


def _json_files(folder: Path) -> list[Path]:
    """Return the JSON files in a folder that are searched."""
    return [path for path in sorted(folder.glob("*.json"))[:_SEARCHED_ENTRIES] if path.is_file()]


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


def _models_below(folder: Path) -> list[Path]:
    """Return the COLMAP models in the first level of subfolders that has any, among the entries that are searched."""
    level = [folder]
    with contextlib.suppress(OSError):
        for _ in range(_SEARCHED_LEVELS):
            entries = [entry for parent in level for entry in sorted(parent.iterdir())[:_SEARCHED_ENTRIES]]
            level = [entry for entry in entries if entry.is_dir()][:_SEARCHED_ENTRIES]
            models = [entry for entry in level if has_model(entry)]
            if models:
                return models
    return []
