"""`/v1/jobs/{id}/blends`: blends of a job's scene with its result, and with results of other jobs."""

from __future__ import annotations

import asyncio

from fastapi import APIRouter, Request, Response

from api.http.context import Caller, CallerDep, Context, ContextDep
from api.http.documentation import headers, invalid, links, problems
from api.http.multipart import BodyTypeError, NotUtf8Error, TooSlowError, check_media_type, read_json
from api.http.routes.jobs import JobId, find
from api.http.schemas import ArtifactView, BlendRequest, artifact_view
from service.errors import (
    BusyError,
    BytesQuotaError,
    DamagedFileError,
    InspectionLimitError,
    LostFileError,
    NoArtifactError,
    NoSpaceError,
    RefusedInputError,
    StoreError,
    TooLargeError,
    TooManyBlendsError,
)
from service.inspection.derived import Blend
from service.store.tables import JobRow
from sgsst_core.errors import OutputError, SceneError
from sgsst_core.files.formats import by_name

router = APIRouter(prefix="/v1/jobs", tags=["artifacts"])
#: Maximum bytes of a request's body.
_MAX_BODY = 4096


@router.post(
    "/{job_id}/blends",
    status_code=201,
    response_model=ArtifactView,
    openapi_extra={
        "requestBody": {
            "required": True,
            "content": {"application/json": {"schema": {"$ref": "#/components/schemas/BlendRequest"}}},
        }
    },
    responses={
        201: {
            "description": "The blend exists. The same request returns the same file.",
            "headers": headers("Location"),
            "links": links("get_artifact", "head_artifact", job_id="$request.path.job_id", name="$response.body#/name"),
        },
        **problems(
            NoArtifactError,
            invalid("weight", "Input should be less than or equal to 10"),
            BodyTypeError("application/json"),
            TooLargeError("The request has more than 4,096 bytes. JSON only names uploads, or a key.", _MAX_BODY),
            NotUtf8Error,
            TooSlowError,
            RefusedInputError(
                "scene.ply: has 616 Gaussians, but stylized.ply has 800. Blend scenes with the same Gaussians; "
                "refining splits some.",
                SceneError.code,
            ),
            RefusedInputError(
                "blend.spz: SPZ cannot hold a Gaussian 1e+07 from the origin. Write a PLY, or a .compressed.ply.",
                OutputError.code,
            ),
            InspectionLimitError("Blending the results takes more time or memory than allowed."),
            TooManyBlendsError,
            BytesQuotaError,
            BusyError,
            NoSpaceError,
            StoreError,
            LostFileError,
            DamagedFileError,
        ),
    },
    operation_id="create_blend",
)
async def create_blend(request: Request, job_id: JobId, context: ContextDep, caller: CallerDep) -> Response:
    """Blend a finished job's scene with its result, and store the blend among the job's artifacts."""
    check_media_type(request, "application/json")
    body = BlendRequest.model_validate(await read_json(request, context.settings, _MAX_BODY))
    others = {part.job_id: part.weight for part in body.others}
    if len({job_id, *others}) != 1 + len(body.others):
        raise RefusedInputError("others: A job is named twice. Give each job one weight.", "invalid-request")
    job = await asyncio.to_thread(_find_owned, context, caller, job_id, others)
    row = await context.derived.blended(job, Blend(body.weight, others, by_name(body.format)), caller.quotas)
    view = artifact_view(row)
    return Response(view.model_dump_json(), 201, {"Location": view.url}, media_type="application/json")


def _find_owned(context: Context, caller: Caller, job_id: str, others: dict[str, float]) -> JobRow:
    """Return the caller's job; raise an error unless the caller owns the jobs in `others` too."""
    for other in others:
        find(context, caller, other)
    return find(context, caller, job_id)
