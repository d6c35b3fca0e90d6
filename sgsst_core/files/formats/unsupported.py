"""Detection of files that are not scenes or cannot be read, to say what to do instead."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import NoReturn

from sgsst_core.errors import SceneError
from sgsst_core.files.formats.scene_format import FileStart
from sgsst_core.files.lfs_pointers import POINTER, is_pointer

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


def is_usdz(head: bytes) -> bool:
    """Return whether the first bytes of a file are those of a USDZ archive, whose first file is a USD layer."""
    return head.startswith(b"PK") and b".usd" in head[:200]


#: What a file is and what to do, by its first bytes without leading blanks and its suffix. The first match counts.
_KNOWN: tuple[tuple[Callable[[bytes, str], bool], str], ...] = (
    (lambda head, _: not head, "empty. Copy or export it again."),
    (
        lambda head, _: is_checkpoint(head),
        "a checkpoint, not a scene. Make a PLY of it: `sgsst convert CHECKPOINT scene.ply` (gsplat, nerfstudio) or "
        "`ns-export gaussian-splat` (nerfstudio); the original 3DGS code has point_cloud/iteration_*/point_cloud.ply "
        "beside it.",
    ),
    (lambda head, _: is_pointer(head), f"{POINTER}."),
    (
        lambda head, _: _is_html(head) and b"SuperSplat" in head,
        "a viewer of SuperSplat, with the scene in it or beside it. Export the scene as PLY or SOG instead.",
    ),
    (lambda head, _: _is_html(head), "an HTML page, such as an error message. Download the scene again."),
    (
        lambda head, _: head.startswith(b"{") and b'"lodLevels"' in head,
        f"a streamed SOG, whose levels of detail are in other files. {advice('lod-meta.json')}",
    ),
    (
        lambda head, _: head.startswith(b"{") and b'"geometricError"' in head,
        "a tileset of 3D Tiles, whose data are in other files. Give the scene that it was made of.",
    ),
    (
        lambda head, suffix: suffix in (".lcc", ".lcc2") or (head.startswith(b"{") and b'"totalSplats"' in head),
        f"a scene of XGRIDS. {advice('scene.lcc')}",
    ),
    (
        lambda head, _: head.startswith((b"PXR-USDC", b"#usda")) or is_usdz(head),
        "OpenUSD, which is written but not read. Give the scene that it was made of, or export it as PLY.",
    ),
    (
        lambda head, _: head.startswith(b"x,y,z,") and b"f_dc_0" in head,
        "a table of splat-transform, which cannot be read. Write a PLY instead: `splat-transform SOURCE scene.ply`.",
    ),
    (
        lambda head, suffix: head.startswith(b"RAD0") or suffix == ".rad",
        "a scene for streaming of Spark. Give the scene that it was made of.",
    ),
    (
        lambda head, suffix: head.startswith(b"spx") or suffix == ".spx",
        "an SPX scene. Convert it to PLY with gsbox (https://github.com/gotoeasy/gsbox).",
    ),
    (
        lambda head, suffix: suffix == ".gltf" or (head.startswith(b"{") and b'"asset"' in head),
        "a glTF document whose data are in other files. Save it as one GLB; Gaussians need KHR_gaussian_splatting.",
    ),
    (
        lambda head, suffix: suffix == ".obj" or _is_obj(head),
        "an OBJ mesh without Gaussians. Train Gaussians on renders of it first.",
    ),
)


#: Properties that change what the usual ones mean: why the usual ones alone are not the scene, and what to do.
_CHANGED_MEANING: tuple[tuple[re.Pattern[str], str], ...] = (
    (
        re.compile(
            r"t|times?|(t|time)_(center|mean|scale|sigma|start|end)|(start|end)_time|trbf_\w+|motion_\w+|omega_\w+"
            r"|f_t_\d+|(scale|scales|scaling|rot|rotation|opacity|xyz|mean|mu|center|sigma|cov)_t"
            r"|(rot|rotation)_r(_\w+)?|v[xyz]|vel(ocity|ocities)?(_\w+)?|durations?|life(span|time)"
        ),
        "a dynamic scene, whose Gaussians move or exist at certain moments only. Export one moment as a static scene",
    ),
    (
        re.compile(r"binding(_\d+)?|f_offset_\d+|f_anchor_feat_\d+"),
        "a scene whose Gaussians are relative to a mesh or to anchors. Export them in world coordinates",
    ),
    (
        re.compile(r"beta(_\d+)?|sb_params_\d+|shape(_\d+)?|scale_[3-9]|rot_[4-9]"),
        "a scene of another kernel than 3D Gaussians. Export it as one of 3D Gaussians",
    ),
)


def refuse_changed_meaning(path: Path, names: Iterable[str]) -> None:
    """Raise a SceneError if a file has properties that change what the usual ones of a 3DGS scene mean.

    Args:
        path: Path of the file.
        names: Names of its properties, or of the attributes of a glTF primitive, which may have a prefix.
    """
    for name in names:
        plain = name.rpartition(":")[2].lstrip("_").lower()
        for pattern, text in _CHANGED_MEANING:
            if pattern.fullmatch(plain):
                raise SceneError(f"{path}: has the property {name!r}, so it is {text}.")


def refuse_unsupported(start: FileStart) -> None:
    """Raise a SceneError that says what to do if the file has a known format that is no scene."""
    for matches, text in _KNOWN:
        if matches(start.head.lstrip(), start.path.suffix.lower()):
            raise SceneError(f"{start.path}: is {text}")


def _is_html(head: bytes) -> bool:
    return head[:20].lower().startswith((b"<!doctype html", b"<html"))


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
    if (folder / "lod-meta.json").is_file():
        raise SceneError(f"{folder}: is a streamed SOG. {advice(str(folder / 'lod-meta.json'))}")
    raise SceneError(f"{folder}: is a folder. Give the file of a scene.")


def _numbers(path: Path) -> list[int]:
    """Return the numbers in a path, to find the scene of the last iteration."""
    return [int(number) for number in re.findall("[0-9]{1,18}", str(path))]
