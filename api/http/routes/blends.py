"""`/v1/jobs/{id}/blends`: blends of a job's scene with its result, and with results of other jobs."""

from __future__ import annotations

import asyncio
from typing import Annotated

from fastapi import APIRouter, Depends, Response

from api.http.context import Caller, CallerDep, Context, ContextDep
from api.http.documentation import headers, links
from api.http.multipart import json_body
from api.http.routes.jobs import JobId, find
from api.http.schemas import ArtifactView, BlendRequest, artifact_view
from service import problems
from service.inspection.derived import Blend
from service.store.tables import JobRow
from sgsst_core.files.formats import by_name

router = APIRouter(prefix="/v1/jobs", tags=["artifacts"])


@router.post(
    "/{job_id}/blends",
    status_code=201,
    response_model=ArtifactView,
    responses={
        201: {
            "description": "The blend exists. The same request returns the same file.",
            "headers": headers("Location"),
            "links": links("get_artifact", "head_artifact", job_id="$request.path.job_id", name="$response.body#/name"),
        },
    },
    operation_id="create_blend",
)
async def create_blend(
    job_id: JobId,
    context: ContextDep,
    caller: CallerDep,
    body: Annotated[BlendRequest, Depends(json_body(BlendRequest))],
) -> Response:
    """Blend a finished job's scene with its result, and store the blend among the job's artifacts."""
    others = {part.job_id: part.weight for part in body.others}
    if len({job_id, *others}) != 1 + len(body.others):
        raise problems.INVALID_REQUEST("others: A job is named twice. Give each job one weight.")
    job = await asyncio.to_thread(_find_owned, context, caller, job_id, others)
    row = await context.derived.blended(job, Blend(body.weight, others, by_name(body.format)), caller.quotas)
    view = artifact_view(row)
    return Response(view.model_dump_json(), 201, {"Location": view.url}, media_type="application/json")


def _find_owned(context: Context, caller: Caller, job_id: str, others: dict[str, float]) -> JobRow:
    """Return the caller's job; raise an error unless the caller owns the jobs in `others` too."""
    for other in others:
        find(context, caller, other)
    return find(context, caller, job_id)
