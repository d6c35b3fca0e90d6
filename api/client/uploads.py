"""Files that a client sends for a job: their selection and names, and uploads of large ones in resumable parts."""

from __future__ import annotations

import base64
import hashlib
import os
import secrets
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

from api.client.transport import ApiError, Progress, RequestError, Transport, in_thread, json_text
from sgsst_core.files.camera_folder import find_cameras, label
from sgsst_core.files.formats import scene_path
from sgsst_core.files.formats.sog import INDEX_NAME, pack

#: Maximum bytes of a part; larger files are uploaded in parts.
PART_BYTES = 16 << 20
#: Protocol version of uploads, which every request must state.
_TUS = {"Tus-Resumable": "1.0.0"}


async def upload(transport: Transport, path: Path, name: str, progress: Progress) -> str:
    """Upload a file in parts, and return the upload's id."""
    size = (await in_thread(path.stat)).st_size
    creation = {
        **_TUS,
        "Upload-Length": str(size),
        "Upload-Metadata": f"filename {base64.b64encode(name.encode()).decode()}",
        "Idempotency-Key": secrets.token_hex(16),
    }
    created = (await transport.call("POST", "/v1/uploads", headers=creation)).json()
    where = f"/v1/uploads/{created['id']}"
    offset = int(created["offset"])
    while offset < size:
        part, headers = await in_thread(_read_part, path, offset)
        try:
            await transport.call("PATCH", where, content=part, headers=headers)
            offset += len(part)
        except ApiError as error:
            if error.status != 409:
                raise
            offset = int((await transport.call("HEAD", where, headers=_TUS)).headers["Upload-Offset"])
        progress(offset, size)
    return str(created["id"])


def _read_part(path: Path, offset: int) -> tuple[bytes, dict[str, str]]:
    """Return a part of a file, and the headers to send it with."""
    with path.open("rb") as file:
        file.seek(offset)
        part = file.read(PART_BYTES)
    if not part:
        raise RequestError(f"{path}: was truncated during the upload. Send it again.")
    digest = base64.b64encode(hashlib.sha256(part).digest()).decode()
    return part, {
        **_TUS,
        "Upload-Offset": str(offset),
        "Upload-Checksum": f"sha256 {digest}",
        "Content-Type": "application/offset+octet-stream",
    }


async def send_files(
    transport: Transport, files: JobFiles, parameters: Mapping[str, Any], progress: Progress
) -> list[tuple[str, Any]]:
    """Upload the large files, and return the form fields of the request, which contain the small files and the URLs."""
    given = json_text({name: value for name, value in parameters.items() if value is not None})
    with tempfile.TemporaryDirectory() as folder:
        inputs = await in_thread(input_files, replace(files, scene=await in_thread(_packed, files.scene, Path(folder))))
        fields = await _sent(transport, inputs, progress)
    return [*fields, ("parameters", (None, given))]


def _packed(scene: Path | str, folder: Path) -> Path | str:
    """Return the scene, in an archive in `folder` if it is an unpacked streamed SOG."""
    index = scene_path(scene) if isinstance(scene, Path) else None
    if index is None or index.name != INDEX_NAME or not index.is_file():
        return scene
    archive = folder / f"{index.absolute().parent.name or 'scene'}.zip"
    pack(index, archive)
    return archive


async def _sent(transport: Transport, inputs: Sequence[InputFile], progress: Progress) -> list[tuple[str, Any]]:
    """Upload the large files, and return the form fields of all."""
    total = sum(file.size for file in inputs if file.size > PART_BYTES)
    done = 0
    fields: list[tuple[str, Any]] = []
    for file in inputs:
        if isinstance(file.source, str):
            fields.append((file.role, (None, file.source)))
        elif file.size > PART_BYTES:
            upload_id = await upload(transport, file.source, file.name, partial(_report_sum, progress, done, total))
            fields.append((file.role, (None, upload_id)))
            done += file.size
        else:
            content = await in_thread(file.source.read_bytes)
            fields.append((file.role, (file.name, content, "application/octet-stream")))
    return fields


def _report_sum(progress: Progress, before: int, total: int, done: int, _size: int) -> None:
    """Report the progress of one file as part of the progress of all files."""
    progress(before + done, total)


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
        painted: Painted images of views.
    """

    scene: Path | str
    styles: Sequence[Path | str]
    cameras: Path | str | None = None
    photos: Path | None = None
    masks: Mapping[str, Path] = field(default_factory=dict)
    painted: Sequence[Path] = ()


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
    return files + [_input("painted", *each) for each in zip(job.painted, different_names(job.painted), strict=True)]


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

    It accepts the same paths as `sgsst stylize --cameras`.

    Raises:
        RequestError: If the path does not exist.
        CameraError: If there are none.
    """
    _check_exists(path)
    cameras = find_cameras(path)
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
