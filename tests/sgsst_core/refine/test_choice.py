"""Tests of the choice of Gaussians to split: projected sizes, and budget."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from sgsst_core.constants import EPS2D
from sgsst_core.rasterizer.cpu import CpuRasterizer
from sgsst_core.rasterizer.projection import Column, project
from sgsst_core.rasterizer.reference import ReferenceRasterizer
from sgsst_core.refine.choice import (
    SIZES,
    STROKE_SIZE,
    Footprints,
    axes_in_view,
    candidates,
    choose_pieces,
    finest_size,
    max_children,
    refine_decision,
)
from sgsst_core.refine.split import Refinement, piece_counts, ratio_of
from sgsst_core.settings import make_settings
from tests.sgsst_core.splat_scenes import camera, cloud, rotated_pose


def test_projected_axes_add_up_to_the_projected_covariance() -> None:
    scene, view = cloud(300), camera(pose=rotated_pose())
    projection = project(scene, view)
    rows = torch.from_numpy(projection.gaussians).long()
    x, y = (torch.from_numpy(projection.values[:, column]) for column in (Column.X, Column.Y))
    inside = (x > 0) & (x < view.width) & (y > 0) & (y < view.height)  # outside the view, directions are clamped
    lengths, reach = axes_in_view(scene, rows[inside], view)
    reference = ReferenceRasterizer(scene)
    assert reference.dtype == torch.float64
    # Extents are t sqrt(p) and t sqrt(r) with the same t; without blur, the squared axes sum to p + r.
    support = torch.from_numpy(projection.values[:, Column.LOG2_OPACITY]).double()[inside] + torch.log2(
        torch.tensor(255.0)
    )
    t = (2 * torch.log(torch.tensor(2.0, dtype=torch.float64)) * support).sqrt()
    extents = [
        torch.from_numpy(projection.values[:, column])[inside] / t for column in (Column.EXTENT_X, Column.EXTENT_Y)
    ]
    expected = extents[0].square() + extents[1].square() - 2 * EPS2D
    assert len(expected) > 50
    assert torch.allclose(lengths.square().sum(dim=1), expected, rtol=1e-5, atol=1e-5)
    depth = (scene.means.double() @ view.world_to_camera[2, :3].double() + view.world_to_camera[2, 3])[rows[inside]]
    assert torch.allclose(reach, scene.scales[rows[inside]].double().exp().amax(dim=1) / depth)


def test_footprints_are_means_weighted_by_visibility() -> None:
    scene, views = cloud(200), [camera(pose=rotated_pose()), camera(40, 30, focal=30.0)]
    rasterizer, prints = CpuRasterizer(scene), Footprints(scene)
    weights = [rasterizer.survey(view)[1] for view in views]
    for view, own in zip(views, weights, strict=True):
        prints.add(view, own)
    total = weights[0].double() + weights[1].double()
    assert torch.equal(prints.weights, total)
    both = ((weights[0] > 0) & (weights[1] > 0)).nonzero()[:, 0]
    assert len(both) > 5
    squares = sum(
        own[both].double()[:, None] * axes_in_view(scene, both, view)[0].square()
        for view, own in zip(views, weights, strict=True)
    )
    assert torch.allclose(prints.lengths[both], (squares / total[both, None]).sqrt())
    assert bool((prints.lengths[total == 0] == 0).all())
    other = Footprints(scene)
    other.replace(*prints.sums)
    assert torch.equal(other.lengths, prints.lengths)


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 2**31), st.floats(1, 16), st.floats(0.1, 300))
def test_chosen_pieces_never_exceed_the_budget(seed: int, factor: float, largest: float) -> None:
    generator = torch.Generator().manual_seed(seed)
    count = 50
    lengths = largest * torch.rand(count, 3, generator=generator, dtype=torch.float64) ** 3
    allowed = torch.rand(count, generator=generator) > 0.3
    cancels = torch.rand(count, generator=generator, dtype=torch.float64)
    most = torch.randint(1, 400, (count,), generator=generator).double()
    budget = int(factor * count)
    pieces, size = choose_pieces(lengths, allowed, cancels, most, budget)
    assert int(piece_counts(pieces).sum()) <= budget
    assert bool((piece_counts(pieces) <= most).all())
    assert bool((pieces[~allowed] == 1).all())
    assert bool((pieces[lengths <= SIZES[-1]] == 1).all())
    assert (size is None) == (not bool((pieces > 1).any()))
    again, same = choose_pieces(lengths, allowed, cancels, most, budget)
    assert torch.equal(again, pieces)
    assert same == size


def test_gaussians_that_disagree_most_are_split_first_within_the_budget() -> None:
    lengths = torch.tensor([[10.0, 0.1, 0.1]], dtype=torch.float64).repeat(6, 1)
    weights = torch.full((6,), 1e4, dtype=torch.float64)
    cancels = torch.tensor([1.0, 5.0, 2.0, 0.5, 4.0, 3.0], dtype=torch.float64)
    pieces, _ = choose_pieces(lengths, torch.ones(6, dtype=torch.bool), cancels, max_children(weights), 11)
    assert piece_counts(pieces).tolist() == [1, 3, 1, 1, 3, 1]
    one, most = torch.ones(1, dtype=torch.bool), max_children(weights[:1])
    blob, _ = choose_pieces(lengths.new_full((1, 3), 200.0), one, cancels[:1], most, 10**6)
    assert 200 < int(piece_counts(blob)) <= 1024
    nothing, size = choose_pieces(
        torch.full_like(lengths, 1.0), torch.ones(6, dtype=torch.bool), cancels, max_children(weights), 60
    )
    assert bool((nothing == 1).all())
    assert size is None


@pytest.mark.parametrize(
    ("values", "size"),
    [
        ({"refine": 4}, SIZES[-1]),
        ({"refine": "auto"}, STROKE_SIZE),
        ({"refine": "auto", "scales": (1.0, 0.0, 1.0)}, STROKE_SIZE),
        ({"refine": "auto", "scales": (0.0, 0.0, 1.0)}, 4 * STROKE_SIZE),
    ],
)
def test_finest_size_is_that_of_the_strokes_of_the_finest_scale(values: dict[str, Any], size: float) -> None:
    assert finest_size(make_settings(**values)) == size


def test_gaussians_are_split_down_to_the_finest_size_only() -> None:
    lengths = torch.tensor([[3.0, 0.1, 0.1], [40.0, 0.1, 0.1]], dtype=torch.float64)
    one, cancels = torch.ones(2, dtype=torch.bool), torch.ones(2, dtype=torch.float64)
    pieces, size = choose_pieces(lengths, one, cancels, 1000 * cancels, 1000, STROKE_SIZE)
    assert size == STROKE_SIZE
    assert piece_counts(pieces)[0] == 1
    assert 40 / ratio_of(int(pieces[1, 0])) <= STROKE_SIZE < 40 / ratio_of(int(pieces[1, 0]) - 1)
    finer, _ = choose_pieces(lengths, one, cancels, 1000 * cancels, 1000)
    assert bool((piece_counts(finer) > piece_counts(pieces)).all())


def test_faint_uniform_or_close_gaussians_are_not_candidates() -> None:
    prints = Footprints(cloud(5))
    prints.weights = torch.tensor([100.0, 1.0, 100.0, 100.0, 100.0], dtype=torch.float64)
    prints.reach = torch.tensor([0.1, 0.1, 1.9, 0.1, 0.1], dtype=torch.float64)
    magnitude = torch.ones(5, dtype=torch.float64)
    cancels = torch.tensor([0.9, 0.9, 0.9, 0.01, 0.9], dtype=torch.float64)
    splittable = torch.tensor([True, True, True, True, False])
    assert candidates(prints, splittable, cancels, magnitude).tolist() == [True, False, False, False, False]
    assert not candidates(prints, splittable, torch.zeros(5), torch.zeros(5)).any(), "no gradient asks for anything"


@pytest.mark.parametrize("reverted", [0, 7])
def test_plan_line_states_splits_and_their_image_error(reverted: int) -> None:
    pieces = torch.ones(1000, 3, dtype=torch.uint8)
    pieces[:10, 0] = 5
    refinement = Refinement(pieces, 10, 1040, 6.5, 43.21, 41.09, reverted)
    line = refine_decision(refinement, make_settings(refine=4))
    assert line.decision == "10 are split, which turns 1,000 Gaussians into 1,040"
    assert "6.5 pixels" in line.reason
    assert ("7 are not split" in line.reason) == bool(reverted)
    assert "43.2 dB" in line.error
    assert "41.1 dB" in line.error
    automatic = refine_decision(refinement, make_settings(refine="auto"))
    assert "at most 2 times as many are allowed" in automatic.reason
    none = refine_decision(Refinement(torch.ones(9, 3, dtype=torch.uint8), 0, 9), make_settings(refine=4))
    assert none.decision == "none is split"
