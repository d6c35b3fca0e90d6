"""Tests of `sgsst check` on scenes, views and styles, each with one extreme property."""

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
    scene_findings,
    style_findings,
    view_findings,
)
from sgsst_core.rasterizer import make_rasterizer
from sgsst_core.scene.camera import Camera
from sgsst_core.scene.gaussians import Scene
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
    (tiny,) = style_findings(torch.rand(8, 9, 3), views)
    assert tiny.worst == "used at 9 x 8"
    assert style_findings(torch.rand(1000, 50, 3), views) == []
