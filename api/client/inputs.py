"""Selection of the local files that a client sends for a job, and the names under which they are sent."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from api.client.answers import RequestError
from sgsst_core.files.camera_folder import find_cameras, issue_warning, label

IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".webp", ".bmp", ".gif", ".avif", ".heic", ".heif", ".hif")


@dataclass(frozen=True)
class InputFile:
    """File of a job: its role, its path or the URL that the service fetches it from, its name there, and its bytes."""

    role: str
    source: Path | str
    name: str = ""
    size: int = 0


@dataclass(frozen=True)
class JobFiles:
    """Files of a job: paths of local files, or URLs as text.

    Attributes:
        cameras: Camera file or folder; None for an orbit.
        masks: Mask files, or folders of mask images, by the names that the job's regions give them.
    """

    scene: Path | str
    styles: Sequence[Path | str]
    cameras: Path | str | None = None
    photos: Path | None = None
    masks: Mapping[str, Path] = field(default_factory=dict)


def input_files(job: JobFiles) -> list[InputFile]:
    """Return all files that a job needs.

    Raises:
        RequestError: If a local file is missing.
    """
    local_styles = [style for style in job.styles if isinstance(style, Path)]
    names = iter(different_names(local_styles))
    files = [_input("scene", job.scene)]
    files += [_input("style", style, next(names) if isinstance(style, Path) else "") for style in job.styles]
    if job.cameras is not None:
        cameras = [job.cameras] if isinstance(job.cameras, str) else camera_files(job.cameras)
        files += [_input("cameras", each) for each in cameras]
    files += [_input("photos", path, name) for path, name in (image_files(job.photos) if job.photos else [])]
    for mask, path in job.masks.items():
        images = [(each, f"{mask}/{name}") for each, name in image_files(path)] if path.is_dir() else [(path, mask)]
        files += [_input("mask", each, name) for each, name in images]
    return files


def _input(role: str, source: Path | str, name: str = "") -> InputFile:
    if isinstance(source, str):
        return InputFile(role, source)
    if not source.is_file():
        raise RequestError(f"{source}: not a file. Check the path.")
    return InputFile(role, source, name or source.name, source.stat().st_size)


def different_names(paths: Sequence[Path]) -> list[str]:
    """Return a unique name for each file: its own, prefixed by a number if an earlier file has the same name."""
    names: list[str] = []
    for number, path in enumerate(paths, 1):
        taken, name = {name.lower() for name in names}, path.name
        while name.lower() in taken:
            name = f"{number}_{name}"
        names.append(name)
    return names


def camera_files(path: Path) -> list[Path]:
    """Return the camera files for a path: a JSON file, a COLMAP model or a folder with either.

    It accepts the same paths as `sgsst stylize --cameras`, and issues a `CameraWarning` for a COLMAP model that is
    smaller than one beside it.

    Raises:
        RequestError: If the path does not exist.
        CameraError: If there are none.
    """
    _check_exists(path)
    cameras = find_cameras(path, issue_warning)
    if cameras.is_dir():
        return _model_files(cameras) or [path]
    companion = cameras.with_name("dataparser_transforms.json")
    return [cameras, companion] if companion.is_file() and companion != cameras else [cameras]


def _model_files(folder: Path) -> list[Path]:
    """Return the files of a COLMAP model; empty if the folder holds none."""
    for suffix in (".bin", ".txt"):
        if (folder / f"cameras{suffix}").is_file():
            names = ("cameras", "images", "points3D", "rigs", "frames")
            return [file for name in names if (file := folder / f"{name}{suffix}").is_file()]
    return []


def _check_exists(path: Path) -> None:
    """Raise a RequestError if there is neither a file nor a folder."""
    if not path.exists():
        raise RequestError(f"{path}: does not exist. Check the path.")


def image_files(folder: Path) -> list[tuple[Path, str]]:
    """Return all images below a folder, with their paths relative to it.

    Raises:
        RequestError: If there are none.
    """
    _check_exists(folder)
    visible = (path for path in folder.rglob("*") if not path.name.startswith("."))
    images = sorted(path for path in visible if path.suffix.lower() in IMAGE_SUFFIXES and path.is_file())
    if not images:
        raise RequestError(f"{folder}: contains no images. Give a folder of image files.")
    return [(path, label(os.fsencode(path.relative_to(folder).as_posix()))) for path in images]
