"""Devices: the current one of a thread, waiting for it, and a profiler that uses its stream events, or the clock."""

import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from typing import Any

import torch


def on_device(device: torch.device) -> AbstractContextManager[None]:
    """Make a GPU the current device inside a `with` block; do nothing for a CPU.

    Triton launches kernels on the current device, wherever their arguments are. Every thread starts with device 0.
    """
    return torch.cuda.device(device) if device.type == "cuda" else nullcontext()


class Timer:
    """Profiler that accumulates seconds by block name.

    Time in nested blocks counts only for the innermost block, so all names together add up to the total. Inside a
    `whole` block, the time of nested blocks counts for the outer name.

    A GPU works asynchronously: a block is timed from when the GPU starts its work to when it finishes, not by when the
    program queues the work. The device is not synchronized before `read`.

    Args:
        device: Device whose time is measured: on a GPU by events of its stream, on a CPU by the clock.

    Attributes:
        seconds: Accumulated seconds by name; on a GPU, only for blocks that ended before the last call of `read`.
    """

    def __init__(self, device: torch.device | str = "cpu") -> None:
        self.seconds: dict[str, float] = {}
        self._device = torch.device(device)
        self._open: list[str] = []
        self._whole: str | None = None
        #: Last switch: an event on a GPU, seconds on a CPU.
        self._since: Any = None
        #: Name, start and end of blocks that have not been read yet.
        self._marked: list[tuple[str, Any, Any]] = []

    @contextmanager
    def __call__(self, name: str, *, whole: bool = False) -> Iterator[None]:
        """Measure a `with` block. With `whole`, the time of nested blocks counts for this name too."""
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

    def lap(self) -> "Timer":
        """Return a timer that has all measurements so far, to be read later, and continue with none."""
        earlier = Timer(self._device)
        earlier.seconds, earlier._marked = self.seconds, self._marked
        self.seconds, self._marked = {}, []
        return earlier

    def read(self) -> dict[str, float]:
        """Update and return `seconds`. On a GPU, waits for the end of the last block."""
        if self._marked and not self._marked[-1][2].query():
            self._marked[-1][2].synchronize()
        for name, start, end in self._marked:
            self._add(name, start.elapsed_time(end) / 1000)
        self._marked.clear()
        return self.seconds

    def _switch(self) -> None:
        """Attribute the time since the last switch to the innermost open block."""
        start, self._since = self._since, self._now()
        if self._open and self._device.type == "cuda":
            self._marked.append((self._open[-1], start, self._since))
        elif self._open:
            self._add(self._open[-1], self._since - start)

    def _now(self) -> Any:
        if self._device.type != "cuda":
            return time.perf_counter()
        event = torch.cuda.Event(enable_timing=True)
        event.record()
        return event

    def _add(self, name: str, seconds: float) -> None:
        self.seconds[name] = self.seconds.get(name, 0.0) + seconds


def seconds_left(within: float | None, started: float | None = None) -> Callable[[], float] | None:
    """Return a function that returns the seconds left of a time budget; None without a budget.

    Args:
        within: Time budget in seconds.
        started: Start of the budget, in seconds since the epoch; None for now.
    """
    if within is None:
        return None
    # The system's clock may be set while the job runs.
    end = time.monotonic() + within - (0.0 if started is None else time.time() - started)
    return lambda: end - time.monotonic()


def wait_for(device: torch.device) -> None:
    """Wait until a device has finished its queued work."""
    if device.type == "cuda":
        torch.cuda.synchronize(device)
