"""Tests of detecting a scene's subject: the whole object, without outliers, needles and background."""

from __future__ import annotations

import math

import pytest
import torch

from sgsst_core.orbit.subject import find_subject, quantile, spread_directions
from tests.sgsst_core.orbit.objects import ball, box, figure, joined, scene_of

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
    assert subject.left_out == pytest.approx(0, abs=1e-9)
    assert float(subject.weights.sum()) == pytest.approx(1)
    assert bool(subject.holds(OBJECT.means).all())
    assert not bool(subject.holds(torch.tensor([[0.0, 1.6, 0.0]])).any())


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


@pytest.mark.parametrize(
    "scene",
    [
        scene_of(torch.ones(1, 3)),
        scene_of(torch.ones(1, 3), opacities=torch.tensor([-100.0])),
        scene_of(torch.ones(500, 3)),
        scene_of(torch.ones(500, 3), 1e-30),
        scene_of(torch.rand(7, 3), opacities=torch.full((7,), -300.0)),
        scene_of(torch.rand(50, 3) * 1e15, 1e12),
        scene_of(torch.rand(50, 3) * 1e-15, 1e-20),
    ],
)
def test_degenerate_scenes_have_a_finite_extent_that_contains_them(scene: object) -> None:
    subject = find_subject(scene)  # type: ignore[arg-type]
    assert bool(torch.isfinite(subject.hull).all())
    assert bool(torch.isfinite(subject.weights).all())
    assert float(subject.weights.sum()) == pytest.approx(1)
    assert len(subject.points)


def test_zero_quaternion_counts_as_no_rotation() -> None:
    scene = scene_of(OBJECT.means)
    scene.quats[0] = 0
    assert torch.allclose(extent(scene), extent(OBJECT))


def test_subject_of_a_large_scene_is_estimated_from_a_sample() -> None:
    scene = figure()
    times = -(-150_000 // len(scene))
    many = joined(*[scene] * times)
    assert torch.allclose(extent(many), extent(scene), atol=0.02)
    assert len(find_subject(many).points) <= 20_000


def test_quantiles_are_weighted_and_directions_spread() -> None:
    values, weights = torch.tensor([3.0, 1.0, 2.0]), torch.tensor([1.0, 1.0, 2.0])
    assert [quantile(values, weights, fraction) for fraction in (0.0, 0.25, 0.5, 0.75, 1.0)] == [1, 1, 2, 2, 3]
    directions = spread_directions(300)
    assert torch.allclose(directions.norm(dim=1), torch.ones(300, dtype=torch.float64))
    nearest = (directions @ directions.T - 2 * torch.eye(300)).amax(1).clamp(max=1).acos()
    assert math.degrees(float(nearest.amax())) < 15
    assert float(directions.mean(0).norm()) < 0.01
