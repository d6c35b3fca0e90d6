"""Tests that attenuated SH coefficients are bit-identical in memory, read on demand from a file, and written."""

from __future__ import annotations

import pickle
from pathlib import Path

import numpy as np
import pytest
import torch
from plyfile import PlyData, PlyElement
from torch import Tensor

from sgsst_core.errors import SceneError
from sgsst_core.files import stylized_ply
from sgsst_core.files.formats import scene_format
from sgsst_core.files.formats.spz import SPZ
from sgsst_core.files.scene_file import read_scene, write_scene
from sgsst_core.files.stylized_ply import write_stylized
from sgsst_core.scene import stored_harmonics
from sgsst_core.scene.gaussians import attenuation_factor
from sgsst_core.scene.stored_harmonics import StoredHarmonics, held
from tests.sgsst_core.splat_scenes import cloud

ATTENUATIONS = (1e-9, 0.25, 0.7, 1.0)


@pytest.fixture(autouse=True)
def small_blocks(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(stored_harmonics, "BLOCK_BYTES", 2000)
    for module in (scene_format, stylized_ply):
        monkeypatch.setattr(module, "BLOCK_ROWS", 17)


def written(folder: Path, degree: int = 3) -> Path:
    write_scene(folder / "scene.ply", cloud(60, degree=degree))
    return folder / "scene.ply"


def in_another_encoding(path: Path, form: str) -> Path:
    """Write the same scene as ASCII, as big-endian, with doubles, or with another property between the coefficients."""
    vertices = PlyData.read(path)["vertex"].data
    kinds = [(name, "<f8" if form == "doubles" and "rest" in name else "<f4") for name in vertices.dtype.names]
    if form == "mixed up":
        kinds.insert(20, ("extra", "u1"))
        kinds.append(kinds.pop(12))
    rows = np.zeros(len(vertices), kinds)
    for name in vertices.dtype.names:
        rows[name] = vertices[name]
    target = path.with_name("other.ply")
    PlyData([PlyElement.describe(rows, "vertex")], text=form == "text", byte_order=">" if form == "big" else "<").write(
        target
    )
    return target


@pytest.mark.parametrize("form", ["plain", "text", "big", "doubles", "mixed up"])
@pytest.mark.parametrize("attenuation", ATTENUATIONS)
def test_file_contains_the_attenuated_coefficients(tmp_path: Path, form: str, attenuation: float) -> None:
    path = written(tmp_path)
    if form != "plain":
        path = in_another_encoding(path, form)
    source = read_scene(path)
    wanted = source.scene.attenuated(attenuation)
    colors = source.scene.sh_dc + 1
    write_stylized(source, tmp_path / "out.ply", colors, sh_attenuation=attenuation)
    loaded = read_scene(tmp_path / "out.ply").scene
    rest = torch.zeros_like(held(loaded.sh_rest)) if attenuation == 1 else held(wanted.sh_rest)
    assert torch.equal(held(loaded.sh_rest), rest)
    if attenuation == 1:
        assert wanted.sh_degree == 0
        assert not torch.signbit(held(loaded.sh_rest)).any()
    assert torch.equal(loaded.sh_dc, colors)
    for name in ("means", "quats", "scales", "opacities"):
        assert torch.equal(getattr(loaded, name), getattr(source.scene, name))
    before, after = (PlyData.read(each)["vertex"].data for each in (path, tmp_path / "out.ply"))
    assert before.dtype == after.dtype
    for name in set(before.dtype.names) - {"f_dc_0", "f_dc_1", "f_dc_2"}:
        if "rest" not in name:
            assert np.array_equal(before[name], after[name])


def test_file_is_bit_identical_without_attenuation(tmp_path: Path) -> None:
    source = read_scene(written(tmp_path))
    for attenuation in (0.0, 1e-9):
        path = tmp_path / f"{attenuation}.ply"
        write_stylized(source, path, source.scene.sh_dc, sh_attenuation=attenuation)
        assert path.read_bytes() == source.path.read_bytes()
    assert source.scene.attenuated(0) is source.scene


@pytest.mark.parametrize("attenuation", ATTENUATIONS)
def test_stored_coefficients_match_those_in_memory(tmp_path: Path, attenuation: float) -> None:
    path = written(tmp_path)
    stored, plain = (read_scene(path, held_bytes=limit).scene.attenuated(attenuation) for limit in (0, None))
    assert isinstance(plain.sh_rest, Tensor)
    if attenuation == 1:
        assert stored.sh_rest.shape == plain.sh_rest.shape == (60, 0, 3)
        return
    assert isinstance(stored.sh_rest, StoredHarmonics)
    rows = torch.arange(0, 60, 3)
    for harmonics in (stored.sh_rest, pickle.loads(pickle.dumps(stored.sh_rest))):
        assert torch.equal(harmonics.tensor(), plain.sh_rest)
        assert torch.equal(held(harmonics[rows]), plain.sh_rest[rows])
        assert torch.equal(harmonics.first(8).tensor(), plain.sh_rest[:, :8])
        assert torch.equal(harmonics.largest(), plain.sh_rest.abs().amax((1, 2)))
    assert stored.used_degree() == 3


def test_dropped_rows_are_absent_and_others_are_attenuated(tmp_path: Path) -> None:
    scene = cloud(60, degree=2)
    scene.means[5] = torch.nan
    write_scene(tmp_path / "scene.ply", scene)
    source = read_scene(tmp_path / "scene.ply", drop_invalid=True)
    write_stylized(source, tmp_path / "out.ply", source.scene.sh_dc, sh_attenuation=0.5)
    loaded = read_scene(tmp_path / "out.ply").scene
    assert len(loaded) == 59
    assert torch.equal(held(loaded.sh_rest), held(source.scene.sh_rest) * 0.5)


def test_attenuation_ignores_scenes_of_degree_0(tmp_path: Path) -> None:
    source = read_scene(written(tmp_path, degree=0))
    assert source.scene.attenuated(0.5) is source.scene
    write_stylized(source, tmp_path / "out.ply", source.scene.sh_dc, sh_attenuation=0.5)
    assert (tmp_path / "out.ply").read_bytes() == source.path.read_bytes()


def test_compressed_scenes_are_attenuated_in_their_ply(tmp_path: Path) -> None:
    write_scene(tmp_path / "scene.spz", cloud(60, degree=1), SPZ)
    source = read_scene(tmp_path / "scene.spz")
    write_stylized(source, tmp_path / "out.ply", source.scene.sh_dc, sh_attenuation=0.25)
    assert torch.equal(held(read_scene(tmp_path / "out.ply").scene.sh_rest), held(source.scene.sh_rest) * 0.75)


def test_integer_coefficients_cannot_be_attenuated(tmp_path: Path) -> None:
    vertices = PlyData.read(written(tmp_path, 1))["vertex"].data
    kinds = [(name, "i4" if "rest" in name else "<f4") for name in vertices.dtype.names]
    PlyData([PlyElement.describe(vertices.astype(kinds), "vertex")], byte_order="<").write(tmp_path / "whole.ply")
    source = read_scene(tmp_path / "whole.ply")
    write_stylized(source, tmp_path / "out.ply", source.scene.sh_dc)
    with pytest.raises(SceneError, match="f_rest_0 is stored as integers, which cannot be attenuated"):
        write_stylized(source, tmp_path / "out.ply", source.scene.sh_dc, sh_attenuation=0.5)


def test_attenuation_factor_is_a_float32() -> None:
    assert attenuation_factor(0) == 1
    assert attenuation_factor(1) == 0
    assert np.float32(attenuation_factor(0.3)) == attenuation_factor(0.3)
