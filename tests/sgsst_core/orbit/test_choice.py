"""Tests of automatic orbits: rings show more of the surface, requests are followed, and plans list all decisions."""

from __future__ import annotations

import itertools
import math
from pathlib import Path

import pytest
import torch
from scipy.spatial.transform import Rotation

from sgsst_core.files.scene_file import read_scene, write_scene
from sgsst_core.orbit.cameras import middle_of
from sgsst_core.orbit.choice import Orbit, OrbitRequest, find_upright_subject, make_orbit, orbit_decisions
from sgsst_core.orbit.subject import find_subject, find_up
from sgsst_core.planning.survey import survey_views
from sgsst_core.progress import Decision
from sgsst_core.rasterizer import make_rasterizer
from sgsst_core.scene.camera import resized
from sgsst_core.scene.gaussians import Scene
from sgsst_core.settings import make_settings
from sgsst_core.style import Style
from sgsst_core.stylizing.planner import plan_job
from tests.sgsst_core.orbit.objects import ball, box, figure, ground, joined, moved, scene_of
from tests.small_scenes import style

REQUEST = OrbitRequest(count=12)


def elevations(scene: Scene, orbit: Orbit) -> list[float]:
    """Return the elevation of each camera above the horizon, in degrees."""
    up = orbit.up.direction
    middle = middle_of(find_subject(scene), up)
    offsets = [camera.center - middle for camera in orbit.cameras]
    return [math.degrees(math.asin(float(offset @ up / offset.norm()))) for offset in offsets]


def plan_lines(scene: Scene, orbit: Orbit) -> dict[str, Decision]:
    """Return the plan's decisions about an orbit by item."""
    cameras = [resized(camera, 64) for camera in orbit.cameras]
    survey = survey_views(scene, cameras, make_rasterizer("cpu", scene))
    return {decision.item: decision for decision in orbit_decisions(orbit, cameras, survey.uncovered)}


def table() -> Scene:
    """Return a wide flat object on the ground, which is best seen from above."""
    return joined(ground(4.0), scene_of(box((-0.5, -0.5, -0.5), (0.5, 0.0, 0.5))))


def test_scene_with_ground_gets_views_from_above_and_none_from_below() -> None:
    orbit = make_orbit(table(), OrbitRequest(count=24))
    assert orbit.up.ground
    assert orbit.elevations[0] == 10
    assert max(orbit.elevations) >= 40
    assert min(orbit.tried) > 0
    assert orbit.shown > 0.9
    assert len(orbit.cameras) == 24


def test_pole_gets_no_views_from_above() -> None:
    pole = scene_of(box((-0.05, -2, -0.05), (0.05, 2, 0.05), 3000), 0.01)
    orbit = make_orbit(pole, OrbitRequest(count=24))
    assert max(orbit.elevations) == 10
    assert max(orbit.tried) == 70
    assert orbit.next is not None
    assert orbit.next < 0.03


def test_automatic_view_count_is_bounded_and_grows_with_the_rings() -> None:
    pole = make_orbit(scene_of(box((-0.05, -2, -0.05), (0.05, 2, 0.05), 3000), 0.01), OrbitRequest())
    wide = make_orbit(table(), OrbitRequest())
    for orbit in (pole, wide):
        assert 16 * len(orbit.elevations) / 3 < len(orbit.cameras) <= 16 * len(orbit.elevations)
    assert len({camera.name for camera in wide.cameras}) == len(wide.cameras)


@pytest.mark.parametrize("count", [1, 2, 5, 11])
def test_few_views_form_one_ring(count: int) -> None:
    orbit = make_orbit(table(), OrbitRequest(count=count))
    assert len(orbit.cameras) == count
    assert orbit.elevations == (10,)


def test_requested_properties_are_used() -> None:
    scene = figure()
    orbit = make_orbit(scene, OrbitRequest(count=14, up=(0.0, 0.0, 1.0), elevation=35.0, radius=6.5))
    assert len(orbit.cameras) == 14
    assert orbit.up.direction.tolist() == [0, 0, 1]
    assert elevations(scene, orbit) == pytest.approx([35.0] * 14)
    assert orbit.radius == pytest.approx(6.5)
    decisions = plan_lines(scene, orbit)
    assert (decisions["up"].decision, decisions["up"].reason) == ("z", "requested")
    assert decisions["cameras"].decision == "14 views in a ring at 35 degrees, 6.5 from the center"
    assert decisions["cameras"].reason == "requested"


def test_orbit_surrounds_what_remains_of_a_cropped_scene() -> None:
    subject, other = figure(), scene_of(box((3, -4, 2), (6, 0, 5), 4000))
    scene = joined(other, subject)
    remaining = torch.arange(len(scene)) >= len(other)
    orbit, alone, whole = (
        make_orbit(scene, REQUEST, remaining),
        make_orbit(subject, REQUEST),
        make_orbit(scene, REQUEST),
    )
    for camera, expected in zip(orbit.cameras, alone.cameras, strict=True):
        assert torch.allclose(camera.world_to_camera, expected.world_to_camera)
        assert camera.fx == expected.fx
    assert whole.radius > 1.5 * orbit.radius
    assert orbit.hidden > 0, "the rest of the scene still stands in front"


def test_ground_outside_a_crop_shows_where_up_is() -> None:
    above = scene_of(ball((0, -0.5, 0), 0.4))
    scene = moved(joined(ground(4.0), above), Rotation.from_euler("z", 90, degrees=True))
    remaining = torch.arange(len(scene)) >= len(scene) - len(above)
    assert not find_up(find_subject(scene.subset(remaining))).sure
    up = make_orbit(scene, REQUEST, remaining).up
    assert (up.name, up.sure, up.ground) == ("x", True, True)


@pytest.mark.parametrize(
    ("comment", "up", "reason"),
    [
        ("Vertical axis: 0 0 1", "z", "the file states it"),
        ("vertical axis: [0.0, -2, 0.0]", "-y", "the file states it"),
        ("Vertical axis: z", "-z", "the file states it"),
        ("Vertical axis: y", "x", "there is a flat layer below the whole subject, and none above"),  # Brush's default
        ("Vertical axis: 0 0 0", "x", "there is a flat layer below the whole subject, and none above"),
        ("Vertical axis: nan 1 2", "x", "there is a flat layer below the whole subject, and none above"),
        ("Vertical axis: sideways", "x", "there is a flat layer below the whole subject, and none above"),
    ],
)
def test_up_direction_of_the_file_is_used(tmp_path: Path, comment: str, up: str, reason: str) -> None:
    path, scene = tmp_path / "scene.ply", joined(ground(4.0), scene_of(ball((0, -0.5, 0), 0.4)))
    write_scene(path, moved(scene, Rotation.from_euler("z", 90, degrees=True)))
    path.write_bytes(path.read_bytes().replace(b"element", f"comment {comment}\nelement".encode(), 1))
    chosen = find_upright_subject(read_scene(path).scene, None)[1]
    assert (chosen.name, chosen.reason) == (up, reason)
    assert find_upright_subject(read_scene(path).scene, (0.0, 0.0, -1.0))[1].name == "-z"


def test_plan_lines_state_the_reasons_of_an_orbit() -> None:
    scene = figure()
    orbit = make_orbit(scene, OrbitRequest(count=24))
    decisions = plan_lines(scene, orbit)
    assert decisions["up"].decision == "-y"
    assert "times as tall as wide" in decisions["up"].reason
    assert decisions["cameras"].decision.startswith(f"24 views in {len(orbit.elevations)} rings at 10")
    assert f"{orbit.shown:.0%} of the surface" in decisions["cameras"].reason
    assert "% of their pixels" in decisions["frames"].reason
    assert "subject" not in decisions


@pytest.mark.parametrize(
    ("surroundings", "what"),
    [
        (scene_of(box((-4, -4, -4), (4, 4, 4), 1000), 0.05), "outside the frames"),
        (scene_of(box((-1, -1, -1), (1, 1, 1), 3000), 0.05), "lies inside"),
    ],
)
def test_plan_warns_that_a_room_is_not_a_single_object(surroundings: Scene, what: str) -> None:
    scene = joined(scene_of(ball((0, 0, 0), 0.5, 5000), 0.05), surroundings)
    orbit = make_orbit(scene, OrbitRequest(count=12))
    warning = plan_lines(scene, orbit)["subject"]
    assert warning.decision.startswith("warning: ")
    assert what in warning.decision
    assert "--cameras" in warning.reason
    assert len(orbit.cameras) == 12


@pytest.mark.parametrize(
    "scene",
    [
        scene_of(torch.ones(1, 3)),
        scene_of(torch.ones(3, 3), opacities=torch.full((3,), -100.0)),
        scene_of(torch.ones(300, 3)),
        scene_of(torch.zeros(1, 3), torch.tensor([[1e-4, 2.0, 1e-4]])),
    ],
)
def test_degenerate_scenes_have_an_automatic_orbit(scene: Scene) -> None:
    for request in (OrbitRequest(), OrbitRequest(count=3)):
        orbit = make_orbit(scene, request)
        assert all(bool(torch.isfinite(camera.world_to_camera).all()) for camera in orbit.cameras)
        assert 0 <= orbit.shown <= 1 + 1e-9


def test_plan_starts_with_the_lines_about_the_orbit(tiny_weights) -> None:  # type: ignore[no-untyped-def]
    scene = figure()
    orbit = make_orbit(scene, OrbitRequest(count=3))
    cameras = [resized(camera, 64) for camera in orbit.cameras]
    plan = plan_job(scene, cameras, Style.of(style()), make_settings(), weights=tiny_weights, orbit=orbit).plan
    assert [decision.item for decision in plan.decisions[:3]] == ["up", "cameras", "frames"]
    without = plan_job(scene, cameras, Style.of(style()), make_settings(), weights=tiny_weights).plan
    assert "up" not in {decision.item for decision in without.decisions}


def test_automatic_orbits_are_deterministic() -> None:
    first, second = (make_orbit(figure(), OrbitRequest(count=12)) for _ in range(2))
    for one, other in itertools.zip_longest(first.cameras, second.cameras):
        assert torch.equal(one.world_to_camera, other.world_to_camera)
        assert (one.width, one.height, one.fx) == (other.width, other.height, other.fx)


@pytest.mark.parametrize(
    ("name", "reason"), [("statues/narcissus.sog", "foot"), ("playbot_synthetic_sh2/point_cloud.ply", "flat layer")]
)
def test_real_object_scans_stand_upright(shared_data: Path, name: str, reason: str) -> None:
    scene = read_scene(shared_data / "scenes" / name).scene
    orbit = make_orbit(scene, OrbitRequest(count=12))
    assert orbit.up.name == "-y"
    assert orbit.up.sure
    assert reason in orbit.up.reason
    assert orbit.outside < 0.01
    assert orbit.hidden == 0
