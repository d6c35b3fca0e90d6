"""Small streamed SOGs."""

from __future__ import annotations

import io
import json
import zipfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from sgsst_core.files.formats.sog import SOG
from sgsst_core.files.scene_file import encode_scene, read_scene
from sgsst_core.scene.gaussians import Scene

Files = dict[str, bytes]


def sog_files(scene: Scene) -> Files:
    """Return the files of an unpacked SOG."""
    target = io.BytesIO()
    encode_scene(target, scene, SOG, Path("scene.sog"))
    with zipfile.ZipFile(target) as archive:
        return {name: archive.read(name) for name in archive.namelist()}


def streamed(levels: Sequence[Sequence[Scene]], environment: Scene | None = None) -> Files:
    """Return the files of a streamed SOG, given the scenes of each level; each has two leaves for every scene."""
    files: Files = {}
    leaves: list[dict[str, Any]] = []
    for level, scenes in enumerate(levels):
        for number, scene in enumerate(scenes):
            files |= {f"{level}_{number}/{name}": data for name, data in sog_files(scene).items()}
            half = len(scene) // 2
            for offset, count in ((half, len(scene) - half), (0, half)):
                lods = {str(level): {"file": len(names_of(files)) - 1, "offset": offset, "count": count}}
                leaves.append({"bound": {"min": [0, 0, 0], "max": [1, 1, 1]}, "lods": lods})
    index: dict[str, Any] = {"lodLevels": len(levels), "filenames": names_of(files), "environment": None}
    if environment is not None:
        files |= {f"env/{name}": data for name, data in sog_files(environment).items()}
        index["environment"] = "env/meta.json"
    index["tree"] = {"bound": leaves[0]["bound"], "children": leaves}
    return files | {"lod-meta.json": json.dumps(index).encode()}


def names_of(files: Files) -> list[str]:
    """Return the paths of the parts."""
    return [name for name in files if name.endswith("/meta.json")]


def unpacked(folder: Path, files: Files) -> Path:
    """Write files to a folder, and return it."""
    for name, data in files.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(data)
    return folder


def archived(path: Path, files: Files, above: str = "") -> Path:
    """Write files to a ZIP archive, and return its path."""
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, data in files.items():
            archive.writestr(above + name, data)
    return path


def files_of(path: Path) -> Files:
    """Return the files of an archive or a folder."""
    if path.is_dir():
        return {each.relative_to(path).as_posix(): each.read_bytes() for each in path.rglob("*") if each.is_file()}
    with zipfile.ZipFile(path) as archive:
        return {name: archive.read(name) for name in archive.namelist()}


def part_of(files: Files, folder: str, at: Path) -> Scene:
    """Return the scene of one part, written to a folder."""
    return read_scene(unpacked(at, files) / folder / "meta.json").scene
