"""PLY of 3DGS trainers: header check and writer. `scene_file` reads it.

The properties are those of Kerbl et al., "3D Gaussian Splatting for Real-Time Radiance Field Rendering" (2023): x y z,
f_dc_0..2, f_rest_* (channel-major: all coefficients of red first), opacity (logit), scale_0..2 (log), rot_0..3 (wxyz).

Two variants are read too: colors of 8 bits in red, green and blue instead of f_dc_* (nerfstudio), and a single scale.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import numpy as np

from sgsst_core.errors import SceneError
from sgsst_core.files.advice import refuse_changed_meaning
from sgsst_core.files.formats.compressed_ply import COMPRESSED_PLY
from sgsst_core.files.formats.ply_header import (
    PlyHeader,
    check_length,
    comment_lines,
    is_flat,
    ply_tag,
    read_header,
    stated_up,
)
from sgsst_core.files.formats.scene_format import (
    COEFFICIENTS,
    STORED_COEFFICIENTS,
    Arrays,
    FileStart,
    SceneFormat,
    SceneHeader,
    blocks,
)
from sgsst_core.scene.rendering import Rendering

#: Properties of the scene's tensors; opacity and f_rest_* follow.
PROPERTIES = {
    "means": ("x", "y", "z"),
    "quats": ("rot_0", "rot_1", "rot_2", "rot_3"),
    "scales": ("scale_0", "scale_1", "scale_2"),
    "sh_dc": ("f_dc_0", "f_dc_1", "f_dc_2"),
}
#: Colors of 8 bits, which nerfstudio writes instead of f_dc_* on request, and others beside them.
RGB = ("red", "green", "blue")


@dataclass(frozen=True)
class PlySceneHeader(SceneHeader):
    """Header of a PLY.

    Attributes:
        stored_coefficients: SH coefficients per color channel above degree 0 in the file.
        sources: Properties of a variant by the name of the usual property that they replace; empty if there are none.
    """

    ply: PlyHeader
    stored_coefficients: int
    sources: dict[str, str]


def _read_header(start: FileStart) -> PlySceneHeader:
    header = read_header(start)
    stored, sources = _check_properties(start.path, header)
    check_length(start.path, header)
    coefficients = min(stored, COEFFICIENTS[3])
    notes = ["SH bands above degree 3 are not drawn; only a stylized PLY keeps them"] if coefficients < stored else []
    if sources:
        notes.append(f"{', '.join(dict.fromkeys(sources.values()))} become the usual properties of a stylized PLY")
    fields = (header.vertex.count, coefficients, header, stored, sources)
    return PlySceneHeader(PLY, *fields, notes=tuple(notes), tag=ply_tag(header), up=stated_up(header))


def _sources(kinds: dict[str, str]) -> dict[str, str]:
    """Return the properties of a variant, by the name of the usual property that they replace."""
    sources: dict[str, str] = {}
    if all(kinds.get(name) == "u1" for name in RGB) and not any(name in kinds for name in PROPERTIES["sh_dc"]):
        sources |= dict(zip(PROPERTIES["sh_dc"], RGB, strict=True))
    scales = [name for name in ("scale", *PROPERTIES["scales"]) if name in kinds]
    if scales in (["scale"], ["scale_0"]):
        sources |= dict.fromkeys(PROPERTIES["scales"], scales[0])
    return sources


def _check_properties(path: Path, header: PlyHeader) -> tuple[int, dict[str, str]]:
    """Check that a PLY is a 3DGS scene before any data is read.

    Returns:
        Stored SH coefficients per channel, and `PlySceneHeader.sources`.
    """
    vertex = header.elements.get("vertex")
    kinds = {name: kind for name, kind in vertex.kinds.items() if name not in vertex.lists} if vertex else {}
    refuse_changed_meaning(path, kinds)
    sources = _sources(kinds)
    known = {*kinds, *sources, *(["scale_2"] if is_flat(kinds) else [])}
    missing = [name for names in (*PROPERTIES.values(), ("opacity",)) for name in names if name not in known]
    if vertex is None or missing:
        raise SceneError(f"{path}: is not a 3DGS scene but {_likely_content(header)}; missing: {', '.join(missing)}.")
    if vertex.count == 0:
        raise SceneError(f"{path}: holds no Gaussians (element vertex 0). Export the scene again.")
    for name in vertex.lists:
        raise SceneError(
            f"{path}: vertex property {name!r} is a list, which 3DGS scenes do not have. Export without it."
        )
    for name in PROPERTIES["sh_dc"]:
        if name not in sources and kinds[name][0] != "f":
            raise SceneError(
                f"{path}: {name} is stored as integers; new colors need float or double. Convert it first."
            )
    rest = [name for name in kinds if re.fullmatch(r"f_rest_\d+", name)]
    if len(rest) // 3 not in STORED_COEFFICIENTS.values() or len(rest) % 3:
        raise SceneError(
            f"{path}: has {len(rest)} f_rest properties; SH degree 0 to 4 have 0, 9, 24, 45, 72. Export it again."
        )
    absent = [f"f_rest_{i}" for i in range(len(rest)) if f"f_rest_{i}" not in kinds]
    if absent:
        raise SceneError(
            f"{path}: f_rest properties are not numbered 0 to {len(rest) - 1}; missing: {', '.join(absent)}."
        )
    return len(rest) // 3, sources


def _likely_content(header: PlyHeader) -> str:
    """Guess what a PLY without Gaussians contains, for the error message."""
    vertex = header.elements.get("vertex")
    names = set(vertex.kinds) if vertex else set()
    if "face" in header.elements:
        return "a mesh (it has faces)"
    if {"x", "y", "z"} <= names and not names & {"opacity", "scale_0", "rot_0", "f_dc_0"}:
        return "a point cloud (train Gaussians on it first)"
    return "something else" if vertex else "a PLY without vertices"


def write_ply(output: BinaryIO, arrays: Arrays, rendering: Rendering, least_coefficients: int = 0) -> None:
    """Write a binary little-endian float32 PLY with the usual order of properties. Normals are 0.

    Args:
        least_coefficients: SH coefficients per color channel above degree 0 that each row has; missing ones are 0.
    """
    count, stored = arrays["sh_rest"].shape[:2]
    coefficients = max(stored, least_coefficients)
    names = [*PROPERTIES["means"], "nx", "ny", "nz", *PROPERTIES["sh_dc"]]
    names += [*(f"f_rest_{i}" for i in range(3 * coefficients)), "opacity", *PROPERTIES["scales"], *PROPERTIES["quats"]]
    lines = ["ply", "format binary_little_endian 1.0", *comment_lines(rendering), f"element vertex {count}"]
    lines += [f"property float {name}" for name in names]
    output.write("\n".join([*lines, "end_header", ""]).encode())
    for part in blocks(count):
        block = {name: array[part] for name, array in arrays.items()}
        rows = np.zeros((len(block["means"]), len(names)), "<f4")
        rows[:, :3] = block["means"]
        rows[:, 6:9] = block["sh_dc"]
        rest = np.zeros((len(rows), 3, coefficients), np.float32)  # channel-major
        rest[:, :, :stored] = block["sh_rest"].transpose(0, 2, 1)
        rows[:, 9:-8] = rest.reshape(len(rows), -1)
        rows[:, -8] = block["opacities"]
        rows[:, -7:-4] = block["scales"]
        rows[:, -4:] = block["quats"]
        output.write(rows.data)


def _matches(start: FileStart) -> bool:
    return start.head.startswith(b"ply") and not COMPRESSED_PLY.matches(start)


PLY = SceneFormat("ply", "PLY", 248, _matches, _read_header, write=write_ply)
