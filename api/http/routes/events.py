"""`/v1/jobs/{id}/events`: events of a job, as server-sent events."""

from __future__ import annotations

import asyncio
import json
from typing import Annotated

from fastapi import APIRouter, Header, Response
from fastapi.responses import StreamingResponse

from api.http.context import CallerDep, ContextDep, Digits
from api.http.documentation import headers
from api.http.routes.jobs import JobId, find
from api.http.schemas import ProgressView, example_of
from service.problems import SHA256

router = APIRouter(prefix="/v1/jobs", tags=["jobs"])

#: Schema of a single event, because OpenAPI 3.1 cannot describe a stream.
_EVENT = {
    "type": "object",
    "required": ["id", "event", "data"],
    "properties": {
        "id": {"type": "string", "pattern": "^[0-9]+$", "description": "Number for `Last-Event-ID`."},
        "event": {"type": "string", "enum": ["status", "progress", "artifact"]},
        "data": {"type": "string", "contentMediaType": "application/json"},
    },
}
_EXAMPLES = {
    "status": {"status": "running", "attempt": 1},
    "progress": example_of(ProgressView),
    "artifact": {"name": "previews/000100.jpg", "size": 41239, "sha256": SHA256},
}


@router.get(
    "/{job_id}/events",
    response_class=StreamingResponse,
    responses={
        200: {
            "description": "Events `status`, `progress` and `artifact`, until the job has ended. Each is sent as the "
            "lines `id: `, `event: ` and `data: `, followed by an empty line.",
            "headers": headers("Cache-Control", "X-Accel-Buffering"),
            "content": {
                "text/event-stream": {
                    "schema": _EVENT,
                    "examples": {
                        kind: {"value": {"id": str(number), "event": kind, "data": json.dumps(data)}}
                        for number, (kind, data) in enumerate(_EXAMPLES.items(), start=4)
                    },
                }
            },
        },
        204: {"description": "The job has ended, and `Last-Event-ID` was its last event: do not reconnect."},
    },
)
async def watch_job(
    job_id: JobId,
    context: ContextDep,
    caller: CallerDep,
    last_event_id: Annotated[
        Digits | None,
        Header(
            alias="Last-Event-ID",
            ge=0,
            lt=2**62,
            description="ID of the last received event; later ones follow. After an ID that the job has not had, all "
            "events follow.",
            examples=[42],
        ),
    ] = None,
) -> Response:
    """Watch a job. Resume an interrupted stream with `Last-Event-ID`, which browsers' `EventSource` sends by itself."""
    await asyncio.to_thread(find, context, caller, job_id)
    after = await context.hub.resumed(job_id, last_event_id) if last_event_id else 0
    if after is None:
        return Response(status_code=204)
    response_headers = {"Cache-Control": "no-store", "X-Accel-Buffering": "no"}
    return StreamingResponse(context.hub.watch(job_id, after), 200, response_headers, "text/event-stream")
