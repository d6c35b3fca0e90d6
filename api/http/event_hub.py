"""Job events for any number of watchers; one task polls the database for all of them."""

from __future__ import annotations

import asyncio
import json
import logging
from collections import deque
from collections.abc import AsyncIterator
from dataclasses import dataclass, field
from typing import Any

from pydantic_core import to_jsonable_python

from api.http.schemas import utc
from service.problems import DatabaseUnavailableError
from service.states import ENDED
from service.store import Store
from service.store.tables import EventRow

#: Seconds between polls of the database. On average, watchers receive an event after half of this time.
_POLL_SECONDS = 0.3
#: Seconds without an event after which a comment is sent, so that proxies do not drop the connection as idle.
HEARTBEAT_SECONDS = 15.0
#: Number of events that are buffered per watched job. A watcher that is farther behind reads the database.
_BUFFERED = 300

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Item:
    """Server-sent event of a job, ready to be sent."""

    id: int
    text: bytes
    ends: bool


@dataclass
class _Channel:
    """Newest event, recent events and watchers of one job."""

    last: int = 0
    items: deque[Item] = field(default_factory=lambda: deque(maxlen=_BUFFERED))
    changed: asyncio.Event = field(default_factory=asyncio.Event)
    watchers: int = 0
    deleted: bool = False


class Hub:
    """Poller of job events that notifies the watchers of each job."""

    def __init__(self, store: Store) -> None:
        self._store = store
        self._channels: dict[str, _Channel] = {}
        self._task: asyncio.Task[None] | None = None
        self._closing = asyncio.Event()
        #: Work that clients wait for, which is canceled when the service stops.
        self.working: set[asyncio.Task[Any]] = set()

    def start(self) -> None:
        """Start polling."""
        self._task = asyncio.create_task(self._poll())

    async def close(self) -> None:
        """End all streams and cancel work; watchers reconnect with the id of their last event."""
        self._closing.set()
        for task in self.working:
            task.cancel()
        for channel in self._channels.values():
            channel.changed.set()
        if self._task is not None:
            self._task.cancel()

    async def resumed(self, job_id: str, after: int) -> int | None:
        """Return the id of the event after which to continue a stream whose last event had the id `after`.

        It is 0 if the job has not had such an event, because the database was restored from a backup: the stream starts
        again. It is None if the job has ended, and has no later events.
        """
        last = (await asyncio.to_thread(self._store.jobs.last_events, [job_id])).get(job_id)
        if last is None or last > after:
            return after
        rows = await asyncio.to_thread(self._store.jobs.events, job_id, last - 1, 1)
        if rows and _to_item(rows[0]).ends:
            return None
        return after if after == last else 0

    async def watch(self, job_id: str, after: int) -> AsyncIterator[bytes]:
        """Yield the encoded events of a job after the one with id `after`, until the job has ended."""
        channel = self._channels.setdefault(job_id, _Channel())
        channel.watchers += 1
        try:
            yield b"retry: 2000\n\n"
            while not self._closing.is_set() and not channel.deleted:
                changed = channel.changed
                items = await self._events_after(job_id, channel, after)
                for item in items:
                    yield item.text
                    after = item.id
                if items and items[-1].ends and channel.last <= after:
                    return
                if items:
                    continue
                try:
                    await asyncio.wait_for(changed.wait(), HEARTBEAT_SECONDS)
                except TimeoutError:
                    yield b": still here\n\n"
        finally:
            channel.watchers -= 1
            if not channel.watchers:
                self._channels.pop(job_id, None)

    async def _events_after(self, job_id: str, channel: _Channel, after: int) -> list[Item]:
        if channel.items and after >= channel.items[0].id:
            return [item for item in channel.items if item.id > after]
        try:
            rows = await asyncio.to_thread(self._store.jobs.events, job_id, after)
        except DatabaseUnavailableError:  # The stream waits until the database is back.
            return []
        return [_to_item(row) for row in rows]

    async def _poll(self) -> None:
        unavailable = False
        while True:
            await asyncio.sleep(_POLL_SECONDS)
            if not self._channels:
                continue
            try:
                await self._read_new_events()
                unavailable = False
            except DatabaseUnavailableError as error:  # Watchers wait until the database is back.
                if not unavailable:
                    _log.warning("cannot read events: %s", error)
                unavailable = True
            except Exception:
                _log.exception("reading events failed")

    async def _read_new_events(self) -> None:
        watched = dict(self._channels)
        newest = await asyncio.to_thread(self._store.jobs.last_events, list(watched))
        for job_id, channel in watched.items():
            number = newest.get(job_id)
            if number is None:
                channel.deleted = True
            elif not channel.last:
                channel.last = number
            elif number > channel.last:
                rows = await asyncio.to_thread(self._store.jobs.events, job_id, channel.last)
                channel.items.extend(_to_item(row) for row in rows)
                channel.last = rows[-1].id if rows else channel.last
            else:
                continue
            changed, channel.changed = channel.changed, asyncio.Event()
            changed.set()


def _to_item(row: EventRow) -> Item:
    data = row.data
    if row.kind == "progress":  # same format as in responses that show the job
        data = {**data, "updated_at": to_jsonable_python(utc(data["updated_at"]))}
    text = f"id: {row.id}\nevent: {row.kind}\ndata: {json.dumps(data)}\n\n"
    return Item(row.id, text.encode(), row.kind == "status" and row.data["status"] in ENDED)
