"""Threads that write the bodies of requests, limited per owner so that one owner cannot occupy all of them."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from typing import ParamSpec, TypeVar
from weakref import WeakValueDictionary

#: Maximum number of threads per owner. Threads mostly wait for the disk.
_THREADS_PER_OWNER = 2

Arguments = ParamSpec("Arguments")
Result = TypeVar("Result")


class OwnerLimit:
    """Semaphore of each owner, which exists as long as it is used."""

    def __init__(self, most: int) -> None:
        self._most = most
        self._free: WeakValueDictionary[str, asyncio.Semaphore] = WeakValueDictionary()

    def of(self, owner: str) -> asyncio.Semaphore:
        """Return the semaphore of an owner."""
        free = self._free.get(owner)
        if free is None:
            free = self._free[owner] = asyncio.Semaphore(self._most)
        return free


class OwnerThreads:
    """Access to the threads of the event loop's executor, which limits how many each owner occupies at once."""

    def __init__(self) -> None:
        self._limit = OwnerLimit(_THREADS_PER_OWNER)

    async def run(
        self, owner: str, function: Callable[Arguments, Result], *args: Arguments.args, **kwargs: Arguments.kwargs
    ) -> Result:
        """Call a function in a thread as soon as the owner has a free one, and return its result."""
        async with self._limit.of(owner):
            return await asyncio.to_thread(function, *args, **kwargs)
