"""Tests of the render mode in files: what each program writes, what is written back, and what is not believed."""

from __future__ import annotations

import gzip
import json
import zipfile
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from sgsst_core.files.formats import RESULT_FORMATS, by_name
from sgsst_core.files.formats.scene_format import SceneFormat
from sgsst_core.files.scene_file import SceneFile, read_scene, write_scene
from sgsst_core.files.stylized_ply import write_stylized
from sgsst_core.scene.rendering import CLASSIC, Rendering, RenderMode
from tests.small_scenes import wall

AA, MIP = Rendering("antialiased", 0.3), Rendering("antialiased", 0.1)
FVDB = "fvdb_ply_af_8198767135"


def ply(tmp_path: Path, *comments: str, newline: bytes = b"\n") -> Path:
    """Write a PLY with comments in its header."""
    path = tmp_path / "scene.ply"
    write_scene(path, wall())
    head, end, data = path.read_bytes().partition(b"end_header\n")
    lines = [*head.split(b"\n")[:2], *(f"comment {text}".encode() for text in comments), *head.split(b"\n")[2:]]
    path.write_bytes(newline.join(lines) + end[:-1] + newline + data)
    return path


@pytest.mark.parametrize(
    ("comments", "expected"),
    [
        (["SplatRenderMode: mip"], AA),
        (["Exported from Brush", "SH degree: 0", "SplatRenderMode: mip"], MIP),
        (["Exported from Brush", "SplatRenderMode: default"], CLASSIC),
        (["splatrendermode:  MIP "], AA),
        (["SplatRenderMode: 2dgs"], Rendering("2dgs")),
        (["antialiased 1"], AA),
        (["antialiased 0"], CLASSIC),
        (["antialiased 1", "SplatRenderMode: default"], CLASSIC),
        (["SplatRenderMode: default", "antialiased 1"], AA),
        (["SplatRenderMode: mip", "eps2d 0.2"], Rendering("antialiased", 0.2)),
        (["eps2d 0.05"], Rendering("classic", 0.05)),
        ([f"{FVDB}eps2d|double|0.30000000000000004", f"{FVDB}antialias|int64|1"], replace(AA, eps2d=0.1 + 0.2)),
        ([f"{FVDB}eps2d|double|0.3", f"{FVDB}antialias|int64|0"], CLASSIC),
        (["SplatRenderMode: banana"], CLASSIC),
        (["SplatRenderMode: mip", "eps2d nan"], AA),
        (["SplatRenderMode: mip", "eps2d 1e9"], AA),
        (["SplatRenderMode: mip", "eps2d -0.1"], AA),
        (["not antialiased 1", "antialiased 12"], CLASSIC),
        (["postshot.anti_aliasing=1"], AA),
        (["postshot.anti_aliasing=0"], CLASSIC),
        (["Anti-Aliasing: on"], AA),
        (["rasterize_mode=antialiased", "kernel_size: 0.1"], MIP),
        (["mip_splatting true"], AA),
        ([], CLASSIC),
    ],
)
def test_comments_of_programs_state_the_render_mode(tmp_path: Path, comments: list[str], expected: Rendering) -> None:
    for newline in (b"\n", b"\r\n"):
        file = read_scene(ply(tmp_path, *comments, newline=newline))
        assert file.scene.rendering == file.tag.rendering == expected


def test_doubtful_comments_give_warnings(tmp_path: Path) -> None:
    for comment, said in (
        ("SplatRenderMode: banana", "unknown"),
        ("trained with anti-aliasing", "unknown"),
        ("antialiased 12", "unknown"),
        ("Mip-Splatting, 30,000 steps", "unknown"),
        ("eps2d nan", "unknown"),
        ("SplatRenderMode: 2dgs", "without thickness"),
        ("trained with 3DGUT", "another projection"),
        (f"{FVDB}projection_method|str|unscented", "another projection"),
    ):
        (warning,) = read_scene(ply(tmp_path, comment)).tag.warnings
        assert said in " ".join(warning)
    assert read_scene(ply(tmp_path, "gut feeling", "mipless", "SplatRenderMode: mip")).tag.warnings == ()


@pytest.mark.parametrize("rendering", [CLASSIC, AA, MIP, Rendering("2dgs")], ids=lambda each: each.text)
@pytest.mark.parametrize("format", RESULT_FORMATS, ids=lambda format: format.name)
def test_written_files_state_the_render_mode(tmp_path: Path, format: SceneFormat, rendering: Rendering) -> None:
    path = tmp_path / "scene.any"
    write_scene(path, replace(wall(sh_degree=1), rendering=rendering), format)
    loaded = read_scene(path).scene.rendering
    if format.name.endswith("spz"):  # has a flag for antialiased scenes only
        rendering = AA if rendering.antialiased else CLASSIC
    assert loaded == rendering


@pytest.mark.parametrize("format", RESULT_FORMATS, ids=lambda format: format.name)
def test_classic_scenes_state_no_render_mode(tmp_path: Path, format: SceneFormat) -> None:
    path = tmp_path / "scene.any"
    write_scene(path, wall(), format)
    data = path.read_bytes()
    if format.name == "sog":
        with zipfile.ZipFile(path) as archive:
            assert not {"model", "extras"} & json.loads(archive.read("meta.json")).keys()
    elif format.name == "v3.spz":
        assert gzip.decompress(data)[14] == 0
    elif format.name == "spz":
        assert data[14] == 2
    else:
        assert b"comment" not in data[:4000]
    assert read_scene(path).tag.reason == ""


def test_flag_of_old_spz_files_is_ignored(tmp_path: Path) -> None:
    path = tmp_path / "scene.spz"
    write_scene(path, replace(wall(), rendering=AA), by_name("v3.spz"))
    data = bytearray(gzip.decompress(path.read_bytes()))
    assert data[14] == 1
    data[13] = 12  # as by Spark
    path.write_bytes(gzip.compress(bytes(data)))
    file = read_scene(path)
    assert file.scene.rendering == CLASSIC
    ((drawn, reason),) = file.tag.warnings
    assert drawn == "classic"
    assert "Spark" in reason


def stylized(file: SceneFile, target: Path) -> SceneFile:
    write_stylized(file, target, torch.zeros_like(file.scene.sh_dc))
    return read_scene(target)


@pytest.mark.parametrize("newline", [b"\n", b"\r\n"])
def test_stylized_ply_keeps_the_render_mode_of_its_source(tmp_path: Path, newline: bytes) -> None:
    path = ply(tmp_path, "Exported from Brush", "SplatRenderMode: mip", newline=newline)
    loaded = stylized(read_scene(path), tmp_path / "out.ply")
    assert loaded.scene.rendering == MIP
    size = path.read_bytes().index(b"end_header")
    assert (tmp_path / "out.ply").read_bytes()[:size] == path.read_bytes()[:size]


@pytest.mark.parametrize("newline", [b"\n", b"\r\n"])
@pytest.mark.parametrize("comments", [[], ["Exported from Brush", "SplatRenderMode: mip"], ["antialiased 1"]])
@pytest.mark.parametrize("rendering", [CLASSIC, AA, MIP], ids=lambda each: each.text)
def test_stylized_ply_states_the_requested_render_mode(
    tmp_path: Path, rendering: Rendering, comments: list[str], newline: bytes
) -> None:
    mode: RenderMode = "antialiased" if rendering.antialiased else "classic"
    file = read_scene(ply(tmp_path, *comments, newline=newline)).rendered(mode, rendering.eps2d)
    result = stylized(file, tmp_path / "out.ply")
    assert result.scene.rendering == file.scene.rendering == rendering
    assert torch.equal(result.scene.means, file.scene.means)
    again = stylized(result, tmp_path / "again.ply")
    assert again.scene.rendering == rendering


def test_requested_mode_is_stated_when_gaussians_are_dropped(tmp_path: Path) -> None:
    scene = wall()
    scene.means[3] = torch.nan
    write_scene(tmp_path / "scene.ply", scene)
    file = read_scene(tmp_path / "scene.ply", drop_invalid=True).rendered("antialiased", None)
    result = stylized(file, tmp_path / "out.ply")
    assert (len(result.scene), result.scene.rendering) == (len(scene) - 1, AA)


def test_plys_from_other_formats_keep_the_render_mode(tmp_path: Path) -> None:
    write_scene(tmp_path / "scene.sog", replace(wall(), rendering=MIP), by_name("sog"))
    assert stylized(read_scene(tmp_path / "scene.sog"), tmp_path / "out.ply").scene.rendering == MIP
