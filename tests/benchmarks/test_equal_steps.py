"""Tests of the sliced color distance between image and style, which is not optimized by any loss term."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from benchmarks.equal_steps import quantiles, sliced_distance


def _noise(height: int = 40, width: int = 30) -> Tensor:
    return torch.rand((height, width, 3), generator=torch.Generator().manual_seed(3))


def _palette(image: Tensor) -> Tensor:
    return quantiles(image, torch.ones(image.shape[:2]))


def test_color_distance_ignores_pixel_order() -> None:
    image = _noise()
    order = torch.randperm(1200, generator=torch.Generator().manual_seed(5))
    shuffled = image.reshape(-1, 3)[order].reshape(30, 40, 3)
    assert sliced_distance([shuffled, shuffled], _palette(image)) == pytest.approx(0, abs=1e-6)


def test_distance_of_two_colors_averages_directions() -> None:
    """Along uniformly distributed directions, a difference d has the mean square d^2 / 3. Here 64 are sampled."""
    first, second = torch.full((4, 4, 3), 0.2), torch.tensor([0.9, 0.5, 0.2]).expand(7, 3, 3)
    distance = sliced_distance([first, first], _palette(second))
    assert distance == pytest.approx(255 * math.hypot(0.7, 0.3) / math.sqrt(3), rel=0.1)


def test_uncovered_pixels_are_ignored() -> None:
    image = _noise()
    covered = torch.rand(image.shape[:2], generator=torch.Generator().manual_seed(4)) < 0.5
    on_black, on_white = image.clone(), image.clone()
    on_black[~covered], on_white[~covered] = 0.0, 1.0
    seen = image[covered][:, None]
    assert sliced_distance([on_black, on_white], _palette(seen)) == pytest.approx(0, abs=1e-4)
    assert sliced_distance([on_black, on_black], _palette(seen)) > 10  # uncovered black pixels would count
