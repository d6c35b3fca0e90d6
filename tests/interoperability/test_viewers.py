"""Tests of viewers in Node.js: the readers of their packages find the values that were written.

Only the readers run; what needs a GPU does not. antimatter15's viewer has no package; gsplat.js reads a PLY into the
same .splat.
"""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from sgsst_core.files.formats import by_name
from sgsst_core.files.formats.scene_format import Y_UP, Frame
from sgsst_core.files.scene_file import read_scene, write_scene, write_sog_folder
from sgsst_core.scene.gaussians import TENSORS, Scene
from sgsst_core.scene.stored_harmonics import held
from tests.interoperability.comparison import VALUES, assert_same, matched, read_raw, run_script
from tests.sgsst_core.splat_scenes import cloud

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def full_scene() -> Scene:
    """Return a scene of degree 3, as which PlayCanvas and Spark return every scene with harmonics."""
    return cloud(2000, degree=3)


def with_y_up(scene: Scene) -> Scene:
    """Return a scene rotated by 180 degrees about z, as viewers with y up show it."""
    arrays = {name: held(getattr(scene, name)).numpy().copy() for name in TENSORS}
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
    values = held(expected.sh_rest)
    limit = values.abs().amax(dim=2, keepdim=True).log2().floor().exp2()
    error = (held(loaded.sh_rest) - values.clamp(-limit, limit)).abs() - limit * 0.51 / 255
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
    rounded = np.clip(held(expected.sh_rest).double().numpy() * 128 + 128, 0, 255)
    assert float(np.abs(harmonics - rounded).max()) <= 0.5
