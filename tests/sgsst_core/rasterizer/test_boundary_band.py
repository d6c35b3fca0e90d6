"""Tests of `boundary_band`: it detects errors and tolerates differences at cutoffs."""

from __future__ import annotations

import pytest
import torch

from tests.sgsst_core.rasterizer.boundary_band import assert_close_outside_band, relative_error


def test_step_within_the_band_is_tolerated_and_counted() -> None:
    expected, band = torch.zeros(40, 50, 3), torch.zeros(40, 50, dtype=torch.bool)
    actual = expected.clone()
    actual[3, 4, 1] = 5e-3
    band[3, 4] = True
    band[7, 7] = True
    assert assert_close_outside_band(actual, expected, band, tolerance=1e-4) == 1


def test_error_outside_the_band_fails() -> None:
    expected, band = torch.zeros(40, 50, 3), torch.zeros(40, 50, dtype=torch.bool)
    band[3, 5] = True
    actual = expected.clone()
    actual[3, 4, 1] = 2e-4
    with pytest.raises(AssertionError, match="1 pixels outside"):
        assert_close_outside_band(actual, expected, band, tolerance=1e-4)


def test_step_too_large_for_a_cutoff_fails() -> None:
    expected, band = torch.zeros(40, 50, 3), torch.ones(40, 50, dtype=torch.bool)
    actual = expected.clone()
    actual[3, 4, 1] = 0.1
    with pytest.raises(AssertionError, match="cannot explain"):
        assert_close_outside_band(actual, expected, band, tolerance=1e-4)


def test_too_many_steps_and_non_finite_values_fail() -> None:
    expected, band = torch.zeros(40, 50), torch.ones(40, 50, dtype=torch.bool)
    with pytest.raises(AssertionError, match="of the pixels flip"):
        assert_close_outside_band(expected + 1e-3, expected, band, tolerance=1e-4)
    with pytest.raises(AssertionError, match="not finite"):
        assert_close_outside_band(expected * torch.nan, expected, band, tolerance=1e-4)


def test_relative_error_of_zeros_is_zero() -> None:
    assert relative_error(torch.zeros(3), torch.zeros(3)) == 0
    assert relative_error(torch.tensor([1.0, 1.1]), torch.tensor([1.0, 1.0])) == pytest.approx(0.1 / 2**0.5, rel=1e-5)
