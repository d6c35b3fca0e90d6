"""Tests of the timer of nested, named blocks with the host's clock."""

import time
from typing import Any

import pytest

from sgsst_core.devices import Timer


def step(timer: Timer, work: Any) -> None:
    """Run nested blocks, including one within another of the same name, and work outside of all blocks."""
    with timer("loss"):
        work(1.0)
        with timer("forward"):
            work(2.0)
            with timer("statistics"):
                work(4.0)
            work(8.0)
        with timer("forward"):
            work(16.0)
        work(32.0)
    work(64.0)
    with timer("optimizer"):
        work(128.0)


SECONDS = {"loss": 33.0, "forward": 26.0, "statistics": 4.0, "optimizer": 128.0}


def test_nested_block_counts_for_the_inner_name(monkeypatch: pytest.MonkeyPatch) -> None:
    now = [10.0]
    monkeypatch.setattr(time, "perf_counter", lambda: now[0])
    timer = Timer()
    step(timer, lambda seconds: now.__setitem__(0, now[0] + seconds))
    assert timer.seconds == SECONDS  # without reading them
    assert timer.read() == SECONDS
