"""Test of the timer of nested, named blocks with the host's clock."""

import time

import pytest

from sgsst_core.devices import Timer


def test_nested_block_counts_for_the_inner_name(monkeypatch: pytest.MonkeyPatch) -> None:
    """A name occurs twice within another one, and time passes outside of all blocks."""
    now = [10.0]
    monkeypatch.setattr(time, "perf_counter", lambda: now[0])
    timer = Timer()
    with timer("loss"):
        now[0] += 1
        for _ in range(2):
            with timer("forward"):
                now[0] += 2
                with timer("statistics"):
                    now[0] += 4
        now[0] += 8
    now[0] += 16
    expected = {"loss": 9.0, "forward": 4.0, "statistics": 8.0}
    assert timer.seconds == expected  # without reading them
    assert timer.read() == expected
