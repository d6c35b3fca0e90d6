"""Tests of content weights by region: loss and maps compared with float64 references, and whole jobs."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest
import torch
from torch import Tensor

from benchmarks.stability.sos_reference import sos_reference
from sgsst_core.errors import SettingsError
from sgsst_core.features.network_weights import BackboneWeights
from sgsst_core.features.vgg import FeatureNetwork
from sgsst_core.loss.sos import SosLoss, SosResult
from sgsst_core.quality.measure import Float32Reference
from sgsst_core.rasterizer.cpu import CpuRasterizer
from sgsst_core.rasterizer.reference import ReferenceRasterizer
from sgsst_core.regions.definition import Region, Regions, check_regions
from sgsst_core.regions.maps import ContentMaps
from sgsst_core.settings import make_settings
from sgsst_core.style import Style
from sgsst_core.stylizing.loop import run
from sgsst_core.stylizing.stylizer import Stylizer
from tests.sgsst_core.synthetic_images import relative_error, synthetic_image
from tests.small_scenes import ball, cameras, style, wall

SIZE = (112, 150)

pytestmark = pytest.mark.usefixtures("one_thread")


# --- loss ----------------------------------------------------------------------------------------------------------


def images() -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Return image, style, content, coverage and relative content weights, at most the coverage, of a view."""
    image, look, content, coverage = (synthetic_image(*SIZE, seed=seed) for seed in (1, 2, 3, 4))
    coverage = coverage[:, :, 0]
    coverage[:20] = 0
    weights = coverage * synthetic_image(*SIZE, seed=5)[:, :, 0] ** 4
    weights[:, :40] = 0
    return image, look, content, coverage, weights


def evaluate(
    network: FeatureNetwork, coverage: Tensor | None, weights: Tensor | None, tile_size: int | None
) -> SosResult:
    image, look, content, *_ = (each.to(network.dtype) for each in images())
    loss = SosLoss(network, content_weight=2e3, coarsest=60, tile_size=tile_size)
    view = loss.targets.of_view(content, coverage)
    view.content_weights = None if weights is None else loss.targets.position_weights(weights)
    return loss.evaluate(image, loss.targets.of_style(Style.of(look), SIZE), view)


@pytest.mark.parametrize(("tile_size", "covered"), [(None, False), (64, True)])
def test_loss_agrees_with_autograd(tiny_weights: BackboneWeights, tile_size: int | None, covered: bool) -> None:
    image, look, content, coverage, weights = images()
    given = coverage if covered else None
    expected, gradient = sos_reference(
        tiny_weights,
        image,
        look,
        content,
        content_weight=2e3,
        coverage=given,
        content_weights=weights,
        coarsest=60,
    )
    for dtype, bound in ((torch.float64, 1e-9), (torch.float32, 1e-5)):
        result = evaluate(FeatureNetwork(tiny_weights, dtype=dtype), given, weights, tile_size)
        assert result.loss == pytest.approx(expected, rel=bound)
        assert result.image_gradient is not None
        assert relative_error(result.image_gradient, gradient) < bound


def test_content_weight_of_1_everywhere_is_bit_identical_to_none(tiny_weights: BackboneWeights) -> None:
    coverage = images()[3]
    actual, wanted = (evaluate(FeatureNetwork(tiny_weights), coverage, own, None) for own in (coverage, None))
    assert torch.equal(actual.values, wanted.values)
    assert actual.image_gradient is not None
    assert wanted.image_gradient is not None
    assert torch.equal(actual.image_gradient, wanted.image_gradient)


def test_only_the_content_term_depends_on_content_weights(tiny_weights: BackboneWeights) -> None:
    coverage = images()[3]
    network = FeatureNetwork(tiny_weights, dtype=torch.float64)
    half, whole = (evaluate(network, coverage, own, None) for own in (coverage / 2, coverage))
    for scale, terms in whole.terms.items():
        for name, value in terms.items():
            expected = value / 2 if name == "content" else value
            assert half.terms[scale][name] == pytest.approx(expected, rel=1e-12)


# --- maps ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("weights", [(1.0, 3e4, 0.0), (1e-3, 1e12, 5.0)])
def test_maps_are_blended_weights(weights: tuple[float, ...]) -> None:
    """Small weights are accurate beside large ones, over any background."""
    scene, view = ball(), cameras()[0]
    labels = (torch.arange(len(scene)) % 7).clamp(max=2)
    by_gaussian = torch.tensor(weights)[labels]
    black = ReferenceRasterizer(scene)
    expected = torch.zeros(view.height, view.width, dtype=torch.float64)
    for label, weight in enumerate(weights):
        member = (labels == label).double()[:, None].expand(-1, 3).contiguous()
        expected += weight / max(weights) * black.render(member, view)[:, :, 0]
    for rasterizer in (ReferenceRasterizer, CpuRasterizer):
        maps = ContentMaps(by_gaussian, rasterizer(scene, background=(0.2, 0.4, 0.6))).render(view)
        assert maps.shape == (view.height, view.width, 1)
        torch.testing.assert_close(maps[:, :, 0].double(), expected, atol=1e-5, rtol=1e-4)
    background = black.coverage(view) == 0
    assert bool(background.any())
    assert bool((maps[background] == 0).all())


def test_small_weights_are_not_lost_beside_large_ones() -> None:
    scene, view = wall(), cameras()[0]
    weights = torch.where(scene.means[:, 0] > 0.5, 1e12, 1.0)
    maps = ContentMaps(weights, CpuRasterizer(scene, background=(0.2, 0.4, 0.6))).render(view)
    left = maps[:, : view.width // 4, 0]
    coverage = CpuRasterizer(scene).coverage(view)[:, : view.width // 4]
    torch.testing.assert_close(left.double() * 1e12, coverage.double(), atol=1e-4, rtol=1e-4)


# --- regions -------------------------------------------------------------------------------------------------------


def protected(content_weight: float | None = 1e4, rest: Region | None = None, **treatment: Any) -> Regions:
    """Return regions of the wall whose right half has a content weight."""
    right = Region("right", content_weight=content_weight, **treatment)
    return Regions((rest or Region("rest"), right), (wall().means[:, 0] >= 0).to(torch.uint8))


@pytest.mark.parametrize(
    ("regions", "shares"),
    [
        (protected(), True),
        (protected(content_weight=0.0), True),
        (protected(content_weight=None), False),
        (protected(weight=2.0), False),
        (protected(weight=2.0, rest=Region("rest", weight=2.0)), True),
        (protected(style=Style.of(style())), False),
        (protected(rest=Region("rest", style=Style.of(style()))), False),
        (protected(rest=Region("rest", freeze=True)), False),
        (protected(rest=Region("rest", content_weight=5.0)), True),
    ],
)
def test_region_with_a_content_weight_alone_is_compared_together_with_the_rest(regions: Regions, shares: bool) -> None:
    assert torch.equal(regions.style_labels, torch.zeros_like(regions.labels) if shares else regions.labels)
    resolved = regions.resolved(torch.ones(len(regions.labels), dtype=torch.float64))
    frozen = regions.every[0].freeze
    assert resolved.active == ((0,) if shares else (1,) if frozen else (0, 1))
    assert torch.equal(resolved.labels, regions.labels)


def test_content_weight_of_each_gaussian() -> None:
    regions = protected(rest=Region("rest", content_weight=3.0))
    labels = regions.labels.bool()
    weights = regions.content_weights(1.0)
    assert weights is not None
    assert weights[labels].unique().tolist() == [1e4]
    assert weights[~labels].unique().tolist() == [3.0]
    assert protected(content_weight=None).content_weights(1.0) is None
    assert protected(content_weight=7.0).content_weights(7.0) is None
    empty = replace(protected(), labels=torch.zeros_like(regions.labels))
    assert empty.content_weights(1.0) is None


def test_region_needs_a_content_term() -> None:
    with pytest.raises(SettingsError, match="--content-weight 0 disables the content term"):
        check_regions(protected(), content_weight=0.0)
    check_regions(protected(content_weight=None), content_weight=0.0)
    check_regions(protected(), content_weight=1.0)


# --- jobs ----------------------------------------------------------------------------------------------------------


def make(weights: BackboneWeights, regions: Regions | None, **values: Any) -> Stylizer:
    settings = make_settings(**{"steps_coarse": 2, "steps_sos": 4, "coarsest_side": 24, **values})
    return Stylizer.planned(wall(), cameras(), style(), settings, weights=weights, regions=regions)


def test_content_weight_of_the_job_in_a_region_changes_nothing(tiny_weights: BackboneWeights) -> None:
    actual, wanted = make(tiny_weights, protected(1.0)), make(tiny_weights, None)
    for stylizer in (actual, wanted):
        run(stylizer)
    seen = wanted.job.plan.seen  # unseen Gaussians follow their neighbors in the same region
    assert torch.equal(actual.stylized()[seen], wanted.stylized()[seen])
    assert [record.loss for record in actual.history] == [record.loss for record in wanted.history]


@pytest.mark.slow
@pytest.mark.parametrize("treatment", [{"style": Style.of(style().flip(0, 2) ** 2)}])
def test_only_the_protected_region_stays_near_its_content(
    tiny_weights: BackboneWeights, treatment: dict[str, Any]
) -> None:
    scene = wall()
    options: dict[str, Any] = {"steps_sos": 25, "learning_rate_end": 0.02, "warm_start": False, "early_stop": False}
    plain, own = (make(tiny_weights, protected(weight, **treatment), **options) for weight in (1.0, 1e8))
    changes = []
    for stylizer in (plain, own):
        run(stylizer)
        changes.append((stylizer.stylized() - scene.sh_dc).square().sum(dim=1))
    seen, right = plain.job.plan.seen, scene.means[:, 0]
    parts = seen & (right > 0.7), seen & (right < -0.7)  # not near the border
    inside, outside = (float(changes[1][part].mean() / changes[0][part].mean()) for part in parts)
    assert inside < 0.8 * outside


def test_float32_reference_has_the_same_content_weights(tiny_weights: BackboneWeights) -> None:
    stylizer = make(tiny_weights, protected(), warm_start=False)
    scales = stylizer.job.scales(0)
    colors = torch.roll(wall().sh_dc, 1, dims=0)
    with stylizer.with_colors(colors):
        own = stylizer.gradient(0, scales)[0]
    exact = Float32Reference(stylizer).gradient(0, colors, scales)[0][stylizer.job.plan.seen]
    assert relative_error(own, exact) < 1e-6
    other = Float32Reference(make(tiny_weights, None, warm_start=False)).gradient(0, colors, scales)[0]
    assert relative_error(other[stylizer.job.plan.seen], exact) > 1e-2


def test_plan_and_report_state_the_content_weight(tiny_weights: BackboneWeights) -> None:
    stylizer = make(tiny_weights, protected())
    lines = {line.item: line.decision for line in stylizer.job.plan.decisions}
    assert lines["region right"].endswith("use the style, with content weight 10,000")
    assert "content weight" not in lines["region rest"]
    assert "regions" not in lines  # statistics are not weighted by region
