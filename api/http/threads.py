"""Threads that read long lists from the database, limited per owner so that one owner cannot occupy all of them."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from typing import ParamSpec, TypeVar

from service.files.threads import OwnerLimit

#: Maximum number of threads per owner.
_THREADS_PER_OWNER = 2

Arguments = ParamSpec("Arguments")
Result = TypeVar("Result")


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
