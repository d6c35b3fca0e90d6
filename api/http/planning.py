"""The answer to a dry run: the plan, or events on the way to it for who accepts them."""

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
#: For the log alone, as other servers have it.
_NOBODY_LISTENS = 499
_EVENT = {
    "type": "object",
    "required": ["event", "data"],
    "properties": {
        "event": {"type": "string", "enum": ["planning", "plan", "problem"]},
        "data": {"type": "string", "contentMediaType": "application/json"},
    },
}
_PLANNING = {"step": 5, "total": 24, "fraction": 0.208, "eta_s": 31.5}
#: For the OpenAPI document.
DRY_RUN: dict[str, Any] = {
    "model": PlanView,
    "description": "With `dry_run`: the plan. Nothing was queued. With `Accept: text/event-stream`, events: "
    "`planning`, how many views have been looked at; at last `plan`, or the `problem` that was found after the answer "
    "had begun.",
    "content": {
        _EVENTS: {
            "schema": _EVENT,
            "examples": {"planning": {"value": {"event": "planning", "data": json.dumps(_PLANNING)}}},
        }
    },
}

_log = logging.getLogger(__name__)


class Planning(Protocol):
    """Plans, and tells how far it is."""

    def __call__(self, show: Any) -> Coroutine[Any, Any, dict[str, Any]]:
        """What was found; `show` is called with each `planning`."""


async def answer_plan(request: Request, plan: Planning, workers: int | None) -> Response:
    """The plan as JSON once it is there; or at once a stream of events, where the request accepts that.

    Who closes the connection ends the planning.
    """
    if _EVENTS in request.headers.get("accept", ""):
        sent = {"Cache-Control": "no-store", "X-Accel-Buffering": "no"}
        told: asyncio.Queue[dict[str, Any] | None] = asyncio.Queue()
        # started here: what the plan holds is let go of at its end, even if nobody ever asks for the first event
        task = asyncio.create_task(plan(told.put_nowait))
        task.add_done_callback(lambda _: told.put_nowait(None))
        return StreamingResponse(_events(task, told, workers), 200, sent, _EVENTS)
    planning, leaving = asyncio.create_task(plan(lambda now: None)), asyncio.create_task(_left(request))
    try:
        await asyncio.wait((planning, leaving), return_when=asyncio.FIRST_COMPLETED)
        if not planning.done():
            return Response(status_code=_NOBODY_LISTENS)
        return JSONResponse(_view(planning.result(), workers))
    finally:
        planning.cancel()
        leaving.cancel()


async def _left(request: Request) -> None:
    """Return when the client of a request whose body has been read has closed its connection."""
    while (await request.receive())["type"] != "http.disconnect":
        pass


def _view(found: Mapping[str, Any], workers: int | None) -> dict[str, Any]:
    return PlanView(**found, workers=workers).model_dump(mode="json")


async def _events(
    task: asyncio.Task[dict[str, Any]], told: asyncio.Queue[dict[str, Any] | None], workers: int | None
) -> AsyncIterator[bytes]:
    """Yield the events of a plan until it is done; the end of the iteration ends the planning."""
    try:
        while True:
            try:
                now = await asyncio.wait_for(told.get(), HEARTBEAT_SECONDS)
            except TimeoutError:
                yield b": still here\n\n"
                continue
            if now is None:
                break
            yield _event("planning", now)
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
