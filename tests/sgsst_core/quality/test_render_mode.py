"""Tests of findings about the render mode, and of the PSNR between two scenes."""

from __future__ import annotations

import tracemalloc
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from sgsst_core.files.scene_file import read_scene, write_scene
from sgsst_core.quality.findings import render_mode_findings, small_gaussians
from sgsst_core.quality.measure import scene_psnr
from sgsst_core.rasterizer import make_rasterizer
from sgsst_core.rasterizer.projection import project
from sgsst_core.rasterizer.reference import splat
from sgsst_core.scene.camera import Camera
from sgsst_core.scene.gaussians import Scene
from sgsst_core.scene.rendering import CLASSIC, Rendering
from sgsst_core.scene.spherical_harmonics import scene_colors
from tests.sgsst_core.splat_scenes import camera, cloud, rotated_pose
from tests.small_scenes import cameras, wall

AA = Rendering("antialiased")
VIEWS = [camera(), camera(pose=rotated_pose())]


def dust(tmp_path: Path, rendering: Rendering = CLASSIC, log_scale: float = -4.0) -> Path:
    """Write a scene of opaque Gaussians that are smaller than a pixel."""
    scene = cloud(600, log_scale=log_scale)
    write_scene(tmp_path / "dust.ply", replace(scene, opacities=torch.full((600,), 2.0), rendering=rendering))
    return tmp_path / "dust.ply"


def test_scene_of_small_opaque_gaussians_may_be_antialiased(tmp_path: Path) -> None:
    file = read_scene(dust(tmp_path))
    (finding,) = render_mode_findings(file, VIEWS, near=0.2)
    assert "states no mode" in finding.what
    assert finding.done.endswith("add --render-mode antialiased")
    expected = scene_psnr(file.scene, replace(file.scene, rendering=AA), VIEWS, near=0.2)
    assert finding.worst == f"{expected:.1f} dB PSNR against antialiased, eps2d 0.3, in 2 views"


def test_scenes_of_other_sizes_or_with_a_statement_are_not_reported(tmp_path: Path) -> None:
    assert render_mode_findings(read_scene(dust(tmp_path, log_scale=-1.0)), VIEWS, near=0.2) == []
    path = dust(tmp_path)
    path.write_bytes(path.read_bytes().replace(b"element", b"comment SplatRenderMode: default\nelement", 1))
    assert render_mode_findings(read_scene(path), VIEWS, near=0.2) == []


def test_antialiased_scene_is_compared_with_classic(tmp_path: Path) -> None:
    file = read_scene(dust(tmp_path, replace(AA, eps2d=0.1)))
    (finding,) = render_mode_findings(file, VIEWS, near=0.2)
    assert (finding.what, finding.done) == ("drawn antialiased, eps2d 0.1", "as the file states")
    assert "against classic, eps2d 0.3" in finding.worst
    (finding,) = render_mode_findings(read_scene(dust(tmp_path)).rendered("antialiased", None), VIEWS, near=0.2)
    assert finding.done == "as requested"


def test_counts_are_those_of_the_reference(tmp_path: Path) -> None:
    scene = replace(cloud(2000, log_scale=-3.0), opacities=torch.linspace(-2, 4, 2000))
    small = opaque = 0
    for view in VIEWS:
        visible = set(visible_in(scene, view))
        plain, after = splat(scene, view), splat(replace(scene, rendering=AA), view)
        left = dict(zip(after.gaussians.tolist(), after.opacity.tolist(), strict=True))
        for index, opacity in zip(plain.gaussians.tolist(), plain.opacity.tolist(), strict=True):
            if opacity > 0.5 and index in visible:
                opaque += 1
                small += left.get(index, 0.0) < 0.5 * opacity
    counts = small_gaussians(scene, VIEWS, 0.2)
    assert 0 < small < opaque
    # The projection leaves out small ones between pixel centers, which the reference keeps.
    assert counts[1] == pytest.approx(opaque / 2, abs=1)
    assert counts[0] == pytest.approx(small / 2, rel=0.02)


def visible_in(scene: Scene, view: Camera) -> list[int]:
    return project(scene, view).gaussians.tolist()


def test_psnr_is_that_of_all_pixels() -> None:
    scene, views = wall(), cameras()
    assert scene_psnr(scene, scene, views, near=0.2) is None
    other = replace(scene, sh_dc=scene.sh_dc + 0.1)
    squares = []
    for view in views:
        one, two = (make_rasterizer("cpu", each).render(scene_colors(each, view), view) for each in (scene, other))
        squares.append((one.clamp(0, 1).double() - two.clamp(0, 1).double()).square())
    expected = -10 * torch.cat([each.flatten() for each in squares]).mean().log10()
    assert scene_psnr(scene, other, views, near=0.2) == pytest.approx(float(expected))


def test_memory_of_a_comparison_does_not_grow_with_the_views() -> None:
    scene, peaks = wall(140, 110), []
    for count in (2, 2, 12):  # the first comparison also compiles kernels
        tracemalloc.start()
        scene_psnr(scene, scene, cameras(count), near=0.2)
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    assert peaks[2] < 1.2 * peaks[1]
