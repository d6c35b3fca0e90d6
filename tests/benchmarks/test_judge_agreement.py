"""Tests of the agreement of judges, and that the document shows that of the stored results."""

from __future__ import annotations

import math
from pathlib import Path

import pytest

from benchmarks.judge_agreement import agreement, stored_runs, table

ROOT = Path(__file__).resolve().parents[2]


def runs(*figures: tuple[float | None, float | None]) -> list[dict[str, float | None]]:
    return [{"style": style, "content": content} for style, content in figures]


def test_ranks_are_compared_within_pairs() -> None:
    """Ranks 1 2 3 4 and 1 2 4 3: 1 - 6 * 2 / (4 * 15) = 0.8; opposite ranks of three runs: -1."""
    alike = runs((1, 10), (2, 20), (3, 90), (4, 80))
    opposite = runs((0.1, 3), (0.2, 2), (0.3, 1))
    assert agreement([alike], "style", "content") == (pytest.approx(0.8), 4)
    assert agreement([alike, opposite], "style", "content") == (pytest.approx((4 * 0.8 - 3) / 7), 7)


def test_runs_without_a_figure_and_equal_figures_do_not_count() -> None:
    for pair in (runs((1, 1), (2, 2), (3, None)), runs((1, 1), (2, 1), (3, 1)), [{"style": 1.0}] * 4):
        correlation, count = agreement([pair], "style", "content")
        assert math.isnan(correlation)
        assert count == 0


def test_document_shows_the_stored_results() -> None:
    assert table(stored_runs()) in (ROOT / "benchmarks" / "results" / "README.md").read_text()
