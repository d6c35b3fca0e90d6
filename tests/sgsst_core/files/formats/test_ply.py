"""Tests of the writer of PLYs."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from plyfile import PlyData, PlyElement

from sgsst_core.files.scene_file import write_scene
from sgsst_core.scene.stored_harmonics import held
from tests.sgsst_core.splat_scenes import cloud


def test_written_ply_is_that_of_plyfile(tmp_path: Path) -> None:
    """The file is bit-identical to plyfile's."""
    scene, path, other = cloud(300, degree=2), tmp_path / "a.ply", tmp_path / "b.ply"
    write_scene(path, scene)
    names = ["x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2", *(f"f_rest_{i}" for i in range(24))]
    names += ["opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"]
    rest = held(scene.sh_rest).transpose(1, 2).reshape(300, 24)
    parts = [scene.means, torch.zeros(300, 3), scene.sh_dc, rest, scene.opacities[:, None], scene.scales, scene.quats]
    values = torch.cat(parts, dim=1).numpy()
    rows = np.array([tuple(row) for row in values.tolist()], [(name, "<f4") for name in names])
    PlyData([PlyElement.describe(rows, "vertex")], byte_order="<").write(str(other))
    assert path.read_bytes() == other.read_bytes()
