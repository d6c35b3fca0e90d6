"""Tests of PLYs with Mip-Splatting's 3D filter, and of those without a third axis."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from plyfile import PlyData, PlyElement

from sgsst_core.errors import SceneError
from sgsst_core.files.formats import by_name
from sgsst_core.files.scene_columns import apply_filter
from sgsst_core.files.scene_file import read_scene, write_scene
from sgsst_core.files.stylized_ply import write_stylized
from sgsst_core.rasterizer import make_rasterizer
from sgsst_core.refine.split import Refinement
from sgsst_core.scene.gaussians import Scene
from sgsst_core.scene.rendering import CLASSIC, Rendering
from tests.small_scenes import cameras, wall


def with_filter(path: Path, scene: Scene, deviations: torch.Tensor, *, text: bool = False) -> Path:
    """Write a PLY with the property filter_3D."""
    write_scene(path, scene)
    old = PlyData.read(path)["vertex"].data
    rows = np.empty(len(old), [*old.dtype.descr, ("filter_3D", "<f4")])
    for name in old.dtype.names:
        rows[name] = old[name]
    rows["filter_3D"] = deviations.numpy()
    PlyData([PlyElement.describe(rows, "vertex")], text=text, byte_order="=" if text else "<").write(str(path))
    return path


def without_thickness(path: Path, scene: Scene) -> Path:
    """Write a PLY without the property scale_2."""
    write_scene(path, scene)
    old = PlyData.read(path)["vertex"].data
    kinds = [each for each in old.dtype.descr if each[0] != "scale_2"]
    rows = np.empty(len(old), kinds)
    for name, *_ in kinds:
        rows[name] = old[name]
    PlyData([PlyElement.describe(rows, "vertex")], byte_order="<").write(str(path))
    return path


def deviations_of(scene: Scene) -> torch.Tensor:
    return torch.linspace(0, 0.1, len(scene))


@pytest.mark.parametrize("text", [False, True])
def test_filter_is_applied_and_preserved(tmp_path: Path, text: bool) -> None:
    scene = wall(sh_degree=1)
    path, out = with_filter(tmp_path / "scene.ply", scene, deviations_of(scene), text=text), tmp_path / "out.ply"
    file = read_scene(path)
    variances, added = scene.scales.double().exp().square(), deviations_of(scene).double().square()[:, None]
    opacities = scene.opacities.double().sigmoid() * (variances / (variances + added)).prod(dim=1).sqrt()
    assert torch.allclose(file.scene.scales.double().exp().square(), variances + added, rtol=1e-5)
    assert torch.allclose(file.scene.opacities.double().sigmoid(), opacities, rtol=1e-5)
    assert file.scene.opacities[0] == scene.opacities[0]
    assert file.scene.rendering == file.tag.rendering == Rendering("antialiased", 0.1)
    assert "filter_3D" in file.tag.reason
    write_stylized(file, out, torch.zeros_like(file.scene.sh_dc))
    before, after = (PlyData.read(each)["vertex"].data for each in (path, out))
    assert (after["f_dc_0"] == 0).all()
    for name in set(before.dtype.names) - {"f_dc_0", "f_dc_1", "f_dc_2"}:
        assert np.array_equal(before[name], after[name]), name


def test_comment_outweighs_the_property(tmp_path: Path) -> None:
    path = with_filter(tmp_path / "scene.ply", wall(), deviations_of(wall()))
    path.write_bytes(path.read_bytes().replace(b"element vertex", b"comment SplatRenderMode: default\nelement vertex"))
    file = read_scene(path)
    assert file.scene.rendering == CLASSIC
    assert not torch.equal(file.scene.scales, wall().scales)


@pytest.mark.parametrize("text", [False, True])
def test_split_gaussians_have_no_filter(tmp_path: Path, text: bool) -> None:
    scene, out = wall(), tmp_path / "out.ply"
    file = read_scene(with_filter(tmp_path / "scene.ply", scene, deviations_of(scene), text=text))
    pieces = torch.ones(len(scene), 3, dtype=torch.uint8)
    pieces[::2, 0] = 3
    refined = file.refined(Refinement(pieces, len(scene) // 2, 2 * len(scene)))
    write_stylized(refined, out, refined.scene.sh_dc)
    again, view = read_scene(out).scene, cameras()[1]
    assert not PlyData.read(out)["vertex"].data["filter_3D"].any()
    assert again.rendering == file.scene.rendering
    first, second = (make_rasterizer("cpu", each).coverage(view) for each in (refined.scene, again))
    assert torch.allclose(first, second, atol=1e-6)


def test_filter_becomes_part_of_the_shapes_in_other_formats(tmp_path: Path) -> None:
    file = read_scene(with_filter(tmp_path / "scene.ply", wall(), deviations_of(wall())))
    write_scene(tmp_path / "scene.glb", file.scene, by_name("glb"))
    again = read_scene(tmp_path / "scene.glb").scene
    assert again.rendering == file.scene.rendering
    assert torch.allclose(again.scales, file.scene.scales, atol=1e-5)


def test_filters_of_any_size_are_exact() -> None:
    scales = np.array([[-80.0, -80, -80], [80, 80, 80], [0, 0, 0], [0, 0, 0], [-5, 0, 5]], np.float32)
    logits = np.array([np.inf, 90, -90, 3, 3], np.float32)
    filters = np.array([1e-30, 1e-30, 1.0, 0.0, -1.0])
    filtered, opacities = scales.copy(), logits.copy()
    apply_filter(filtered, opacities, filters)
    assert filtered[0] == pytest.approx(np.log(1e-30), rel=1e-6)
    assert np.array_equal(filtered[[1, 3]], scales[[1, 3]])
    assert opacities[[1, 3]].tolist() == [90, 3]
    assert opacities[0] == pytest.approx(3 * (-80 - np.log(1e-30)), rel=1e-5)  # a logit of -33 is the logarithm
    assert opacities[2] == pytest.approx(-90 - 1.5 * np.log(2), rel=1e-6)
    assert filtered[4] == pytest.approx(np.log(np.exp(2 * scales[4].astype(np.float64)) + 1) / 2, rel=1e-6)


def test_invalid_filters_are_reported(tmp_path: Path) -> None:
    filters = deviations_of(wall())
    filters[7] = torch.nan
    path = with_filter(tmp_path / "scene.ply", wall(), filters)
    with pytest.raises(SceneError, match=re.escape("1 of 616 Gaussians hold NaN")):
        read_scene(path)
    assert read_scene(path, drop_invalid=True).dropped == 1


def test_flat_scene_is_rendered_without_thickness_and_preserved(tmp_path: Path) -> None:
    scene, out = wall(sh_degree=1), tmp_path / "out.ply"
    path = without_thickness(tmp_path / "scene.ply", scene)
    file = read_scene(path)
    assert file.scene.rendering == Rendering("2dgs")
    assert torch.equal(file.scene.scales[:, :2], scene.scales[:, :2])
    assert "thickness" in file.tag.warnings[0][0]
    thin = replace(scene, scales=scene.scales - torch.tensor([0.0, 0.0, 60.0]))
    for view in cameras():
        first, second = (make_rasterizer("cpu", each).coverage(view) for each in (file.scene, thin))
        assert torch.equal(first, second)
    write_stylized(file, out, torch.zeros_like(scene.sh_dc))
    names = PlyData.read(out)["vertex"].data.dtype.names
    assert "scale_2" not in names
    assert read_scene(out).scene.rendering == Rendering("2dgs")


@pytest.mark.parametrize("name", ["spz", "sog", "glb", "compressed.ply", "ply"])
def test_flat_scene_is_written_in_every_format(tmp_path: Path, name: str) -> None:
    file = read_scene(without_thickness(tmp_path / "scene.ply", wall()))
    write_scene(tmp_path / "out", file.scene, by_name(name))
    again, view = read_scene(tmp_path / "out").scene, cameras()[1]
    first, second = (make_rasterizer("cpu", each).coverage(view) for each in (file.scene, again))
    assert torch.allclose(first, second, atol=0.02)


def test_flat_gaussians_can_be_split(tmp_path: Path) -> None:
    file, out = read_scene(without_thickness(tmp_path / "scene.ply", wall())), tmp_path / "out.ply"
    pieces = torch.ones(616, 3, dtype=torch.uint8)
    pieces[:, :2] = 3
    refined = file.refined(Refinement(pieces, 616, 9 * 616))
    write_stylized(refined, out, refined.scene.sh_dc)
    assert torch.equal(read_scene(out).scene.scales, refined.scene.scales)


def test_isotropic_gaussians_are_not_flat(tmp_path: Path) -> None:
    write_scene(tmp_path / "scene.ply", wall())
    old = PlyData.read(tmp_path / "scene.ply")["vertex"].data
    kinds = [each for each in old.dtype.descr if each[0] not in ("scale_1", "scale_2")]
    rows = np.empty(len(old), kinds)
    for name, *_ in kinds:
        rows[name] = old[name]
    PlyData([PlyElement.describe(rows, "vertex")], byte_order="<").write(str(tmp_path / "round.ply"))
    assert read_scene(tmp_path / "round.ply").scene.rendering == CLASSIC
