"""Server-sent events of jobs, and responses to requests that take long: progress events, then the result.

One task polls the database for the events of all watched jobs.
"""

from __future__ import annotations

import asyncio
import json
import logging
from collections.abc import AsyncIterator, Coroutine, Mapping
from dataclasses import dataclass, field
from typing import Any, Protocol

from fastapi import Request, Response
from fastapi.responses import JSONResponse, StreamingResponse
from pydantic import BaseModel
from pydantic_core import to_jsonable_python

from api.http.problems import from_service
from api.http.schemas import ArtifactView, PlanView, utc
from service import problems
from service.problems import DatabaseUnavailableError, ServiceError
from service.states import ENDED
from service.store import Store
from service.store.tables import EventRow

#: Seconds between polls of the database. On average, watchers receive an event after half of this time.
_POLL_SECONDS = 0.3
#: Seconds without an event after which a comment is sent, so that proxies do not drop the connection as idle.
HEARTBEAT_SECONDS = 15.0
_log = logging.getLogger(__name__)


@dataclass
class _Watched:
    """Job with watchers.

    Attributes:
        newest: Number of its newest event at the last poll; 0 before the first one, None if the job was deleted.
        changed: Event that is set when there are newer events, and then replaced.
    """

    newest: int | None = 0
    changed: asyncio.Event = field(default_factory=asyncio.Event)
    watchers: int = 0


class Hub:
    """Poller of job events that notifies the watchers of each job."""

    def __init__(self, store: Store) -> None:
        self._store = store
        self._watched: dict[str, _Watched] = {}
        self._task: asyncio.Task[None] | None = None
        self._closing = False
        #: Work that clients wait for, which is canceled when the service stops.
        self.working: set[asyncio.Task[Any]] = set()

    def start(self) -> None:
        """Start polling."""
        self._task = asyncio.create_task(self._poll())

    async def close(self) -> None:
        """End all streams and cancel work; watchers reconnect with the id of their last event."""
        self._closing = True
        for task in self.working:
            task.cancel()
        for watched in self._watched.values():
            watched.changed.set()
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
        if rows and _ends(rows[0]):
            return None
        return after if after == last else 0

    async def watch(self, job_id: str, after: int) -> AsyncIterator[bytes]:
        """Yield the encoded events of a job after the one with id `after`, until the job has ended."""
        watched = self._watched.setdefault(job_id, _Watched())
        watched.watchers += 1
        ended = False
        try:
            yield b"retry: 2000\n\n"
            while not self._closing and watched.newest is not None:
                changed = watched.changed
                rows = await self._events_after(job_id, after)
                for row in rows:
                    yield _text(row)
                    after, ended = row.id, _ends(row)
                if rows:
                    continue
                if ended:
                    return
                try:
                    await asyncio.wait_for(changed.wait(), HEARTBEAT_SECONDS)
                except TimeoutError:
                    yield b": still here\n\n"
        finally:
            watched.watchers -= 1
            if not watched.watchers:
                self._watched.pop(job_id, None)

    async def _events_after(self, job_id: str, after: int) -> list[EventRow]:
        try:
            return await asyncio.to_thread(self._store.jobs.events, job_id, after)
        except DatabaseUnavailableError:  # The stream waits until the database is back.
            return []

    async def _poll(self) -> None:
        unavailable = False
        while True:
            await asyncio.sleep(_POLL_SECONDS)
            if not self._watched:
                continue
            try:
                await self._find_new_events()
                unavailable = False
            except DatabaseUnavailableError as error:  # Watchers wait until the database is back.
                if not unavailable:
                    _log.warning("cannot read events: %s", error)
                unavailable = True
            except Exception:
                _log.exception("reading events failed")

    async def _find_new_events(self) -> None:
        watched = dict(self._watched)
        newest = await asyncio.to_thread(self._store.jobs.last_events, list(watched))
        for job_id, each in watched.items():
            if each.newest != newest.get(job_id):
                each.newest = newest.get(job_id)
                changed, each.changed = each.changed, asyncio.Event()
                changed.set()


def _text(row: EventRow) -> bytes:
    """Return an event as it is sent."""
    data = row.data
    if row.kind == "progress":  # same format as in responses that show the job
        data = {**data, "updated_at": to_jsonable_python(utc(data["updated_at"]))}
    return f"id: {row.id}\nevent: {row.kind}\ndata: {json.dumps(data)}\n\n".encode()


def _ends(row: EventRow) -> bool:
    return row.kind == "status" and row.data["status"] in ENDED


_EVENTS = "text/event-stream"
#: Status in the log if the client has closed the connection, as in nginx. It is never sent.
_CLOSED = 499
_PROGRESS = {"stage": "planning", "step": 5, "total": 24, "fraction": 0.208, "eta_s": 31.5}


def _work_documentation(model: type[BaseModel], description: str, progress: str, result: str) -> dict[str, Any]:
    """Return the documentation of such a response, given the names of its events."""
    event = {
        "type": "object",
        "required": ["event", "data"],
        "properties": {
            "event": {"type": "string", "enum": [progress, result, "problem"]},
            "data": {"type": "string", "contentMediaType": "application/json"},
        },
    }
    examples = {progress: {"value": {"event": progress, "data": json.dumps(_PROGRESS)}}}
    return {"model": model, "description": description, "content": {_EVENTS: {"schema": event, "examples": examples}}}


#: Documentation of the responses for the OpenAPI document.
DRY_RUN = _work_documentation(
    PlanView,
    "With `dry_run`: the plan. Nothing was queued. With `Accept: text/event-stream`, events: `planning`, the stage "
    "(`planning` or `refining`) and its number of completed views (`total` is 0 if it has none); finally "
    "`plan`, or a `problem` that occurred after the response started.",
    "planning",
    "plan",
)
VIDEO = _work_documentation(
    ArtifactView,
    "The video, which has been rendered. With `Accept: text/event-stream`, events: `rendering`, the number of rendered "
    "frames; finally `video`, or a `problem` that occurred after the response started.",
    "rendering",
    "video",
)


class Work(Protocol):
    """Function that makes a result and reports its progress."""

    def __call__(self, show: Any) -> Coroutine[Any, Any, BaseModel]:
        """Return the result; call `show` with the data of each progress event."""


async def answer_work(
    request: Request,
    work: Work,
    progress: str,
    result: str,
    working: set[asyncio.Task[Any]],
    checked: asyncio.Event,
) -> Response:
    """Return the result as JSON, or a stream of events if the request accepts one.

    JSON is returned when the result is complete; a stream is returned as soon as the inputs are checked. If the client
    closes the connection, the work is canceled.

    Args:
        request: Request, whose body has been read.
        work: Function that makes the result.
        progress: Name of the progress events.
        result: Name of the event with the result.
        working: Tasks of all such work, which are canceled when the service stops.
        checked: Event after which the stream starts, in which a later error is reported.
    """
    reports: asyncio.Queue[dict[str, Any] | None] = asyncio.Queue()
    # Started here rather than in `_events`, so that the work releases its resources even if no event is read.
    task = asyncio.create_task(work(reports.put_nowait))
    task.add_done_callback(lambda _: reports.put_nowait(None))
    working.add(task)
    task.add_done_callback(working.discard)
    streamed = _EVENTS in request.headers.get("accept", "")
    waits: list[Coroutine[Any, Any, object]] = [_wait_for_disconnect(request), *([checked.wait()] if streamed else [])]
    canceled: list[asyncio.Task[Any]] = [task, *map(asyncio.create_task, waits)]
    try:
        await asyncio.wait(canceled, return_when=asyncio.FIRST_COMPLETED)
        if streamed and checked.is_set():
            canceled.remove(task)
            response_headers = {"Cache-Control": "no-store", "X-Accel-Buffering": "no"}
            return StreamingResponse(_events(task, reports, progress, result), 200, response_headers, _EVENTS)
        return JSONResponse(_result(task).model_dump(mode="json")) if task.done() else Response(status_code=_CLOSED)
    finally:
        for each in canceled:
            each.cancel()


def _result(task: asyncio.Task[BaseModel]) -> BaseModel:
    """Return the result of work that has ended.

    Raises:
        STOPPING: If it was canceled because the service stops.
    """
    if task.cancelled():
        raise problems.STOPPING()
    return task.result()


async def _wait_for_disconnect(request: Request) -> None:
    """Return once the client has closed its connection; the body of the request must have been read."""
    while (await request.receive())["type"] != "http.disconnect":
        pass


async def _events(
    task: asyncio.Task[BaseModel], reports: asyncio.Queue[dict[str, Any] | None], progress: str, result: str
) -> AsyncIterator[bytes]:
    """Yield the events of some work until it is done; ending the iteration cancels the work."""
    try:
        while True:
            try:
                report = await asyncio.wait_for(reports.get(), HEARTBEAT_SECONDS)
            except TimeoutError:
                yield b": still here\n\n"
                continue
            if report is None:
                break
            yield _encoded(progress, report)
        try:
            yield _encoded(result, _result(task).model_dump(mode="json"))
        except ServiceError as error:
            yield _encoded("problem", json.loads(bytes(from_service(error).body)))
        except Exception as error:
            _log.exception("%s failed unexpectedly", progress, exc_info=error)
            yield _encoded("problem", json.loads(bytes(from_service(problems.INTERNAL()).body)))
    finally:
        task.cancel()


def _encoded(kind: str, data: Mapping[str, Any]) -> bytes:
    return f"event: {kind}\ndata: {json.dumps(data)}\n\n".encode()
