"""Tests of color transport against a plain version without sampling, and on degenerate distributions."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from torch import Tensor

from sgsst_core.stylizing import color_transfer as warm_start
from sgsst_core.stylizing.color_transfer import _drawn, _round_axes, _rounds, _through, _through_compiled, transported

Array = NDArray[np.float64]


def colors(count: int, seed: int) -> Tensor:
    """Return two clusters of colors, one of them long and thin."""
    generator = torch.Generator().manual_seed(seed)
    heap = 0.2 + 0.05 * torch.randn(count, 3, generator=generator, dtype=torch.float64)
    long = 0.7 + 0.2 * torch.randn(count, 1, generator=generator, dtype=torch.float64) * torch.tensor([0.6, 0.3, -0.7])
    chosen = torch.rand(count, 1, generator=generator) < 0.3
    return torch.where(chosen, heap, long + 0.01 * torch.randn(count, 3, generator=generator)).clamp(0, 1)


def weights(count: int, seed: int) -> Tensor:
    return torch.rand(count, generator=torch.Generator().manual_seed(seed), dtype=torch.float64) ** 4


def plain(moved: Array, weight: Array, wanted: Array) -> Array:
    """Transport all colors by a reference implementation without sampling and interpolation.

    Along each direction, a value is replaced by the target value at the same cumulative weight.
    """
    moved = moved.copy()
    for axes in (rotation.numpy() for rotation in _round_axes()):
        rotated, targets = moved @ axes, np.sort(wanted @ axes, axis=0)
        for axis in range(3):
            order = np.argsort(rotated[:, axis])
            share = np.cumsum(weight[order]) - 0.5 * weight[order]
            places = np.linspace(0, weight.sum(), len(targets))
            rotated[order, axis] = np.interp(share, places, targets[:, axis])
        moved = rotated @ axes.T
    return moved


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


def test_axes_are_distinct_rotations() -> None:
    rotations = list(_round_axes())
    assert len(rotations) == warm_start.ROUNDS
    for rotation in rotations:
        torch.testing.assert_close(rotation @ rotation.T, torch.eye(3, dtype=torch.float64), rtol=0, atol=1e-14)
        assert torch.linalg.det(rotation) == pytest.approx(1)
    angles = [torch.arccos(((a.T @ b).trace() - 1) / 2) for i, a in enumerate(rotations) for b in rotations[:i]]
    assert min(angles) > 0.2


@pytest.mark.parametrize("scale", [1e-12, 1.0, 1e9])
def test_weighted_colors_get_the_target_distribution(scale: float) -> None:
    own, count, wanted = colors(4000, 0), scale * weights(4000, 1), 1 - colors(3000, 2)
    actual = transported(own, count, wanted)
    assert distance(sampled(own, count), wanted) > 0.1
    assert distance(sampled(actual, count), wanted) < 0.01


def test_transport_by_samples_and_knots_is_close_to_exact() -> None:
    own, count, wanted = colors(3000, 3), weights(3000, 4), 1 - colors(2000, 5)
    expected = torch.from_numpy(plain(own.numpy(), count.numpy(), wanted.numpy()))
    error = (transported(own, count, wanted) - expected).norm(dim=1)
    seen = count > 0.01  # colors with little weight may lie anywhere between their neighbors
    assert float(error[seen].median()) < 0.01
    assert float(error[seen].quantile(0.95)) < 0.06
    assert float((own - expected).norm(dim=1).median()) > 0.2


def test_matching_distribution_is_unchanged() -> None:
    own = colors(5000, 6)
    error = (transported(own, torch.ones(5000, dtype=torch.float64), own) - own).norm(dim=1)
    assert float(error.mean()) < 1e-3
    assert float(error.max()) < 0.06, "of the outermost ones, between which there is nothing"


def test_equal_colors_stay_equal_and_zero_weights_are_ignored() -> None:
    own, count, wanted = colors(500, 7), weights(500, 8), colors(500, 9)
    more = torch.cat([own, own[:100], 5 - own])
    less = torch.cat([count, torch.zeros(600, dtype=torch.float64)])
    actual = transported(more, less, wanted)
    torch.testing.assert_close(actual[:500], transported(own, count, wanted), rtol=0, atol=1e-12)
    torch.testing.assert_close(actual[500:600], actual[:100], rtol=0, atol=1e-12)


@pytest.mark.parametrize("size", [1e-9, 1e-3, 1.0, 1e6, 1e30])
def test_colors_of_any_size_get_close_to_the_target(size: float) -> None:
    own, wanted = size * (colors(800, 10) - 0.5), colors(900, 11)
    actual = transported(own, torch.ones(800, dtype=torch.float64), wanted)
    assert bool(actual.isfinite().all())
    assert float(actual.min()) > -0.3
    assert float(actual.max()) < 1.3
    torch.testing.assert_close(actual.mean(0), wanted.mean(0), rtol=0, atol=0.05)


def test_nearly_equal_colors_become_the_mean() -> None:
    wanted = colors(1000, 12)
    own = torch.full((100_000, 3), 0.1, dtype=torch.float64)
    own += 1e-9 * torch.randn(own.shape, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    actual = transported(own, torch.ones(len(own), dtype=torch.float64), wanted)
    torch.testing.assert_close(actual.mean(0), wanted.mean(0), rtol=0, atol=1e-3)
    assert float(actual.std(0).max()) < 1e-6


@pytest.mark.parametrize("case", ["heaps", "far", "flat", "two"])
def test_compiled_kernel_agrees_with_tensor_operations(case: str) -> None:
    own, count, wanted = colors(3000, 13), weights(3000, 14), colors(700, 15)
    if case == "far":  # most knots fall into one cell
        own[::100] *= 50
    if case == "flat":
        own[:] = 0.3
    if case == "two":
        own[:] = torch.where(own[:, :1] < own[:, :1].median(), 0.2, 0.7)
    begun = own.clamp(-10, 10)
    indices, counts = _drawn(count)
    rounds = _rounds(begun[indices], counts, wanted)
    outside = torch.cat([begun, 3 * begun - 1, torch.full((1, 3), -10.0), torch.full((1, 3), 10.0)])
    for only in rounds:  # one round at a time, because slopes of up to 1e6 amplify rounding errors
        torch.testing.assert_close(_through_compiled(outside, [only]), _through(outside, [only]), rtol=0, atol=1e-8)
    errors = (_through_compiled(outside, rounds) - _through(outside, rounds)).abs()
    assert float(errors.median()) < 1e-12
