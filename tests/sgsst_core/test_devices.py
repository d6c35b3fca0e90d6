"""Tests of the timer of nested, named blocks with the host's clock."""

from __future__ import annotations

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


def test_blocks_nested_in_a_whole_block_count_for_it(monkeypatch: pytest.MonkeyPatch) -> None:
    clock = iter(float(2**step) for step in range(12))
    monkeypatch.setattr(time, "perf_counter", lambda: next(clock))
    timer = Timer()
    with timer("outer"), timer("whole", whole=True), timer("inner"), timer("innermost"):
        pass
    with timer("inner"):
        pass
    assert timer.seconds == {"outer": 2**1 - 2**0 + 2**7 - 2**6, "whole": 2**6 - 2**1, "inner": 2**9 - 2**8}


def test_failing_block_is_timed_and_closed(monkeypatch: pytest.MonkeyPatch) -> None:
    clock = iter(float(2**step) for step in range(6))
    monkeypatch.setattr(time, "perf_counter", lambda: next(clock))
    timer = Timer()
    with pytest.raises(KeyError), timer("loss"), timer("forward"):
        raise KeyError
    with timer("render"):
        pass
    assert timer.read() == {"loss": 2**1 - 2**0 + 2**3 - 2**2, "forward": 2**2 - 2**1, "render": 2**5 - 2**4}
