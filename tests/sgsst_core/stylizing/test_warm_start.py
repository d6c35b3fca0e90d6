"""Colours that start with the style's mean and covariance."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from sgsst_core.constants import SH_C0
from sgsst_core.stylizing.warm_start import warm_start
from tests.sgsst_core.pictures import picture


def moments(colours: Tensor, weights: Tensor) -> tuple[Tensor, Tensor]:
    """Weighted mean and covariance, written out once more."""
    share = weights / weights.sum()
    mean = (colours * share[:, None]).sum(0)
    covariance = torch.zeros(3, 3, dtype=torch.float64)
    for i in range(3):
        for j in range(3):
            covariance[i, j] = (share * (colours[:, i] - mean[i]) * (colours[:, j] - mean[j])).sum()
    return mean, covariance


def colours_of(sh_dc: Tensor) -> Tensor:
    return 0.5 + SH_C0 * sh_dc.double()


@pytest.mark.parametrize("scale", [1e-12, 1.0, 1e9])
def test_weighted_mean_and_covariance_become_the_styles(scale: float) -> None:
    generator = torch.Generator().manual_seed(0)
    # a style of little contrast in the middle of the range, so that no colour is clamped
    style = 0.45 + 0.1 * picture(40, 50, seed=3).float()
    sh_dc = torch.randn(500, 3, generator=generator) @ torch.tensor([[1.0, 0.5, 0], [0, 1, 0.3], [0, 0, 0.2]])
    weights = scale * torch.rand(500, generator=generator, dtype=torch.float64) ** 4
    found = moments(colours_of(warm_start(sh_dc, weights, style)), weights)
    pixels = style.reshape(-1, 3).double()
    wanted = moments(pixels, torch.ones(len(pixels), dtype=torch.float64))
    torch.testing.assert_close(found[0], wanted[0], rtol=1e-5, atol=1e-6)
    torch.testing.assert_close(found[1], wanted[1], rtol=1e-4, atol=1e-8)


def test_colours_that_match_already_stay() -> None:
    style = picture(30, 30, seed=2).float()
    sh_dc = (style.reshape(-1, 3) - 0.5) / SH_C0
    found = warm_start(sh_dc, torch.ones(len(sh_dc), dtype=torch.float64), style)
    torch.testing.assert_close(found, sh_dc, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("case", ["grey scene", "one colour", "one Gaussian", "style of one colour", "black style"])
def test_flat_scenes_and_styles_give_finite_colours_in_range(case: str) -> None:
    generator = torch.Generator().manual_seed(1)
    style = picture(30, 30, seed=2).float()
    sh_dc = torch.randn(50, 3, generator=generator)
    if case == "grey scene":
        sh_dc = sh_dc[:, :1].expand(-1, 3).contiguous()
    elif case == "one colour":
        sh_dc = torch.full((50, 3), 0.3)
    elif case == "one Gaussian":
        sh_dc = sh_dc[:1]
    elif case == "style of one colour":
        style = torch.full((10, 10, 3), 0.25)
    else:
        style = torch.zeros((10, 10, 3))
    found = colours_of(warm_start(sh_dc, torch.ones(len(sh_dc), dtype=torch.float64), style))
    assert bool(found.isfinite().all())
    assert -1e-6 <= float(found.min()) <= float(found.max()) <= 1 + 1e-6
    expected = style.reshape(-1, 3).double().mean(0)
    torch.testing.assert_close(found.mean(0), expected, rtol=0, atol=0.06)  # clamping moves the mean a little
