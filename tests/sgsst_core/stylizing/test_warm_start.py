"""Tests of initializing colors from the style's color distribution, or from its mean and covariance alone."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch
from torch import Tensor

from sgsst_core.constants import SH_C0
from sgsst_core.style import Style
from sgsst_core.stylizing.color_transfer import luminance_start, warm_start, with_moments
from tests.sgsst_core.synthetic_images import synthetic_image

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


@pytest.mark.parametrize("start", [with_moments, warm_start])
def test_matching_colors_are_unchanged(start: Start) -> None:
    style = synthetic_image(30, 30, seed=2).float()
    sh_dc = (style.reshape(-1, 3) - 0.5) / SH_C0
    started = start(sh_dc, torch.ones(len(sh_dc), dtype=torch.float64), Style.of(style))
    if start is with_moments:
        torch.testing.assert_close(started, sh_dc, rtol=1e-4, atol=1e-4)
    else:
        torch.testing.assert_close(colors_of(started), colors_of(sh_dc), rtol=0, atol=0.06)


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


@pytest.mark.parametrize("start", [with_moments, warm_start])
@pytest.mark.parametrize("case", ["gray scene", "one color", "one Gaussian", "style of one color", "black style"])
def test_flat_scenes_and_styles_give_finite_colors_in_range(case: str, start: Start) -> None:
    generator = torch.Generator().manual_seed(1)
    style = synthetic_image(30, 30, seed=2).float()
    sh_dc = torch.randn(50, 3, generator=generator)
    if case == "gray scene":
        sh_dc = sh_dc[:, :1].expand(-1, 3).contiguous()
    elif case == "one color":
        sh_dc = torch.full((50, 3), 0.3)
    elif case == "one Gaussian":
        sh_dc = sh_dc[:1]
    elif case == "style of one color":
        style = torch.full((10, 10, 3), 0.25)
    else:
        style = torch.zeros((10, 10, 3))
    colors = colors_of(start(sh_dc, torch.ones(len(sh_dc), dtype=torch.float64), Style.of(style)))
    assert bool(colors.isfinite().all())
    assert -1e-6 <= float(colors.min()) <= float(colors.max()) <= 1 + 1e-6
    expected = style.reshape(-1, 3).double().mean(0)
    torch.testing.assert_close(colors.mean(0), expected, rtol=0, atol=0.06)  # clamping changes the mean slightly
