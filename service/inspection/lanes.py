"""Fair scheduling of owners on a few slots: an owner with many requests delays only their own."""

from __future__ import annotations

import asyncio
from collections import OrderedDict, deque
from collections.abc import AsyncIterator, Sequence
from contextlib import asynccontextmanager
from typing import Generic, TypeVar

from service import problems

#: Maximum number of waiting requests per owner; further ones are rejected with `BUSY`.
MAX_WAITING = 64

Slot = TypeVar("Slot")


class Lanes(Generic[Slot]):
    """Slots that owners take turns on; each owner occupies at most one at a time.

    Args:
        slots: Slots; the first free one is assigned.
    """

    def __init__(self, slots: Sequence[Slot]) -> None:
        self.slots = tuple(slots)
        self._free = list(slots)
        self._active: set[str] = set()
        # owners in the order of their turns; the owner of a finished turn moves to the end
        self._waiting: OrderedDict[str, deque[asyncio.Future[Slot]]] = OrderedDict()

    @property
    def full(self) -> bool:
        """Whether no slot is free."""
        return not self._free

    @asynccontextmanager
    async def turn(self, owner: str) -> AsyncIterator[Slot]:
        """Wait for the owner's turn and occupy a slot for the duration of the block.

        Raises:
            BUSY: If too many requests of this owner wait already.
        """
        queue = self._waiting.setdefault(owner, deque())
        if len(queue) >= MAX_WAITING:
            raise problems.BUSY("Too many files of this key are being checked. Try again later.")
        granted: asyncio.Future[Slot] = asyncio.get_running_loop().create_future()
        queue.append(granted)
        self._grant_turns()
        try:
            yield await granted
        finally:
            self._end_turn(owner, granted)

    def _grant_turns(self) -> None:
        for owner, queue in list(self._waiting.items()):
            while queue and queue[0].cancelled():
                queue.popleft()
            if queue and self._free and owner not in self._active:
                queue.popleft().set_result(self._free.pop(0))
                self._active.add(owner)
            if not queue:
                del self._waiting[owner]

    def _end_turn(self, owner: str, granted: asyncio.Future[Slot]) -> None:
        queue = self._waiting.get(owner, deque())
        if not granted.cancelled():
            self._free.insert(0, granted.result())
            self._active.discard(owner)
            if queue:
                self._waiting.move_to_end(owner)
        elif granted in queue:
            queue.remove(granted)
        self._grant_turns()
