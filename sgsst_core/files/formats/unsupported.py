"""Detection of files that are not scenes or cannot be read, to say what to do instead."""

from __future__ import annotations

import re
from pathlib import Path
from typing import NoReturn

from sgsst_core.errors import SceneError
from sgsst_core.files.formats.scene_format import FileStart

CONVERTER = "https://github.com/playcanvas/splat-transform"
#: Signatures in the first bytes of a PyTorch checkpoint: the first file of its ZIP archive, and pickle.
_CHECKPOINT, _PICKLE = b"/data.pkl", (b"\x80\x02", b"\x80\x04", b"\x80\x05")
_OBJ_LINE = re.compile(rb"(#[^\n]*|\s*)(\r?\n|$)|(mtllib|o|g|usemtl|v|vt|vn|vp|s|f) [^\n]*(\r?\n|$)")
_OBJ_LINES = 8
#: Scenes in the folders of a run, in order of preference: of the original code, of gsplat, any, and an unpacked SOG.
_SCENES = ("point_cloud/iteration_*/point_cloud.ply", "ply/*.ply", "*.ply", "meta.json")


def advice(name: str) -> str:
    """Return the sentence that says how to convert a file with an example name."""
    return f"Convert it first: `splat-transform {name} scene.ply` ({CONVERTER})."


def is_checkpoint(head: bytes) -> bool:
    """Return whether the first bytes of a file are those of a PyTorch checkpoint."""
    return (head.startswith(b"PK") and _CHECKPOINT in head[:200]) or head.startswith(_PICKLE)


def refuse_unsupported(start: FileStart) -> None:
    """Raise a SceneError that says what to do if the file has a known format that is no scene."""
    path, head, suffix = start.path, start.head, start.path.suffix.lower()
    if is_checkpoint(head):
        raise SceneError(
            f"{path}: is a checkpoint, not a scene. Make a PLY of it: `sgsst convert CHECKPOINT scene.ply` (gsplat, "
            "nerfstudio) or `ns-export gaussian-splat` (nerfstudio); the original 3DGS code has "
            "point_cloud/iteration_*/point_cloud.ply beside it."
        )
    if suffix == ".gltf" or (head.lstrip().startswith(b"{") and b'"asset"' in head):
        raise SceneError(
            f"{path}: is a glTF document whose data are in other files. Save it as one GLB; Gaussians need "
            "KHR_gaussian_splatting."
        )
    if suffix == ".obj" or _is_obj(head):
        raise SceneError(f"{path}: is an OBJ mesh without Gaussians. Train Gaussians on renders of it first.")


def _is_obj(head: bytes) -> bool:
    """Return whether the first lines are those of an OBJ file, with at least one vertex or object."""
    position, has_vertex = 0, False
    for _ in range(_OBJ_LINES):
        line = _OBJ_LINE.match(head, position)
        if line is None:
            return False
        position, has_vertex = line.end(), has_vertex or line[3] is not None
    return has_vertex


def refuse_folder(folder: Path) -> NoReturn:
    """Raise a SceneError about a folder given as a scene: it names the scene in the folder, or how to export one."""
    for pattern in _SCENES:
        scene = max(folder.glob(pattern), key=_numbers, default=None)
        if scene is not None:
            raise SceneError(f"{folder}: is a folder. Give the scene in it: {scene}")
    if any(folder.glob("nerfstudio_models/*.ckpt")):
        command = f"ns-export gaussian-splat --load-config {folder / 'config.yml'} --output-dir exports"
        raise SceneError(f"{folder}: is a run of nerfstudio. Export its scene: `{command}`.")
    checkpoint = max(folder.glob("ckpts/*_rank0.pt"), key=_numbers, default=None)
    if checkpoint is not None:
        raise SceneError(
            f"{folder}: is a run of gsplat without a PLY. Make one: `sgsst convert {checkpoint} scene.ply`."
        )
    raise SceneError(f"{folder}: is a folder. Give the file of a scene.")


def _numbers(path: Path) -> list[int]:
    """Return the numbers in a path, to find the scene of the last iteration."""
    return [int(number) for number in re.findall("[0-9]{1,18}", str(path))]
