"""Tests of numbers as texts for people."""

from __future__ import annotations

import pytest

from sgsst_core.progress import duration


@pytest.mark.parametrize(
    ("seconds", "text"),
    [
        (0.31234, "0.312 s"),
        (59, "59 s"),
        (61, "1 min 01 s"),
        (3599.6, "1 h 00 min"),
        (4900, "1 h 22 min"),
        (75200, "20 h 53 min"),
        (None, "–"),
    ],
)
def test_duration_is_in_seconds_minutes_or_hours(seconds: float | None, text: str) -> None:
    assert duration(seconds, " ") == text
    assert duration(seconds) == text.replace(" ", "\u00a0")
