"""Check that tests apply to the hard cases of `sgsst bench stability`."""

from __future__ import annotations

from sgsst_core.bench.stability import Case, measure

#: Maximum growth of memory. No case needs more than a few hundred megabytes; an allocation error takes many gigabytes.
LARGEST_GROWTH = 1 << 30


def check(case: Case) -> None:
    """Check that a case in its small size stays within its error bound and the memory limit."""
    found = measure(case)
    result = found.result
    assert result.passed, f"{case.name}: {case.measure} {result.error:.3g}, bound {result.bound:.3g}. {result.note}"
    assert found.peak_growth < LARGEST_GROWTH
