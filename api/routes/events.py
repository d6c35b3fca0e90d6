"""`/v1/jobs/{id}/events`: what happens to a job, as server-sent events."""

from __future__ import annotations

import asyncio
from typing import Annotated

from fastapi import APIRouter, Header, Response
from fastapi.responses import StreamingResponse

from api.context import CallerDep, ContextDep
from api.problems import RESPONSES
from api.routes.jobs import find

router = APIRouter(prefix="/v1/jobs", tags=["jobs"], responses=RESPONSES)

#: Of each event of the stream.
_SCHEMA = {
    "type": "object",
    "required": ["id", "event", "data"],
    "properties": {
        "id": {"type": "string", "pattern": "^[0-9]+$"},
        "event": {"type": "string", "enum": ["status", "progress", "artifact"]},
        "data": {"type": "string", "contentMediaType": "application/json"},
    },
}
_EXAMPLE = 'id: 42\nevent: progress\ndata: {"stage": "sos", "step": 120, "total": 300, "fraction": 0.4}\n\n'


@router.get(
    "/{job_id}/events",
    operation_id="watch_job",
    response_class=StreamingResponse,
    responses={
        200: {
            "description": "Events `status`, `progress` and `artifact`, until the job has ended.",
            "content": {"text/event-stream": {"schema": _SCHEMA, "example": _EXAMPLE}},
        },
        204: {"description": "The job has ended, and `Last-Event-ID` was its last event: do not come back."},
    },
)
async def watch_job(
    job_id: str,
    context: ContextDep,
    caller: CallerDep,
    last_event_id: Annotated[
        int | None, Header(alias="Last-Event-ID", ge=0, lt=2**62, description="Go on after this event.")
    ] = None,
) -> Response:
    """Watch a job. A stream that was cut off goes on with `Last-Event-ID`; browsers' `EventSource` sends it."""
    await asyncio.to_thread(find, context, caller, job_id)
    if last_event_id and await context.hub.ended(job_id, last_event_id):
        return Response(status_code=204)
    headers = {"Cache-Control": "no-store", "X-Accel-Buffering": "no"}
    return StreamingResponse(context.hub.watch(job_id, last_event_id or 0), 200, headers, "text/event-stream")
