"""Limits of the time that work may take: the deadline of a request, and threads for work on files, which may hang.

In addition, the patience with a database or a file store that does not answer, at the start and at the end of a job.

A request ends some time after its last sign of progress, whatever it waits for. The code that serves it extends the
deadline for large files, and suspends it for work that has a limit of its own; outside of requests, both do nothing.

The threads for the file store and the data folder are separate from those that read the database. Each owner occupies
few of them, so a hanging file of one owner does not stop the others. Work that takes too long is given up; its thread
stays occupied until the file store answers.
"""

import asyncio
import logging
import tempfile
import time
from collections.abc import AsyncIterator, Callable, Coroutine, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import AbstractContextManager, asynccontextmanager, contextmanager, nullcontext, suppress
from contextvars import ContextVar, copy_context
from functools import partial
from pathlib import Path
from typing import Any, TypeVar
from weakref import WeakValueDictionary

from service import problems
from service.problems import DatabaseUnavailableError, NoSpaceError, StoreError

_log = logging.getLogger(__name__)

#: Interval in seconds between attempts of `until_answered`.
_RETRY_SECONDS = 2.0
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


def suspended() -> AbstractContextManager[None]:
    """Return the context of `Deadline.suspended` of the current request."""
    deadline = _current.get()
    return nullcontext() if deadline is None else deadline.suspended()


#: Number of threads, and maximum number per owner. Threads mostly wait for the disk or the network.
_THREADS, _THREADS_PER_OWNER = 16, 4

Returned = TypeVar("Returned")


class OwnerLimit:
    """Semaphore of each owner, which exists as long as it is used."""

    def __init__(self, most: int) -> None:
        self._most = most
        self._free: WeakValueDictionary[str, asyncio.Semaphore] = WeakValueDictionary()

    def of(self, owner: str) -> asyncio.Semaphore:
        """Return the semaphore of an owner."""
        return self._free.setdefault(owner, asyncio.Semaphore(self._most))


class FileThreads:
    """Pool of threads that owners take turns on.

    Args:
        seconds: Time limit of a piece of work, including the wait for a thread.
    """

    def __init__(self, seconds: float) -> None:
        self._seconds = seconds
        self._pool = ThreadPoolExecutor(_THREADS, "files")
        self._limit = OwnerLimit(_THREADS_PER_OWNER)
        self._cleaning: set[asyncio.Task[Any]] = set()

    async def run(self, owner: str, function: Callable[..., Returned], *arguments: Any, size: int = 0) -> Returned:
        """Call a function in a thread as soon as the owner has a free one, and return its result.

        Args:
            size: Bytes that the function reads or writes, as far as they are known; they add to the time limit.

        Raises:
            StoreError: If the result is not there in time.
        """
        extend(size)
        free = self._limit.of(owner)
        try:
            async with asyncio.timeout(self._seconds + size / LEAST_RATE) as limit:
                await free.acquire()
                future = self._pool.submit(copy_context().run, function, *arguments)
                future.add_done_callback(partial(_release, asyncio.get_running_loop(), free))
                return await asyncio.wrap_future(future)
        except TimeoutError as error:
            if not limit.expired():
                raise
            raise problems.STORE_UNAVAILABLE() from error

    @asynccontextmanager
    async def folder(self, owner: str, parent: Path) -> AsyncIterator[Path]:
        """Provide a temporary folder for the duration of the block."""
        folder = await self.run(owner, partial(tempfile.TemporaryDirectory, dir=parent, ignore_cleanup_errors=True))
        try:
            yield Path(folder.name)
        finally:
            await self.clean_up(self.run(owner, folder.cleanup))

    async def clean_up(self, work: Coroutine[Any, Any, Returned]) -> Returned:
        """Await some work, which continues in the background if the request that waits for it is canceled."""
        task = asyncio.ensure_future(work)
        self._cleaning.add(task)  # the event loop itself holds weak references only
        task.add_done_callback(self._cleaning.discard)
        return await asyncio.shield(task)

    def close(self) -> None:
        """Stop the threads without waiting for those that hang."""
        self._pool.shutdown(wait=False, cancel_futures=True)


def _release(loop: asyncio.AbstractEventLoop, free: asyncio.Semaphore, _done: Any) -> None:
    with suppress(RuntimeError):  # the event loop has been closed
        loop.call_soon_threadsafe(free.release)


def until_answered(function: Callable[[], None], patience: float, given_up: Callable[[], bool] = lambda: False) -> None:
    """Call a function, and repeat it while a database server or a file store does not answer, or a disk is full.

    Args:
        patience: Seconds after which its error is raised; services may start before what they need.
        given_up: Callback that returns whether to stop waiting; it is called after each error.

    Raises:
        DatabaseUnavailableError, StoreError, NoSpaceError: If there is no answer by then.
    """
    until = time.monotonic() + patience
    while True:
        try:
            function()
            return
        except (DatabaseUnavailableError, StoreError, NoSpaceError) as error:
            if given_up() or time.monotonic() >= until:
                raise
            _log.warning("no answer, retrying: %s", error.__cause__ or error)
            time.sleep(_RETRY_SECONDS)
