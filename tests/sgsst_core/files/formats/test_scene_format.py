"""Tests of what holds for every format: round trips, axes, render modes, surplus content, refused kinds of scenes."""

import gzip
import json
import re
import struct
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
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
    by_name,
    download_of_name,
    format_of_name,
    read_scene_header,
)
from sgsst_core.files.formats.ply import COMPRESSED_PLY, PLY
from sgsst_core.files.formats.scene_format import FileStart, Frame, SceneFormat
from sgsst_core.files.formats.sog import SOG
from sgsst_core.files.formats.splat import SPLAT
from sgsst_core.files.formats.spz import SPZ, SPZ_3
from sgsst_core.files.library import load_scene, save
from sgsst_core.files.scene_file import SceneFile, losses, read_scene, write_scene, write_stylized
from sgsst_core.quality.measure import measure_compression
from sgsst_core.rasterizer import make_rasterizer
from sgsst_core.scene.gaussians import TENSORS, Scene
from sgsst_core.scene.rendering import CLASSIC, Rendering, RenderMode
from sgsst_core.scene.spherical_harmonics import rest_colors, scene_colors, view_colors
from tests.sgsst_core.files.formats.samples import (
    check_damage,
    encoded,
    ksplat,
    refused,
)
from tests.sgsst_core.rasterizer.splat_reference import ReferenceRasterizer
from tests.sgsst_core.splat_scenes import camera, cloud, rotated_pose
from tests.small_scenes import cameras, wall
from worker.derived import blend, convert
from worker.job import SceneRequest


def matrix(scale: float = 1.0) -> np.ndarray:
    pose = rotated_pose(2.1).numpy()
    pose[:3, :3] *= scale
    return pose


def applied(frame: Frame, scene: Scene) -> Scene:
    arrays = {name: getattr(scene, name).numpy().copy() for name in TENSORS}
    frame.apply(arrays)
    return Scene(*(torch.from_numpy(array) for array in arrays.values()))


@pytest.mark.parametrize("scale", [1.0, 0.3])
def test_transformed_scene_and_camera_give_the_same_image(scale: float) -> None:
    scene, view = cloud(300, degree=3), camera(90, 70)
    moved = matrix(scale)
    pose = view.world_to_camera.clone()
    pose[:3, :3] = pose[:3, :3] @ torch.from_numpy(moved[:3, :3].T / scale)
    pose[:3, 3] = scale * view.world_to_camera[:3, 3] - pose[:3, :3] @ torch.from_numpy(moved[:3, 3])
    images = []
    for each, seen in (
        (scene, view),
        (applied(Frame.of(moved), scene), replace(view, world_to_camera=pose)),
    ):
        near = 0.2 if seen is view else 0.2 * scale
        images.append(ReferenceRasterizer(each, near=near).render(scene_colors(each, seen), seen))
    assert float((images[0] - images[1]).abs().max()) < 2e-4


@pytest.mark.parametrize(
    "linear", [np.diag([1.0, 1.0, -1.0]), np.diag([1.0, 2.0, 1.0]), np.zeros((3, 3)), np.full((3, 3), np.nan)]
)
def test_mirrors_and_distortions_are_refused(linear: np.ndarray) -> None:
    distorted = np.eye(4)
    distorted[:3, :3] = linear
    with pytest.raises(ValueError, match="the transformation"):
        Frame.of(distorted)


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


def test_scenes_of_2dgs_give_a_warning(tmp_path: Path) -> None:
    (warning,) = read_scene(ply(tmp_path, "SplatRenderMode: 2dgs")).tag.warnings
    assert "without thickness" in " ".join(warning)
    assert read_scene(ply(tmp_path, "gut feeling", "SplatRenderMode: mip")).tag.warnings == ()


@pytest.mark.parametrize("rendering", [CLASSIC, AA, MIP, Rendering("2dgs")], ids=lambda each: each.text)
@pytest.mark.parametrize("format", RESULT_FORMATS, ids=lambda format: format.name)
def test_written_files_state_the_render_mode(tmp_path: Path, format: SceneFormat, rendering: Rendering) -> None:
    path = tmp_path / "scene.any"
    write_scene(path, replace(wall(sh_degree=1), rendering=rendering), format)
    file = read_scene(path)
    if format.name.endswith("spz"):  # has a flag for antialiased scenes only
        rendering = AA if rendering.antialiased else CLASSIC
    assert (file.scene.rendering, bool(file.tag.reason)) == (rendering, rendering != CLASSIC)


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


NOTE = "the file is longer than its header declares by {} B, which are not read; copy or export it again"


def fewer(data: bytes, count: int = 600) -> bytes:
    """Return a PLY whose header counts fewer Gaussians."""
    return data.replace(b"element vertex 616", f"element vertex {count}".encode())


def with_elements(data: bytes) -> bytes:
    """Return a PLY with two other elements after its Gaussians."""
    lines = b"element edge 2\nproperty int i\nelement view 1\nproperty double focal\nend_header\n"
    return data.replace(b"end_header\n", lines) + struct.pack("<2id", 1, 2, 1)


@pytest.mark.parametrize("change", [bytes, with_elements])
def test_rows_beyond_the_declared_ones_are_counted(tmp_path: Path, change: Callable[[bytes], bytes]) -> None:
    path, data = tmp_path / "scene.ply", change(encoded(tmp_path, by_name("ply")))
    path.write_bytes(data + b"\n")
    assert read_scene(path).notes == ()
    if change is with_elements:
        path.write_bytes(data + b"more bytes")
        assert read_scene(path).notes == (NOTE.format(10),)
        return
    path.write_bytes(fewer(data))
    loaded = read_scene(path)
    assert (len(loaded.scene), loaded.notes) == (600, (NOTE.format(16 * 26 * 4),))
    write_stylized(loaded, tmp_path / "out.ply", torch.zeros(600, 3))
    assert read_scene(tmp_path / "out.ply").notes == loaded.notes


def test_invalid_rows_before_a_surplus_are_not_dropped(tmp_path: Path) -> None:
    """A byte too many shifts all values after it."""
    write_scene(tmp_path / "good", cloud(2000, degree=1))
    data = (tmp_path / "good").read_bytes()
    middle = len(data) // 2
    refused(
        tmp_path, data[:middle] + b"\x7f" + data[middle:], "not as the header declares: the file is longer .* by 1 B"
    )


@pytest.mark.parametrize("compress", [gzip.compress, bytes])
@pytest.mark.parametrize("extended", [True, False])
def test_spz_that_counts_fewer_gaussians_is_refused(
    tmp_path: Path, compress: Callable[[bytes], bytes], extended: bool
) -> None:
    """The attributes of all Gaussians follow each other, so that a wrong count shifts them."""
    raw = bytearray(gzip.decompress(encoded(tmp_path, by_name("v3.spz"))))
    raw[8:12] = struct.pack("<I", 600)
    if not extended:
        raw[14] = 0
    refused(tmp_path, compress(bytes(raw)), "continues after all Gaussians", "scene.spz")
    data = bytearray(encoded(tmp_path, by_name("spz")))
    data[8:12] = struct.pack("<I", 600)
    refused(tmp_path, bytes(data), "belong to 600 Gaussians", "scene.spz")


@pytest.mark.parametrize("scene", [wall(sh_degree=1), cloud(2000, degree=1)], ids=["wall", "cloud"])
@pytest.mark.parametrize("name", ["ply", "compressed.ply", "spz", "v3.spz", "sog", "glb"])
def test_activated_opacities_are_refused(tmp_path: Path, scene: Scene, name: str) -> None:
    """Formats that store opacities cannot show that logits of opacities were taken for logits."""
    path = tmp_path / "scene"
    write_scene(path, replace(scene, opacities=scene.opacities.sigmoid()), by_name(name))
    if name != "ply":
        assert len(read_scene(path).scene) == len(scene)
        return
    with pytest.raises(SceneError, match=r"its logits of opacities go from.*activated.*Export the scene again"):
        read_scene(path)


def test_scenes_in_small_units_are_read(tmp_path: Path) -> None:
    """In millimeters, all Gaussians may be larger than 1."""
    scene = cloud(2000, degree=0)
    shift = float(-scene.scales.min()) + 0.1
    large = replace(scene, means=scene.means * float(np.exp(shift)), scales=scene.scales + shift)
    write_scene(tmp_path / "scene.ply", large)
    assert torch.equal(read_scene(tmp_path / "scene.ply").scene.scales, large.scales)


def test_colors_in_place_of_coefficients_are_noticed(tmp_path: Path) -> None:
    path, colors = tmp_path / "scene.ply", torch.rand(616, 3, generator=torch.Generator().manual_seed(1))
    write_scene(path, replace(wall(), sh_dc=colors * 255))
    with pytest.raises(SceneError, match=r"colors \(f_dc\) go from .* colors of 0 to 255"):
        read_scene(path)


@pytest.mark.parametrize(
    ("attribute", "values", "message"),
    [
        ("SCALE", wall().scales.numpy(), "scales are negative, so they are logarithms"),
        ("OPACITY", wall().opacities.numpy(), r"opacities are not in 0\.\.1, so they are logits"),
    ],
)
def test_logarithms_in_a_glb_are_refused(tmp_path: Path, attribute: str, values: np.ndarray, message: str) -> None:
    data = encoded(tmp_path, by_name("glb"))
    size = struct.unpack_from("<I", data, 12)[0]
    document = json.loads(data[20 : 20 + size])
    index = document["meshes"][0]["primitives"][0]["attributes"][f"KHR_gaussian_splatting:{attribute}"]
    start = 28 + size + document["bufferViews"][index]["byteOffset"]
    raw = values.astype("<f4").tobytes()
    refused(tmp_path, data[:start] + raw + data[start + len(raw) :], message, "scene.glb")


def test_logarithms_in_a_splat_are_refused(tmp_path: Path) -> None:
    row = struct.pack("<6f8B", 1, 2, 3, -4, -5, -2, 0, 255, 51, 128, 255, 128, 128, 128)
    refused(tmp_path, 40 * row, "scales are negative", "scene.splat")


@pytest.mark.parametrize("level", [0, 1])
def test_logarithms_in_a_ksplat_are_refused(tmp_path: Path, level: int) -> None:
    scene = wall()
    data = ksplat(replace(scene, scales=torch.full_like(scene.scales, 0.5)), level)
    old, new = (np.full(3, value, "<f2" if level else "<f4").tobytes() for value in (np.exp(np.float32(0.5)), -2.0))
    refused(tmp_path, re.sub(re.escape(old), new, data), "scales are negative", "scene.ksplat")


@pytest.mark.parametrize(
    ("names", "message"),
    [
        (("trbf_center", "trbf_scale", "motion_0"), "'trbf_center', so it is a dynamic scene.*Export one moment"),
        (("motion_3",), "'motion_3', so it is a dynamic scene"),
        (("t", "scale_t", "rot_r_0"), "'t', so it is a dynamic scene"),
        (("rot_r_3",), "'rot_r_3', so it is a dynamic scene"),
        (("velocity_x",), "'velocity_x', so it is a dynamic scene"),
        (("motion_x",), "'motion_x', so it is a dynamic scene"),
        (("opacity_t",), "'opacity_t', so it is a dynamic scene"),
        (("t_start", "t_end"), "'t_start', so it is a dynamic scene"),
        (("vx", "vy", "vz"), "'vx', so it is a dynamic scene"),
        (("binding_0",), "'binding_0', .*relative to a mesh"),
        (("beta",), "'beta', .*another kernel"),
    ],
)
@pytest.mark.parametrize("name", ["ply", "compressed.ply"])
def test_properties_that_change_the_meaning_are_refused(
    tmp_path: Path, name: str, names: tuple[str, ...], message: str
) -> None:
    data = encoded(tmp_path, by_name(name))
    end = b"element sh" if name == "compressed.ply" else b"end_header"
    lines = "".join(f"property float {each}\n" for each in names).encode()
    head, _, body = data.partition(end)
    refused(tmp_path, head + lines + end + body + bytes(4 * 616 * len(names)), message)


def test_properties_of_other_meanings_are_read(tmp_path: Path) -> None:
    """Names that begin or end as those of dynamic scenes do."""
    names = ("label", "confidence", "type", "tint", "weight", "variance", "rot_reference", "shading", "timestamp")
    data = encoded(tmp_path, by_name("ply"))
    lines = "".join(f"property float {each}\n" for each in names).encode()
    head, _, body = data.partition(b"end_header\n")
    row = len(body) // 616
    rows = b"".join(body[i : i + row] + bytes(4 * len(names)) for i in range(0, len(body), row))
    (tmp_path / "scene.ply").write_bytes(head + lines + b"end_header\n" + rows)
    assert read_scene(tmp_path / "scene.ply").notes == ()


@pytest.mark.parametrize(
    ("data", "name", "message"),
    [
        (b"# Blender\nmtllib cube.mtl\no Cube\n", "mesh.obj", "is an OBJ mesh"),
        (b'\n{"scenes": [], "asset": {"version": "2.0"}}', "scene", "Save it as one GLB"),
        (b'{"scenes": []}', "scene.gltf", "Save it as one GLB"),
        (b"", "scene.ply", "is empty"),
        (b"version https://git-lfs.github.com/spec/v1\noid sha256:0\nsize 9\n", "scene.ply", "Run `git lfs pull`"),
        (b"\n<!DOCTYPE html>\n<html><body>404", "scene.ply", "is an HTML page.*Download the scene again"),
        (b"<!DOCTYPE html>\n<title>SuperSplat Viewer</title>", "a.html", "a viewer of SuperSplat.*as PLY or SOG"),
        (b'{"asset":{"version":"1.1"},"geometricError":5}', "tileset.json", "is a tileset of 3D Tiles"),
        (b'{"version":"5.0","totalSplats":1}', "scene.lcc", "of XGRIDS.*`splat-transform scene.lcc scene.ply`"),
        (b"PXR-USDC" + bytes(90), "a.usdc", "is OpenUSD, which is written but not read"),
        (b"#usda 1.0\n", "a.usda", "is OpenUSD"),
        (b"PK\x03\x04" + bytes(26) + b"default.usda#usda 1.0", "a.usdz", "is OpenUSD"),
        (
            b"PK\x03\x04" + bytes(26) + b"means3d.npy",
            "scene.zip",
            "NumPy arrays, such as those of gsplat.*export_splats",
        ),
        (b"PK\x03\x04" + bytes(90), "a.npz", "NumPy arrays"),
        (b"PK\x03\x04" + bytes(90), "a.sog4d.zip", "is a dynamic scene.*Export one moment"),
        (b'{"means": {"shape": [9, 3], "mins": [0], "maxs": [1]}}', "meta.json", "that gsplat compressed"),
        (b"x,y,z,nx,ny,nz,f_dc_0\n1,2,3", "a.csv", "a table of splat-transform"),
        (b"RAD0" + bytes(90), "a.rad", "of Spark"),
        (b"spx" + bytes(90), "a.spx", "with gsbox"),
        (b"\x80\x02}q\x00.", "model.pth", "is a checkpoint.*sgsst convert CHECKPOINT scene.ply.*ns-export"),
    ],
)
def test_error_names_the_file_type(tmp_path: Path, data: bytes, name: str, message: str) -> None:
    refused(tmp_path, data, message, name)


@pytest.mark.parametrize("legacy", [False, True])
def test_checkpoints_are_refused_as_such(tmp_path: Path, legacy: bool) -> None:
    path = tmp_path / "step-000029999.ckpt"
    content = {"splats": {"means": torch.zeros(5, 3)}}
    torch.save(content, path, _use_new_zipfile_serialization=not legacy)
    with pytest.raises(SceneError, match="is a checkpoint, not a scene"):
        read_scene(path)


@pytest.mark.parametrize(
    ("files", "message"),
    [
        (
            ["point_cloud/iteration_7000/point_cloud.ply", "point_cloud/iteration_30000/point_cloud.ply", "input.ply"],
            "Give the scene in it: {}/point_cloud/iteration_30000/point_cloud.ply",
        ),
        (
            ["ply/point_cloud_6999.ply", "ply/point_cloud_29999.ply", "ckpts/ckpt_29999_rank0.pt"],
            "Give the scene in it: {}/ply/point_cloud_29999.ply",
        ),
        (["splat.ply"], "Give the scene in it: {}/splat.ply"),
        (["meta.json", "sh0.webp"], "Give the scene in it: {}/meta.json"),
        (
            ["config.yml", "nerfstudio_models/step-000029999.ckpt"],
            "`sgsst convert {}/nerfstudio_models/step-000029999.ckpt scene.ply`",
        ),
        (
            ["ckpts/ckpt_6999_rank0.pt", "ckpts/ckpt_29999_rank0.pt", "ckpts/ckpt_29999_rank1.pt"],
            "`sgsst convert {}/ckpts/ckpt_29999_rank0.pt scene.ply`",
        ),
        ([], "is a folder. Give the file of a scene"),
    ],
)
def test_folder_error_names_the_scene_in_it(tmp_path: Path, files: list[str], message: str) -> None:
    for name in files:
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).touch()
    with pytest.raises(SceneError, match=re.escape(message.format(tmp_path))):
        read_scene(tmp_path)


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
    scene.sh_rest[:, 3:] = 0
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
            {"SPZ": "scales outside -10 to 5.94", "compressed": ""},
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
        b"v 1 2 3\n" * 100,
    ],
)
def test_other_files_are_refused(tmp_path: Path, data: bytes) -> None:
    refused(tmp_path, data, re.escape(f"expected {TITLES}"))
