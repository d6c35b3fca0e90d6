"""Tests of combined controls: regions of a refined scene, several styles in luminance, and all controls at once."""

from __future__ import annotations

import pytest
import torch

from sgsst_core.features.network_weights import BackboneWeights
from sgsst_core.refine import parents_of, piece_counts
from sgsst_core.regions import Region, Regions
from sgsst_core.scene.colors import luminance
from sgsst_core.settings import make_settings
from sgsst_core.style import Style
from sgsst_core.stylizing.job import JobInputs
from sgsst_core.stylizing.refining import refine
from sgsst_core.stylizing.stylizer import Stylizer
from tests.sgsst_core.stylizing.test_refining import large_wall
from tests.small_scenes import cameras, style

pytestmark = pytest.mark.usefixtures("one_thread")


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


@pytest.mark.parametrize("colors", ["luminance"])
def test_all_controls_work_together(tiny_weights: BackboneWeights, colors: str) -> None:
    values = {"refine": 2.0, "preserve_colors": colors, "scales": (1.0, 0.5), "warm_start": True}
    stylizer = job(tiny_weights, **values)
    before = stylizer.job.scene.sh_dc.clone()
    stylized_colors = stylized(stylizer)
    assert len(stylized_colors) > len(large_wall())
    assert stylizer.job.regions is not None
    frozen = stylizer.job.regions.frozen
    assert torch.equal(stylized_colors[frozen], before[frozen])
    assert not torch.equal(stylized_colors[~frozen], before[~frozen])
    assert bool(stylized_colors.isfinite().all())
    if colors == "luminance":
        change = stylized_colors.double() - before.double()
        assert float((change - change.mean(dim=1, keepdim=True)).abs().max()) < 1e-6
        assert float(luminance(change).abs().max()) > 0.01
    assert torch.equal(stylized(job(tiny_weights, **values)), stylized_colors)
