"""Tests of orbits: subject, up direction, rings of cameras, choice."""

import itertools
import math
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from sgsst_core.errors import SettingsError
from sgsst_core.files.scene_file import read_scene
from sgsst_core.orbit import (
    RESOLUTION,
    Orbit,
    OrbitRequest,
    Subject,
    Up,
    cameras_per_ring,
    find_subject,
    find_up,
    make_orbit,
    middle_of,
    orbit,
    orbit_decisions,
    turntable,
)
from sgsst_core.progress import Decision
from sgsst_core.rasterizer import make_rasterizer
from sgsst_core.scene.camera import Camera, resized
from sgsst_core.scene.gaussians import Scene
from tests.sgsst_core.objects import UP, ball, box, figure, ground, joined, moved, scene_of

OBJECT = scene_of(box((-0.5, -1.5, -0.3), (0.5, 1.5, 0.3), 3000))


def extent(scene: object) -> torch.Tensor:
    """Return the lower and the upper corner of the subject's box, [2, 3]."""
    subject = find_subject(scene)  # type: ignore[arg-type]
    return torch.stack([subject.hull.amin(0), subject.hull.amax(0)])


def test_extent_of_a_box_includes_the_extents_of_its_gaussians() -> None:
    reach = 0.02 * math.sqrt(2 * math.log(torch.sigmoid(torch.tensor(3.0)) / 0.03))
    corner = torch.tensor([0.5, 1.5, 0.3], dtype=torch.float64) + reach
    assert torch.allclose(extent(OBJECT), torch.stack([-corner, corner]), atol=0.01)
    subject = find_subject(OBJECT)
    assert (subject.left_out, float(subject.weights.sum())) == (pytest.approx(0, abs=1e-9), pytest.approx(1))


STRAYS = {
    "one far outlier": scene_of(torch.tensor([[1e6, 0.0, 0.0]])),
    "one near outlier": scene_of(torch.tensor([[0.0, 4.0, 0.0]])),
    "floaters": scene_of(torch.randn(15, 3, generator=torch.Generator().manual_seed(1)) * 500),
    "a sky": scene_of(ball((0, 0, 0), 300, 400)),
    "faint ones all around": scene_of(
        torch.rand(3000, 3, generator=torch.Generator().manual_seed(2)) * 60 - 30, opacities=torch.full((3000,), -9.0)
    ),
    "a needle": scene_of(torch.zeros(1, 3), torch.tensor([[1e-3, 200.0, 1e-3]])),
    "a huge sheet": scene_of(torch.zeros(1, 3), torch.tensor([[1e3, 1e3, 1e-3]])),
}


@pytest.mark.parametrize("name", STRAYS)
def test_stray_gaussians_do_not_change_the_subject(name: str) -> None:
    assert torch.allclose(extent(joined(OBJECT, STRAYS[name])), extent(OBJECT), atol=0.02)


def test_connected_thin_part_belongs_to_the_subject() -> None:
    rod = torch.zeros(60, 3)
    rod[:, 1] = torch.linspace(-3.0, -1.5, 60)
    subject = extent(joined(OBJECT, scene_of(rod, 0.01)))
    assert float(subject[0, 1]) < -3.0


def test_two_separate_objects_both_belong_to_the_subject() -> None:
    other = scene_of(box((2.0, -0.5, -0.3), (3.0, 0.5, 0.3), 1500))
    assert float(extent(joined(OBJECT, other))[1, 0]) > 3.0


def test_subject_of_a_large_scene_is_estimated_from_a_sample() -> None:
    scene = figure()
    times = -(-150_000 // len(scene))
    many = joined(*[scene] * times)
    assert torch.allclose(extent(many), extent(scene), atol=0.02)
    assert len(find_subject(many).points) <= 20_000


ROTATIONS = [
    Rotation.identity(),
    Rotation.from_euler("xyz", [40, 65, -130], degrees=True),
    Rotation.from_rotvec([2, 1, 1]),
]


#: Rotations that map the axes to axes.
QUARTERS = Rotation.create_group("O")


def up_of(scene: Scene) -> Up:
    return find_up(find_subject(scene))


def degrees(up: Up, rotation: Rotation) -> float:
    """Return the angle in degrees between the estimated and the true up direction."""
    expected = torch.from_numpy(rotation.apply(UP))
    return math.degrees(math.acos(min(1.0, float(up.direction @ expected))))


def lamp() -> Scene:
    """Return a ball on a thin pole above a small ground. The ground defines the up direction, not the longest axis."""
    pole = box((-0.03, -1.0, -0.03), (0.03, 0.0, 0.03), 400)
    return joined(ground(), scene_of(torch.cat([pole, ball((0, -1.2, 0), 0.3, 900)])))


@pytest.mark.parametrize("rotation", ROTATIONS)
@pytest.mark.parametrize(
    ("scene", "factor", "shift", "most", "ground", "reason"),
    [(lamp(), 3.0, (5, -2, 7), 1.5, True, "flat layer"), (figure(), 0.2, (0, 0, 0), 5, False, "times as tall as wide")],
    ids=["ground", "standing"],
)
def test_up_follows_from_ground_or_stature_for_any_rotation(
    scene: Scene, factor: float, shift: tuple[int, int, int], most: float, ground: bool, reason: str, rotation: Rotation
) -> None:
    up = up_of(moved(scene, rotation, factor, shift))
    assert degrees(up, rotation) < most
    assert (up.sure, up.ground) == (True, ground)
    assert reason in up.reason


@pytest.mark.parametrize("rotation", ROTATIONS)
def test_few_points_below_a_foot_are_not_the_foot(rotation: Rotation) -> None:
    drips = box((-0.02, 0.0, -0.02), (0.02, 0.1, 0.02), 25)
    up = up_of(moved(joined(figure(), scene_of(drips)), rotation))
    assert degrees(up, rotation) < 5
    assert up.sure


def test_long_subject_on_wheels_lies_instead_of_standing() -> None:
    wheels = [box((x, -0.3, z), (x + 0.6, 0.0, z + 0.2), 300) for x in (-1.9, 1.3) for z in (-0.8, 0.6)]
    body = ball((0, 0, 0), 1.0, 3000) * torch.tensor([2.2, 0.5, 0.8]) + torch.tensor([0.0, -0.7, 0.0])
    up = up_of(scene_of(torch.cat([*wheels, body])))
    assert up.name == "-y"
    assert "rests" in up.reason


def turned(subject: Subject) -> list[tuple[Up, str]]:
    """Return the estimate, and the true up axis, for a subject in each of the 24 orientations along the axes."""
    estimates = []
    for matrix in torch.from_numpy(QUARTERS.as_matrix()).round():
        copy = replace(subject, points=subject.points @ matrix.T, hull=subject.hull @ matrix.T)
        expected = Up(matrix @ torch.tensor(UP, dtype=torch.float64), "")
        estimates.append((find_up(copy), expected.name))
    return estimates


def legs(height: float, x: float, z: float) -> list[torch.Tensor]:
    """Return four legs below y = -height, whose outer edges are at x and z."""
    corners = [(a, b) for a in (-x, x - 0.2) for b in (-z, z - 0.2)]
    return [box((a, -height, b), (a + 0.2, 0.0, b + 0.2), 300) for a, b in corners]


def animal() -> Scene:
    """Return a long body on four legs. Its back is broad and flat, and would be the foot if it stood on that."""
    body = box((-1.2, -1.2, -0.4), (1.2, -0.6, 0.4), 3000)
    head = ball((1.5, -1.4, 0), 0.3, 500)
    return scene_of(torch.cat([*legs(0.6, 1.2, 0.6), body, head]))


def chair() -> Scene:
    """Return a chair with a flat back, which is no ground below it."""
    seat, back = box((-0.6, -0.7, -0.6), (0.6, -0.6, 0.6), 2000), box((-0.6, -1.5, 0.4), (0.6, -0.7, 0.5), 1500)
    return scene_of(torch.cat([*legs(0.6, 0.7, 0.7), seat, back]))


@pytest.mark.parametrize("scene", [figure(), lamp(), animal()])
def test_up_of_a_turned_scene_is_right_or_asked_for(scene: Scene, one_thread: None) -> None:
    for up, expected in turned(find_subject(scene)):
        assert up.name == expected or not up.sure, up


def test_chair_rests_on_its_legs_and_not_on_its_flat_back(one_thread: None) -> None:
    for up, expected in turned(find_subject(chair())):
        assert (up.name, up.sure) == (expected, True)
        assert "rests firmly" in up.reason


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "sure"),
    [
        ("statues/massa.sog", True),
        ("statues/narcissus.sog", True),
        ("playbot_synthetic_sh2/point_cloud.ply", True),
        ("broche/broche.splat", False),
        ("snowmiku_plush/point_cloud.ply", False),
    ],
)
def test_up_of_real_scenes_is_never_wrong_and_sure(shared_data: Path, name: str, sure: bool, one_thread: None) -> None:
    subject = find_subject(read_scene(shared_data / "scenes" / name).scene)
    for up, expected in turned(subject):
        assert up.sure == sure
        assert not sure or up.name == expected
        assert len(up.candidates) == (1 if sure else 2)


@pytest.mark.parametrize(
    "scene",
    [
        scene_of(ball((1, 2, 3), 1.0)),
        scene_of(box((-1, -1, -1), (1, 1, 1))),
        scene_of(torch.ones(1, 3)),
        scene_of(torch.ones(100, 3)),
        joined(*(scene_of(part) for part in (box((-1, -1, -1), (1, 1, 1), 4000), ball((0, 0, 0), 3.9, 1500)))),
    ],
)
def test_up_is_conventional_without_evidence(scene: Scene) -> None:
    up = up_of(scene)
    assert up.name == "-y"
    assert not up.sure
    assert up.candidates == ["-y", "z"]
    assert "most captures" in up.reason


def test_up_snaps_to_a_close_world_axis_only() -> None:
    assert up_of(moved(figure(), Rotation.from_euler("x", 13, degrees=True))).name == "-y"
    slanted = up_of(moved(figure(), Rotation.from_euler("x", 30, degrees=True)))
    assert slanted.name.startswith("(")
    assert float(slanted.direction.norm()) == pytest.approx(1)


PIXELS = RESOLUTION**2 * 3 / 4
ROTATION = Rotation.from_euler("xyz", [40, 65, -130], degrees=True)


def project(view: Camera, points: Tensor) -> tuple[Tensor, Tensor]:
    """Return image positions [P, 2] as fractions of width and height, and depths [P], of points [P, 3]."""
    local = points.double() @ view.world_to_camera[:3, :3].T + view.world_to_camera[:3, 3]
    lens = torch.tensor([[view.fx, view.fy], [view.cx, view.cy]], dtype=torch.float64)
    size = torch.tensor([view.width, view.height], dtype=torch.float64)
    return (local[:, :2] / local[:, 2:] * lens[0] + lens[1]) / size, local[:, 2]


def in_view(view: Camera, points: Tensor) -> Tensor:
    places, depths = project(view, points)
    return (depths > 0.2) & (places > 0).all(1) & (places < 1).all(1)


def elevation(view: Camera, middle: Tensor, up: Tensor) -> float:
    offset = view.center - middle
    return math.degrees(math.asin(float(offset @ up / offset.norm())))


@pytest.mark.parametrize("up", [(0, -1, 0), (0, 0, 1), (1, 0, 0), (0.3, -2, 0.9)])
@pytest.mark.parametrize("size", [0.01, 1.0, 300.0])
@pytest.mark.parametrize("shape", [None, (360, 480)])
def test_every_frame_contains_the_object_and_is_filled_by_it(
    up: tuple[float, float, float], size: float, shape: tuple[int, int] | None
) -> None:
    means = box((-0.5, -1.5, -0.3), (0.5, 1.5, 0.3), 3000) * size + torch.tensor([5.0, -7.0, 2.0]) * size
    width, height = shape or (None, None)
    views = orbit(scene_of(means, 0.01 * size), 7, width=width, height=height, up=up, elevations=[15.0])
    assert len({view.name for view in views}) == 7
    middle = torch.tensor([5.0, -7.0, 2.0], dtype=torch.float64) * size
    axis = torch.tensor(up, dtype=torch.float64) / torch.tensor(up, dtype=torch.float64).norm()
    distances = torch.stack([(view.center - middle).norm() for view in views])
    assert torch.allclose(distances, distances[0].expand(7), rtol=0.02)
    for view in views:
        assert view.fx == view.fy
        assert bool(in_view(view, means).all())
        assert elevation(view, middle, axis) == pytest.approx(15, abs=1)
        places, _ = project(view, torch.stack([middle, middle + 0.1 * size * axis]))
        assert float(places[1, 1]) < float(places[0, 1])  # up in the world is up in the image
        places, _ = project(view, means)
        if shape is None:
            assert view.width * view.height == pytest.approx(PIXELS, rel=2e-3)
            assert float((places.amax(0) - places.amin(0)).amin()) > 0.65
        else:
            assert (view.width, view.height) == shape
        assert float((places.amax(0) - places.amin(0)).amax()) > 0.55
        assert torch.allclose(places.amax(0) + places.amin(0), torch.ones(2, dtype=torch.float64), atol=0.03)


def test_frames_have_few_aspect_ratios_that_follow_the_object() -> None:
    standing = orbit(figure(), 12)
    assert all(view.height > 2 * view.width for view in standing)
    assert len({view.width for view in standing}) <= 4
    lying = orbit(scene_of(box((-2, -0.2, -2), (2, 0.2, 2), 3000)), 12, elevations=[0.0])
    assert all(view.width > 2 * view.height for view in lying)


def test_frames_have_a_margin_around_the_object() -> None:
    """In a render, the object is not cropped, and fills most of its box's area."""
    scene = figure()
    rasterizer = make_rasterizer("cpu", scene)
    for view in orbit(scene, 5, elevations=[10.0, 45.0]):
        coverage = rasterizer.coverage(resized(view, 256))
        border = torch.cat([coverage[0], coverage[-1], coverage[:, 0], coverage[:, -1]])
        assert float(border.amax()) < 0.1
        assert float(coverage.mean()) > 0.35


def test_cameras_are_distributed_over_rings_by_circumference() -> None:
    assert (cameras_per_ring(24, [10.0]), cameras_per_ring(24, [0.0, 60.0])) == ([24], [16, 8])
    assert (cameras_per_ring(2, [0.0, 40.0, 70.0]), cameras_per_ring(5, [0.0, 80.0])) == ([1, 1, 0], [4, 1])
    middle, axis = middle_of(find_subject(figure()), torch.tensor(UP).double()), torch.tensor(UP, dtype=torch.float64)
    views = orbit(figure(), 24, up=UP, elevations=[10.0, 40.0, -20.0])
    counts = cameras_per_ring(24, [10.0, 40.0, -20.0])
    expected = [angle for angle, count in zip([10.0, 40.0, -20.0], counts, strict=True) for _ in range(count)]
    assert [elevation(view, middle, axis) for view in views] == pytest.approx(expected, abs=1e-6)


def test_cameras_follow_rotation_and_scale_of_the_scene() -> None:
    scene, matrix = figure(), torch.from_numpy(ROTATION.as_matrix())
    before = orbit(scene, 9, up=UP, elevations=[10.0, 40.0])
    after = orbit(moved(scene, ROTATION, 3.0, (5, -2, 7)), 9, up=ROTATION.apply(UP).tolist(), elevations=[10.0, 40.0])
    shift = torch.tensor([5.0, -2.0, 7.0], dtype=torch.float64)
    size = 3 * find_subject(scene).size
    for old, new in zip(before, after, strict=True):
        assert (new.width, new.height) == (old.width, old.height)
        assert float((3 * matrix @ old.center + shift - new.center).norm()) < 0.01 * size
        rotated = old.world_to_camera[:3, :3] @ matrix.T
        assert torch.allclose(rotated, new.world_to_camera[:3, :3], atol=0.02)
        assert new.fx == pytest.approx(old.fx, rel=0.02)


def test_first_camera_faces_the_broad_side() -> None:
    scene = scene_of(box((-1, -1, -0.2), (1, 1, 0.2), 3000))
    rotated = moved(scene, Rotation.from_euler("y", 37, degrees=True))
    offset = orbit(rotated, 4)[0].center
    broad = torch.from_numpy(Rotation.from_euler("y", 37, degrees=True).apply([0, 0, 1]))
    assert abs(float(offset @ broad) / float(offset.norm())) > 0.97


def test_explicit_radius_is_used() -> None:
    scene = figure()
    middle = middle_of(find_subject(scene), torch.tensor(UP, dtype=torch.float64))
    for radius in (2.5, 40.0):
        views = orbit(scene, 5, radius=radius)
        for view in views:
            assert float((view.center - middle).norm()) == pytest.approx(radius)
            assert bool(in_view(view, scene.means).all())
    for view in orbit(scene, 5, radius=0.05):  # inside, with parts of it behind the camera
        assert bool(torch.isfinite(view.world_to_camera).all())
        assert view.fx > 0.2 * max(view.width, view.height)


ODD = {
    "a point": scene_of(torch.ones(1, 3)),
    "an invisible point": scene_of(torch.ones(1, 3), opacities=torch.tensor([-100.0])),
    "coincident points": scene_of(torch.ones(200, 3)),
    "a needle": scene_of(torch.zeros(1, 3), torch.tensor([[1e-4, 2.0, 1e-4]])),
    "a stick": scene_of(torch.linspace(-2, 2, 300)[:, None] * torch.tensor([0.0, 1.0, 0.0])),
    "a sheet": scene_of(box((-2, 0, -2), (2, 0, 2), 2000)),
    "a far outlier": joined(figure(), scene_of(torch.tensor([[1e5, 0.0, 0.0]]))),
    "small": moved(figure(), ROTATION, 1e-6),
    "large": moved(figure(), ROTATION, 1e6),
}


@pytest.mark.parametrize("name", ODD)
def test_degenerate_scenes_have_cameras_that_see_them(name: str) -> None:
    scene = ODD[name]
    seen = figure().means if name == "a far outlier" else scene.means
    for view in orbit(scene, 6, elevations=[10.0, 40.0]):
        assert bool(torch.isfinite(view.world_to_camera).all())
        assert math.isfinite(view.fx)
        assert 0.24 < view.width / view.height < 4.2
        assert view.width * view.height == pytest.approx(PIXELS, rel=2e-3)
        assert bool(in_view(view, seen).all())


@pytest.mark.parametrize(
    "wrong",
    [
        {"count": 0},
        {"width": 0, "height": 5},
        {"up": (0, 0, 0)},
        {"up": (0, math.nan, 0)},
        {"elevations": [90.0]},
        {"elevations": [math.nan]},
        {"elevations": []},
        {"radius": 0.0},
        {"radius": math.inf},
    ],
)
def test_invalid_orbit_arguments_are_refused(wrong: dict[str, object]) -> None:
    arguments = {"count": 3} | wrong
    with pytest.raises(SettingsError):
        orbit(scene_of(torch.rand(9, 3)), **arguments)  # type: ignore[arg-type]


def test_turntable_keeps_focal_length_target_and_frame_and_shows_all_of_the_object() -> None:
    means = box((-0.5, -1.5, -0.3), (0.5, 1.5, 0.3), 3000) + torch.tensor([5.0, -7.0, 2.0])
    subject = find_subject(scene_of(means, 0.01))
    views = turntable(subject, 40, up=UP, elevation=20, side=400)
    assert len({(view.width, view.height, view.fx, view.fy, view.cx, view.cy) for view in views}) == 1
    assert max(views[0].width, views[0].height) == 400
    assert all(bool(in_view(view, means).all()) for view in views)
    middle = middle_of(subject, torch.tensor(UP, dtype=torch.float64))
    assert all(torch.allclose(project(view, middle[None])[0], torch.tensor([0.5, 0.5]).double()) for view in views)
    centers = torch.stack([view.center for view in views])
    steps = (centers - centers.roll(1, 0)).norm(dim=1)  # the last camera is one step before the first
    assert torch.allclose(steps, steps[0].expand(40))


def test_turntable_of_a_point_or_from_within_is_finite() -> None:
    point = find_subject(scene_of(torch.zeros(1, 3), 1e-6))
    inside = find_subject(scene_of(box((-1, -1, -1), (1, 1, 1), 2000), 0.01))
    for views in (turntable(point, 3, up=UP), turntable(inside, 3, up=UP, radius=0.1)):
        assert all(math.isfinite(view.fx) and view.fx > 0 for view in views)
        assert all(bool(torch.isfinite(view.world_to_camera).all()) for view in views)


REQUEST = OrbitRequest(count=12)


def plan_lines(orbit: Orbit) -> dict[str, Decision]:
    """Return the plan's decisions about an orbit by item."""
    return {decision.item: decision for decision in orbit_decisions(orbit, len(orbit.cameras))}


def table() -> Scene:
    """Return a wide flat object on the ground, which is best seen from above."""
    return joined(ground(4.0), scene_of(box((-0.5, -0.5, -0.5), (0.5, 0.0, 0.5))))


@pytest.mark.parametrize("up", [None, UP])
def test_scene_with_ground_gets_views_from_above_and_none_from_below(up: tuple[float, float, float] | None) -> None:
    orbit = make_orbit(table(), OrbitRequest(count=24, up=up))
    assert orbit.up.ground
    assert orbit.elevations == (10, 70)
    assert len(orbit.cameras) == 24


@pytest.mark.parametrize(
    ("scene", "count", "rings"),
    [(figure(), None, 3), (figure(), 17, 2), (figure(), 18, 3), (table(), None, 2), (table(), 24, 2)],
)
def test_automatic_views_are_distributed_over_rings(scene: Scene, count: int | None, rings: int) -> None:
    orbit = make_orbit(scene, OrbitRequest(count=count))
    assert len(orbit.elevations) == rings
    assert len({camera.name for camera in orbit.cameras}) == (count or {3: 43, 2: 22}[rings])


@pytest.mark.parametrize("count", [1, 2, 5, 11])
def test_few_views_form_one_ring(count: int) -> None:
    orbit = make_orbit(table(), OrbitRequest(count=count))
    assert (len(orbit.cameras), orbit.elevations) == (count, (10,))


def test_requested_properties_are_used() -> None:
    scene = figure()
    orbit = make_orbit(scene, OrbitRequest(count=14, up=(0.0, 0.0, 1.0), elevation=35.0, radius=6.5))
    assert (len(orbit.cameras), orbit.up.direction.tolist()) == (14, [0, 0, 1])
    middle = middle_of(find_subject(scene), orbit.up.direction)
    angles = [elevation(camera, middle, orbit.up.direction) for camera in orbit.cameras]
    assert angles == pytest.approx([35.0] * 14)
    assert orbit.radius == pytest.approx(6.5)
    decisions = plan_lines(orbit)
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


def test_ground_outside_a_crop_shows_where_up_is() -> None:
    above = scene_of(ball((0, -0.5, 0), 0.4))
    scene = moved(joined(ground(4.0), above), Rotation.from_euler("z", 90, degrees=True))
    remaining = torch.arange(len(scene)) >= len(scene) - len(above)
    assert not find_up(find_subject(scene.subset(remaining))).sure
    up = make_orbit(scene, REQUEST, remaining).up
    assert (up.name, up.sure, up.ground) == ("x", True, True)


def test_plan_lines_state_the_reasons_of_an_orbit() -> None:
    scene = figure()
    orbit = make_orbit(scene, OrbitRequest(count=24))
    decisions = plan_lines(orbit)
    assert decisions["up"].decision == "-y"
    assert "times as tall as wide" in decisions["up"].reason
    assert decisions["cameras"].decision.startswith("24 views in 3 rings at 10, 40 and -20 degrees, ")
    assert "more of the surface" in decisions["cameras"].reason
    assert "subject" not in decisions


def test_plan_warns_that_a_room_is_not_a_single_object() -> None:
    surroundings = scene_of(box((-4, -4, -4), (4, 4, 4), 1000), 0.05)
    scene = joined(scene_of(ball((0, 0, 0), 0.5, 5000), 0.05), surroundings)
    orbit = make_orbit(scene, OrbitRequest(count=12))
    warning = plan_lines(orbit)["subject"]
    assert warning.decision.startswith("warning: ")
    assert "outside the frames" in warning.decision
    assert "--cameras" in warning.reason
    assert len(orbit.cameras) == 12


@pytest.mark.parametrize("name", ["a point", "an invisible point", "coincident points", "a needle"])
def test_degenerate_scenes_have_an_automatic_orbit(name: str) -> None:
    for request in (OrbitRequest(), OrbitRequest(count=3)):
        orbit = make_orbit(ODD[name], request)
        assert all(bool(torch.isfinite(camera.world_to_camera).all()) for camera in orbit.cameras)


def test_automatic_orbits_are_deterministic() -> None:
    first, second = (make_orbit(figure(), OrbitRequest(count=12)) for _ in range(2))
    for one, other in itertools.zip_longest(first.cameras, second.cameras):
        assert torch.equal(one.world_to_camera, other.world_to_camera)
        assert (one.width, one.height, one.fx) == (other.width, other.height, other.fx)
