"""`/v1/jobs/{id}/video`: a video of a job's result."""

from __future__ import annotations

import asyncio
from typing import Any

from fastapi import APIRouter, Request, Response

from api.http.context import CallerDep, ContextDep
from api.http.documentation import invalid, problems
from api.http.multipart import BodyTypeError, NotUtf8Error, TooSlowError, check_media_type, read_json
from api.http.progress import VIDEO, answer_work
from api.http.routes.jobs import JobId, find
from api.http.schemas import ArtifactView, artifact_view
from service.errors import (
    BusyError,
    BytesQuotaError,
    DamagedFileError,
    InspectionLimitError,
    LostFileError,
    NoArtifactError,
    NoSpaceError,
    StoreError,
    TooLargeError,
)
from worker.options import JobVideo

router = APIRouter(prefix="/v1/jobs", tags=["artifacts"])

#: Maximum number of bytes of the options.
_MAX_BODY = 4096


@router.post(
    "/{job_id}/video",
    response_model=ArtifactView,
    openapi_extra={
        "requestBody": {
            "required": True,
            "content": {"application/json": {"schema": {"$ref": "#/components/schemas/JobVideo"}}},
        }
    },
    responses={
        200: VIDEO,
        **problems(
            NoArtifactError,
            invalid("seconds", "Input should be less than or equal to 30"),
            BodyTypeError("application/json"),
            TooLargeError("The request has more than 4,096 bytes. JSON only names uploads, or a key.", _MAX_BODY),
            NotUtf8Error,
            TooSlowError,
            InspectionLimitError("Rendering the video takes more time or memory than allowed."),
            BytesQuotaError,
            BusyError,
            NoSpaceError,
            StoreError,
            LostFileError,
            DamagedFileError,
        ),
    },
    operation_id="make_video",
)
async def make_video(request: Request, job_id: JobId, context: ContextDep, caller: CallerDep) -> Response:
    """Render a video of the result as `video.mp4`, which replaces an earlier one. It takes minutes.

    The video is completed even if the client closes the connection; repeat the request to wait for it again.
    """
    check_media_type(request, "application/json")
    options = JobVideo.model_validate(await read_json(request, context.settings, _MAX_BODY))
    job = await asyncio.to_thread(find, context, caller, job_id)

    async def work(show: Any) -> ArtifactView:
        return artifact_view(await context.videos.make(job, options, caller.quotas, show))

    return await answer_work(request, work, "rendering", "video")
