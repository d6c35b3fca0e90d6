"""Health checks that return within a second, even if a check hangs."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor

#: Time limit in seconds for all checks together.
_SECONDS = 0.8

Check = Callable[[], object]


class Readiness:
    """Health checks, which run in separate threads that requests cannot occupy.

    A check that hangs is not started again until it has returned, so it never takes more than one thread.

    Args:
        checks: Check functions by name; each returns a value or raises.
    """

    def __init__(self, checks: Mapping[str, Check]) -> None:
        self._checks = checks
        self._threads = ThreadPoolExecutor(len(checks), "readiness")
        self._running: dict[str, asyncio.Future[object]] = {}

    async def run(self) -> dict[str, object]:
        """Return the result or exception of each check; `TimeoutError` for a check that has not returned in time."""
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
        """Cancel checks that have not started, without waiting for running ones."""
        self._threads.shutdown(wait=False, cancel_futures=True)


def _outcome(future: asyncio.Future[object]) -> object:
    if not future.done():
        return TimeoutError()
    return future.exception() or future.result()
