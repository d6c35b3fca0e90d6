"""Where the seconds go: exclusive time by name, on a CPU by the clock, on a GPU by events in its stream."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from typing import Any, Protocol

import torch


class Event(Protocol):
    """A mark in a device's stream, as `torch.cuda.Event`."""

    def record(self) -> None:
        """Put it behind what the device was given so far."""

    def query(self) -> bool:
        """Whether the device has come to it."""

    def synchronize(self) -> None:
        """Wait until the device has come to it."""

    def elapsed_time(self, end_event: Any, /) -> float:
        """Milliseconds from this mark to a later one, once the device has come to both."""


class Timer:
    """Adds up seconds by name. Nested blocks count for the inner name only, so that the sum is the whole; within a
    whole block they count for its name.

    A GPU works behind the program: what is measured there is when it began and ended a block's work, not when the
    program gave it. Nothing waits for it until `read`.

    Args:
        device: whose time it is.
        event: makes a mark in the device's stream; None for PyTorch's own on a GPU, and the clock on a CPU.

    Attributes:
        seconds: by name; on a GPU those of blocks that ended before the last `read`.
    """

    def __init__(self, device: torch.device | str = "cpu", event: Callable[[], Event] | None = None) -> None:
        self.seconds: dict[str, float] = {}
        if event is None and torch.device(device).type == "cuda":
            event = partial(torch.cuda.Event, enable_timing=True)
        self._event = event
        self._open: list[str] = []
        self._whole: str | None = None
        self._since: Event | None = None
        self._since_clock = 0.0
        #: Name, begin and end of what was marked and not yet read.
        self._marked: list[tuple[str, Event, Event]] = []

    @contextmanager
    def __call__(self, name: str, *, whole: bool = False) -> Iterator[None]:
        """Time a block; whole: with the blocks in it."""
        self._switch()
        outer = self._whole
        self._open.append(outer or name)
        if whole:
            self._whole = self._open[-1]
        try:
            yield
        finally:
            self._switch()
            self._open.pop()
            self._whole = outer

    def clear(self) -> None:
        """Forget everything that was measured so far; blocks that are open count from here."""
        self.seconds.clear()
        self._marked.clear()
        if self._open:
            self._begin()

    def read(self) -> dict[str, float]:
        """Complete `seconds`. Waits for the end of the last block on a GPU, if nothing else has waited for it yet."""
        if self._marked and not self._marked[-1][2].query():
            self._marked[-1][2].synchronize()
        for name, begin, end in self._marked:
            self._add(name, begin.elapsed_time(end) / 1000)
        self._marked.clear()
        return self.seconds

    def _switch(self) -> None:
        """Give the time since the last switch to the innermost open block."""
        begin, begin_clock = self._since, self._since_clock
        self._begin()
        if not self._open:
            return
        if self._since is None:
            self._add(self._open[-1], self._since_clock - begin_clock)
        elif begin is not None:
            self._marked.append((self._open[-1], begin, self._since))

    def _begin(self) -> None:
        if self._event is None:
            self._since_clock = time.perf_counter()
        else:
            self._since = self._event()
            self._since.record()

    def _add(self, name: str, seconds: float) -> None:
        self.seconds[name] = self.seconds.get(name, 0.0) + seconds


def wait_for(device: torch.device) -> None:
    """Until a device has done what it was given."""
    if device.type == "cuda":
        torch.cuda.synchronize(device)
