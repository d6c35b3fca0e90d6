"""Tests of the timer of nested, named blocks, with the host's clock and with events of a simulated stream."""

from __future__ import annotations

import time
from typing import Any

import pytest

from sgsst_core.devices import Timer


class Stream:
    """Simulated stream of an asynchronous device, on which each piece of work takes a given time."""

    def __init__(self) -> None:
        self.given = 0.0
        self.done = 0.0
        self.waits = 0
        self.events = 0

    def launch(self, seconds: float) -> None:
        self.given += seconds

    def wait(self) -> None:
        self.waits += self.done < self.given
        self.done = self.given

    def event(self) -> PretendEvent:
        self.events += 1
        return PretendEvent(self)


class PretendEvent:
    """Event of a simulated `Stream`. As in CUDA, its time is unknown until the device has reached it."""

    def __init__(self, stream: Stream) -> None:
        self._stream = stream
        self.at: float | None = None

    def record(self) -> None:
        self.at = self._stream.given

    def query(self) -> bool:
        assert self.at is not None
        return self.at <= self._stream.done

    def synchronize(self) -> None:
        assert self.at is not None
        if self._stream.done < self.at:
            self._stream.waits += 1
            self._stream.done = self.at

    def elapsed_time(self, end_event: Any) -> float:
        assert self.at is not None
        assert max(self.at, end_event.at) <= self._stream.done, "the device has not come to it yet"
        return 1000 * (end_event.at - self.at)


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


def test_gpu_block_is_timed_by_device_events() -> None:
    """The program submits the work at once, so its own clock hardly advances."""
    stream = Stream()
    timer = Timer(event=stream.event)
    step(timer, stream.launch)
    assert timer.seconds == {}
    assert timer.read() == pytest.approx(SECONDS)
    assert stream.waits == 1


def test_failing_block_is_timed_and_closed() -> None:
    stream = Stream()
    timer = Timer(event=stream.event)
    with pytest.raises(KeyError):
        fail(timer, stream)
    with timer("render"):
        stream.launch(3.0)
    assert timer.read() == pytest.approx({"loss": 0.5, "forward": 0.25, "render": 3.0})


def fail(timer: Timer, stream: Stream) -> None:
    with timer("loss"):
        stream.launch(0.5)
        with timer("forward"):
            stream.launch(0.25)
            raise KeyError
