"""Tests against other programs, such as splat-transform: they read what is written, and vice versa.

They come from npm and PyPI at fixed versions. Without npm, its tests are skipped.
"""

from __future__ import annotations

import json
import shutil
import struct
import subprocess
from dataclasses import replace
from pathlib import Path

import gaussforge
import numpy as np
import pytest
import torch
from scipy.spatial import cKDTree

from sgsst_core.files.formats import RESULT_FORMATS, by_name
from sgsst_core.files.formats.frame import Y_UP, Frame
from sgsst_core.files.scene_file import read_scene, write_scene
from sgsst_core.scene.gaussians import TENSORS, Scene
from sgsst_core.scene.rendering import Rendering
from sgsst_core.scene.stored_harmonics import held
from tests.sgsst_core.splat_scenes import cloud

pytestmark = pytest.mark.slow

PACKAGES = (
    "@playcanvas/splat-transform@3.7.0",
    "gltf-validator@2.0.0-dev.3.10",
    "@mkkellogg/gaussian-splats-3d@0.4.7",
    "@babylonjs/core@9.28.0",
    "@babylonjs/loaders@9.28.0",
)
#: What Babylon.js reads from a GLB, before it is sent to a GPU: records of .splat, then harmonics of 8 bits.
BABYLON_SCRIPT = """
globalThis.XMLHttpRequest = class {};
const { readFileSync, writeFileSync } = await import("fs");
const { NullEngine } = await import("@babylonjs/core/Engines/nullEngine.js");
const { Scene } = await import("@babylonjs/core/scene.js");
const { GaussianSplattingMesh } = await import("@babylonjs/core/Meshes/GaussianSplatting/gaussianSplattingMesh.js");
const { AppendSceneAsync } = await import("@babylonjs/core/Loading/sceneLoader.js");
await import("@babylonjs/loaders/glTF/glTFFileLoader.js");
await import("@babylonjs/loaders/glTF/2.0/glTFLoader.js");
await import("@babylonjs/loaders/glTF/2.0/Extensions/KHR_gaussian_splatting.js");
const [glb, out] = process.argv.slice(1);
GaussianSplattingMesh.prototype.updateDataAsync = async (records, harmonics) => {
  writeFileSync(out, Buffer.from(records));
  harmonics.forEach((part, index) => writeFileSync(out + index, Buffer.from(part)));
};
await AppendSceneAsync(readFileSync(glb), new Scene(new NullEngine()), { pluginExtension: ".glb" });
process.exit(0);
"""
#: Conversion of a PLY to .ksplat at a compression level and an SH degree.
KSPLAT_SCRIPT = """
globalThis.window = globalThis.document = {};
const { PlyParser, SplatBufferGenerator } = await import("@mkkellogg/gaussian-splats-3d");
const { readFileSync, writeFileSync } = await import("fs");
const [ply, out, level, degree] = process.argv.slice(1);
const data = new Uint8Array(readFileSync(ply)).buffer;
const splats = PlyParser.parseToUncompressedSplatArray(data, Number(degree));
const generator = SplatBufferGenerator.getStandardGenerator(1, Number(level), 0);
writeFileSync(out, Buffer.from(generator.generateFromUncompressedSplatArray(splats).bufferData));
"""
#: Formats that splat-transform reads; its name ends with this suffix for each of ours.
READ_BY_SPLAT_TRANSFORM = ("ply", "compressed.ply", "spz", "v4.spz", "sog")
#: Largest differences of opacities after the sigmoid, and of other values, from what another program reads. Compressed
#: formats leave a byte's value open: some read its center, others its lower end.
OPACITIES, VALUES = 1.1e-3, {"compressed.ply": 0.02}


@pytest.fixture(scope="session")
def modules(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with the packages of npm."""
    if not shutil.which("npm") or not shutil.which("node"):
        pytest.skip("npm is not installed")
    folder = tmp_path_factory.mktemp("npm")
    (folder / "package.json").write_text("{}")
    done = subprocess.run(
        ["npm", "install", "--no-audit", "--no-fund", "--ignore-scripts", *PACKAGES],
        cwd=folder,
        capture_output=True,
        text=True,
    )
    if done.returncode:
        pytest.skip(f"npm cannot install the packages: {done.stderr[-300:]}")
    return folder


@pytest.fixture(scope="session")
def scene() -> Scene:
    return cloud(2000, degree=2)


def splat_transform(modules: Path, *arguments: str | Path) -> None:
    program = modules / "node_modules/@playcanvas/splat-transform/bin/cli.mjs"
    command = ["node", str(program), "--quiet", "--overwrite", "--gpu", "cpu", *map(str, arguments)]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr


def matched(found: Scene, expected: Scene) -> Scene:
    """Return the Gaussians of `found` in the order of `expected`, by position."""
    assert len(found) == len(expected)
    _, rows = cKDTree(found.means.numpy()).query(expected.means.numpy())
    assert len(np.unique(rows)) == len(expected)
    return found.subset(torch.from_numpy(rows))


def assert_same(found: Scene, expected: Scene, tolerance: float = 1e-4, opacities: float = OPACITIES) -> None:
    """Assert that every value of every Gaussian is the same, up to the sign of quaternions."""
    found = matched(found, expected)
    assert found.sh_degree == expected.sh_degree
    for name in TENSORS:
        one, other = (held(getattr(each, name)).double() for each in (found, expected))
        if name == "opacities":
            one, other = one.sigmoid(), other.sigmoid()
        if name == "quats":
            one, other = (torch.nn.functional.normalize(each, dim=1) for each in (one, other))
            other = other * (one * other).sum(dim=1, keepdim=True).sign()
        error = float((one - other).abs().max()) if one.numel() else 0.0
        assert error <= (opacities if name == "opacities" else tolerance), (name, error)


@pytest.mark.parametrize("name", READ_BY_SPLAT_TRANSFORM)
def test_splat_transform_reads_written_scenes(modules: Path, scene: Scene, tmp_path: Path, name: str) -> None:
    ours, ply = tmp_path / f"ours.{name}", tmp_path / "theirs.ply"
    write_scene(ours, scene, by_name(name))
    splat_transform(modules, ours, ply)
    assert_same(read_scene(ply).scene, read_scene(ours).scene, VALUES.get(name, 1e-4))


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
    assert_same(read_scene(theirs).scene, read_scene(back).scene, 0.02 if "compressed" in name else 1e-4)


def test_glb_matches_splat_transform(modules: Path, scene: Scene, tmp_path: Path) -> None:
    """All attributes have the same values, up to the last bit of normalized quaternions, and those of the PLY."""
    ply, ours, theirs = (tmp_path / name for name in ("ours.ply", "ours.glb", "theirs.glb"))
    unit = replace(scene, quats=torch.nn.functional.normalize(scene.quats, dim=1))
    write_scene(ply, unit)
    write_scene(ours, unit, by_name("glb"))
    splat_transform(modules, ply, theirs)
    found, expected = (attributes_of(path) for path in (ours, theirs))
    assert found.keys() == expected.keys()
    for name, values in expected.items():
        tolerance = 1 if name == "COLOR_0" else 2e-7
        np.testing.assert_allclose(found[name].astype(float), values.astype(float), rtol=2e-7, atol=tolerance)
    assert_same(read_scene(theirs).scene, scene, 1e-6)


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
    command = ["node", "--input-type=module", "-e", KSPLAT_SCRIPT, *map(str, (ply, theirs, level, 2))]
    subprocess.run(command, cwd=modules, capture_output=True, text=True, check=True)
    splat_transform(modules, theirs, back)
    found = read_scene(theirs).scene
    assert_same(found, read_scene(back).scene, 1e-6)
    # colors and opacities are rounded down to 8 bits
    found = matched(found, within)
    assert float((found.sh_dc - within.sh_dc).abs().max()) <= 1.01 / 255 / 0.282
    rounded = replace(found, sh_dc=within.sh_dc)
    if level == 2:
        assert float((held(found.sh_rest) - held(within.sh_rest)).abs().max()) <= 1.51 / 255 * 2
        rounded = replace(rounded, sh_rest=within.sh_rest)
    assert_same(rounded, within, 4e-3, opacities=1.01 / 255)


def test_babylon_reads_glb(modules: Path, scene: Scene, tmp_path: Path) -> None:
    """The Gaussians are those of the scene, rotated by 180 degrees about z, up to the rounding of 8 bits."""
    ours, theirs = tmp_path / "ours.glb", tmp_path / "theirs.splat"
    within = replace(scene, sh_dc=scene.sh_dc.clamp(-1.7, 1.7), opacities=scene.opacities.clamp(-5, 5))
    write_scene(ours, within, by_name("glb"))
    command = ["node", "--input-type=module", "-e", BABYLON_SCRIPT, *map(str, (ours, theirs))]
    done = subprocess.run(command, cwd=modules, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    arrays = {name: held(getattr(within, name)).numpy().copy() for name in TENSORS}
    Frame.of(Y_UP).apply(arrays)
    expected = Scene(*(torch.from_numpy(arrays[name]) for name in TENSORS))
    found = read_scene(theirs).scene
    assert float((found.sh_dc - expected.sh_dc).abs().max()) <= 0.51 / 255 / 0.282
    bare = replace(expected, sh_dc=found.sh_dc, sh_rest=found.sh_rest)
    assert_same(found, bare, 0.015, opacities=0.51 / 255)  # its bytes of quaternions are half a step off
    parts = [np.fromfile(f"{theirs}{index}", "u1").reshape(-1, 16)[: len(scene)] for index in range(2)]
    harmonics = np.concatenate(parts, axis=1)[:, :24].reshape(-1, 8, 3)
    rounded = np.clip(held(expected.sh_rest).double().numpy() * 128 + 128, 0, 255)
    assert float(np.abs(harmonics - rounded).max()) <= 0.5


def attributes_of(path: Path) -> dict[str, np.ndarray]:
    """Return the values of all attributes of a GLB, without gaps and interleaving."""
    data = path.read_bytes()
    size = struct.unpack_from("<I", data, 12)[0]
    document = json.loads(data[20 : 20 + size])
    found = {}
    for name, index in document["meshes"][0]["primitives"][0]["attributes"].items():
        entry = document["accessors"][index]
        view = document["bufferViews"][entry["bufferView"]]
        kind = np.dtype({5126: "<f4", 5121: "u1"}[entry["componentType"]])
        count = view["byteLength"] // kind.itemsize
        found[name] = np.frombuffer(data, kind, count, 28 + size + view["byteOffset"])
    return found


@pytest.mark.parametrize("name", ["ply", "compressed.ply", "spz", "v4.spz", "sog"])
def test_gaussforge_reads_written_scenes(scene: Scene, tmp_path: Path, name: str) -> None:
    ours = tmp_path / f"ours.{name}"
    write_scene(ours, scene, by_name(name))
    answer = gaussforge.GaussForge().read(ours.read_bytes(), name.removeprefix("v4."))
    assert "error" not in answer, answer
    expected = read_scene(ours).scene
    names = {
        "positions": expected.means,
        "scales": expected.scales,
        "colors": expected.sh_dc,
        "rotations": expected.quats,
    }
    for key, values in names.items():
        found = torch.tensor(np.frombuffer(answer["data"][key], np.float32).reshape(values.shape).copy())
        if key == "rotations":  # q and -q are the same rotation
            found, values = (torch.nn.functional.normalize(each, dim=1) for each in (found, values))
            values = values * (found * values).sum(dim=1, keepdim=True).sign()
        torch.testing.assert_close(found, values, rtol=1e-5, atol=1e-5, msg=key)


def test_every_result_format_is_tested() -> None:
    """A new format is added to the lists above, or here if no other program reads it."""
    assert {each.name for each in RESULT_FORMATS} == {*READ_BY_SPLAT_TRANSFORM, "glb"}
