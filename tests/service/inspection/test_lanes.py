"""Tests of fair queuing of inspections: an owner waits for at most one request of each other owner."""

from __future__ import annotations

import asyncio
import random
from collections import Counter

from service import problems
from service.inspection.inspector import MAX_WAITING, Lanes
from tests.raised import raises_problem


class Work:
    """Requests that the test ends; `order` lists them in the order in which they started."""

    def __init__(self, lanes: Lanes) -> None:
        self.lanes = lanes
        self.order: list[str] = []
        self.at_work: dict[str, asyncio.Event] = {}

    async def ask(self, name: str) -> None:
        """Send a request of the owner whose name is the first letter of `name`."""
        async with self.lanes.turn(name[0]):
            self.order.append(name)
            self.at_work[name] = asyncio.Event()
            await self.at_work[name].wait()
            del self.at_work[name]

    async def end(self, name: str) -> None:
        """End a request, and let waiting ones start."""
        self.at_work[name].set()
        await settle()


async def settle() -> None:
    """Let all tasks run until they wait."""
    for _ in range(10):
        await asyncio.sleep(0)


async def start(work: Work, *names: str) -> list[asyncio.Task[None]]:
    tasks = [asyncio.create_task(work.ask(name)) for name in names]
    await settle()
    return tasks


def test_owners_take_turns_on_one_slot() -> None:
    async def run() -> list[str]:
        work = Work(Lanes(1))
        tasks = await start(work, "a1", "a2", "a3", "b1", "b2", "c1")
        while work.at_work:
            await work.end(next(iter(work.at_work)))
        await asyncio.gather(*tasks)
        return work.order

    assert asyncio.run(run()) == ["a1", "b1", "c1", "a2", "b2", "a3"]


def test_owner_never_occupies_two_slots() -> None:
    async def run() -> None:
        work = Work(Lanes(2))
        tasks = await start(work, *(f"a{number}" for number in range(5)))
        assert list(work.at_work) == ["a0"], "the other place stays free for others"
        tasks += await start(work, "b0", "c0")
        assert sorted(work.at_work) == ["a0", "b0"]
        await work.end("b0")
        assert sorted(work.at_work) == ["a0", "c0"]
        await work.end("a0")
        assert sorted(work.at_work) == ["a1", "c0"]
        while work.at_work:
            await work.end(next(iter(work.at_work)))
        await asyncio.gather(*tasks)

    asyncio.run(run())


def test_queue_limit_applies_per_owner() -> None:
    async def run() -> None:
        work = Work(Lanes(2))
        tasks = await start(work, *(f"a{number}" for number in range(1 + MAX_WAITING)))
        with raises_problem(problems.BUSY):
            await work.ask("a-more")
        tasks += await start(work, "b0")
        assert sorted(work.at_work) == ["a0", "b0"]
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)
        work.at_work.clear()
        again = await start(work, "a-again")
        assert list(work.at_work) == ["a-again"], "those who gave up wait no more"
        await work.end("a-again")
        await asyncio.gather(*again)

    asyncio.run(run())


def test_every_slot_is_returned_after_cancellations() -> None:
    """For random requests, ends and cancellations: at most one slot per owner; no slot is lost or assigned twice."""

    async def run(seed: int) -> None:
        chance = random.Random(seed)
        lanes, had = Lanes(3), Counter[str]()

        async def ask(owner: str) -> None:
            async with lanes.turn(owner):
                had.update([owner])
                assert had[owner] == 1
                assert had.total() <= 3
                try:
                    for _ in range(chance.randrange(4)):
                        await asyncio.sleep(0)
                finally:
                    had.subtract([owner])

        tasks: list[asyncio.Task[None]] = []
        for _ in range(80):
            tasks.append(asyncio.create_task(ask(chance.choice("abcd"))))
            if not chance.randrange(3):
                chance.choice(tasks).cancel()
            for _ in range(chance.randrange(3)):
                await asyncio.sleep(0)
        ended = await asyncio.gather(*tasks, return_exceptions=True)
        assert not [each for each in ended if each and not isinstance(each, asyncio.CancelledError)]
        async with lanes.turn("x"), lanes.turn("y"):
            assert not lanes.full
            async with lanes.turn("z"):
                assert lanes.full

    for seed in range(50):
        asyncio.run(run(seed))
