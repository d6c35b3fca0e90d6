"""Reader of single properties of a scene's Gaussians, including those that 3DGS does not use."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from sgsst_core.errors import SceneError
from sgsst_core.files.formats.ply_header import element_offsets
from sgsst_core.files.scene_file import SceneFile, file_stamp, text_vertices
from sgsst_core.scene.stored_harmonics import changed

#: Standard 3DGS properties by their names in PLY files: field of `Scene`, and column of its tensor (None for a 1D
#: tensor).
_OWN = {
    **{name: ("means", column) for column, name in enumerate("xyz")},
    **{f"scale_{column}": ("scales", column) for column in range(3)},
    **{f"rot_{column}": ("quats", column) for column in range(4)},
    **{f"f_dc_{column}": ("sh_dc", column) for column in range(3)},
    "opacity": ("opacities", None),
}


def read_property(file: SceneFile, name: str) -> Tensor:
    """Return a property of the scene's Gaussians, [N].

    Standard 3DGS properties are float32. Other properties keep the file's dtype, except that integers become float64.

    Raises:
        SceneError: If the file has no such numeric property, or has changed since it was read.
    """
    if name in _OWN:
        field, column = _OWN[name]
        values: Tensor = getattr(file.scene, field)
        return values if column is None else values[:, column]
    header = file.header
    others = [] if header is None else [prop.name for prop in header.vertex.properties]
    if header is None or name not in others:
        known = sorted({*_OWN, *others})
        raise SceneError(f"{file.path}: its Gaussians have no property {name!r}. There are {', '.join(known)}.")
    if header.text:
        rows = text_vertices(file.path, header)[name]
    else:
        offset = element_offsets(file.path, header)["vertex"]
        table = np.memmap(file.path, header.vertex.dtype(header.byte_order), "r", offset, (header.vertex.count,))
        rows = np.array(table[name])
    if file_stamp(file.path) != file.stamp:
        raise changed(file.path)
    if file.kept is not None:
        rows = rows[file.kept]
    return torch.from_numpy(rows.astype(np.float64 if rows.dtype.kind != "f" else rows.dtype.newbyteorder("=")))
