"""Responses to dry runs: the plan as JSON, or progress events followed by the plan."""

from __future__ import annotations

import asyncio
import json
import logging
from collections.abc import AsyncIterator, Coroutine, Mapping
from typing import Any, Protocol

from fastapi import Request, Response
from fastapi.responses import JSONResponse, StreamingResponse

from api.http.hub import HEARTBEAT_SECONDS
from api.http.problems import InternalError, from_service
from api.http.schemas import PlanView
from service.errors import ServiceError

_EVENTS = "text/event-stream"
#: Status in the log if the client has closed the connection, as in nginx. It is never sent.
_CLIENT_CLOSED = 499
_EVENT = {
    "type": "object",
    "required": ["event", "data"],
    "properties": {
        "event": {"type": "string", "enum": ["planning", "plan", "problem"]},
        "data": {"type": "string", "contentMediaType": "application/json"},
    },
}
_PLANNING = {"step": 5, "total": 24, "fraction": 0.208, "eta_s": 31.5}
#: Documentation of the response for the OpenAPI document.
DRY_RUN: dict[str, Any] = {
    "model": PlanView,
    "description": "With `dry_run`: the plan. Nothing was queued. With `Accept: text/event-stream`, events: "
    "`planning`, the number of surveyed views; finally `plan`, or a `problem` that occurred after the response "
    "started.",
    "content": {
        _EVENTS: {
            "schema": _EVENT,
            "examples": {"planning": {"value": {"event": "planning", "data": json.dumps(_PLANNING)}}},
        }
    },
}

_log = logging.getLogger(__name__)


class Planning(Protocol):
    """Function that makes a plan and reports its progress."""

    def __call__(self, show: Any) -> Coroutine[Any, Any, dict[str, Any]]:
        """Return the plan; call `show` with the data of each `planning` event."""


async def answer_plan(request: Request, plan: Planning, workers: int | None) -> Response:
    """Return the plan as JSON, or a stream of events if the request accepts one.

    JSON is returned when the plan is complete; a stream is returned immediately. If the client closes the connection,
    planning stops.
    """
    if _EVENTS in request.headers.get("accept", ""):
        response_headers = {"Cache-Control": "no-store", "X-Accel-Buffering": "no"}
        reports: asyncio.Queue[dict[str, Any] | None] = asyncio.Queue()
        # Started here rather than in `_events`, so that the plan releases its resources even if no event is read.
        task = asyncio.create_task(plan(reports.put_nowait))
        task.add_done_callback(lambda _: reports.put_nowait(None))
        return StreamingResponse(_events(task, reports, workers), 200, response_headers, _EVENTS)
    planning, leaving = asyncio.create_task(plan(lambda now: None)), asyncio.create_task(_wait_for_disconnect(request))
    try:
        await asyncio.wait((planning, leaving), return_when=asyncio.FIRST_COMPLETED)
        if not planning.done():
            return Response(status_code=_CLIENT_CLOSED)
        return JSONResponse(_view(planning.result(), workers))
    finally:
        planning.cancel()
        leaving.cancel()


async def _wait_for_disconnect(request: Request) -> None:
    """Return once the client has closed its connection; the body of the request must have been read."""
    while (await request.receive())["type"] != "http.disconnect":
        pass


def _view(plan: Mapping[str, Any], workers: int | None) -> dict[str, Any]:
    return PlanView(**plan, workers=workers).model_dump(mode="json")


async def _events(
    task: asyncio.Task[dict[str, Any]], reports: asyncio.Queue[dict[str, Any] | None], workers: int | None
) -> AsyncIterator[bytes]:
    """Yield the events of a plan until it is done; ending the iteration stops the planning."""
    try:
        while True:
            try:
                report = await asyncio.wait_for(reports.get(), HEARTBEAT_SECONDS)
            except TimeoutError:
                yield b": still here\n\n"
                continue
            if report is None:
                break
            yield _event("planning", report)
        try:
            yield _event("plan", _view(task.result(), workers))
        except ServiceError as error:
            yield _event("problem", json.loads(bytes(from_service(error).body)))
        except Exception as error:
            _log.exception("a dry run failed unexpectedly", exc_info=error)
            yield _event("problem", json.loads(bytes(from_service(InternalError()).body)))
    finally:
        task.cancel()


def _event(kind: str, data: Mapping[str, Any]) -> bytes:
    return f"event: {kind}\ndata: {json.dumps(data)}\n\n".encode()
