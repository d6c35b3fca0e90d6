"""Shared check of the tests that run the hard cases of `make stability`."""

from collections.abc import Sequence
from typing import Any

import pytest

from benchmarks.stability import Case, measure

#: Maximum growth of memory. Three jobs with VGG16 need 1.5 GB; an allocation error takes many gigabytes.
LARGEST_GROWTH = 3 << 30
#: Number of cases in other ways than float32 of which one is tested. It has no factor in common with their number.
_OTHERS = 7


def parameters(cases: Sequence[Case | str]) -> list[Any]:
    """Return cases as parameters of a test: all of float32, and some of other ways; `make stability` runs all.

    Five of six are for the slow tests.
    """
    single = [case for case in cases if isinstance(case, str) or case.way == "float32"]
    others = [case for case in cases if case not in single][::_OTHERS]
    return [
        case if place % 6 == 0 else pytest.param(case, marks=pytest.mark.slow)
        for place, case in enumerate([*single, *others])
    ]


def check(case: Case) -> None:
    """Run the small version of a case, and check its error bound and memory limit."""
    actual = measure(case)
    result = actual.result
    assert result.passed, f"{case.name}: {case.measure} {result.error:.3g}, bound {result.bound:.3g}. {result.note}"
    assert actual.peak_growth < LARGEST_GROWTH, actual.peak_growth
