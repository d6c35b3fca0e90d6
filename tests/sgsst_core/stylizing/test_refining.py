"""Tests of refining a scene of large Gaussians: images hardly change, and only large Gaussians are split."""

from dataclasses import replace

import pytest
import torch

from sgsst_core import refine as choice
from sgsst_core.features.network_weights import BackboneWeights
from sgsst_core.parallel.collectives import Collectives
from sgsst_core.planning.survey import psnr
from sgsst_core.rasterizer.cpu import CpuRasterizer
from sgsst_core.rasterizer.reference import ReferenceRasterizer
from sgsst_core.refine import MIN_PSNR, Footprints, Refinement, parents_of, piece_counts
from sgsst_core.regions import Region, Regions
from sgsst_core.scene.colors import luminance
from sgsst_core.scene.gaussians import TENSORS, Scene
from sgsst_core.settings import Settings, make_settings
from sgsst_core.style import Style
from sgsst_core.stylizing import refining
from sgsst_core.stylizing.job import JobInputs
from sgsst_core.stylizing.loop import run
from sgsst_core.stylizing.refining import disagreement, refine, render
from sgsst_core.stylizing.stylizer import Stylizer
from tests.networks import tiny_weights as make_tiny_weights
from tests.sgsst_core.splat_scenes import camera, cloud
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


def settings(**values: object) -> Settings:
    return make_settings("preview", steps_coarse=0, steps_sos=2, measure=0, **values)


def refinement_of(weights: BackboneWeights, factor: float, scene: Scene | None = None) -> Refinement:
    refinement = refine(
        JobInputs(scene or large_wall(), cameras(), Style.of(style()), settings(refine=factor), weights=weights)
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
    refinement = refine(JobInputs(scene, views, Style.of(style()), settings(refine="auto"), weights=tiny_weights))
    assert refinement is not None
    assert refinement.size is not None
    assert refinement.size >= choice.STROKE_SIZE
    assert len(scene) < refinement.gaussians <= 2 * len(scene)
    prints, rasterizer = Footprints(scene), CpuRasterizer(scene)
    for view in views:
        prints.add(view, rasterizer.survey(view)[1])
    split = piece_counts(refinement.pieces) > 1
    assert float(prints.lengths[split].amax(dim=1).min()) > choice.STROKE_SIZE


def test_splits_that_would_change_the_image_are_undone(
    tiny_weights: BackboneWeights, monkeypatch: pytest.MonkeyPatch
) -> None:
    """An impossible bound undoes all splits, and no bound undoes none."""
    monkeypatch.setattr(refining, "MIN_PSNR", 200.0)
    refinement = refinement_of(tiny_weights, 4.0)
    assert refinement.split == 0
    assert refinement.reverted > 0
    assert "are not split" in choice.refine_decision(refinement, settings(refine=4)).reason
    monkeypatch.setattr(refining, "MIN_PSNR", 0.0)
    loose = refinement_of(tiny_weights, 4.0)
    assert (loose.reverted, loose.split) == (0, refinement.reverted)


def test_stylizer_contains_the_refined_scene(tiny_weights: BackboneWeights) -> None:
    scene = large_wall()
    stylizer = Stylizer.planned(scene, cameras(), style(), settings(refine=3), weights=tiny_weights)
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
        JobInputs(large_wall(), cameras(), Style.of(style()), settings(refine=2.0), weights=tiny_weights),
        show=lambda now: reports.append((now.stage, now.step, now.total)),
    )
    stages = [(stage, done, 3) for stage in ("planning", "refining") for done in range(3)]
    assert reports == [*stages, ("refining", 0, 0)]


def on_a_rank(collectives: Collectives, factor: float) -> Refinement | None:
    """Refine the wall on one of several ranks, each of which runs this function in its own process."""
    weights = make_tiny_weights()
    return refine(
        JobInputs(large_wall(), cameras(), Style.of(style()), settings(refine=factor), weights=weights),
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
    assert stylizer.job.regions is not None
    frozen = stylizer.job.regions.frozen
    assert torch.equal(stylized_colors[frozen], before[frozen])
    assert not torch.equal(stylized_colors[~frozen], before[~frozen])
    assert bool(stylized_colors.isfinite().all())
    change = stylized_colors.double() - before.double()
    assert float((change - change.mean(dim=1, keepdim=True)).abs().max()) < 1e-6
    assert float(luminance(change).abs().max()) > 0.01
    assert torch.equal(stylized(job(tiny_weights, **values)), stylized_colors)
