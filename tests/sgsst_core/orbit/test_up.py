"""Tests of estimating the up direction: from the ground, from the side that an object rests on, or by convention."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from scipy.spatial.transform import Rotation

from sgsst_core.files.scene_file import read_scene
from sgsst_core.orbit.subject import Subject, Up, find_subject, find_up
from sgsst_core.scene.gaussians import Scene
from tests.sgsst_core.orbit.objects import UP, ball, box, figure, ground, joined, moved, scene_of

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
def test_up_follows_from_the_ground_for_any_rotation(rotation: Rotation) -> None:
    up = up_of(moved(lamp(), rotation, 3.0, (5, -2, 7)))
    assert degrees(up, rotation) < 1.5
    assert up.ground
    assert up.sure
    assert "flat layer" in up.reason


@pytest.mark.parametrize("rotation", ROTATIONS)
def test_standing_subject_has_its_foot_below(rotation: Rotation) -> None:
    up = up_of(moved(figure(), rotation, 0.2))
    assert degrees(up, rotation) < 5
    assert up.sure
    assert not up.ground
    assert "times as tall as wide" in up.reason


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


@pytest.mark.parametrize("scene", [figure(), lamp(), animal(), chair()])
def test_up_of_a_turned_scene_is_right_or_asked_for(scene: Scene, one_thread: None) -> None:
    for up, expected in turned(find_subject(scene)):
        assert up.name == expected or (not up.sure and expected in up.candidates), up


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


@pytest.mark.parametrize(("normal", "candidates"), [(0, ["y", "x"]), (1, ["y", "y"]), (2, ["y", "z"])])
def test_panel_may_stand_or_lie(normal: int, candidates: list[str]) -> None:
    points = box((-3, -1, -3), (3, -0.9, 3)).roll(normal - 1, 1)
    up = up_of(scene_of(points))
    assert not up.sure
    assert [each.removeprefix("-") for each in up.candidates] == candidates
    assert up.name == "-y"


@pytest.mark.parametrize(("along", "name"), [(0, "x"), (1, "-y"), (2, "z")])
def test_stick_stands_along_its_axis_in_the_conventional_sense(along: int, name: str) -> None:
    points = torch.zeros(400, 3)
    points[:, along] = torch.linspace(-1, 1, 400)
    up = up_of(scene_of(points))
    assert up.name == name
    assert not up.sure
    assert "both ends are alike" in up.reason


def test_up_snaps_to_a_close_world_axis_only() -> None:
    assert up_of(moved(figure(), Rotation.from_euler("x", 13, degrees=True))).name == "-y"
    slanted = up_of(moved(figure(), Rotation.from_euler("x", 30, degrees=True)))
    assert slanted.name.startswith("(")
    assert float(slanted.direction.norm()) == pytest.approx(1)


@pytest.mark.parametrize("quarters", range(4))
def test_stick_may_stand_or_lie_and_a_foot_is_certain(quarters: int) -> None:
    rotation = Rotation.from_euler("z", 90 * quarters, degrees=True)
    stick = up_of(moved(scene_of(box((-0.2, -1, -0.2), (0.2, 1, 0.2), 4000)), rotation, 1.0))
    assert not stick.sure
    assert stick.candidates == (["x", "-y"] if quarters % 2 else ["-y", "y"])
    standing = up_of(moved(figure(), rotation, 1.0))
    assert standing.candidates == [["-y", "x", "y", "-x"][quarters]]


def test_pieces_are_the_same_in_a_mirror() -> None:
    """Crumbs lie at many distances around a box, about a cell of the grid from each other."""
    generator = torch.Generator().manual_seed(4)
    crumbs = (torch.rand(60, 3, generator=generator) - 0.5) * torch.tensor([2.0, 1.3, 0.7]) * 1.6
    points = torch.cat(
        [box((-0.5, -0.4, -0.2), (0.5, 0.4, 0.2), 3000), *(crumbs + 0.002 * index for index in range(30))]
    )
    subject, mirrored = (find_subject(scene_of(each)) for each in (points, -points))
    assert 0 < subject.left_out == pytest.approx(mirrored.left_out)
    assert len(subject.points) == len(mirrored.points)
