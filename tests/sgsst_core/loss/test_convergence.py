"""Tests of early stopping."""

from __future__ import annotations

import math

import pytest

from sgsst_core.scales import has_converged, has_reached, smoothed, window_length


def test_windows_are_whole_rounds() -> None:
    assert window_length(1) == 24
    assert window_length(7) == 28
    assert window_length(97) == 97


def test_smoothed_loss_is_the_geometric_mean_of_the_last_steps() -> None:
    assert smoothed([100.0, 1.0, 4.0], 2) == pytest.approx(2.0)
    assert smoothed([8.0, 2.0], 10) == pytest.approx(4.0)
    assert smoothed([0.0, 0.0], 2) < 1e-200


def test_convergence_ignores_differences_between_views() -> None:
    """The losses of three views alternate in the ratio 1 : 10 : 100."""
    views = [1.0, 10.0, 100.0]
    falling = [views[step % 3] * math.exp(-0.01 * step) for step in range(120)]
    assert not has_converged(falling, 3)
    assert has_converged([views[step % 3] for step in range(60)], 3)
    assert not has_converged([views[step % 3] for step in range(47)], 3)  # less than two windows of 24


def test_rising_loss_counts_as_converged() -> None:
    assert has_converged([1.0 + 0.01 * step for step in range(60)], 1)


def test_target_is_reached_only_after_a_whole_round() -> None:
    assert not has_reached([0.1], 0.5, 2)
    assert has_reached([0.9, 0.2], 0.5, 2)
    assert not has_reached([0.9, 0.9], 0.5, 2)
