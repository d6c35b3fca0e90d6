"""Graceful Ctrl-C: the first one lets the current step finish, the second one ends the program at once."""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType


class StopFlag:
    """Flag that records whether a signal has asked the program to stop, and which."""

    def __init__(self) -> None:
        self.signal: int | None = None

    def __call__(self) -> bool:
        """Return whether a signal has arrived."""
        return self.signal is not None

    @property
    def exit_code(self) -> int:
        """Exit code of a program that was ended by the signal: 130 for Ctrl-C."""
        return 128 + (self.signal or signal.SIGINT)


@contextmanager
def stop_on_signal(announce: Callable[[], None]) -> Iterator[StopFlag]:
    """Turn the first SIGINT or SIGTERM into a flag, and call `announce` when it arrives.

    The second signal has its usual effect. Outside the main thread, Python allows no signal handlers, so the flag stays
    unset.
    """
    flag = StopFlag()
    if threading.current_thread() is not threading.main_thread():
        yield flag
        return
    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}

    def handle(number: int, _frame: FrameType | None) -> None:
        flag.signal = number
        for other, handler in before.items():
            signal.signal(other, handler)
        announce()

    try:
        for number in before:
            signal.signal(number, handle)
        yield flag
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
