"""Tests of refining a scene: which Gaussians are split, their children, and that images hardly change."""

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from sgsst_core import refine as module
from sgsst_core.features.network_weights import BackboneWeights
from sgsst_core.parallel import Collectives
from sgsst_core.planning.survey import psnr
from sgsst_core.rasterizer.cpu import CpuRasterizer
from sgsst_core.refine import (
    MAX_PIECES,
    MIN_PSNR,
    SIZES,
    STROKE_SIZE,
    Footprints,
    Refinement,
    can_be_split,
    choose_pieces,
    finest_size,
    max_children,
    parents_of,
    piece_counts,
    ratio_of,
    split,
    split_axis,
)
from sgsst_core.regions import Region, Regions
from sgsst_core.scene.colors import luminance
from sgsst_core.scene.gaussians import TENSORS, Scene, unit_rotations
from sgsst_core.settings import Settings, make_settings
from sgsst_core.style import Style
from sgsst_core.stylizing import refining
from sgsst_core.stylizing.job import JobInputs
from sgsst_core.stylizing.loop import run
from sgsst_core.stylizing.refining import disagreement, refine, render
from sgsst_core.stylizing.stylizer import Stylizer
from tests.networks import tiny_weights as make_tiny_weights
from tests.sgsst_core.rasterizer.splat_reference import ReferenceRasterizer
from tests.sgsst_core.splat_scenes import camera, cloud, single
from tests.small_scenes import cameras, style, wall

pytestmark = pytest.mark.usefixtures("one_thread")


def large_wall() -> Scene:
    """Return the wall of small Gaussians, with a dozen large faint Gaussians and a needle in front of it."""
    behind = wall()
    before = wall(4, 3, 0)
    before = replace(
        before,
        means=before.means * 0.6 - torch.tensor([0.0, 0.0, -0.9]),
        scales=torch.tensor([0.5, 0.3, 0.02]).log().repeat(12, 1),
        opacities=torch.full((12,), -1.0),
        sh_dc=before.sh_dc * 0.3,
    )
    before.scales[0] = torch.tensor([0.9, 0.002, 0.002]).log()
    return Scene(*(torch.cat([getattr(part, name) for part in (behind, before)]) for name in TENSORS))


def refine_settings(**values: object) -> Settings:
    return make_settings("preview", steps_coarse=0, steps_sos=2, measure=0, **values)


def refinement_of(weights: BackboneWeights, factor: float, scene: Scene | None = None) -> Refinement:
    refinement = refine(
        JobInputs(scene or large_wall(), cameras(), Style.of(style()), refine_settings(refine=factor), weights=weights)
    )
    assert refinement is not None
    return refinement


def test_disagreement_is_the_gradient_that_cancels_between_pixels() -> None:
    scene, view = cloud(60), camera(20, 14, focal=18.0)
    generator = torch.Generator().manual_seed(0)
    gradient = torch.randn(14, 20, 3, generator=generator, dtype=torch.float64)
    reference = ReferenceRasterizer(scene)
    cancels, magnitude = disagreement(reference, view, gradient)
    operator = []  # blend weights [pixels, N], pixel by pixel
    for pixel in range(14 * 20):
        one = torch.zeros(14 * 20, 3, dtype=torch.float64)
        one[pixel] = 1
        operator.append(reference.color_gradient(one.reshape(14, 20, 3), view)[:, 0])
    weights, flat = torch.stack(operator), gradient.reshape(-1, 3)
    total, summed = weights.T @ flat.abs(), (weights.T @ flat).abs()
    assert torch.allclose(magnitude, total.sum(dim=1), atol=1e-12)
    assert torch.allclose(cancels, (total - summed).sum(dim=1), atol=1e-12)
    fast = disagreement(CpuRasterizer(scene), view, gradient.float())
    assert torch.allclose(fast[0], cancels, atol=1e-4 * float(magnitude.max()))
    uniform = disagreement(reference, view, torch.full((14, 20, 3), -0.3, dtype=torch.float64))
    assert torch.allclose(uniform[0], torch.zeros(60, dtype=torch.float64), atol=1e-12)


@pytest.mark.parametrize("factor", [1.2, 2.0, 4.0])
def test_large_gaussians_are_split_within_the_budget_and_images_are_preserved(
    tiny_weights: BackboneWeights, factor: float
) -> None:
    scene = large_wall()
    refinement = refinement_of(tiny_weights, factor)
    counts = piece_counts(refinement.pieces)
    assert refinement.split == int((counts > 1).sum()) > 0
    assert len(scene) < refinement.gaussians == int(counts.sum()) <= factor * len(scene)
    assert refinement.psnr is not None
    assert refinement.lowest_psnr is not None
    assert refinement.psnr >= refinement.lowest_psnr >= MIN_PSNR
    refined_scene = refinement.of(scene)
    errors = []
    for view in cameras():  # with the slow float64 rasterizer
        before, after = (render(each, ReferenceRasterizer(each), view).clamp(0, 1) for each in (scene, refined_scene))
        errors.append(float((after - before).square().mean()))
    assert psnr(max(errors)) == pytest.approx(refinement.lowest_psnr, abs=0.01)
    assert psnr(sum(errors) / len(errors)) == pytest.approx(refinement.psnr, abs=0.01)


def test_nothing_is_split_if_no_gaussian_is_large(tiny_weights: BackboneWeights) -> None:
    small = replace(wall(), scales=torch.full_like(wall().scales, -5.0))
    refinement = refinement_of(tiny_weights, 8.0, small)
    assert (refinement.split, refinement.gaussians, refinement.reverted) == (0, len(small), 0)
    assert refinement.psnr is None
    assert refinement.of(small) is small


def test_auto_splits_only_what_is_too_large_for_strokes(tiny_weights: BackboneWeights) -> None:
    scene, views = large_wall(), cameras()
    refinement = refine(
        JobInputs(scene, views, Style.of(style()), refine_settings(refine="auto"), weights=tiny_weights)
    )
    assert refinement is not None
    assert refinement.size is not None
    assert refinement.size >= module.STROKE_SIZE
    assert len(scene) < refinement.gaussians <= 2 * len(scene)
    prints, rasterizer = Footprints(scene), CpuRasterizer(scene)
    for view in views:
        prints.add(view, rasterizer.survey(view)[1])
    split = piece_counts(refinement.pieces) > 1
    assert float(prints.lengths[split].amax(dim=1).min()) > module.STROKE_SIZE


def test_splits_that_would_change_the_image_are_undone(
    tiny_weights: BackboneWeights, monkeypatch: pytest.MonkeyPatch
) -> None:
    """An impossible bound undoes all splits, and no bound undoes none."""
    monkeypatch.setattr(refining, "MIN_PSNR", 200.0)
    refinement = refinement_of(tiny_weights, 4.0)
    assert refinement.split == 0
    assert refinement.reverted > 0
    assert "are not split" in module.refine_decision(refinement, refine_settings(refine=4)).reason
    monkeypatch.setattr(refining, "MIN_PSNR", 0.0)
    loose = refinement_of(tiny_weights, 4.0)
    assert (loose.reverted, loose.split) == (0, refinement.reverted)


def test_stylizer_contains_the_refined_scene(tiny_weights: BackboneWeights) -> None:
    scene = large_wall()
    stylizer = Stylizer.planned(scene, cameras(), style(), refine_settings(refine=3), weights=tiny_weights)
    refinement = stylizer.job.plan.refinement
    assert refinement is not None
    assert len(stylizer.job.scene) == refinement.gaussians > len(scene)
    assert stylizer.job.plan.decisions[0].item == "refined Gaussians"
    assert len(stylizer.job.plan.seen) == refinement.gaussians
    run(stylizer)
    assert stylizer.stylized().shape == (refinement.gaussians, 3)
    parents, change = parents_of(refinement.pieces), stylizer.stylized() - stylizer.job.scene.sh_dc
    parent = int((piece_counts(refinement.pieces) > 1).nonzero()[0])
    children = change[parents == parent]
    assert float(children.std(dim=0).max()) > 0.01, "children have colors of their own"


def test_refinement_reports_its_progress(tiny_weights: BackboneWeights) -> None:
    reports: list[tuple[str, int, int]] = []
    refine(
        JobInputs(large_wall(), cameras(), Style.of(style()), refine_settings(refine=2.0), weights=tiny_weights),
        show=lambda now: reports.append((now.stage, now.step, now.total)),
    )
    stages = [*(("planning", done, 3) for done in range(4)), *(("refining", done, 3) for done in range(3))]
    assert reports == [*stages, ("refining", 0, 0)]


def on_a_rank(collectives: Collectives, factor: float) -> Refinement | None:
    """Refine the wall on one of several ranks, each of which runs this function in its own process."""
    weights = make_tiny_weights()
    return refine(
        JobInputs(large_wall(), cameras(), Style.of(style()), refine_settings(refine=factor), weights=weights),
        collectives=collectives,
    )


def halves() -> Regions:
    """Return regions of the wall: the left is frozen, the right has its own style, and the rest is background."""
    across = large_wall().means[:, 0]
    labels = torch.zeros(len(across), dtype=torch.uint8)
    labels[across < -0.5], labels[across > 0.5] = 1, 2
    own = Style.weighted([style().flip(0), style().flip(2)], [1, 3])
    return Regions((Region("rest"), Region("left", freeze=True), Region("right", style=own, weight=2.0)), labels)


def job(weights: BackboneWeights, **values: object) -> Stylizer:
    settings = make_settings("preview", steps_coarse=1, steps_sos=2, measure=0, coarsest_side=24, **values)
    both = Style.weighted([style(), style().flip(1)], [2, 1])
    return Stylizer.planned(large_wall(), cameras(), both, settings, weights=weights, regions=halves())


def stylized(stylizer: Stylizer) -> torch.Tensor:
    while stylizer.step < stylizer.job.total_steps:
        stylizer.run_step()
    return stylizer.stylized()


def test_frozen_gaussians_are_not_split_and_children_keep_regions(tiny_weights: BackboneWeights) -> None:
    settings, regions = make_settings("preview", refine=2.0), halves()
    free = refine(JobInputs(large_wall(), cameras(), Style.of(style()), settings, weights=tiny_weights))
    refinement = refine(
        JobInputs(large_wall(), cameras(), Style.of(style()), settings, weights=tiny_weights, regions=regions)
    )
    assert free is not None
    assert refinement is not None
    assert bool((piece_counts(free.pieces)[regions.frozen] > 1).any()), "nothing is proved"
    assert bool((piece_counts(refinement.pieces)[regions.frozen] == 1).all())
    assert refinement.split
    assert torch.equal(regions.refined(refinement).labels, regions.labels[parents_of(refinement.pieces)])


def test_all_controls_work_together(tiny_weights: BackboneWeights) -> None:
    values = {"refine": 2.0, "preserve_colors": "luminance", "scales": (1.0, 0.5), "warm_start": True}
    stylizer = job(tiny_weights, **values)
    before = stylizer.job.scene.sh_dc.clone()
    stylized_colors = stylized(stylizer)
    assert len(stylized_colors) > len(large_wall())
    assert stylizer.job.styles.regions is not None
    frozen = stylizer.job.styles.regions.frozen
    assert torch.equal(stylized_colors[frozen], before[frozen])
    assert not torch.equal(stylized_colors[~frozen], before[~frozen])
    assert bool(stylized_colors.isfinite().all())
    change = stylized_colors.double() - before.double()
    assert float((change - change.mean(dim=1, keepdim=True)).abs().max()) < 1e-6
    assert float(luminance(change).abs().max()) > 0.01
    assert torch.equal(stylized(job(tiny_weights, **values)), stylized_colors)


NUMBERS = [1, *range(3, MAX_PIECES + 1)]


def covariances(scene: Scene) -> Tensor:
    """Return covariances [N, 3, 3] in float64."""
    factors = (
        unit_rotations(torch.nn.functional.normalize(scene.quats.double())) * scene.scales.double().exp()[:, None, :]
    )
    return factors @ factors.transpose(1, 2)


def mixtures(children: Scene, parents: Tensor, count: int) -> tuple[Tensor, Tensor]:
    """Return opacity-weighted mean [N, 3] and covariance [N, 3, 3] of each parent's children, in float64."""
    opacity = torch.sigmoid(children.opacities.double())
    fraction = opacity / torch.zeros(count, dtype=torch.float64).index_add(0, parents, opacity)[parents]
    mean = torch.zeros(count, 3, dtype=torch.float64).index_add(0, parents, fraction[:, None] * children.means.double())
    apart = children.means.double() - mean[parents]
    own = covariances(children) + apart[:, :, None] * apart[:, None, :]
    return mean, torch.zeros(count, 3, 3, dtype=torch.float64).index_add(0, parents, fraction[:, None, None] * own)


@pytest.mark.parametrize("number", NUMBERS)
def test_split_axis_has_the_parents_variance_and_nearly_its_density(number: int) -> None:
    (offsets, weights), ratio = split_axis(number), ratio_of(number)
    assert len(offsets) == len(weights) == number
    assert weights.sum() == pytest.approx(1, abs=1e-14)
    assert weights @ offsets == pytest.approx(0, abs=1e-12)
    assert 1 / ratio**2 + weights @ offsets**2 == pytest.approx(1, abs=1e-11)
    x = np.linspace(-9, 9, 20001)
    density = np.exp(-(x**2) / 2) / math.sqrt(2 * math.pi)
    parts = np.exp(-(((x[:, None] - offsets) * ratio) ** 2) / 2) * ratio / math.sqrt(2 * math.pi)
    error = np.sqrt(((parts @ weights - density) ** 2).sum() / (density**2).sum())
    assert error < 0.03
    # Factor on the opacity of a child, which never exceeds the parent's.
    assert float((weights * ratio).max()) <= 1


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 2**31), st.lists(st.sampled_from(NUMBERS[:8]), min_size=3, max_size=3), st.floats(-8, 2))
def test_children_have_the_parents_mean_and_covariance(seed: int, numbers: list[int], log_scale: float) -> None:
    scene = cloud(30, seed=seed, log_scale=log_scale)
    pieces = torch.tensor(numbers, dtype=torch.uint8).repeat(30, 1)
    pieces[::3] = 1
    children, parents = split(scene, pieces), parents_of(pieces)
    assert len(children) == len(parents) == int(piece_counts(pieces).sum())
    mean, covariance = mixtures(children, parents, 30)
    expected = covariances(scene)
    size = expected.diagonal(dim1=1, dim2=2).sum(1)
    rounding = 1e-6 * scene.means.abs().amax(1).double()  # of positions stored in float32
    assert bool(((mean - scene.means).norm(dim=1) < 1e-5 * size.sqrt() + rounding).all())
    apart = (covariance - expected).flatten(1).norm(dim=1)
    assert bool((apart < 1e-5 * size + 10 * rounding * size.sqrt() + rounding**2).all())


def test_unsplit_gaussians_and_inherited_properties_are_bit_identical(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "_CHUNK", 50)
    scene = cloud(40, degree=2)
    pieces = torch.ones(40, 3, dtype=torch.uint8)
    pieces[3], pieces[17], pieces[18, 1] = torch.tensor([5, 4, 1]), torch.tensor([3, 3, 3]), 32
    children, parents = split(scene, pieces), parents_of(pieces)
    assert bool((parents[1:] >= parents[:-1]).all())
    for name in ("quats", "sh_dc", "sh_rest"):
        assert torch.equal(getattr(children, name), getattr(scene, name)[parents])
    unsplit = (piece_counts(pieces) == 1)[parents]
    for name in TENSORS:
        assert torch.equal(getattr(children, name)[unsplit], getattr(scene, name)[parents][unsplit])
    assert split(scene, torch.ones(40, 3, dtype=torch.uint8)) is scene


def test_extreme_gaussians_have_finite_children_or_are_not_split() -> None:
    """Cases are needles, points, huge and coincident Gaussians, and opacities of 0 and 1."""
    count = 9
    scene = replace(
        cloud(count, degree=1),
        means=torch.tensor([[0.0, 0.0, 4.0]]).repeat(count, 1),
        scales=torch.tensor(
            [
                [10.0, -40, -40],
                [-59.0] * 3,
                [59.0] * 3,
                [-1.0] * 3,
                [-1.0] * 3,
                [3e38] * 3,
                [-3e38] * 3,
                [0.0] * 3,
                [0.0] * 3,
            ]
        ),
        opacities=torch.tensor([0.0, 0, 0, -3.4e38, 3.4e38, 0, 0, 90, -90]),
    )
    scene.quats[7] = 0
    scene.quats[8] *= 1e-30
    possible = can_be_split(scene)
    assert possible.tolist() == [True, True, True, True, True, False, False, False, True]
    pieces = torch.ones(count, 3, dtype=torch.uint8)
    pieces[possible] = torch.tensor([4, 3, 5], dtype=torch.uint8)
    children = split(scene, pieces)
    for name in TENSORS:
        assert bool(torch.isfinite(getattr(children, name)).all()), name
    opacity = torch.sigmoid(children.opacities.double())
    assert bool((opacity <= torch.sigmoid(scene.opacities.double())[parents_of(pieces)]).all())
    pieces[5, 0] = 3
    with pytest.raises(ValueError, match="extreme"):
        split(scene, pieces)


@pytest.mark.parametrize("pieces", [[[2, 1, 1]], [[0, 1, 1]], [[33, 1, 1]], [[1, 1, 1], [1, 1, 1]]])
def test_invalid_piece_counts_are_refused(pieces: list[list[int]]) -> None:
    with pytest.raises(ValueError, match="pieces must be"):
        split(single((0, 0, 3)), torch.tensor(pieces, dtype=torch.uint8))


@pytest.mark.parametrize(("opacity", "least"), [(0.1, 45.0), (0.4, 40.0), (0.7, 33.0)])
def test_split_gaussian_looks_like_its_parent(opacity: float, least: float) -> None:
    """A single white Gaussian on black is the hardest case, because nothing around it hides a change."""
    scene = single((0.1, 0, 4.0), opacity=opacity, scales=(0.5, 0.3, 0.02), quat=(0.9, 0.1, 0.1, 0.3))
    pieces = torch.tensor([[6, 4, 1]], dtype=torch.uint8)
    images = []
    for each in (scene, split(scene, pieces)):
        images.append(ReferenceRasterizer(each).render(torch.ones(len(each), 3), camera()))
    error = float((images[0] - images[1]).square().mean())
    assert -10 * math.log10(error) > least


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
