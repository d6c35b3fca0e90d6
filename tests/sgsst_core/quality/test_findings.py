"""Tests of `sgsst check` on scenes, views and styles, each with one extreme property, and of the PSNR of scenes."""

import math
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from sgsst_core.errors import TooManyIntersectionsError
from sgsst_core.files.scene_file import SceneFile, read_scene, write_scene
from sgsst_core.planning.survey import survey_views
from sgsst_core.quality.findings import (
    Finding,
    render_mode_findings,
    scene_findings,
    small_gaussians,
    style_findings,
    view_findings,
)
from sgsst_core.quality.measure import scene_psnr
from sgsst_core.rasterizer import make_rasterizer
from sgsst_core.rasterizer.projection import project
from sgsst_core.rasterizer.reference import splat
from sgsst_core.scene.camera import Camera
from sgsst_core.scene.gaussians import Scene
from sgsst_core.scene.rendering import CLASSIC, Rendering
from tests.sgsst_core.splat_scenes import camera, cloud, rotated_pose
from tests.small_scenes import ball, blind_camera, cameras, style, wall

pytestmark = pytest.mark.usefixtures("one_thread")


def stored(folder: Path, scene: Scene) -> SceneFile:
    write_scene(folder / "scene.ply", scene)
    return read_scene(folder / "scene.ply", drop_invalid=True)


def findings_in(folder: Path, scene: Scene) -> dict[str, Finding]:
    return {finding.what: finding for finding in scene_findings(stored(folder, scene))}


def seen_by(scene: Scene, views: list[Camera]) -> dict[str, Finding]:
    survey = survey_views(scene, views, make_rasterizer("cpu", scene))
    return {finding.what: finding for finding in view_findings(views, survey)}


def finding_about(findings: dict[str, Finding], text: str) -> Finding:
    (match,) = [finding for what, finding in findings.items() if text in what]
    return match


def test_ordinary_scene_has_no_findings(tmp_path: Path) -> None:
    scene = wall()
    scene.quats[:2] *= torch.tensor([[1e-20], [1e20]])  # drawn exactly, as needles are
    scene.scales[6] = torch.tensor([0.5, 1e-5, 1e-12]).log()
    assert findings_in(tmp_path, scene) == {}
    assert seen_by(wall(), cameras()) == {}
    assert style_findings(style(), cameras()) == []


@pytest.mark.parametrize(
    ("column", "rows", "value", "what", "worst"),
    [
        ("scales", [7], 5.0, "longer than the scene's extent", "Gaussian 7: "),
        ("sh_dc", [2, 13], -1e4, "DC SH coefficients above 20", "Gaussian 2: 1e+04"),
    ],
)
def test_extreme_gaussians_are_counted_and_the_worst_is_named(
    tmp_path: Path, column: str, rows: list[int], value: float, what: str, worst: str
) -> None:
    scene = wall()
    getattr(scene, column)[rows] = value
    finding = finding_about(findings_in(tmp_path, scene), what)
    assert (finding.count, finding.total) == (len(rows), len(scene))
    assert finding.worst.startswith(worst)
    assert finding.done
    assert ("--target-loss" in finding.done) == (column == "sh_dc")


def test_invalid_rows_are_reported_with_file_indices(tmp_path: Path) -> None:
    scene = wall()
    scene.means[2, 1] = math.nan
    scene.sh_dc[5, 0] = math.inf
    scene.quats[20] = 0
    scene.scales[21, 1] = 5.0
    findings = findings_in(tmp_path, scene)
    invalid = finding_about(findings, "NaN or infinite")
    assert (invalid.count, invalid.total, invalid.worst) == (3, len(scene), "first: Gaussian 2")
    assert "--drop-invalid" in invalid.done
    assert finding_about(findings, "longer than the scene's extent").worst.startswith("Gaussian 21: ")


def test_scene_far_from_origin_is_reported_with_its_resolution(tmp_path: Path) -> None:
    scene = replace(wall(), means=wall().means + torch.tensor([1e6, 0.0, 0.0]))
    finding = finding_about(findings_in(tmp_path, scene), "far from its origin")
    assert "positions are 0.0625 apart" in finding.worst


def test_blind_views_are_reported() -> None:
    finding = finding_about(seen_by(ball(), [*cameras(), blind_camera()]), "see no Gaussian")
    assert (finding.count, finding.total, finding.worst) == (1, 4, "first: 'blind'")


def test_view_with_too_many_intersections_is_refused() -> None:
    scene = wall(50, 43)
    scene.scales[:] = 6.0
    scene.opacities[:] = 2.0
    view = replace(cameras(1)[0], width=16384, height=16384, fx=8e3, fy=8e3, cx=8192, cy=8192)
    with pytest.raises(TooManyIntersectionsError, match="can be addressed"):
        seen_by(scene, [view])


def test_extreme_styles_are_reported() -> None:
    views = cameras()
    (flat,) = style_findings(torch.full((60, 60, 3), 0.4), views)
    assert flat.what == "one color throughout"
    (tiny,) = style_findings(torch.rand(8, 9, 3), views)
    assert tiny.worst == "used at 9 x 8"
    assert style_findings(torch.rand(1000, 50, 3), views) == []


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
    assert render_mode_findings(read_scene(dust(tmp_path, AA)), VIEWS, near=0.2) == []


def test_counts_are_those_of_the_reference() -> None:
    scene = replace(cloud(2000, log_scale=-3.0), opacities=torch.linspace(-2, 4, 2000))
    small = opaque = 0
    for view in VIEWS:
        visible = set(project(scene, view).gaussians.tolist())
        plain, after = splat(scene, view), splat(replace(scene, rendering=AA), view)
        left = dict(zip(after.gaussians.tolist(), after.opacity.tolist(), strict=True))
        for index, opacity in zip(plain.gaussians.tolist(), plain.opacity.tolist(), strict=True):
            if opacity > 0.5 and index in visible:
                opaque += 1
                small += left.get(index, 0.0) < 0.5 * opacity
    counts = small_gaussians(scene, VIEWS, 0.2)
    assert 0 < small < opaque
    # The projection leaves out small ones between pixel centers, which the reference keeps.
    assert (counts[1], counts[0]) == (pytest.approx(opaque / 2, abs=1), pytest.approx(small / 2, rel=0.02))
