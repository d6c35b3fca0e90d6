"""Tests of the writer of PLYs, and of variants that other programs write."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from plyfile import PlyData, PlyElement

from sgsst_core.constants import SH_C0
from sgsst_core.errors import SceneError
from sgsst_core.files.scene_file import read_scene, write_scene
from sgsst_core.files.stylized_ply import write_stylized
from sgsst_core.scene.gaussians import Scene
from sgsst_core.scene.stored_harmonics import StoredHarmonics, held
from tests.sgsst_core.splat_scenes import cloud


def test_written_ply_is_bit_identical_to_plyfile(tmp_path: Path) -> None:
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


def table(scene: Scene) -> dict[str, np.ndarray]:
    """Return the usual properties of a scene, float32, by name."""
    columns = dict(zip("xyz", scene.means.numpy().T, strict=True))
    columns |= {f"f_dc_{i}": values for i, values in enumerate(scene.sh_dc.numpy().T)}
    rest = held(scene.sh_rest).transpose(1, 2).reshape(len(scene), -1).numpy()
    columns |= {f"f_rest_{i}": values for i, values in enumerate(rest.T)}
    columns["opacity"] = scene.opacities.numpy()
    columns |= {f"scale_{i}": values for i, values in enumerate(scene.scales.numpy().T)}
    return columns | {f"rot_{i}": values for i, values in enumerate(scene.quats.numpy().T)}


def save(path: Path, columns: dict[str, np.ndarray], text: bool = False) -> None:
    rows = np.empty(len(columns["x"]), [(name, values.dtype) for name, values in columns.items()])
    for name, values in columns.items():
        rows[name] = values
    PlyData([PlyElement.describe(rows, "vertex")], text=text, byte_order="=" if text else "<").write(str(path))


def rgb_columns(scene: Scene) -> dict[str, np.ndarray]:
    colors = (255 * (0.5 + SH_C0 * scene.sh_dc)).clamp(0, 255).round().numpy().astype("u1")
    return dict(zip(("red", "green", "blue"), colors.T, strict=True))


@pytest.mark.parametrize("text", [False, True])
def test_8_bit_colors_of_nerfstudio_are_read(tmp_path: Path, text: bool) -> None:
    """`ns-export gaussian-splat --ply-color-mode rgb` writes no f_dc_*; the stylized PLY has them."""
    scene, path, out = cloud(200), tmp_path / "splat.ply", tmp_path / "out.ply"
    scene = replace(scene, sh_dc=scene.sh_dc.clamp(-1.5, 1.5))
    columns = {name: values for name, values in table(scene).items() if "f_dc" not in name}
    save(path, rgb_columns(scene) | columns, text)
    file = read_scene(path)
    assert file.notes == ("red, green, blue become the usual properties of a stylized PLY",)
    assert float((file.scene.sh_dc - scene.sh_dc).abs().max()) < 0.51 / 255 / SH_C0
    assert torch.equal(file.scene.scales, scene.scales)
    write_stylized(file, out, scene.sh_dc)
    back = read_scene(out)
    assert torch.equal(back.scene.sh_dc, scene.sh_dc)
    assert not back.notes


@pytest.mark.parametrize("name", ["scale", "scale_0"])
def test_isotropic_scales_are_read(tmp_path: Path, name: str) -> None:
    scene, path, out = cloud(200, degree=1), tmp_path / "scene.ply", tmp_path / "out.ply"
    columns = {key: values for key, values in table(scene).items() if "scale" not in key}
    save(path, columns | {name: scene.scales[:, 1].numpy()})
    file = read_scene(path, held_bytes=0)
    assert torch.equal(file.scene.scales, scene.scales[:, 1:2].expand(-1, 3))
    assert torch.equal(held(file.scene.sh_rest), held(scene.sh_rest))
    write_stylized(file, out, scene.sh_dc + 1)
    assert torch.equal(read_scene(out).scene.scales, file.scene.scales)


def test_two_of_three_scales_are_refused(tmp_path: Path) -> None:
    columns = table(cloud(20))
    del columns["scale_2"]
    columns["scale"] = columns["scale_0"]
    save(tmp_path / "scene.ply", columns)
    with pytest.raises(SceneError, match="missing: scale_2"):
        read_scene(tmp_path / "scene.ply")


@pytest.mark.parametrize("stored", [False, True])
@pytest.mark.parametrize("text", [False, True])
def test_sh_degree_4_is_rendered_up_to_3_and_preserved(tmp_path: Path, text: bool, stored: bool) -> None:
    scene, path, out = cloud(150, degree=3), tmp_path / "scene.ply", tmp_path / "out.ply"
    more = torch.randn(150, 9, 3, generator=torch.Generator().manual_seed(1))
    whole = torch.cat([held(scene.sh_rest), more], dim=1)
    save(path, table(replace(scene, sh_rest=whole)), text)
    file = read_scene(path, held_bytes=0 if stored else None)
    assert isinstance(file.scene.sh_rest, StoredHarmonics) == (stored and not text)
    assert file.scene.sh_degree == 3
    assert torch.equal(held(file.scene.sh_rest), held(scene.sh_rest))
    assert file.notes == ("SH bands above degree 3 are not drawn; only a stylized PLY keeps them",)
    write_stylized(file, out, scene.sh_dc * 2, sh_attenuation=0.5)
    vertex = PlyData.read(str(out))["vertex"]
    for channel, i in ((0, 0), (1, 14), (2, 23)):
        expected = (whole[:, i, channel] * 0.5).numpy()
        np.testing.assert_array_equal(vertex[f"f_rest_{24 * channel + i}"], expected)


@pytest.mark.parametrize("text", [False, True])
def test_8_bit_colors_follow_changed_coefficients(tmp_path: Path, text: bool) -> None:
    scene, path, out = cloud(100), tmp_path / "scene.ply", tmp_path / "out.ply"
    save(path, table(scene) | rgb_columns(scene) | {"label": np.arange(100, dtype="u1")}, text)
    new = torch.rand(100, 3) * 4 - 2
    write_stylized(read_scene(path), out, new)
    vertex = PlyData.read(str(out))["vertex"]
    for name, expected in rgb_columns(replace(scene, sh_dc=new)).items():
        np.testing.assert_array_equal(vertex[name], expected)
    np.testing.assert_array_equal(vertex["label"], np.arange(100))
