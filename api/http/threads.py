"""Threads that write what requests bring: a few for each owner, so that one cannot keep all of them busy."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from typing import ParamSpec, TypeVar
from weakref import WeakValueDictionary

#: Threads of one owner at the same time. Files are made durable in them, which takes as long as the disk does.
_OF_AN_OWNER = 2

Arguments = ParamSpec("Arguments")
Result = TypeVar("Result")


class OwnerThreads:
    """The threads of the event loop's executor, of which each owner has a few."""

    def __init__(self) -> None:
        self._free: WeakValueDictionary[str, asyncio.Semaphore] = WeakValueDictionary()

    async def run(
        self, owner: str, function: Callable[Arguments, Result], *args: Arguments.args, **kwargs: Arguments.kwargs
    ) -> Result:
        """Call a function in a thread, once fewer than a few of the owner's run; return its result."""
        free = self._free.get(owner)
        if free is None:
            free = self._free[owner] = asyncio.Semaphore(_OF_AN_OWNER)
        async with free:
            return await asyncio.to_thread(function, *args, **kwargs)
