"""Responses to requests that take long: the result as JSON, or progress events followed by the result."""

from __future__ import annotations

import asyncio
import json
import logging
from collections.abc import AsyncIterator, Coroutine, Mapping
from typing import Any, Protocol

from fastapi import Request, Response
from fastapi.responses import JSONResponse, StreamingResponse
from pydantic import BaseModel

from api.http.event_hub import HEARTBEAT_SECONDS
from api.http.problems import from_service
from api.http.schemas import ArtifactView, PlanView
from service import problems
from service.problems import ServiceError

_EVENTS = "text/event-stream"
#: Status in the log if the client has closed the connection, as in nginx. It is never sent.
_CLIENT_CLOSED = 499
_PROGRESS = {"stage": "planning", "step": 5, "total": 24, "fraction": 0.208, "eta_s": 31.5}

_log = logging.getLogger(__name__)


def _documented(model: type[BaseModel], description: str, progress: str, result: str) -> dict[str, Any]:
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
DRY_RUN = _documented(
    PlanView,
    "With `dry_run`: the plan. Nothing was queued. With `Accept: text/event-stream`, events: `planning`, the stage "
    "(`planning` or `refining`) and its number of completed views (`total` is 0 if it has none); finally "
    "`plan`, or a `problem` that occurred after the response started.",
    "planning",
    "plan",
)
VIDEO = _documented(
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
    checked: asyncio.Event | None = None,
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
        checked: Event after which an error is reported in the stream; None to start the stream immediately.
    """
    reports: asyncio.Queue[dict[str, Any] | None] = asyncio.Queue()
    # Started here rather than in `_events`, so that the work releases its resources even if no event is read.
    task = asyncio.create_task(work(reports.put_nowait))
    task.add_done_callback(lambda _: reports.put_nowait(None))
    working.add(task)
    task.add_done_callback(working.discard)
    if _EVENTS in request.headers.get("accept", ""):
        response_headers = {"Cache-Control": "no-store", "X-Accel-Buffering": "no"}
        if checked is not None:
            waiting = [asyncio.create_task(wait) for wait in (checked.wait(), _wait_for_disconnect(request))]
            try:
                done, _ = await asyncio.wait((task, *waiting), return_when=asyncio.FIRST_COMPLETED)
            except asyncio.CancelledError:
                task.cancel()
                raise
            finally:
                for each in waiting:
                    each.cancel()
            if waiting[1] in done:
                task.cancel()
                return Response(status_code=_CLIENT_CLOSED)
            if not checked.is_set():
                _result(task)  # raises its error
        return StreamingResponse(_events(task, reports, progress, result), 200, response_headers, _EVENTS)
    leaving = asyncio.create_task(_wait_for_disconnect(request))
    try:
        await asyncio.wait((task, leaving), return_when=asyncio.FIRST_COMPLETED)
        if not task.done():
            return Response(status_code=_CLIENT_CLOSED)
        return JSONResponse(_result(task).model_dump(mode="json"))
    finally:
        task.cancel()
        leaving.cancel()


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
            yield _event(progress, report)
        try:
            yield _event(result, _result(task).model_dump(mode="json"))
        except ServiceError as error:
            yield _event("problem", json.loads(bytes(from_service(error).body)))
        except Exception as error:
            _log.exception("%s failed unexpectedly", progress, exc_info=error)
            yield _event("problem", json.loads(bytes(from_service(problems.INTERNAL()).body)))
    finally:
        task.cancel()


def _event(kind: str, data: Mapping[str, Any]) -> bytes:
    return f"event: {kind}\ndata: {json.dumps(data)}\n\n".encode()
