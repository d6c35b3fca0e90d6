"""Tests against programs that convert and show scenes: they read what is written, and vice versa.

They come from npm and PyPI at fixed versions. Without npm, its tests are skipped.
"""

import json
import struct
import subprocess
from dataclasses import replace
from pathlib import Path

import gaussforge
import numpy as np
import pytest
import torch
from PIL import Image

from sgsst_core.files.formats import RESULT_FORMATS, by_name
from sgsst_core.files.formats.scene_format import Y_UP, Frame
from sgsst_core.files.scene_file import read_scene, write_scene, write_sog_folder
from sgsst_core.scene.gaussians import TENSORS, Scene
from sgsst_core.scene.rendering import Rendering
from tests.interoperability.comparison import VALUES, assert_same, matched, read_raw, run_script
from tests.sgsst_core.splat_scenes import cloud

pytestmark = pytest.mark.slow

#: Formats that splat-transform reads; its name ends with this suffix for each of ours.
READ_BY_SPLAT_TRANSFORM = ("ply", "compressed.ply", "spz", "v3.spz", "sog")


def splat_transform(modules: Path, *arguments: str | Path) -> None:
    program = modules / "node_modules/@playcanvas/splat-transform/bin/cli.mjs"
    command = ["node", str(program), "--quiet", "--overwrite", "--gpu", "cpu", *map(str, arguments)]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr


@pytest.mark.parametrize("name", READ_BY_SPLAT_TRANSFORM)
def test_splat_transform_reads_written_scenes(modules: Path, scene: Scene, tmp_path: Path, name: str) -> None:
    ours, ply = tmp_path / f"ours.{name}", tmp_path / "theirs.ply"
    write_scene(ours, scene, by_name(name))
    splat_transform(modules, ours, ply)
    assert_same(read_scene(ply).scene, read_raw(ours), VALUES.get(name, 1e-4))


@pytest.mark.parametrize("name", READ_BY_SPLAT_TRANSFORM)
def test_render_mode_is_exchanged_with_splat_transform(modules: Path, scene: Scene, tmp_path: Path, name: str) -> None:
    antialiased = Rendering("antialiased")
    ours, ply, theirs = tmp_path / f"ours.{name}", tmp_path / "theirs.ply", tmp_path / f"theirs.{name}"
    write_scene(ours, replace(scene, rendering=antialiased), by_name(name))
    splat_transform(modules, ours, ply)
    assert b"comment SplatRenderMode: mip" in ply.read_bytes()[:1000]
    splat_transform(modules, ply, theirs)
    assert read_scene(theirs).scene.rendering == antialiased


@pytest.mark.parametrize(
    ("name", "options"),
    [
        ("theirs.compressed.ply", ()),
        ("theirs.spz", ("--spz-version", "3")),
        ("theirs.spz", ("--spz-version", "4")),
        ("theirs.sog", ()),
        ("meta.json", ()),
    ],
)
def test_scenes_of_splat_transform_are_read(
    modules: Path, scene: Scene, tmp_path: Path, name: str, options: tuple[str, ...]
) -> None:
    ours, theirs, back = tmp_path / "ours.ply", tmp_path / name, tmp_path / "back.ply"
    write_scene(ours, scene)
    splat_transform(modules, *options, ours, theirs)
    splat_transform(modules, theirs, back)
    assert_same(read_raw(theirs), read_scene(back).scene, 0.02 if "compressed" in name else 1e-4)


def test_glb_matches_splat_transform(modules: Path, scene: Scene, tmp_path: Path) -> None:
    """All attributes have the same values, up to the last bit of normalized quaternions, and those of the PLY."""
    ply, ours, theirs = (tmp_path / name for name in ("ours.ply", "ours.glb", "theirs.glb"))
    unit = replace(scene, quats=torch.nn.functional.normalize(scene.quats, dim=1))
    write_scene(ply, unit)
    write_scene(ours, unit, by_name("glb"))
    splat_transform(modules, ply, theirs)
    actual, expected = (attributes_of(path) for path in (ours, theirs))
    assert actual.keys() == expected.keys()
    for name, values in expected.items():
        wanted, tolerance = values.astype(float), 2e-7
        if name == "COLOR_0":  # ours are linear, as glTF has it; theirs are those of a PLY
            wanted, tolerance = _linear(wanted.reshape(-1, 4)).ravel(), 1.7
        np.testing.assert_allclose(actual[name].astype(float), wanted, rtol=2e-7, atol=tolerance)
    assert_same(read_scene(theirs).scene, scene, 1e-6)


def _linear(rgba: np.ndarray) -> np.ndarray:
    """Return sRGB colors [n, 4] of 0 to 255 as linear ones; alpha stays."""
    rgb = rgba[:, :3] / 255
    linear = np.where(rgb <= 0.04045, rgb / 12.92, ((rgb + 0.055) / 1.055) ** 2.4)
    return np.concatenate([255 * linear, rgba[:, 3:]], axis=1)


def test_glb_is_valid(modules: Path, scene: Scene, tmp_path: Path) -> None:
    """The only errors of Khronos' validator are about the attributes of an extension that it does not know."""
    write_scene(tmp_path / "ours.glb", scene, by_name("glb"))
    script = (
        "require('gltf-validator').validateBytes(new Uint8Array(require('fs').readFileSync(process.argv[1])))"
        ".then((found) => console.log(JSON.stringify(found)))"
    )
    command = ["node", "-e", script, str(tmp_path / "ours.glb")]
    done = subprocess.run(command, cwd=modules, capture_output=True, text=True, check=True)
    issues = json.loads(done.stdout)["issues"]
    known = {"MESH_PRIMITIVE_INVALID_ATTRIBUTE", "UNSUPPORTED_EXTENSION"}
    assert {message["code"] for message in issues["messages"]} <= known, issues


@pytest.mark.parametrize("level", [0, 1, 2])
def test_ksplat_of_reference_writer_is_read(modules: Path, scene: Scene, tmp_path: Path, level: int) -> None:
    """The values are those that splat-transform reads and, within the format's rounding, those of the PLY."""
    ply, theirs, back = (tmp_path / name for name in ("ours.ply", "theirs.ksplat", "back.ply"))
    within = replace(scene, sh_dc=scene.sh_dc.clamp(-1.7, 1.7), opacities=scene.opacities.clamp(-5, 5))
    write_scene(ply, within)
    run_script(modules, "ksplat.mjs", ply, theirs, level, 2)
    splat_transform(modules, theirs, back)
    loaded = read_scene(theirs).scene
    assert_same(loaded, read_scene(back).scene, 1e-6)
    # colors and opacities are rounded down to 8 bits
    loaded = matched(loaded, within)
    assert float((loaded.sh_dc - within.sh_dc).abs().max()) <= 1.01 / 255 / 0.282
    rounded = replace(loaded, sh_dc=within.sh_dc)
    if level == 2:
        assert float((loaded.sh_rest - within.sh_rest).abs().max()) <= 1.51 / 255 * 2
        rounded = replace(rounded, sh_rest=within.sh_rest)
    assert_same(rounded, within, 4e-3, opacities=1.01 / 255)


def attributes_of(path: Path) -> dict[str, np.ndarray]:
    """Return the values of all attributes of a GLB, without gaps and interleaving."""
    data = path.read_bytes()
    size = struct.unpack_from("<I", data, 12)[0]
    document = json.loads(data[20 : 20 + size])
    attributes = {}
    for name, index in document["meshes"][0]["primitives"][0]["attributes"].items():
        entry = document["accessors"][index]
        view = document["bufferViews"][entry["bufferView"]]
        kind = np.dtype({5126: "<f4", 5121: "u1"}[entry["componentType"]])
        count = view["byteLength"] // kind.itemsize
        attributes[name] = np.frombuffer(data, kind, count, 28 + size + view["byteOffset"])
    return attributes


@pytest.mark.parametrize("name", ["ply", "compressed.ply", "spz", "v3.spz", "sog"])
def test_gaussforge_reads_written_scenes(scene: Scene, tmp_path: Path, name: str) -> None:
    ours = tmp_path / f"ours.{name}"
    write_scene(ours, scene, by_name(name))
    answer = gaussforge.GaussForge().read(ours.read_bytes(), name.removeprefix("v3."))
    assert "error" not in answer, answer
    expected = read_raw(ours)
    names = {
        "positions": expected.means,
        "scales": expected.scales,
        "colors": expected.sh_dc,
        "rotations": expected.quats,
    }
    for key, values in names.items():
        actual = torch.tensor(np.frombuffer(answer["data"][key], np.float32).reshape(values.shape).copy())
        if key == "rotations":  # q and -q are the same rotation
            actual, values = (torch.nn.functional.normalize(each, dim=1) for each in (actual, values))
            values = values * (actual * values).sum(dim=1, keepdim=True).sign()
        torch.testing.assert_close(actual, values, rtol=1e-5, atol=1e-5, msg=key)


def test_every_result_format_is_tested() -> None:
    """A new format is added to the lists above, or here if no other program reads it."""
    assert {each.name for each in RESULT_FORMATS} == {*READ_BY_SPLAT_TRANSFORM, "glb"}


@pytest.fixture(scope="module")
def full_scene() -> Scene:
    """Return a scene of degree 3, as which PlayCanvas and Spark return every scene with harmonics."""
    return cloud(2000, degree=3)


def with_y_up(scene: Scene) -> Scene:
    """Return a scene rotated by 180 degrees about z, as viewers with y up show it."""
    arrays = {name: getattr(scene, name).numpy().copy() for name in TENSORS}
    Frame.of(Y_UP).apply(arrays)
    return Scene(*(torch.from_numpy(arrays[name]) for name in TENSORS))


@pytest.mark.parametrize("name", ["ply", "compressed.ply", "glb"])
def test_playcanvas_reads_written_scenes(modules: Path, full_scene: Scene, tmp_path: Path, name: str) -> None:
    ours, theirs = tmp_path / f"ours.{name}", tmp_path / "theirs.ply"
    write_scene(ours, full_scene, by_name(name))
    run_script(modules, "playcanvas.mjs", ours, theirs)
    expected = read_scene(ours).scene
    assert_same(read_scene(theirs).scene, with_y_up(expected) if name == "glb" else expected, VALUES.get(name, 1e-5))


def test_playcanvas_reads_sog(modules: Path, full_scene: Scene, tmp_path: Path) -> None:
    """Node.js cannot decode WebP, so Pillow does."""
    ours, theirs = tmp_path / "meta.json", tmp_path / "theirs.ply"
    write_sog_folder(tmp_path, full_scene)
    for path in tmp_path.glob("*.webp"):
        image = Image.open(path)
        path.with_suffix(".webp.json").write_text(json.dumps(image.size))
        path.with_suffix(".webp.rgba").write_bytes(image.convert("RGBA").tobytes())
    run_script(modules, "playcanvas.mjs", ours, theirs)
    assert_same(read_scene(theirs).scene, read_scene(ours).scene)


@pytest.mark.parametrize("name", ["ply", "compressed.ply", "v3.spz", "sog"])
def test_spark_reads_written_scenes(modules: Path, full_scene: Scene, tmp_path: Path, name: str) -> None:
    """Spark stores a Gaussian in 32 bytes: rotations and scales with about 10 bits, colors and opacities with 11.

    It limits the harmonics of a coefficient to the largest power of two below them, and stores them with 8 bits.
    """
    ours, theirs = tmp_path / f"ours.{name}", tmp_path / "theirs.ply"
    write_scene(ours, full_scene, by_name(name))
    run_script(modules, "spark.mjs", ours, theirs)
    expected = read_raw(ours)
    loaded = matched(read_scene(theirs).scene, expected)
    assert_same(replace(loaded, sh_rest=expected.sh_rest), expected, 4e-3)
    values = expected.sh_rest
    limit = values.abs().amax(dim=2, keepdim=True).log2().floor().exp2()
    error = (loaded.sh_rest - values.clamp(-limit, limit)).abs() - limit * 0.51 / 255
    assert float(error.max()) <= VALUES.get(name, 0)


def test_gsplat_js_reads_ply(modules: Path, scene: Scene, tmp_path: Path) -> None:
    """A .splat has no harmonics, and bytes of colors, opacities and rotations."""
    ours, theirs = tmp_path / "ours.ply", tmp_path / "theirs.splat"
    within = replace(scene, sh_dc=scene.sh_dc.clamp(-1.7, 1.7), opacities=scene.opacities.clamp(-5, 5))
    write_scene(ours, within)
    run_script(modules, "gsplat_js.mjs", ours, theirs)
    loaded = matched(read_scene(theirs).scene, within)
    assert float((loaded.sh_dc - within.sh_dc).abs().max()) <= 0.51 / 255 / 0.282
    assert_same(replace(loaded, sh_dc=within.sh_dc, sh_rest=within.sh_rest), within, 0.01, opacities=0.51 / 255)


@pytest.mark.parametrize("name", ["ply", "compressed.ply"])
def test_ksplat_viewer_reads_written_scenes(modules: Path, scene: Scene, tmp_path: Path, name: str) -> None:
    """mkkellogg's viewer reads SPZ up to version 2 only. Its colors and opacities are rounded down to bytes."""
    ours, theirs = tmp_path / f"ours.{name}", tmp_path / "theirs.ksplat"
    within = replace(scene, sh_dc=scene.sh_dc.clamp(-1.7, 1.7), opacities=scene.opacities.clamp(-5, 5))
    write_scene(ours, within, by_name(name))
    run_script(modules, "ksplat.mjs", ours, theirs, 0, 2)
    expected = read_scene(ours).scene
    loaded = matched(read_scene(theirs).scene, expected)
    assert float((loaded.sh_dc - expected.sh_dc).abs().max()) <= 1.01 / 255 / 0.282
    tolerance = VALUES.get(name, 1e-6)
    assert_same(replace(loaded, sh_dc=expected.sh_dc), expected, tolerance, opacities=1.01 / 255)


def test_babylon_reads_glb(modules: Path, scene: Scene, tmp_path: Path) -> None:
    """The Gaussians are those of the scene, rotated by 180 degrees about z, up to the rounding of 8 bits."""
    ours, theirs = tmp_path / "ours.glb", tmp_path / "theirs.splat"
    within = replace(scene, sh_dc=scene.sh_dc.clamp(-1.7, 1.7), opacities=scene.opacities.clamp(-5, 5))
    write_scene(ours, within, by_name("glb"))
    run_script(modules, "babylon.mjs", ours, theirs)
    expected = with_y_up(within)
    loaded = read_scene(theirs).scene
    assert float((loaded.sh_dc - expected.sh_dc).abs().max()) <= 0.51 / 255 / 0.282
    bare = replace(expected, sh_dc=loaded.sh_dc, sh_rest=loaded.sh_rest)
    assert_same(loaded, bare, 0.015, opacities=0.51 / 255)  # its bytes of quaternions are half a step off
    parts = [np.fromfile(f"{theirs}{index}", "u1").reshape(-1, 16)[: len(scene)] for index in range(2)]
    harmonics = np.concatenate(parts, axis=1)[:, :24].reshape(-1, 8, 3)
    rounded = np.clip(expected.sh_rest.double().numpy() * 128 + 128, 0, 255)
    assert float(np.abs(harmonics - rounded).max()) <= 0.5
