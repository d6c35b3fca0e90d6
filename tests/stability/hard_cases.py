"""Shared check of the tests that run the hard cases of `make stability`."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import pytest

from benchmarks.stability import Case, measure

#: Maximum growth of memory. Three jobs with VGG16 need 1.5 GB; an allocation error takes many gigabytes.
LARGEST_GROWTH = 3 << 30


def parameters(cases: Sequence[Case | str]) -> list[Any]:
    """Return all cases as parameters of a test; five of six are for the slow tests."""
    return [case if place % 6 == 0 else pytest.param(case, marks=pytest.mark.slow) for place, case in enumerate(cases)]


def check(case: Case) -> None:
    """Run the small version of a case, and check its error bound and memory limit."""
    actual = measure(case)
    result = actual.result
    assert result.passed, f"{case.name}: {case.measure} {result.error:.3g}, bound {result.bound:.3g}. {result.note}"
    assert actual.peak_growth < LARGEST_GROWTH, actual.peak_growth
