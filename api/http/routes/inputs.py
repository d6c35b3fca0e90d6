"""`/v1/jobs/{id}/inputs`: the files that a job was created from, as they were sent."""

from __future__ import annotations

import asyncio
import re
from functools import partial
from pathlib import PurePosixPath
from typing import Annotated, Any

from fastapi import APIRouter, Path, Query, Request, Response
from fastapi.responses import StreamingResponse

from api.http.context import Caller, CallerDep, Context, ContextDep, Digits
from api.http.documentation import links
from api.http.routes.jobs import JobId, find
from api.http.schemas import InputFileView, InputList, input_view
from api.http.sending import ConditionsDep, SentFile, file_answers, send_file, send_list
from service import problems
from service.files.blobs import BLOBS
from service.problems import LostFileError
from service.states import JobStatus
from service.store.jobs import Jobs
from service.store.tables import BlobRow, JobRow

router = APIRouter(prefix="/v1/jobs", tags=["inputs"])

#: Media types of inputs by file extension. Images can be shown in a page; everything else is sent as bytes.
_KINDS = {
    ".png": "image/png",
    ".jpg": "image/jpeg",
    ".jpeg": "image/jpeg",
    ".webp": "image/webp",
    ".json": "application/json",
}
_INPUT = re.compile(r"([a-z]{1,10})(?::([0-9]{1,6}))?", re.ASCII)
#: Content-Security-Policy of inputs. Users provide these files, so no script in them may run.
INPUT_POLICY = "sandbox; default-src 'none'"


_CONTENT: dict[str, Any] = {
    "application/octet-stream": "ply\nformat binary_little_endian 1.0\nelement vertex 616\n",
    "application/json": [{"id": 0, "img_name": "view_0", "width": 64, "height": 48}],
    "image/jpeg": "\xff\xd8\xff\xe0",
    "image/png": "\x89PNG\r\n\x1a\n",
    "image/webp": "RIFF",
}
_ANSWERS = file_answers(_CONTENT, always_policy=True)


@router.get(
    "/{job_id}/inputs",
    response_model=InputList,
    responses={
        200: {
            "links": links(
                "get_input", "head_input", job_id="$request.path.job_id", role="$response.body#/inputs/0/role"
            )
        }
    },
)
async def list_inputs(
    job_id: JobId,
    context: ContextDep,
    caller: CallerDep,
    cursor: Annotated[Digits, Query(ge=0, lt=2**31, description="`next_cursor` of a page.", examples=[0])] = 0,
    limit: Annotated[Digits, Query(ge=1, le=1000, description="Files on a page.", examples=[1000])] = 1000,
) -> Response:
    """List the files that a job was created from, photos and masks included."""
    await asyncio.to_thread(find, context, caller, job_id)

    def read(start: str | None, most: int) -> tuple[list[InputFileView], str | None]:
        position = int(start or 0)
        page = context.store.jobs.input_page(job_id, position, most + 1)
        following = str(position + most) if len(page) > most else None
        return [input_view(job_id, *entry) for entry in page[:most]], following

    return await send_list("inputs", read, str(cursor), limit, context.readers.of(caller.owner))


@router.head("/{job_id}/inputs/{role}", operation_id="head_input", response_class=Response, responses=_ANSWERS)
@router.get("/{job_id}/inputs/{role}", operation_id="get_input", response_class=StreamingResponse, responses=_ANSWERS)
async def get_input(
    request: Request,
    job_id: JobId,
    role: Annotated[
        str,
        Path(
            description="`scene`, `style`, `cameras`, `photos` or `mask`; of several files the first one, or `style:1` "
            "and so on, counted from 0 in the order of the list.",
            examples=["scene"],
        ),
    ],
    context: ContextDep,
    caller: CallerDep,
    conditions: ConditionsDep,
) -> Response:
    """Download a file that a job was created from, whole or in ranges, until the job expires."""
    entry, row = await asyncio.to_thread(_find_input, context, caller, job_id, role)
    kind = _KINDS.get(PurePosixPath(entry["name"]).suffix.lower(), "application/octet-stream")
    file = input_file(context, caller.owner, row, entry["name"], kind)
    return await send_file(request, context.threads, file, conditions)


def input_file(context: Context, owner: str, row: BlobRow, name: str, kind: str) -> SentFile:
    """Return a stored input for sending it under a name, with a media type."""
    path = f"{BLOBS}/{row.location}"
    check, read = partial(_check_input, context, row), partial(context.blobs.objects.read, path)
    return SentFile(owner, row.sha256, row.size, name, kind, check, read, policy=INPUT_POLICY)


def _check_input(context: Context, row: BlobRow) -> None:
    """Check that a stored input matches its database row.

    Raises:
        LostFileError, DamagedFileError: If the file is missing or damaged.
        NotFoundError: If the file has just been deleted with its job.
    """
    try:
        context.blobs.objects.check_once(f"{BLOBS}/{row.location}", row.sha256)
    except LostFileError:
        if not context.store.inputs.blobs([row.sha256]):
            raise problems.FILE_REMOVED() from None
        raise


def _find_input(context: Context, caller: Caller, job_id: str, role: str) -> tuple[dict[str, Any], BlobRow]:
    """Return the job's entry for an input file, and the database row of its blob.

    Raises:
        NO_INPUT: If the job has no such input, or has expired and released its inputs.
    """
    job = find(context, caller, job_id)
    entry = find_input(context.store.jobs, job, role)
    if entry is not None:
        row = context.store.inputs.blobs([entry["sha256"]]).get(entry["sha256"])
        if row is not None:
            return entry, row
    raise problems.NO_INPUT(job_id=job.id, name=role[:40])


def parse_input(name: str) -> tuple[str, int] | None:
    """Return role and index of an input such as "scene" or "style:1", or None if it is not such a name."""
    match = _INPUT.fullmatch(name)
    return (match[1], int(match[2] or 0)) if match else None


def find_input(jobs: Jobs, job: JobRow, name: str) -> dict[str, Any] | None:
    """Return a job's entry for an input such as "scene" or "style:1"; None if it is missing or was released."""
    place = parse_input(name)
    return None if place is None or job.status == JobStatus.EXPIRED else jobs.input(job.id, *place)
