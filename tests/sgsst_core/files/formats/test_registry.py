"""Tests of what holds for every scene format."""

import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from sgsst_core.errors import OutputError, SceneError
from sgsst_core.files.camera_files import read_cameras
from sgsst_core.files.formats import (
    DOWNLOADS,
    EXTRA_FORMATS,
    FORMATS,
    RESULT_FORMATS,
    TITLES,
    download_of_name,
    format_of_name,
    read_scene_header,
)
from sgsst_core.files.formats.ply import COMPRESSED_PLY, PLY
from sgsst_core.files.formats.scene_format import FileStart, SceneFormat
from sgsst_core.files.formats.sog import SOG
from sgsst_core.files.formats.splat import SPLAT
from sgsst_core.files.formats.spz import SPZ, SPZ_3
from sgsst_core.files.library import load_scene, save
from sgsst_core.files.scene_file import losses, read_scene, write_scene
from sgsst_core.files.stylized_ply import write_stylized
from sgsst_core.quality.measure import measure_compression
from sgsst_core.rasterizer import make_rasterizer
from sgsst_core.scene.gaussians import Scene
from sgsst_core.scene.spherical_harmonics import rest_colors, view_colors
from sgsst_core.scene.stored_harmonics import held
from tests.sgsst_core.files.formats.samples import (
    check_damage,
    encoded,
    refused,
)
from tests.sgsst_core.splat_scenes import camera, cloud
from tests.small_scenes import cameras, wall
from worker.derived import blend, convert
from worker.job import SceneRequest


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
@pytest.mark.parametrize("format", RESULT_FORMATS, ids=lambda format: format.name)
def test_written_scene_is_read_back(tmp_path: Path, format: SceneFormat, degree: int) -> None:
    scene, path = cloud(700, degree=degree), tmp_path / "scene.any"
    write_scene(path, scene, format)
    header, file = read_scene_header(path), read_scene(path)
    assert (header.format, file.format) == (format, format.name)
    assert (header.count, len(file.scene), file.scene.sh_degree) == (700, 700, degree)
    order, other = (each.means[:, 0].double().argsort() for each in (scene, file.scene))
    assert float((scene.means[order, 0] - file.scene.means[other, 0]).abs().max()) < 0.01


@pytest.mark.parametrize("format", RESULT_FORMATS, ids=lambda format: format.name)
def test_content_matches_one_format(tmp_path: Path, format: SceneFormat) -> None:
    data = encoded(tmp_path, format)
    start = FileStart(tmp_path / "good", data[:8192], len(data))
    assert [each for each in FORMATS if each.matches(start)] == [format]


@pytest.mark.parametrize("format", EXTRA_FORMATS, ids=lambda format: format.name)
def test_scenes_of_any_format_become_stylized_plys(tmp_path: Path, format: SceneFormat) -> None:
    path, out = tmp_path / "scene.any", tmp_path / "out.ply"
    write_scene(path, wall(sh_degree=2), format)
    source = read_scene(path)
    colors = torch.randn(616, 3, generator=torch.Generator().manual_seed(1))
    write_stylized(source, out, colors)
    loaded = read_scene(out)
    assert loaded.format == "ply"
    assert torch.equal(loaded.scene.sh_dc, colors)
    for name in ("means", "quats", "scales", "opacities", "sh_rest"):
        assert torch.equal(getattr(loaded.scene, name), getattr(source.scene, name)), name


def test_sh_bands_of_zeros_are_omitted(tmp_path: Path) -> None:
    scene = wall(sh_degree=3)
    held(scene.sh_rest)[:, 3:] = 0
    for format in EXTRA_FORMATS:
        path = tmp_path / f"scene.{format.name}"
        write_scene(path, scene, format)
        assert read_scene(path).scene.sh_degree == 1


@pytest.mark.parametrize("format", [COMPRESSED_PLY, SPZ, SPZ_3, SOG], ids=lambda format: format.name)
def test_opacities_of_0_and_1_are_finite_and_round_trip(tmp_path: Path, format: SceneFormat) -> None:
    scene = replace(wall(), opacities=torch.cat([torch.full((308,), 1e4), torch.full((308,), -1e4)]))
    path = tmp_path / f"scene.{format.name}"
    write_scene(path, scene, format)
    back = read_scene(path).scene
    assert sorted(set(back.opacities.sigmoid().tolist())) == pytest.approx([0.25 / 255, 1 - 0.25 / 255], rel=1e-4)
    write_scene(path, back, format)
    assert torch.equal(read_scene(path).scene.opacities.sort().values, back.opacities.sort().values)


@pytest.mark.parametrize(("format", "bound"), [(COMPRESSED_PLY, 48), (SPZ, 53), (SPZ_3, 53), (SOG, 46)])
def test_real_scene_round_trips_with_small_loss(
    shared_data: Path, tmp_path: Path, format: SceneFormat, bound: float
) -> None:
    """The plush toy has 47,974 Gaussians of degree 3, trained from photos."""
    folder = shared_data / "scenes" / "snowmiku_plush"
    scene = read_scene(next(folder.glob("*.ply"))).scene
    path = tmp_path / "plush"
    write_scene(path, scene, format)
    loss = measure_compression(path, scene, read_cameras(folder / "cameras.json"), near=0.01)
    assert loss.psnr is not None
    assert loss.psnr > bound
    assert loss.size < 3e6


@pytest.mark.parametrize("format", EXTRA_FORMATS, ids=lambda format: format.name)
def test_compressed_scene_renders_nearly_the_same(tmp_path: Path, format: SceneFormat) -> None:
    scene = replace(cloud(2000, degree=3), opacities=torch.full((2000,), 2.0))
    path = tmp_path / f"scene.{format.name}"
    write_scene(path, scene, format)
    loss = measure_compression(path, scene, [camera(), camera(140, 90)], near=0.01)
    assert loss.psnr is None or loss.psnr > 40
    assert {name: value for name, value in loss.as_dict().items() if name != "warnings"} == {
        "name": path.name,
        "format": format.name,
        "bytes": path.stat().st_size,
        "views": ["test", "test"],
        "psnr_db": loss.psnr and round(loss.psnr, 2),
    }


def far(scene: Scene) -> Scene:
    """Return a scene with a large Gaussian far away, whose size SPZ can store."""
    scene = replace(scene, means=scene.means.clone(), scales=scene.scales.clone())
    scene.means[0], scene.scales[0] = 1e6, 5.0
    return scene


@pytest.mark.parametrize(
    ("change", "losing"),
    [
        (lambda scene: scene, {}),
        (lambda scene: replace(scene, scales=scene.scales - torch.tensor([12.0, 0, 0])), {}),  # thin in one axis
        (
            lambda scene: replace(scene, scales=scene.scales - 12),
            {"SPZ": "scales outside -10 to 5.94", "compressed": "", "SOG": ""},
        ),
        (lambda scene: replace(scene, scales=scene.scales + 30), {"SPZ": "log scales", "compressed": "-20 to 20"}),
        (lambda scene: replace(scene, sh_dc=scene.sh_dc * 40), {"SPZ": "colors (f_dc) outside -3.33 to 3.33"}),
        (lambda scene: replace(scene, sh_rest=scene.sh_rest + 2), {"SPZ": "harmonics outside -1 to 1"}),
        (lambda scene: replace(scene, sh_rest=scene.sh_rest + 9), {"SPZ": "harmonics", "compressed": "-4 to 4"}),
        (lambda scene: replace(scene, scales=scene.scales + 99), {"SPZ": "", "compressed": "", "GLB": "-87 to 88"}),
        (far, {"SPZ": "moves 615 of 616", "compressed": "moves"}),
    ],
)
def test_what_a_format_cannot_hold_is_counted(change: Callable[[Scene], Scene], losing: dict[str, str]) -> None:
    plain = wall(sh_degree=1)
    scene = change(replace(plain, scales=torch.full((616, 3), -5.0), sh_dc=plain.sh_dc.clamp(-3, 3)))
    for format in RESULT_FORMATS:
        notes = losses(scene, format)
        kind = format.title.partition(" ")[0]
        assert bool(notes) == (kind in losing), notes
        assert losing.get(kind, "") in " ".join(notes)


def test_writers_report_what_is_lost(tmp_path: Path) -> None:
    source, out, scene = tmp_path / "scene.ply", tmp_path / "out.spz", wall()
    write_scene(source, replace(scene, sh_dc=scene.sh_dc + 5))
    request, reason = SceneRequest(scene=source), "616 of 616 Gaussians have colors"
    assert reason in convert(request, out, compare=False).decisions[-1].reason
    compared = convert(request, out, compare=True).loss
    assert compared is not None
    assert reason in compared.text("the PLY")
    assert compared.as_dict()["warnings"][0].startswith(reason)
    assert blend([(request, 0.5), (request, 0.5)], out)[0].decision == "warning: out.spz loses detail"
    with pytest.warns(UserWarning, match=reason):
        save(out, load_scene(source))


def test_compression_loss_is_the_psnr_of_renders(tmp_path: Path) -> None:
    """The PSNR of one view is computed by hand."""
    scene, view = wall(sh_degree=1), cameras(1)[0]
    path = tmp_path / "scene.spz"
    write_scene(path, replace(scene, sh_dc=scene.sh_dc + 0.3), SPZ)
    back = read_scene(path).scene
    first, second = (
        make_rasterizer("cpu", each, near=0.01)
        .render(view_colors(each.sh_dc, rest_colors(each.sh_rest, each.means, view)), view)
        .clamp(0, 1)
        for each in (scene, back)
    )
    expected = -10 * torch.log10((first.double() - second.double()).square().mean())
    assert measure_compression(path, scene, [view], near=0.01).psnr == pytest.approx(float(expected))


def test_suffix_determines_the_format() -> None:
    names = ["a.ply", "a.PLY", "a.b.compressed.ply", "a.SPZ", "a.v3.spz", "a.splat", "ply"]
    assert [format_of_name(name) for name in names] == [PLY, PLY, COMPRESSED_PLY, SPZ, SPZ_3, SPLAT, None]


def test_suffix_determines_what_a_result_is_saved_as() -> None:
    names = ["a.ply", "a.b.PLY", "a.compressed.ply", "a.v3.spz", "a.spz", "a.Sog", "a.glb", "a.html", "a"]
    assert [download_of_name(name) for name in names] == [
        *("ply", "ply", "compressed.ply", "v3.spz", "spz", "sog", "glb", "html", "ply")
    ]
    assert {download_of_name(f"a.{name}") for name in DOWNLOADS} == set(DOWNLOADS)
    for name in ("a.splat", "a.zip", "a.usdz", "a.htm", "a.ply.part"):
        with pytest.raises(OutputError, match=re.escape(f"{name}: does not end in .ply, .compressed.ply")):
            download_of_name(name)


@pytest.mark.parametrize("format", RESULT_FORMATS, ids=lambda format: format.name)
def test_truncated_file_is_refused(tmp_path: Path, format: SceneFormat) -> None:
    data = encoded(tmp_path, format)
    for stop in [*range(1, 64), len(data) // 2, len(data) - 1]:
        (tmp_path / "good").write_bytes(data[:stop])
        with pytest.raises(SceneError):
            read_scene(tmp_path / "good")


@pytest.mark.parametrize("format", RESULT_FORMATS, ids=lambda format: format.name)
def test_random_damage_never_crashes_a_reader(tmp_path: Path, format: SceneFormat) -> None:
    check_damage(tmp_path / "scene", encoded(tmp_path, format))


@pytest.mark.parametrize(
    "data",
    [
        b"hello",
        b"\x89PNG\r\n\x1a\n" + bytes(300),
        b"a text of words. " * 200,
        bytes(3200),
        b"so it is\nv 1 2 3\n" * 100,  # no OBJ
        b"# only\n# comments\n" * 100,
    ],
)
def test_other_files_are_refused(tmp_path: Path, data: bytes) -> None:
    refused(tmp_path, data, re.escape(f"expected {TITLES}"))
