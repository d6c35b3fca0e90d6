"""Tests of the difference between two gradients."""

from __future__ import annotations

import math

import pytest
import torch

from sgsst_core.quality.measure import Difference


@pytest.mark.parametrize(
    ("actual", "exact", "error", "cosine"),
    [
        ([3.0, 4.0], [3.0, 4.0], 0.0, 1.0),
        ([6.0, 8.0], [3.0, 4.0], 1.0, 1.0),
        ([-4.0, 3.0], [3.0, 4.0], math.sqrt(2), 0.0),
        ([-3.0, -4.0], [3.0, 4.0], 2.0, -1.0),
        ([0.0, 0.0], [3.0, 4.0], 1.0, 0.0),
        ([1e-30, 0.0], [0.0, 0.0], 1.0, 0.0),
        ([0.0, 0.0], [0.0, 0.0], 0.0, 1.0),
        ([1e-30, 0.0], [2e-30, 0.0], 0.5, 1.0),  # squares underflow in float32
        ([1e30, 0.0], [2e30, 0.0], 0.5, 1.0),  # squares overflow
        ([math.nan, 0.0], [1.0, 0.0], math.inf, 0.0),
        ([math.inf, 0.0], [1.0, 0.0], math.inf, 0.0),
    ],
)
def test_difference_has_relative_error_and_cosine(
    actual: list[float], exact: list[float], error: float, cosine: float
) -> None:
    difference = Difference.of(torch.tensor(actual), torch.tensor(exact))
    assert (difference.relative_error, difference.cosine) == (pytest.approx(error), pytest.approx(cosine, abs=1e-12))
