"""`/v1/jobs/{id}/artifacts`: the files that a job has made."""

from __future__ import annotations

import asyncio
import re
from collections.abc import Iterator
from itertools import chain
from pathlib import PurePosixPath
from typing import Annotated, Literal

from fastapi import APIRouter, Header, Path, Query, Request, Response
from fastapi.responses import StreamingResponse

from api.http.context import CallerDep, Context, ContextDep
from api.http.documentation import Responses, headers, invalid, links, problems
from api.http.routes.jobs import IfNoneMatch, JobId, find
from api.http.schemas import JOB_ID, SHA256, ArtifactList, artifact_view
from service.errors import BusyError, NoSpaceError, NotFoundError, RefusedInputError, ServiceError, StoreError
from service.files.artifacts import media_type
from service.files.names import RESULT
from service.store.tables import ArtifactRow, JobRow

#: Of a result.
Form = Literal["ply", "compressed.ply", "spz"]

router = APIRouter(prefix="/v1/jobs", tags=["artifacts"])

#: What a browser may show in place; a page of results may run its own script, and nothing else of this site's.
_INLINE = ("image/", "text/html", "application/json", "text/plain")
_SANDBOX = (
    "sandbox allow-scripts; default-src 'none'; style-src 'unsafe-inline'; script-src 'unsafe-inline'; img-src data:"
)


_NO_JOB = NotFoundError(f"There is no job {JOB_ID}.")


class RangeError(ServiceError):
    """A range that the file does not have."""

    code, status = "range-not-satisfiable", 416


@router.get(
    "/{job_id}/artifacts",
    response_model=ArtifactList,
    responses={
        200: {
            "links": links(
                "get_artifact", "head_artifact", job_id="$request.path.job_id", name="$response.body#/artifacts/0/name"
            )
        },
        **problems(_NO_JOB),
    },
    operation_id="list_artifacts",
)
def list_artifacts(job_id: JobId, context: ContextDep, caller: CallerDep) -> ArtifactList:
    """All files that a job has made so far; a running job has its plan and previews."""
    find(context, caller, job_id)
    rows = context.store.jobs.artifacts(job_id)
    return ArtifactList(artifacts=[artifact_view(row) for row in rows if not row.name.startswith(".")])


#: The media types of results (`service.files.artifacts`), and how each begins.
_CONTENT = {
    "application/octet-stream": "ply\nformat binary_little_endian 1.0\nelement vertex 616\n",
    "application/json": {"version": 1, "decisions": []},
    "text/html": "<!doctype html><html lang=en><title>Report</title></html>",
    "text/plain": "14:02:11 info    stylizing 616 Gaussians, 3 views\n",
    "image/jpeg": "\xff\xd8\xff\xe0",
    "image/png": "\x89PNG\r\n\x1a\n",
}
_FILE = {
    "content": {
        kind: {"schema": {} if "json" in kind else {"type": "string", "format": "binary"}, "example": begin}
        for kind, begin in _CONTENT.items()
    }
}
_SENT = ("ETag", "Accept-Ranges", "Cache-Control", "Content-Disposition", "X-Content-Type-Options")
_ANSWERS: Responses = {
    200: {
        "description": "The file. Its ETag is the SHA-256 of its content.",
        "headers": headers(*_SENT, "Content-Length", maybe=("Content-Security-Policy",)),
        **_FILE,
    },
    206: {
        "description": "The part that `Range` asks for.",
        "headers": headers(*_SENT, "Content-Length", "Content-Range", maybe=("Content-Security-Policy",)),
        **_FILE,
    },
    304: {
        "description": "`If-None-Match` names what is there.",
        "headers": headers(*_SENT, maybe=("Content-Security-Policy",)),
    },
    **problems(
        NotFoundError(f"Job {JOB_ID} has no file 'stylized.ply' (yet). Its artifacts list has all there are."),
        RangeError("The file has 42301 bytes.", headers={"Content-Range": "bytes */42301"}),
        invalid("query.format", "Input should be 'ply', 'compressed.ply' or 'spz'"),
        RefusedInputError(
            "stylized.spz: SPZ cannot hold a Gaussian 1e+07 from the origin. Write a PLY, or a .compressed.ply.",
            "invalid-output",
        ),
        RefusedInputError("Packing the result takes more time or memory than allowed.", "inspection-limit"),
        BusyError("Files cannot be checked at the moment. Try again later.", retry_after=10),
        NoSpaceError("The service's disk is too full to take this in. Try again later."),
        StoreError("The service's store of files does not answer. Try again later.", retry_after=10),
    ),
}


@router.head(
    "/{job_id}/artifacts/{name:path}", operation_id="head_artifact", response_class=Response, responses=_ANSWERS
)
@router.get(
    "/{job_id}/artifacts/{name:path}",
    operation_id="get_artifact",
    response_class=StreamingResponse,
    responses=_ANSWERS,
)
async def get_artifact(
    request: Request,
    job_id: JobId,
    name: Annotated[str, Path(description="As the list of artifacts has it.", examples=["stylized.ply"])],
    context: ContextDep,
    caller: CallerDep,
    range_: Annotated[
        str | None, Header(alias="Range", description="One range of bytes.", examples=["bytes=0-1023"])
    ] = None,
    if_range: Annotated[
        str | None,
        Header(alias="If-Range", description="An ETag; for another one all is sent.", examples=[f'"{SHA256}"']),
    ] = None,
    if_none_match: IfNoneMatch = None,
    form: Annotated[
        Form | None,
        Query(
            alias="format",
            description="Of `stylized.ply`: another form of it. It is made when it is first asked for, which takes "
            "some ten seconds for a million Gaussians, and is kept beside the PLY; `stylized.spz.json` or "
            "`stylized.compressed.ply.json` then says what it loses, as PSNR of the job's views.",
            examples=["spz"],
        ),
    ] = None,
) -> Response:
    """Download a file, whole or in ranges, to be resumed with `Range` and `If-Range`."""
    job = await asyncio.to_thread(find, context, caller, job_id)
    row = await _find_artifact(context, job, name, form)
    tag = f'"{row.sha256}"'
    sent = _headers(row, tag, job.name)
    if if_none_match is not None and (tag in if_none_match or if_none_match.strip() == "*"):
        return Response(status_code=304, headers=sent)
    span = _parse_range(range_, row.size) if range_ and if_range in (None, tag) else None
    start, stop = span or (0, row.size)
    sent["Content-Length"] = str(stop - start)
    if span:
        sent["Content-Range"] = f"bytes {start}-{stop - 1}/{row.size}"
    status = 206 if span else 200
    if request.method == "HEAD":
        return Response(status_code=status, headers=sent, media_type=media_type(row.name))
    body = context.artifacts.read(row.location, start, stop)
    first = await asyncio.to_thread(_first, body)  # what fails now can still be answered
    return StreamingResponse(chain(first, body), status, sent, media_type(row.name))


async def _find_artifact(context: Context, job: JobRow, name: str, form: Form | None) -> ArtifactRow:
    """A published file, or another form of the result."""
    if form is not None and form != "ply":
        if name != RESULT:
            raise RefusedInputError(f"Only {RESULT} has other forms. Leave 'format' out.", "invalid-request")
        return await context.packer.packed(job, form)
    row = None if name.startswith(".") else await asyncio.to_thread(context.store.jobs.artifact, job.id, name)
    if row is None:
        raise NotFoundError(f"Job {job.id} has no file {name[:80]!r} (yet). Its artifacts list has all there are.")
    return row


def _first(body: Iterator[bytes]) -> list[bytes]:
    """The first piece of a body, where it has one."""
    return [piece for piece in (next(body, None),) if piece is not None]


def _headers(row: ArtifactRow, tag: str, job_name: str) -> dict[str, str]:
    kind = media_type(row.name)
    plain = re.sub(r"[^A-Za-z0-9._-]+", "_", job_name).strip("._")[:60]
    file_name = f"{plain}-{PurePosixPath(row.name).name}" if plain else PurePosixPath(row.name).name
    inline = kind.startswith(_INLINE)
    sent = {
        "ETag": tag,
        "Accept-Ranges": "bytes",
        "Cache-Control": "private, no-cache",
        "X-Content-Type-Options": "nosniff",
        "Content-Disposition": f'{"inline" if inline else "attachment"}; filename="{file_name}"',
    }
    if kind.startswith("text/html"):
        sent["Content-Security-Policy"] = _SANDBOX
    return sent


def _parse_range(text: str, size: int) -> tuple[int, int] | None:
    """First byte and the one behind the last; None where the header asks for several ranges or makes no sense.

    Raises:
        RangeError: the range lies behind the end.
    """
    match = re.fullmatch(r"bytes=(\d{0,18})-(\d{0,18})", text.strip())
    if match is None or match[0] == "bytes=-":
        return None
    first, last = match[1], match[2]
    if not first:
        start, stop = max(0, size - int(last)), size
    else:
        start, stop = int(first), min(size, int(last) + 1) if last else size
        if last and int(last) < start:
            return None
    if start >= stop:
        raise RangeError(f"The file has {size} bytes.", headers={"Content-Range": f"bytes */{size}"})
    return start, stop
