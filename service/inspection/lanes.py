"""Fair scheduling of owners on a few slots: an owner with many requests delays only their own."""

from __future__ import annotations

import asyncio
from collections import OrderedDict, deque
from collections.abc import AsyncIterator, Sequence
from contextlib import asynccontextmanager
from typing import Generic, TypeVar

from service.errors import BusyError

#: Maximum number of waiting requests per owner; further ones are rejected with `BusyError`.
MAX_WAITING = 64

Place = TypeVar("Place")


class Lanes(Generic[Place]):
    """Slots that owners take turns on; each owner occupies at most one at a time.

    Args:
        places: Slots; the first free one is assigned.
    """

    def __init__(self, places: Sequence[Place]) -> None:
        self.places = tuple(places)
        self._free = list(places)
        self._at_work: set[str] = set()
        # owners in the order of their turns; the owner of a finished turn moves to the end
        self._waiting: OrderedDict[str, deque[asyncio.Future[Place]]] = OrderedDict()

    @asynccontextmanager
    async def turn(self, owner: str) -> AsyncIterator[Place]:
        """Wait for the owner's turn and occupy a slot for the duration of the block.

        Raises:
            BusyError: If too many requests of this owner wait already.
        """
        mine = self._waiting.setdefault(owner, deque())
        if len(mine) >= MAX_WAITING:
            raise BusyError("Too many files of this key are being checked. Try again later.", retry_after=10)
        given: asyncio.Future[Place] = asyncio.get_running_loop().create_future()
        mine.append(given)
        self._give_turns()
        try:
            yield await given
        finally:
            self._end_turn(owner, given)

    def _give_turns(self) -> None:
        for owner, mine in list(self._waiting.items()):
            while mine and mine[0].cancelled():
                mine.popleft()
            if mine and self._free and owner not in self._at_work:
                mine.popleft().set_result(self._free.pop(0))
                self._at_work.add(owner)
            if not mine:
                del self._waiting[owner]

    def _end_turn(self, owner: str, given: asyncio.Future[Place]) -> None:
        mine = self._waiting.get(owner, deque())
        if not given.cancelled():
            self._free.insert(0, given.result())
            self._at_work.discard(owner)
            if mine:
                self._waiting.move_to_end(owner)
        elif given in mine:
            mine.remove(given)
        self._give_turns()
