"""Cameras made from cameras, and orbits made from scenes."""

from __future__ import annotations

import itertools
import math
from pathlib import Path

import pytest
import torch
from torch import Tensor

from sgsst_core.errors import CameraError, SettingsError
from sgsst_core.files.ply import read_scene
from sgsst_core.scene.camera import Camera, look_at, orbit, resized, spread
from sgsst_core.scene.gaussians import Scene


def camera(width: int = 990, height: int = 742, name: str = "a") -> Camera:
    return Camera(name, width, height, 820.0, 810.0, 490.0, 380.0, torch.eye(4, dtype=torch.float64))


def scene_of(means: Tensor, opacities: Tensor | None = None) -> Scene:
    n = len(means)
    return Scene(
        means.float(),
        torch.tensor([1.0, 0, 0, 0]).repeat(n, 1),
        torch.full((n, 3), -4.0),
        torch.full((n,), 3.0) if opacities is None else opacities,
        torch.zeros(n, 3),
        torch.zeros(n, 0, 3),
    )


def project(view: Camera, points: Tensor) -> tuple[Tensor, Tensor]:
    """[P, 2] pixels and [P] depths of points [P, 3]."""
    local = points.double() @ view.world_to_camera[:3, :3].T + view.world_to_camera[:3, 3]
    lens = torch.tensor([[view.fx, view.fy], [view.cx, view.cy]], dtype=torch.float64)
    return local[:, :2] / local[:, 2:] * lens[0] + lens[1], local[:, 2]


def in_view(view: Camera, points: Tensor) -> Tensor:
    pixels, depths = project(view, points)
    return (depths > 0.2) & (pixels > 0).all(1) & (pixels < torch.tensor([view.width, view.height])).all(1)


@pytest.mark.parametrize("longer_side", [1, 7, 480, 990, 1600, 5187])
@pytest.mark.parametrize(("width", "height"), [(990, 742), (742, 990), (640, 640), (5000, 3)])
def test_resizing_leaves_every_direction_at_its_place_in_the_picture(width: int, height: int, longer_side: int) -> None:
    before = camera(width, height)
    after = resized(before, longer_side)
    assert max(after.width, after.height) == longer_side
    assert isinstance(after.width, int)
    assert abs(min(after.width, after.height) - longer_side * min(width, height) / max(width, height)) <= 1
    points = torch.tensor([[0.0, 0, 1], [0.3, -0.2, 1], [-1, 2, 4]])
    size = torch.tensor([[before.width, before.height], [after.width, after.height]], dtype=torch.float64)
    assert torch.allclose(project(after, points)[0] / size[1], project(before, points)[0] / size[0], rtol=1e-12)


def test_resizing_to_nothing_is_refused() -> None:
    with pytest.raises(SettingsError, match="resolution is 0"):
        resized(camera(), 0)


@pytest.mark.parametrize(("total", "count"), [(97, 8), (97, 96), (10, 3), (5, 5), (5, 9), (1, 1), (1000, 1)])
def test_a_spread_subset_is_even_and_in_order(total: int, count: int) -> None:
    cameras = [camera(name=str(i)) for i in range(total)]
    chosen = [int(c.name) for c in spread(cameras, count)]
    assert len(chosen) == min(count, total)
    gaps = [after - before for before, after in itertools.pairwise(chosen)]
    assert all(gap >= 1 for gap in gaps)
    if gaps:
        assert max(gaps) - min(gaps) <= 1
        seam = chosen[0] + total - chosen[-1]  # in a ring the last and the first are neighbours
        assert min(gaps) - 1 <= seam <= max(gaps) + 1


def test_a_subset_of_nothing_is_refused() -> None:
    with pytest.raises(SettingsError, match="views is 0"):
        spread([camera()], 0)


def test_look_at_sees_its_target_in_the_middle_and_up_above() -> None:
    position, target, up = torch.tensor([1.0, 2, 3]), torch.tensor([4.0, -1, 7]), torch.tensor([0.0, 0, 5])
    view = look_at("a", position, target, up, width=300, height=200, focal=250.0)
    pixels, depths = project(view, torch.stack([target, target + 0.1 * up]))
    assert pixels[0].tolist() == pytest.approx([150, 100])
    assert float(depths[0]) == pytest.approx(math.sqrt(34))
    assert float(pixels[1, 0]) == pytest.approx(150)
    assert float(pixels[1, 1]) < 100
    assert torch.allclose(view.centre, position.double())
    assert float(torch.linalg.det(view.world_to_camera[:3, :3])) == pytest.approx(1)
    for wrong in (target - position, torch.zeros(3)):
        with pytest.raises(CameraError, match="own up direction"):
            look_at("a", position, target, wrong, width=3, height=2, focal=2.0)


@pytest.mark.parametrize("up", [(0, -1, 0), (0, 0, 1), (1, 0, 0), (0.3, -2, 0.9)])
@pytest.mark.parametrize(("width", "height"), [(1024, 768), (360, 480)])
@pytest.mark.parametrize("size", [0.01, 1.0, 300.0])
def test_an_orbit_sees_the_whole_object_large_from_all_sides(
    up: tuple[float, float, float], width: int, height: int, size: float
) -> None:
    generator = torch.Generator().manual_seed(0)
    means = (torch.rand(3000, 3, generator=generator) - 0.5) * torch.tensor([1.0, 3.0, 0.6]) * size
    means = means + torch.tensor([5.0, -7.0, 2.0]) * size
    views = orbit(scene_of(means), 7, width=width, height=height, up=up)
    assert len({view.name for view in views}) == 7
    middle = torch.tensor([5.0, -7.0, 2.0], dtype=torch.float64) * size
    axis = torch.tensor(up, dtype=torch.float64) / torch.tensor(up, dtype=torch.float64).norm()
    filled = []
    for view in views:
        assert view.fx == view.fy == pytest.approx(1.1 * width)
        assert bool(in_view(view, means).all())
        assert float((view.centre - middle) @ axis) > 0  # slightly above
        # up is up in the picture
        pixels, _ = project(view, torch.stack([middle, middle + 0.1 * size * axis]))
        assert float(pixels[1, 1]) < float(pixels[0, 1])
        pixels, _ = project(view, means)
        filled.append(float(((pixels.amax(0) - pixels.amin(0)) / torch.tensor([width, height])).max()))
    distances = torch.stack([(view.centre - middle).norm() for view in views])
    assert torch.allclose(distances, distances[0].expand(7), rtol=0.02)
    if size > 0.2:  # below, the near plane keeps the cameras away
        assert max(filled) > 0.75


def test_an_orbit_leaves_floaters_and_background_out() -> None:
    generator = torch.Generator().manual_seed(0)
    thing = torch.randn(2000, 3, generator=generator).clamp(-2, 2)
    floaters = torch.randn(15, 3, generator=generator) * 500
    sky = torch.nn.functional.normalize(torch.randn(400, 3, generator=generator), dim=1) * 300
    faint = torch.rand(3000, 3, generator=generator) * 60
    opacities = torch.cat([torch.full((2415,), 3.0), torch.full((3000,), -9.0)])
    views = orbit(scene_of(torch.cat([thing, floaters, sky, faint]), opacities), 5)
    for view in views:
        assert float(view.centre.norm()) < 20
        assert bool(in_view(view, thing).all())


def test_an_orbit_of_a_single_point_looks_at_it_from_beyond_the_near_plane() -> None:
    for view in orbit(scene_of(torch.ones(1, 3), torch.tensor([-100.0])), 2):
        assert bool(in_view(view, torch.ones(1, 3)).all())


@pytest.mark.parametrize(
    "wrong", [{"count": 0}, {"width": 0}, {"up": (0, 0, 0)}, {"up": (0, math.nan, 0)}, {"elevation": 90.0}]
)
def test_an_orbit_without_sense_is_refused(wrong: dict[str, object]) -> None:
    arguments = {"count": 3} | wrong
    with pytest.raises(SettingsError):
        orbit(scene_of(torch.rand(9, 3)), **arguments)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("name", "centre", "radius"),
    [("biker", (-0.1, -1.6, 0.03), 4.6), ("playbot_synthetic_sh2", (0, -0.4, 0), 3.0)],
)
def test_orbits_of_real_object_scans_are_close_to_those_set_by_hand(
    shared_data: Path, name: str, centre: tuple[float, ...], radius: float
) -> None:
    scene = read_scene(shared_data / "scenes" / name / "point_cloud.ply").scene
    views = orbit(scene, 12)
    assert all(float(in_view(view, scene.means).double().mean()) > 0.999 for view in views)
    ring = torch.stack([view.centre for view in views])
    middle = ring.mean(0)
    distance = float((ring[0] - middle).norm())
    assert math.hypot(float(middle[0] - centre[0]), float(middle[2] - centre[2])) < 0.05
    assert radius * 0.8 < distance < radius * 1.3
