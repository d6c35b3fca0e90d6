"""Tests of `sgsst check` on scenes, views and styles, each with one extreme property, and of the PSNR of scenes."""

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from plyfile import PlyData, PlyElement

from benchmarks.stability.splat_reference import splat
from sgsst_core.constants import NEAR
from sgsst_core.errors import TooManyIntersectionsError
from sgsst_core.files.scene_file import SceneFile, read_scene, write_scene
from sgsst_core.planning.survey import survey_views
from sgsst_core.quality import findings
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
from sgsst_core.rasterizer.cpu import project
from sgsst_core.scene.camera import Camera
from sgsst_core.scene.gaussians import TENSORS, Scene
from sgsst_core.scene.rendering import CLASSIC, Rendering
from tests.sgsst_core.splat_scenes import camera, cloud, rotated_pose
from tests.small_scenes import ball, blind_camera, cameras, style, wall

pytestmark = pytest.mark.usefixtures("one_thread")


def stored(folder: Path, scene: Scene) -> SceneFile:
    write_scene(folder / "scene.ply", scene)
    return read_scene(folder / "scene.ply", drop_invalid=True)


def findings_in(folder: Path, scene: Scene) -> dict[str, Finding]:
    return {finding.what: finding for finding in scene_findings(stored(folder, scene))}


def seen_by(folder: Path, scene: Scene, views: list[Camera]) -> dict[str, Finding]:
    file = stored(folder, scene)
    survey = survey_views(file.scene, views, make_rasterizer("cpu", file.scene))
    return {finding.what: finding for finding in view_findings(file, views, survey, near=NEAR)}


def finding_about(findings: dict[str, Finding], text: str) -> Finding:
    (match,) = [finding for what, finding in findings.items() if text in what]
    return match


def test_ordinary_scene_has_no_findings(tmp_path: Path) -> None:
    scene = wall()
    scene.quats[:2] *= torch.tensor([[1e-20], [1e20]])  # drawn exactly, as needles are
    scene.scales[6] = torch.tensor([0.5, 1e-5, 1e-12]).log()
    assert findings_in(tmp_path, scene) == {}
    # The wall extends beyond what its cameras see of it.
    findings = seen_by(tmp_path, wall(), cameras())
    assert {what.split(":")[0] for what in findings} == {"in no view", "hardly seen"}
    assert style_findings(style(), cameras()) == []


@pytest.mark.parametrize(
    ("column", "rows", "value", "what", "worst"),
    [
        ("scales", [5, 6], 200.0, "size that overflows", "Gaussian 5: 200"),
        ("scales", [7], 5.0, "longer than the scene's extent", "Gaussian 7: "),
        ("opacities", [11, 12], -20.0, "opacity below 1/255", "Gaussian 11: 2.06e-09"),
        ("sh_dc", [2, 13], -1e4, "DC SH coefficients above 20", "Gaussian 2: 1e+04"),
    ],
)
def test_extreme_gaussians_are_counted_and_the_worst_is_named(
    tmp_path: Path, column: str, rows: list[int], value: float, what: str, worst: str
) -> None:
    scene = replace(wall(), opacities=torch.full((len(wall()),), 2.0))
    getattr(scene, column)[rows] = value
    finding = finding_about(findings_in(tmp_path, scene), what)
    assert (finding.count, finding.total) == (len(rows), len(scene))
    assert finding.worst.startswith(worst)
    assert finding.done
    assert ("--target-loss" in finding.done) == (column == "sh_dc")


@pytest.mark.parametrize("far", [0.0, 1e6])
@pytest.mark.parametrize("distance", [1e-3, 0.3, 10.0])
def test_gaussians_close_to_cameras_match_all_distances(distance: float, far: float) -> None:
    generator = torch.Generator().manual_seed(0)
    means = (torch.randn((500, 3), generator=generator) + far).float()
    centers = torch.cat([means[:40].double(), torch.randn((20, 3), generator=generator, dtype=torch.float64) + far])
    centers[1] += torch.tensor([distance, 0.0, 0.0])  # just outside or just inside the distance
    expected = [int(((means.double() - center).norm(dim=1) < distance).sum()) for center in centers]
    assert findings.closer(means, centers, distance) == expected
    assert max(expected) > 0


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


def test_positions_in_double_precision_that_float32_rounds_are_reported(tmp_path: Path) -> None:
    path = tmp_path / "scene.ply"
    write_scene(path, wall())
    rows = PlyData.read(path)["vertex"].data
    kinds = [(name, "<f8" if name in "xyz" else kind) for name, kind in rows.dtype.descr]
    double = rows.astype(kinds)
    PlyData([PlyElement.describe(double, "vertex")]).write(path)
    assert not read_scene(path).notes
    double["x"] += 5e5
    double["y"] += 4.5e6
    PlyData([PlyElement.describe(double, "vertex")]).write(path)
    file = read_scene(path)
    assert file.notes[0].startswith("positions are rounded to float32 by up to 0.25, ")
    assert any("subtract an offset" in finding.done for finding in scene_findings(file))


def test_unseen_and_hardly_seen_gaussians_follow_blend_weights(tmp_path: Path) -> None:
    scene = wall()
    scene.means[:10, 2] = -3.0  # behind every camera
    scene.means[10:12] = torch.tensor([0.0, 0.0, 5.0])  # faint, behind two opaque layers
    front = replace(wall(), means=wall().means * torch.tensor([0.9, 0.9, 0.9]))
    scene = Scene(*(torch.cat([getattr(scene, n), getattr(front, n)]) for n in TENSORS))
    findings = seen_by(tmp_path, scene, cameras())
    file = stored(tmp_path, scene)
    rasterizer = make_rasterizer("reference", file.scene)
    weights: Any = sum(rasterizer.color_gradient(torch.ones(c.height, c.width, 3), c)[:, 0] for c in cameras())
    unseen = finding_about(findings, "in no view")
    assert unseen.count == int((weights == 0).sum()) >= 10
    hardly = finding_about(findings, "hardly seen")
    assert hardly.count == int(((weights > 0) & (weights < 1 / 255)).sum()) > 0


def test_blind_views_are_distinguished_from_uncovered_views(tmp_path: Path) -> None:
    findings = seen_by(tmp_path, ball(), [*cameras(), blind_camera()])
    assert finding_about(findings, "see no Gaussian").worst.startswith("'blind'")
    uncovered = finding_about(findings, "uncovered")
    assert (uncovered.count, uncovered.total) == (3, 4)


def test_extreme_lenses_and_sizes_are_reported(tmp_path: Path) -> None:
    view = cameras(1)[0]
    views = [
        replace(view, name="wide", fx=3.0, fy=3.0),
        replace(view, name="small", height=9, cy=4.5),
    ]
    findings = seen_by(tmp_path, wall(), views)
    assert finding_about(findings, "above 140 degrees").worst.startswith("'wide': 169")
    assert finding_about(findings, "fewer than 16 pixels on a side").worst == "'small': 9"


def test_cameras_inside_the_scene_are_reported(tmp_path: Path) -> None:
    scene = wall()
    scene.means[:4] = cameras()[1].center.float() + 0.05
    finding = finding_about(seen_by(tmp_path, scene, cameras()), "inside the scene")
    assert (finding.count, finding.worst) == (1, "'view_1': 4")


def test_view_with_too_many_intersections_is_refused(tmp_path: Path) -> None:
    scene = wall(50, 43)
    scene.scales[:] = 6.0
    scene.opacities[:] = 2.0
    view = replace(cameras(1)[0], width=16384, height=16384, fx=8e3, fy=8e3, cx=8192, cy=8192)
    with pytest.raises(TooManyIntersectionsError, match="can be addressed"):
        seen_by(tmp_path, scene, [view])


def test_extreme_styles_are_reported() -> None:
    views = cameras()
    (flat,) = style_findings(torch.full((60, 60, 3), 0.4), views)
    assert flat.what == "one color throughout"
    (tiny,) = style_findings(torch.rand(8, 9, 3), views)
    assert tiny.worst == "used at 9 x 8"
    (long,) = style_findings(torch.rand(1000, 50, 3), views)
    assert long.worst == "50 x 1000"


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
