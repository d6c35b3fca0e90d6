"""Tests of camera rings around a subject.

Each view shows the whole subject, which fills it. Rings are invariant to the scene's pose and scale.
"""

from __future__ import annotations

import math
from pathlib import Path

import pytest
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from sgsst_core.errors import SettingsError
from sgsst_core.files.scene_file import read_scene
from sgsst_core.orbit.cameras import RESOLUTION, cameras_per_ring, middle_of, orbit, turntable
from sgsst_core.orbit.subject import find_subject
from sgsst_core.rasterizer import make_rasterizer
from sgsst_core.scene.camera import Camera, resized
from sgsst_core.scene.gaussians import Scene
from tests.sgsst_core.orbit.objects import UP, box, figure, joined, moved, scene_of

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
    assert cameras_per_ring(24, [10.0]) == [24]
    assert cameras_per_ring(24, [0.0, 60.0]) == [16, 8]
    assert cameras_per_ring(2, [0.0, 40.0, 70.0]) == [1, 1, 0]
    assert cameras_per_ring(5, [0.0, 80.0]) == [4, 1]
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
    subject = find_subject(scene)
    seen = scene.means[subject.holds(scene.means)] if name == "a far outlier" else scene.means
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


def fill(scene: Scene, views: list[Camera]) -> list[float]:
    """Return the fraction of each view's pixels that the scene covers."""
    rasterizer = make_rasterizer("cpu", scene, max_intersection_bytes=0)
    return [float(rasterizer.coverage(resized(view, 256)).mean()) for view in views]


def test_statue_fills_its_portrait_views(shared_data: Path) -> None:
    scene = read_scene(shared_data / "scenes" / "statues" / "narcissus.sog").scene
    views = orbit(scene, 8, elevations=[10.0, 40.0])
    shares = fill(scene, views)
    assert sum(shares) / len(shares) > 0.5
    assert min(shares) > 0.45
    assert all(view.height > 1.5 * view.width for view in views)
    for view in views:
        assert float(in_view(view, scene.means).double().mean()) > 0.9999


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
