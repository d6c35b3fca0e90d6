"""Health checks that answer within a second, whatever hangs."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor

#: Seconds that all checks together may take.
_SECONDS = 0.8

Check = Callable[[], object]


class Readiness:
    """Checks on threads of their own, which requests cannot occupy.

    A check that hangs is not started again before it has ended: however often it is asked for, it takes one thread.

    Args:
        checks: Functions by name; each returns something, or raises.
    """

    def __init__(self, checks: Mapping[str, Check]) -> None:
        self._checks = checks
        self._threads = ThreadPoolExecutor(len(checks), "readiness")
        self._running: dict[str, asyncio.Future[object]] = {}

    async def run(self) -> dict[str, object]:
        """Return what each check has returned or raised; `TimeoutError` for one that has not ended in time."""
        running = {name: self._start(name) for name in self._checks}
        await asyncio.wait(running.values(), timeout=_SECONDS)
        return {name: _outcome(future) for name, future in running.items()}

    def _start(self, name: str) -> asyncio.Future[object]:
        running = self._running.get(name)
        if running is None or running.done():
            running = asyncio.get_running_loop().run_in_executor(self._threads, self._checks[name])
            self._running[name] = running
        return running

    def close(self) -> None:
        """Wait for no check any longer."""
        self._threads.shutdown(wait=False, cancel_futures=True)


def _outcome(future: asyncio.Future[object]) -> object:
    if not future.done():
        return TimeoutError()
    return future.exception() or future.result()
