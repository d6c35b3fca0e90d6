"""`/v1/jobs/{id}/video`: a video of a job's result."""

from __future__ import annotations

import asyncio
from typing import Annotated, Any

from fastapi import APIRouter, Depends, Request, Response

from api.http.context import CallerDep, ContextDep
from api.http.multipart import json_body
from api.http.progress import VIDEO, answer_work
from api.http.routes.jobs import JobId, find
from api.http.schemas import ArtifactView, artifact_view
from worker.options import JobVideo

router = APIRouter(prefix="/v1/jobs", tags=["artifacts"])


@router.post(
    "/{job_id}/video",
    response_model=ArtifactView,
    responses={
        200: VIDEO,
    },
    operation_id="make_video",
)
async def make_video(
    request: Request,
    job_id: JobId,
    context: ContextDep,
    caller: CallerDep,
    options: Annotated[JobVideo, Depends(json_body(JobVideo))],
) -> Response:
    """Render a video of the result as `video.mp4`, which replaces an earlier one. It takes minutes.

    The video is completed even if the client closes the connection; repeat the request to wait for it again.
    """
    job = await asyncio.to_thread(find, context, caller, job_id)

    async def work(show: Any) -> ArtifactView:
        return artifact_view(await context.videos.make(job, options, caller.quotas, show))

    return await answer_work(request, work, "rendering", "video")
