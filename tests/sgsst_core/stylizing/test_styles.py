"""Tests of transfers of the style's colors: before the first step, in previews, and after the last step."""

from collections.abc import Callable
from typing import Any

import pytest
import torch
from torch import Tensor

from sgsst_core.constants import SH_C0
from sgsst_core.features.network_weights import BackboneWeights
from sgsst_core.regions import Region, Regions
from sgsst_core.scene.gaussians import Scene
from sgsst_core.settings import make_settings
from sgsst_core.style import Style
from sgsst_core.stylizing.loop import run
from sgsst_core.stylizing.styles import (
    _drawn,
    luminance_start,
    transported,
    warm_start,
    with_moments,
)
from sgsst_core.stylizing.stylizer import Stylizer, render_first_view
from tests.sgsst_core.synthetic_images import synthetic_image
from tests.sgsst_core.test_regions import halves
from tests.small_scenes import cameras, style, wall

Start = Callable[[Tensor, Tensor, Style], Tensor]


def moments(colors: Tensor, weights: Tensor) -> tuple[Tensor, Tensor]:
    """Compute weighted mean and covariance of colors in plain loops."""
    share = weights / weights.sum()
    mean = (colors * share[:, None]).sum(0)
    covariance = torch.zeros(3, 3, dtype=torch.float64)
    for i in range(3):
        for j in range(3):
            covariance[i, j] = (share * (colors[:, i] - mean[i]) * (colors[:, j] - mean[j])).sum()
    return mean, covariance


def colors_of(sh_dc: Tensor) -> Tensor:
    return 0.5 + SH_C0 * sh_dc.double()


@pytest.mark.parametrize("scale", [1e-12, 1.0, 1e9])
def test_weighted_mean_and_covariance_match_the_style(scale: float) -> None:
    generator = torch.Generator().manual_seed(0)
    # A style of low contrast in the middle of the range, so that no color is clamped.
    style = 0.45 + 0.1 * synthetic_image(40, 50, seed=3).float()
    sh_dc = torch.randn(500, 3, generator=generator) @ torch.tensor([[1.0, 0.5, 0], [0, 1, 0.3], [0, 0, 0.2]])
    weights = scale * torch.rand(500, generator=generator, dtype=torch.float64) ** 4
    actual = moments(colors_of(with_moments(sh_dc, weights, Style.of(style))), weights)
    pixels = style.reshape(-1, 3).double()
    wanted = moments(pixels, torch.ones(len(pixels), dtype=torch.float64))
    torch.testing.assert_close(actual[0], wanted[0], rtol=1e-5, atol=1e-6)
    torch.testing.assert_close(actual[1], wanted[1], rtol=1e-4, atol=1e-8)


@pytest.mark.parametrize("start", [with_moments, luminance_start])
def test_extreme_color_does_not_flatten_the_others(start: Start) -> None:
    style = synthetic_image(30, 30, seed=2).float()
    sh_dc = (torch.rand(2000, 3, generator=torch.Generator().manual_seed(0)) - 0.5) / SH_C0
    extreme = sh_dc.clone()
    extreme[0] = 1e4
    ones = torch.ones(2000, dtype=torch.float64)
    usual = start(sh_dc, ones, Style.of(style))
    torch.testing.assert_close(start(extreme, ones, Style.of(style))[1:], usual[1:], rtol=0, atol=0.02)


def test_dark_scene_gets_both_colors_of_a_bright_style() -> None:
    """Matching only mean and covariance gives the brighter color to most Gaussians that should get the darker one."""
    style = torch.full((30, 30, 3), 0.9)
    style[:10] = torch.tensor([0.1, 0.2, 0.6])
    generator = torch.Generator().manual_seed(4)
    sh_dc = (0.2 * torch.rand(3000, 1, generator=generator) ** 4 - 0.5).expand(-1, 3) / SH_C0
    colors = colors_of(warm_start(sh_dc, torch.ones(3000, dtype=torch.float64), Style.of(style)))
    blue = (colors - style[0, 0]).norm(dim=1) < 0.1
    white = (colors - style[-1, 0]).norm(dim=1) < 0.1
    assert float(blue.double().mean()) == pytest.approx(1 / 3, abs=0.02)
    assert float(white.double().mean()) == pytest.approx(2 / 3, abs=0.02)


def test_style_images_count_by_their_weights() -> None:
    """Colors are as frequent as in the mixture, whatever the sizes of the images."""
    images = [torch.full((8, 8, 3), 0.2), torch.full((300, 400, 3), 0.8)]
    mixture = Style.weighted(images, [3.0, 1.0])
    sh_dc = torch.randn(4000, 3, generator=torch.Generator().manual_seed(5))
    colors = colors_of(warm_start(sh_dc, torch.ones(4000, dtype=torch.float64), mixture))
    assert float((colors < 0.5).all(dim=1).double().mean()) == pytest.approx(0.75, abs=0.02)


RANDOM, TEXTURE = (
    torch.randn(50, 3, generator=torch.Generator().manual_seed(1)),
    synthetic_image(30, 30, seed=2).float(),
)


@pytest.mark.parametrize("start", [with_moments, warm_start])
@pytest.mark.parametrize(
    ("sh_dc", "style"),
    [
        (RANDOM[:, :1].expand(-1, 3).contiguous(), TEXTURE),
        (torch.full((50, 3), 0.3), TEXTURE),
        (RANDOM[:1], TEXTURE),
        (RANDOM, torch.full((10, 10, 3), 0.25)),
        (RANDOM, torch.zeros((10, 10, 3))),
    ],
    ids=["gray scene", "one color", "one Gaussian", "style of one color", "black style"],
)
def test_flat_scenes_and_styles_give_finite_colors_in_range(sh_dc: Tensor, style: Tensor, start: Start) -> None:
    colors = colors_of(start(sh_dc, torch.ones(len(sh_dc), dtype=torch.float64), Style.of(style)))
    assert bool(colors.isfinite().all())
    assert -1e-6 <= float(colors.min()) <= float(colors.max()) <= 1 + 1e-6
    expected = style.reshape(-1, 3).double().mean(0)
    torch.testing.assert_close(colors.mean(0), expected, rtol=0, atol=0.06)  # clamping changes the mean slightly


def colors(count: int, seed: int) -> Tensor:
    """Return two clusters of colors, one of them long and thin."""
    generator = torch.Generator().manual_seed(seed)
    heap = 0.2 + 0.05 * torch.randn(count, 3, generator=generator, dtype=torch.float64)
    long = 0.7 + 0.2 * torch.randn(count, 1, generator=generator, dtype=torch.float64) * torch.tensor([0.6, 0.3, -0.7])
    chosen = torch.rand(count, 1, generator=generator) < 0.3
    return torch.where(chosen, heap, long + 0.01 * torch.randn(count, 3, generator=generator)).clamp(0, 1)


def weights(count: int, seed: int) -> Tensor:
    return torch.rand(count, generator=torch.Generator().manual_seed(seed), dtype=torch.float64) ** 4


def distance(first: Tensor, second: Tensor) -> float:
    """Return the mean distance between the quantiles of two color distributions along many directions."""
    directions = torch.randn(50, 3, generator=torch.Generator().manual_seed(9), dtype=torch.float64)
    shares = torch.linspace(0, 1, 300, dtype=torch.float64)
    parts = [
        (torch.quantile(first @ direction, shares) - torch.quantile(second @ direction, shares)).abs().mean()
        for direction in directions / directions.norm(dim=1, keepdim=True)
    ]
    return float(torch.stack(parts).mean())


def sampled(own: Tensor, weight: Tensor) -> Tensor:
    indices, counts = _drawn(weight)
    return own[indices.repeat_interleave(counts)]


@pytest.mark.parametrize("scale", [1e-12, 1.0, 1e9])
def test_weighted_colors_get_the_target_distribution(scale: float) -> None:
    own, count, wanted = colors(4000, 0), scale * weights(4000, 1), 1 - colors(3000, 2)
    actual = transported(own, count, wanted)
    assert distance(sampled(own, count), wanted) > 0.1
    assert distance(sampled(actual, count), wanted) < 0.01


CAMERA = cameras(1)[0]


@pytest.mark.parametrize(
    ("values", "right"),
    [
        ({}, None),
        ({"sh_attenuation": 0.5, "background": (0.2, 0.4, 0.6)}, None),
        ({"preserve_colors": "luminance", "warm_start": True}, None),
        ({"preserve_colors": "match", "style_rotation": 30.0}, None),
        ({}, Region("right", freeze=True)),
        ({}, Region("right", style=Style.of(style().flip(2)))),
        ({}, Region("right", content_weight=1e4)),
    ],
    ids=["plain", "attenuated", "luminance", "match", "frozen", "own style", "content"],
)
def test_first_view_has_warm_start_colors(
    tiny_weights: BackboneWeights, values: dict[str, Any], right: Region | None
) -> None:
    scene = wall(sh_degree=1)
    scene.means[:5] += 1000  # the view does not show them
    settings, regions = (
        make_settings("preview", coarsest_side=24, **values),
        None if right is None else halves(scene, right=right),
    )
    planned = Stylizer.planned(scene, [CAMERA], style(), settings, weights=tiny_weights, regions=regions)
    views = planned.job.views
    expected = views.rasterizer.render(views.colors(0, planned.sh_dc), CAMERA)
    actual = render_first_view(scene, CAMERA, Style.of(style()), settings, regions)
    assert actual is not None
    assert torch.equal(actual, expected)
    assert not torch.equal(actual, views.unstylized(0))


pytestmark = pytest.mark.usefixtures("one_thread")


def make(
    weights: BackboneWeights, scene: Scene | None = None, regions: Regions | None = None, **values: Any
) -> Stylizer:
    settings = make_settings(**{"style_loss": "nnfm", "steps_sos": 6, "early_stop": False, **values})
    return Stylizer.planned(scene or wall(60, 40), cameras(), style(), settings, weights=weights, regions=regions)


def test_transfer_changes_results_but_not_optimized_colors(tiny_weights: BackboneWeights) -> None:
    stylizer = make(tiny_weights)
    run(stylizer)
    optimized = stylizer.sh_dc.detach().clone()
    rows = stylizer.job.plan.optimized
    assert rows.any()
    stylized = stylizer.stylized()
    weights = stylizer.job.plan.survey.total_blend_weights[stylizer.job.plan.seen]
    wanted = warm_start(optimized, weights, stylizer.job.styles.own)
    assert torch.equal(stylized[rows], wanted[rows[stylizer.job.plan.seen]])
    assert float((wanted - optimized).abs().mean()) > 0.01
    assert torch.equal(stylizer.sh_dc, optimized)
    assert torch.equal(stylizer.shown(), stylized[stylizer.job.plan.seen])
    assert any("after the last step" in line.decision for line in stylizer.job.plan.decisions)


def test_regions_get_colors_of_their_styles_and_frozen_ones_none(tiny_weights: BackboneWeights) -> None:
    scene = wall(60, 40)
    dark, bright = (Style.of(torch.full((40, 40, 3), gray)) for gray in (0.2, 0.7))
    labels = (scene.means[:, 0] > 0.5).to(torch.uint8)
    labels[scene.means[:, 1] > 1] = 2
    regions = Regions(
        (Region("rest", style=dark), Region("right", style=bright), Region("low", freeze=True)),
        labels,
    )
    stylizer = make(tiny_weights, scene, regions)
    run(stylizer)
    stylized = stylizer.stylized()
    assert torch.equal(stylized[labels == 2].view(torch.int32), scene.sh_dc[labels == 2].view(torch.int32))
    for place, gray in enumerate((0.2, 0.7)):
        own = 0.5 + SH_C0 * stylized[(labels == place) & stylizer.job.plan.optimized]
        assert float((own - gray).abs().max()) < 1e-3
