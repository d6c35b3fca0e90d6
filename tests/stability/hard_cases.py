"""How the tests run the table of hard cases."""

from __future__ import annotations

from sgsst_core.bench.stability import Case, measure

#: No case needs more than some hundred megabytes; a runaway takes many gigabytes.
LARGEST_GROWTH = 1 << 30


def check(case: Case) -> None:
    """Run a case in its small size: within its bound, and without runaway memory."""
    found = measure(case)
    result = found.result
    assert result.passed, f"{case.name}: {case.measure} {result.error:.3g}, bound {result.bound:.3g}. {result.note}"
    assert found.peak_growth < LARGEST_GROWTH
