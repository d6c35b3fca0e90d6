"""`/v1/jobs/{id}/artifacts`, `/blends`, `/video`: files that a job has made, and files made of its result."""

from __future__ import annotations

import asyncio
import re
from functools import partial
from pathlib import PurePosixPath
from typing import Annotated, Any

from fastapi import APIRouter, Depends, Path, Query, Request, Response
from fastapi.responses import StreamingResponse

from api.http.context import Caller, CallerDep, Context, ContextDep, Digits
from api.http.documentation import headers, links
from api.http.multipart import json_body
from api.http.progress import VIDEO, answer_work
from api.http.routes.jobs import JobId, find
from api.http.schemas import ArtifactList, ArtifactView, BlendRequest, artifact_view
from api.http.sending import ConditionsDep, SentFile, file_answers, send_file, send_list
from api.static_files import exported_viewer
from service import problems
from service.files.objects import media_type
from service.inputs import RESULT
from service.inspection.derived import PAGE, Blend
from service.problems import LostFileError
from service.store.tables import ArtifactRow, JobRow
from sgsst_core.files.formats import EXTRA_FORMATS, DownloadName, by_name, listed, result_name
from sgsst_core.files.formats.ply import PLY
from worker.options import JobVideo

router = APIRouter(prefix="/v1/jobs", tags=["artifacts"])

#: Media types that a browser may show inline. The HTML report may run its own script, but is isolated from this site.
_INLINE = ("image/", "video/", "text/html", "application/json", "text/plain")
#: Spaces and punctuation, but for those that names of files have.
_NO_WORD = re.compile(r"[\x00-,/:-@\[-^`{-\xbf\u2000-\u206f\s]+")
_SANDBOX = (
    "sandbox allow-scripts; default-src 'none'; style-src 'unsafe-inline'; script-src 'unsafe-inline'; img-src data:"
)


@router.get(
    "/{job_id}/artifacts",
    response_model=ArtifactList,
    responses={
        200: {
            "links": links(
                "get_artifact", "head_artifact", job_id="$request.path.job_id", name="$response.body#/artifacts/0/name"
            )
        }
    },
)
async def list_artifacts(
    job_id: JobId,
    context: ContextDep,
    caller: CallerDep,
    cursor: Annotated[
        str, Query(max_length=200, description="`next_cursor` of a page.", examples=["previews/step_0000100.jpg"])
    ] = "",
    limit: Annotated[Digits, Query(ge=1, le=1000, description="Files on a page.", examples=[1000])] = 1000,
) -> Response:
    """List the files that a job has made so far, by name. A running job has its plan and previews."""
    await asyncio.to_thread(find, context, caller, job_id)

    def read(after: str | None, most: int) -> tuple[list[ArtifactView], str | None]:
        page = context.store.jobs.artifacts(job_id, after or "", most + 1)
        following = page[most - 1].name if len(page) > most else None
        return [artifact_view(row) for row in page[:most] if not row.name.startswith(".")], following

    return await send_list("artifacts", read, cursor, limit, context.readers.of(caller.owner))


#: Media types of results (`service.files.objects`), and how the content of each starts.
_CONTENT = {
    "application/octet-stream": "ply\nformat binary_little_endian 1.0\nelement vertex 616\n",
    "model/gltf-binary": "glTF\x02\0\0\0",
    "application/json": {"version": 1, "decisions": []},
    "text/html": "<!doctype html><html lang=en><title>Report</title></html>",
    "text/plain": "14:02:11 info    stylizing 616 Gaussians, 3 views\n",
    "image/jpeg": "\xff\xd8\xff\xe0",
    "image/png": "\x89PNG\r\n\x1a\n",
    "video/mp4": "\0\0\0 ftypisom",
}
_ANSWERS = file_answers(_CONTENT)


@router.head(
    "/{job_id}/artifacts/{name:path}", operation_id="head_artifact", response_class=Response, responses=_ANSWERS
)
@router.get(
    "/{job_id}/artifacts/{name:path}", operation_id="get_artifact", response_class=StreamingResponse, responses=_ANSWERS
)
async def get_artifact(
    request: Request,
    job_id: JobId,
    name: Annotated[str, Path(description="Name in the list of artifacts.", examples=["stylized.ply"])],
    context: ContextDep,
    caller: CallerDep,
    conditions: ConditionsDep,
    format_: Annotated[
        DownloadName | None,
        Query(
            alias="format",
            description="Format of `stylized.ply`. The file is converted at the first request, which takes about ten "
            "seconds for a million Gaussians, and stored beside the PLY; "
            f"{listed([f'`{result_name(RESULT, each.name)}.json`' for each in EXTRA_FORMATS])} then has its loss as "
            "PSNR in the job's views. `html` is a page that shows the result in 3D without a server, beside the scene "
            "if both have the same Gaussians.",
            examples=["spz"],
        ),
    ] = None,
) -> Response:
    """Download a file, whole or in ranges. Resume with `Range` and `If-Range`."""
    job = await asyncio.to_thread(find, context, caller, job_id)
    row = await _find_artifact(context, caller, job, name, format_)
    # the suggested name includes the job's, so that results of jobs differ
    plain, last = _NO_WORD.sub("_", job.name).strip("._")[:60], PurePosixPath(row.name).name
    file = artifact_file(context, job.owner, row, f"{plain}-{last}" if plain else last, media_type(row.name))
    return await send_file(request, context.threads, file, conditions)


async def _find_artifact(context: Context, caller: Caller, job: JobRow, name: str, format_: str | None) -> ArtifactRow:
    """Return the database row of a published file, or of the result in another format."""
    if format_ is not None and format_ != PLY.name:
        if name != RESULT:
            raise problems.INVALID_REQUEST(f"Only {RESULT} has other formats. Omit 'format'.")
        if format_ == "html":
            return await context.derived.page(job, exported_viewer(), caller.quotas)
        return await context.derived.compressed(job, by_name(format_), caller.quotas)
    row = None if name.startswith(".") else await asyncio.to_thread(context.store.jobs.artifact, job.id, name)
    if row is None:
        raise problems.NO_ARTIFACT(job_id=job.id, name=name[:80])
    return row


def artifact_file(context: Context, owner: str, row: ArtifactRow, name: str, kind: str) -> SentFile:
    """Return a stored result for sending it under a name, with a media type."""
    check, read = partial(check_artifact, context, row), partial(context.artifacts.objects.read, row.location)
    policy = _SANDBOX if kind.startswith("text/html") else None
    inline = kind.startswith(_INLINE) and row.name != PAGE  # the policy would not let the page show anything
    return SentFile(owner, row.sha256, row.size, name, kind, check, read, policy, inline=inline)


def check_artifact(context: Context, row: ArtifactRow) -> None:
    """Check that a stored result matches its database row.

    Raises:
        LostFileError, DamagedFileError: If the file is missing or damaged.
        NotFoundError: If the file has just been replaced by another one, or its job has been deleted.
    """
    try:
        context.artifacts.objects.check_once(row.location, row.sha256)
    except LostFileError:
        now = context.store.jobs.artifact(row.job_id, row.name)
        if now is None or now.location != row.location:
            raise problems.FILE_REMOVED() from None
        raise


@router.post(
    "/{job_id}/blends",
    status_code=201,
    response_model=ArtifactView,
    responses={
        201: {
            "description": "The blend exists. The same request returns the same file.",
            "headers": headers("Location"),
            "links": links("get_artifact", "head_artifact", job_id="$request.path.job_id", name="$response.body#/name"),
        }
    },
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
    for other in others:
        await asyncio.to_thread(find, context, caller, other)
    job = await asyncio.to_thread(find, context, caller, job_id)
    row = await context.derived.blended(job, Blend(body.weight, others, by_name(body.format)), caller.quotas)
    view = artifact_view(row)
    return Response(view.model_dump_json(), 201, {"Location": view.url}, media_type="application/json")


@router.post("/{job_id}/video", response_model=ArtifactView, responses={200: VIDEO})
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
        return artifact_view(await context.derived.video(job, options, caller.quotas, show))

    return await answer_work(request, work, "rendering", "video", context.hub.working)
