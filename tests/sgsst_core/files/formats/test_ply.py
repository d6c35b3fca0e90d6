"""Tests of variants of PLY and of compressed PLYs."""

import struct
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from gsply.reader import read_compressed
from gsply.writer import write_compressed
from plyfile import PlyData, PlyElement

from sgsst_core.constants import SH_C0
from sgsst_core.errors import SceneError
from sgsst_core.files.formats import read_scene_header
from sgsst_core.files.formats.ply import COMPRESSED_PLY
from sgsst_core.files.scene_file import read_scene, write_scene, write_stylized
from sgsst_core.scene.gaussians import Scene
from sgsst_core.scene.rendering import CLASSIC
from tests.sgsst_core.files.formats.samples import assert_close, encoded, gsply_of, refused, scene_of
from tests.sgsst_core.splat_scenes import cloud
from tests.small_scenes import wall


def test_written_ply_is_bit_identical_to_plyfile(tmp_path: Path) -> None:
    """The file is bit-identical to plyfile's."""
    scene, path, other = cloud(300, degree=2), tmp_path / "a.ply", tmp_path / "b.ply"
    write_scene(path, scene)
    names = ["x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2", *(f"f_rest_{i}" for i in range(24))]
    names += ["opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"]
    rest = scene.sh_rest.transpose(1, 2).reshape(300, 24)
    parts = [scene.means, torch.zeros(300, 3), scene.sh_dc, rest, scene.opacities[:, None], scene.scales, scene.quats]
    values = torch.cat(parts, dim=1).numpy()
    rows = np.array([tuple(row) for row in values.tolist()], [(name, "<f4") for name in names])
    PlyData([PlyElement.describe(rows, "vertex")], byte_order="<").write(str(other))
    assert path.read_bytes() == other.read_bytes()


def table(scene: Scene) -> dict[str, np.ndarray]:
    """Return the usual properties of a scene, float32, by name."""
    columns = dict(zip("xyz", scene.means.numpy().T, strict=True))
    columns |= {f"f_dc_{i}": values for i, values in enumerate(scene.sh_dc.numpy().T)}
    rest = scene.sh_rest.transpose(1, 2).reshape(len(scene), -1).numpy()
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
    file = read_scene(path)
    assert torch.equal(file.scene.scales, scene.scales[:, 1:2].expand(-1, 3))
    assert file.scene.rendering == CLASSIC, "not flat"
    assert torch.equal(file.scene.sh_rest, scene.sh_rest)
    write_stylized(file, out, scene.sh_dc + 1)
    assert torch.equal(read_scene(out).scene.scales, file.scene.scales)


def test_two_of_three_scales_are_refused(tmp_path: Path) -> None:
    columns = table(cloud(20))
    del columns["scale_2"]
    columns["scale"] = columns["scale_0"]
    save(tmp_path / "scene.ply", columns)
    with pytest.raises(SceneError, match="missing: scale_2"):
        read_scene(tmp_path / "scene.ply")


@pytest.mark.parametrize("text", [False, True])
def test_sh_degree_4_is_rendered_up_to_3_and_preserved(tmp_path: Path, text: bool) -> None:
    scene, path, out = cloud(150, degree=3), tmp_path / "scene.ply", tmp_path / "out.ply"
    more = torch.randn(150, 9, 3, generator=torch.Generator().manual_seed(1))
    whole = torch.cat([scene.sh_rest, more], dim=1)
    save(path, table(replace(scene, sh_rest=whole)), text)
    file = read_scene(path)
    assert file.scene.sh_degree == 3
    assert torch.equal(file.scene.sh_rest, scene.sh_rest)
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


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_gsply_files_are_read_as_by_gsply(tmp_path: Path, degree: int) -> None:
    path = tmp_path / "scene.ply"
    data = gsply_of(cloud(700, degree=degree))
    write_compressed(path, data.means, data.scales, data.quats, data.opacities, data.sh0, data.shN)
    assert read_scene_header(path).format is COMPRESSED_PLY
    actual, reference = read_scene(path), read_compressed(path)
    assert actual.scene.sh_degree == degree
    # gsply places the first and last level of SH coefficients in the middle of their steps instead of at the ends.
    expected = scene_of(reference)
    assert_close(replace(actual.scene, sh_rest=expected.sh_rest), expected)
    rest = expected.sh_rest
    inner = rest.abs() < 3.98
    torch.testing.assert_close(actual.scene.sh_rest[inner], rest[inner], rtol=0, atol=1e-6)


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_gsply_reads_written_files(tmp_path: Path, degree: int) -> None:
    path = tmp_path / "scene"
    write_scene(path, cloud(700, degree=degree), COMPRESSED_PLY)
    loaded = read_scene(path).scene
    assert loaded.sh_degree == degree
    assert_close(loaded, scene_of(read_compressed(path)))


def test_files_without_color_bounds_are_read(tmp_path: Path) -> None:
    """Compressed PLYs of older versions have colors between 0 and 1."""
    path = tmp_path / "scene.ply"
    scene = replace(wall(), sh_dc=torch.zeros(616, 3))
    write_scene(path, scene, COMPRESSED_PLY)
    ply = PlyData.read(str(path), mmap=False)
    names = [name for name in ply["chunk"].data.dtype.names if name[-1] not in "rgb"]
    chunk = PlyElement.describe(np.array(ply["chunk"].data[names].tolist(), [(name, "<f4") for name in names]), "chunk")
    ply["vertex"].data["packed_color"] = 0xFF008080
    PlyData([chunk, ply["vertex"]], byte_order="<").write(str(path))
    loaded = read_scene(path).scene
    assert (0.5 + 0.28209479177387814 * loaded.sh_dc[0]).tolist() == pytest.approx([1, 0, 128 / 255], abs=1e-6)


def test_neighbors_share_bounds(tmp_path: Path) -> None:
    """Errors are small in any order of the scene; 1/1024 of the whole extent would be forty times larger."""
    scene = cloud(20_000)
    scene = scene.subset(torch.randperm(len(scene), generator=torch.Generator().manual_seed(1)))
    path = tmp_path / "scene.ply"
    write_scene(path, scene, COMPRESSED_PLY)
    back = read_scene(path).scene.means
    order, other = (each[:, 0].double().argsort() for each in (scene.means, back))
    extent = float(scene.means.max() - scene.means.min())
    error = (scene.means[order, 0] - back[other, 0]).abs().mean()
    assert float(error) < extent / 2048 / 10


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda data: data[:-1], "only .* follow it: the file is truncated"),
        (lambda data: data.replace(b"vertex 616", b"vertex 999999999"), "3 chunks, but 999999999 Gaussians make"),
        (
            lambda data: (
                data.replace(b"vertex 616", b"vertex 2560000000")
                .replace(b"chunk 3", b"chunk 10000000")
                .replace(b"sh 616", b"sh 2560000000")
            ),
            "truncated or its header is wrong",
        ),
        (lambda data: data.replace(b"chunk 3", b"chunk 4"), "4 chunks, but 616 Gaussians make 3"),
        (lambda data: data.replace(b"element sh 616", b"element sh 615"), "'sh' has 615 rows"),
        (lambda data: data.replace(b"property uchar f_rest_8\n", b""), "'sh' has 616 rows of 8 properties"),
        (lambda data: data.replace(b"element chunk", b"element chunks"), "without element 'chunk'"),
        (lambda data: data.replace(b"float min_x", b"int min_x"), "'chunk' has min_x missing or of another type"),
        (lambda data: data.replace(b"uint packed_scale", b"int packed_scale"), "'vertex' has packed_scale missing"),
        (lambda data: data.replace(b"uchar f_rest_3", b"char f_rest_3"), "'sh' has f_rest_3 missing"),
        (lambda data: data.replace(b"binary_little_endian", b"ascii"), "as text"),
        (lambda data: data.replace(b"vertex 616", b"vertex 0").replace(b"chunk 3", b"chunk 0"), "holds no Gaussians"),
    ],
)
def test_false_header_is_refused(tmp_path: Path, change: Callable[[bytes], bytes], message: str) -> None:
    data = encoded(tmp_path, COMPRESSED_PLY)
    changed = change(data)
    assert changed != data
    refused(tmp_path, changed, message)


def test_non_finite_bounds_are_refused_or_dropped(tmp_path: Path) -> None:
    data = encoded(tmp_path, COMPRESSED_PLY)
    start = data.index(b"end_header\n") + len(b"end_header\n")
    changed = data[:start] + struct.pack("<f", float("nan")) + data[start + 4 :]
    refused(tmp_path, changed, r"256 of 616 Gaussians hold NaN or infinite values or no rotation: x\..*--drop-invalid")
    loaded = read_scene(tmp_path / "scene.ply", drop_invalid=True)
    assert (len(loaded.scene), loaded.dropped) == (360, 256)
    write_stylized(loaded, tmp_path / "out.ply", torch.zeros(360, 3))
    assert len(read_scene(tmp_path / "out.ply").scene) == 360
