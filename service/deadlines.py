"""Deadline of a request: the time since its last sign of progress is limited, whatever it waits for.

The code that serves a request extends the request's deadline for large files, and suspends it for work that has a time
limit of its own. Outside of requests, both do nothing.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar

#: Minimum rate of work on files in bytes per second; it adds to the time that work on a file of known size may take.
LEAST_RATE = 10e6


class Deadline:
    """Deadline of the request that the current task serves.

    Args:
        seconds: Time without progress after which the deadline passes.
        passed: Callback for that moment, called at most once.
    """

    def __init__(self, seconds: float, passed: Callable[[], None]) -> None:
        self._seconds, self._passed = seconds, passed
        self._loop = asyncio.get_running_loop()
        self._suspensions = 0
        self._moved_at = self._loop.time()
        self._until = self._moved_at + seconds
        self._timer = self._loop.call_at(self._until, self._check)
        _current.set(self)

    def progress(self) -> None:
        """Postpone the deadline."""
        self._moved_at = self._loop.time()
        self.extend(0)

    def extend(self, size: int) -> None:
        """Extend the deadline to what work on `size` bytes since the last progress needs at the minimum rate."""
        self._until = max(self._until, self._moved_at + self._seconds + size / LEAST_RATE)

    @contextmanager
    def suspended(self) -> Iterator[None]:
        """Suspend the deadline for the duration of the block."""
        self._suspensions += 1
        try:
            yield
        finally:
            self._suspensions -= 1
            self.progress()

    def close(self) -> None:
        """Stop the timer."""
        self._timer.cancel()

    def _check(self) -> None:
        if self._suspensions:
            self.progress()
        if self._loop.time() < self._until:
            self._timer = self._loop.call_at(self._until, self._check)
        else:
            self._passed()


_current: ContextVar[Deadline | None] = ContextVar("deadline", default=None)


def extend(size: int) -> None:
    """Call `Deadline.extend` of the current request."""
    deadline = _current.get()
    if deadline is not None:
        deadline.extend(size)


@contextmanager
def suspended() -> Iterator[None]:
    """Call `Deadline.suspended` of the current request."""
    deadline = _current.get()
    if deadline is None:
        yield
        return
    with deadline.suspended():
        yield
