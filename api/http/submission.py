"""Requests that bring files: `/v1/uploads`, files in resumable parts, and `POST /v1/jobs`, a job that is queued, or
planned, after all its files have been read and checked.

Uploads follow the tus protocol 1.0 (https://tus.io/protocols/resumable-upload).
"""

import asyncio
import base64
import hashlib
import json
import re
import secrets
import threading
from collections.abc import Callable, Mapping, Sequence
from contextlib import AsyncExitStack, suppress
from email.utils import formatdate
from functools import cache, partial
from typing import Annotated, Any

from fastapi import APIRouter, Depends, Header, Path, Query, Request, Response
from pydantic import BaseModel, ConfigDict, Field

from api.http import receiving
from api.http.context import Caller, CallerDep, Context, ContextDep, Digits, is_id
from api.http.jobs import DRY_RUN, FOLLOWING_OPERATIONS, answer_work, parse_input
from api.http.problems import headers, links, raises
from api.http.schemas import JobView, PlanView, UploadView, address, job_view, subpath, upload_view
from service import problems
from service.deadlines import suspended
from service.inputs import MOST_STYLES, RESULT, JobParameters, check_roles, default_job_name, staged_name
from service.inspection.inspector import Show
from service.problems import UPLOAD_ID, NotFoundError, ServiceError, StoreError
from service.scheduling.webhooks import check_url
from service.settings import check_weights
from service.states import JobStatus, WebhookEvent
from service.store.files import check_offset
from service.store.jobs import Idempotency, NewJob
from service.store.tables import ArtifactRow, BlobRow, UploadRow
from sgsst_core.files.formats import TITLES
from worker.options import MOST_PAINTED

# --- uploads ---------------------------------------------------------------------------------------------------------

uploads_router = APIRouter(prefix="/v1/uploads", tags=["uploads"])

VERSION = "1.0.0"
#: Supported extensions of the protocol, and headers of others: name, part of the value, extension.
EXTENSIONS = "creation,expiration,checksum,termination"
_UNSUPPORTED = (
    ("Upload-Concat", "", "concatenation"),
    ("Upload-Defer-Length", "", "creation-defer-length"),
    ("Trailer", "upload-checksum", "checksum-trailer"),
)
#: Digest algorithms of `Upload-Checksum`.
_ALGORITHMS = ("sha256", "sha1", "md5")
#: Number of bytes after which an upload's state is saved. A crash loses at most this many bytes.
_SAVE_BYTES = 64 << 20
#: Media type of a part of a file.
_PART_TYPE = "application/offset+octet-stream"
_HEADERS = {"Tus-Resumable": VERSION, "Cache-Control": "no-store"}


IdempotencyHeader = Annotated[
    str | None,
    Header(
        alias="Idempotency-Key",
        min_length=1,
        max_length=180,
        description="Unique key of the request. Repeating it within a day creates nothing twice.",
        examples=["5f0c9a52-9a3b-4c39-8a1c-0d9a2b8b6d1e"],
    ),
]
UploadId = Annotated[str, Path(description="ID of an upload.", examples=[UPLOAD_ID])]


@raises(problems.TUS_VERSION, problems.TUS_EXTENSION)
def check_protocol(
    request: Request,
    tus: Annotated[
        str,
        Header(
            alias="Tus-Resumable",
            description="Protocol version. Requests without it are rejected.",
            examples=[VERSION],
            json_schema_extra={"pattern": r"^1\.0\.0$"},  # generators of clients do not support constants in headers
        ),
    ] = "",
) -> None:
    """Refuse a request that does not state the protocol version, or uses an unsupported extension.

    tus requires the version for all methods except OPTIONS.

    Raises:
        TUS_VERSION: If the version is missing or not supported.
        TUS_EXTENSION: If a header belongs to an unsupported extension. Ignoring it would store other bytes than meant.
    """
    if tus != VERSION:
        reason = f"{tus[:20]!r} is not supported" if tus else "is missing"
        raise problems.TUS_VERSION(reason=reason, version=VERSION)
    for header, value, extension in _UNSUPPORTED:
        if value in request.headers.get(header, "").lower() and header in request.headers:
            raise problems.TUS_EXTENSION(header=header, extension=extension, supported=EXTENSIONS)
    empty = request.headers.get("content-length", "0") == "0" and "transfer-encoding" not in request.headers
    if request.method == "POST" and receiving.media_type(request) == _PART_TYPE and not empty:
        raise problems.TUS_EXTENSION(header="Content-Type", extension="creation-with-upload", supported=EXTENSIONS)


_REQUIRES_TUS = [Depends(check_protocol)]


_NEW = {"upload_id": "$response.body#/id"}
#: OpenAPI links to the operations that a client may call next on a new upload.
_FOLLOWING_OPERATIONS = {
    **links("get_upload", "head_upload", "delete_upload", **_NEW),
    **links("append_upload", **_NEW, **{"Upload-Offset": "0"}),
}


@uploads_router.options(
    "",
    status_code=204,
    responses={
        204: {
            "description": "The answer is in the headers.",
            "headers": headers(
                "Tus-Resumable", "Tus-Version", "Tus-Extension", "Tus-Checksum-Algorithm", "Tus-Max-Size"
            ),
        }
    },
)
def describe_uploads(context: ContextDep) -> Response:
    """Describe the supported protocol version and extensions."""
    response_headers = {
        "Tus-Resumable": VERSION,
        "Tus-Version": VERSION,
        "Tus-Extension": EXTENSIONS,
        "Tus-Checksum-Algorithm": ",".join(_ALGORITHMS),
        "Tus-Max-Size": str(context.settings.max_upload_bytes),
    }
    return Response(status_code=204, headers=response_headers)


@uploads_router.post(
    "",
    status_code=201,
    dependencies=_REQUIRES_TUS,
    response_model=UploadView,
    responses={
        201: {
            "description": "The upload is created; send its bytes to the `Location`.",
            "headers": headers("Location", "Tus-Resumable", "Upload-Expires", "Cache-Control"),
            "links": _FOLLOWING_OPERATIONS,
        }
    },
)
async def create_upload(
    context: ContextDep,
    caller: CallerDep,
    length: Annotated[
        Digits,
        Header(alias="Upload-Length", ge=0, lt=2**60, description="Size of the whole file in bytes.", examples=[42301]),
    ],
    metadata: Annotated[
        str,
        Header(
            alias="Upload-Metadata",
            max_length=4000,
            description="`filename` and its base64.",
            examples=["filename c2NlbmUucGx5"],
        ),
    ] = "",
    idempotency_key: IdempotencyHeader = None,
) -> Response:
    """Start an upload. Send its bytes with PATCH to the `Location` of the answer."""
    limit = context.settings.max_upload_bytes
    if length > limit:
        raise problems.TOO_LARGE(f"The file has {length:,} bytes. At most {limit:,} are allowed.", limit=limit)
    name = staged_name("upload", uploaded_name(metadata))
    if not length:
        raise problems.MALFORMED_BODY(f"{name}: is empty (Upload-Length: 0). Choose a file with content.")
    seconds = context.settings.upload_hours * 3600
    await context.threads.run(caller.owner, context.blobs.ensure_space, length)
    row = await asyncio.to_thread(
        context.store.inputs.create_upload,
        caller.owner,
        length,
        name,
        metadata,
        seconds,
        idempotency_key,
        caller.quotas,
    )
    response_headers = {
        **_HEADERS,
        "Location": address(f"/v1/uploads/{row.id}"),
        "Upload-Expires": formatdate(row.expires_at, usegmt=True),
    }
    return Response(upload_view(row).model_dump_json(), 201, response_headers, "application/json")


@uploads_router.get("/{upload_id}", response_model=UploadView)
def get_upload(upload_id: UploadId, context: ContextDep, caller: CallerDep) -> UploadView:
    """Get the state of an upload as JSON."""
    return upload_view(_find_upload(context, caller.owner, upload_id))


@uploads_router.head(
    "/{upload_id}",
    dependencies=_REQUIRES_TUS,
    responses={
        200: {
            "description": "The answer is in the headers.",
            "headers": headers(
                "Upload-Offset",
                "Upload-Length",
                "Upload-Expires",
                "Tus-Resumable",
                "Cache-Control",
                maybe=("Upload-Metadata",),
            ),
        }
    },
    response_class=Response,
)
def head_upload(upload_id: UploadId, context: ContextDep, caller: CallerDep) -> Response:
    """Get the state of an upload as headers. `Upload-Offset` is where to resume."""
    row = _find_upload(context, caller.owner, upload_id)
    response_headers = {
        **_HEADERS,
        "Upload-Offset": str(row.offset),
        "Upload-Length": str(row.length),
        "Upload-Expires": formatdate(row.expires_at, usegmt=True),
    }
    if row.metadata_header:
        response_headers["Upload-Metadata"] = row.metadata_header
    return Response(headers=response_headers)


_PATCH_BODY = {
    "requestBody": {
        "required": True,
        "content": {
            _PART_TYPE: {
                "schema": {"type": "string", "format": "binary"},
                "example": "ply\nformat binary_little_endian 1.0\nelement vertex 616\n",
            }
        },
    }
}


@uploads_router.patch(
    "/{upload_id}",
    status_code=204,
    dependencies=_REQUIRES_TUS,
    responses={
        204: {
            "description": "The part is stored; `Upload-Offset` is where the next part starts.",
            "headers": headers("Upload-Offset", "Upload-Expires", "Tus-Resumable", "Cache-Control"),
        }
    },
    openapi_extra=_PATCH_BODY,
    response_class=Response,
)
async def append_upload(
    request: Request,
    upload_id: UploadId,
    context: ContextDep,
    caller: CallerDep,
    offset: Annotated[
        Digits,
        Header(
            alias="Upload-Offset", ge=0, lt=2**60, description="Offset of these bytes in the file.", examples=[16384]
        ),
    ],
    checksum: Annotated[
        str | None,
        Header(
            alias="Upload-Checksum",
            description="Algorithm and base64 of this part's digest.",
            examples=["sha1 Kq5sNclPz7QV2+lfQIuc6R7oRu0="],
        ),
    ] = None,
) -> Response:
    """Send the next part. If the connection breaks, received bytes are stored unless a checksum was announced."""
    receiving.check_media_type(request, _PART_TYPE)
    expected = _parse_checksum(checksum) if checksum else None
    row = await asyncio.to_thread(_find_upload, context, caller.owner, upload_id)
    if row.sha256 is not None and offset != row.length:
        raise problems.CONFLICT(f"The upload is complete with {row.length} bytes.", offset=row.length)
    check_offset(row, offset)
    expires = row.expires_at
    if row.sha256 is None and row.offset == row.length:  # the service died before it recorded the upload as complete
        finish, seconds = context.blobs.finish_upload, context.settings.upload_hours * 3600
        await context.threads.run(caller.owner, finish, row, seconds, size=row.length)
    elif row.sha256 is None:
        expires = await _append_body(request, context, row, expected)
    else:
        async for _ in receiving.body_blocks(request, context.settings):
            raise _longer_than_declared(row.length)
    row = await asyncio.to_thread(_find_upload, context, caller.owner, upload_id)
    response_headers = {"Upload-Offset": str(row.offset), "Upload-Expires": formatdate(expires, usegmt=True)}
    return Response(status_code=204, headers=_HEADERS | response_headers)


@uploads_router.delete(
    "/{upload_id}",
    status_code=204,
    dependencies=_REQUIRES_TUS,
    responses={204: {"description": "The upload is deleted.", "headers": headers("Tus-Resumable", "Cache-Control")}},
)
async def delete_upload(upload_id: UploadId, context: ContextDep, caller: CallerDep) -> Response:
    """Cancel an upload, or delete a finished one. Jobs that use it keep their file."""
    await asyncio.to_thread(_find_upload, context, caller.owner, upload_id)
    unused = await asyncio.to_thread(context.store.inputs.delete_upload, upload_id, caller.owner)
    part, blobs = partial(context.blobs.discard_upload, upload_id), partial(context.blobs.remove, unused)
    await context.receipts.remove(caller.owner, part, blobs)
    return Response(status_code=204, headers=_HEADERS)


async def _append_body(request: Request, context: Context, row: UploadRow, checksum: tuple[str, bytes] | None) -> float:
    """Append the request's body to the upload, and return the upload's new expiry time.

    Args:
        checksum: Algorithm and expected digest of the body; None for no check.
    """
    run = partial(context.threads.run, row.owner)
    writer = await run(_Writer, context, row, checksum)
    try:
        try:
            async for block in receiving.body_blocks(request, context.settings):
                await run(writer.write, block, size=_SAVE_BYTES)
        except ServiceError as error:
            if checksum is None and not isinstance(error, StoreError):
                await run(writer.save, size=_SAVE_BYTES)  # no checksum can contradict them
            raise
        return await run(writer.finish, size=row.length if writer.complete else _SAVE_BYTES)
    finally:
        await context.threads.clean_up(run(writer.close))


class _Writer:
    """Writer that checks received bytes and saves them at intervals.

    A thread that hangs and was given up blocks the others, so that no file is closed while it is written to.
    """

    def __init__(self, context: Context, row: UploadRow, checksum: tuple[str, bytes] | None) -> None:
        self._context, self._row, self._checksum = context, row, checksum
        self._lock = threading.RLock()
        self._seconds = context.settings.upload_hours * 3600
        self._part = context.blobs.append(row, self._seconds)
        self._digest = hashlib.new(checksum[0]) if checksum else None

    def write(self, block: bytes) -> None:
        if self._part.offset + len(block) > self._row.length:
            raise _longer_than_declared(self._row.length)
        with self._lock:
            self._context.blobs.ensure_space(len(block))
            self._part.write(block)
            if self._digest is not None:
                self._digest.update(block)
            elif self._part.offset - self._part.saved >= _SAVE_BYTES:
                self.save()

    @property
    def complete(self) -> bool:
        """Whether all bytes of the upload have been written."""
        return self._part.offset == self._row.length

    def save(self) -> float:
        """Make the received bytes durable, then update the database. Return the upload's new expiry time."""
        with self._lock:
            return self._part.save()

    def finish(self) -> float:
        """Verify and save the bytes of the request. Store the file as a blob if the upload is complete."""
        if self._digest is not None and self._checksum is not None and self._digest.digest() != self._checksum[1]:
            self._part.discard()
            raise problems.CHECKSUM_MISMATCH()
        expires = self.save()
        self.close()
        if self.complete:
            self._context.blobs.finish_upload(self._row, self._seconds)
        return expires

    def close(self) -> None:
        with self._lock:
            self._part.close()


def _longer_than_declared(length: int) -> ServiceError:
    """Return the error for a part with more bytes than the upload lacks."""
    return problems.TOO_LARGE(f"The parts have more bytes than the {length:,} of Upload-Length.", limit=length)


def _parse_checksum(header: str) -> tuple[str, bytes]:
    """Return the algorithm and the digest of an `Upload-Checksum` header.

    Raises:
        MALFORMED_BODY: If the header is malformed.
    """
    name, _, value = header.partition(" ")
    if name not in _ALGORITHMS:
        raise problems.MALFORMED_BODY(f"Upload-Checksum: {name[:20]!r} is none of {', '.join(_ALGORITHMS)}.")
    try:
        return name, base64.b64decode(value, validate=True)
    except ValueError as error:  # raised for non-ASCII characters too
        raise problems.MALFORMED_BODY("Upload-Checksum: the digest is not base64.") from error


def _find_upload(context: Context, owner: str, upload_id: str) -> UploadRow:
    if not is_id(upload_id):
        raise problems.NO_UPLOAD(upload_id=upload_id[:60])
    return context.store.inputs.upload(upload_id, owner)


def uploaded_name(metadata: str) -> str:
    """Return the `filename` in an `Upload-Metadata` header, which has the format `key base64, key base64`.

    Raises:
        MALFORMED_BODY: If it is not base64 of UTF-8.
    """
    for pair in metadata.split(","):
        key, _, value = pair.strip().partition(" ")
        if key in ("filename", "name"):
            try:
                return base64.b64decode(value, validate=True).decode()
            except ValueError as error:  # raised for non-ASCII characters too
                raise problems.MALFORMED_BODY(f"Upload-Metadata: {key!r} is not base64 of UTF-8.") from error
    return ""


# --- jobs ------------------------------------------------------------------------------------------------------------

router = APIRouter(prefix="/v1/jobs", tags=["jobs"])
#: Maximum bytes of a JSON body. Such a body contains no files, only the ids of uploads.
_MAX_JSON = 1 << 20
#: Path of an input or of a result, as in the API. The groups are the id of the job, and the input.
_PATH = re.compile(r"/v1/jobs/(job_[0-9a-f]{20,40})/inputs/([a-z]{1,10}(?::[0-9]{1,6})?)", re.ASCII)
_RESULT_PATH = re.compile(rf"/v1/jobs/(job_[0-9a-f]{{20,40}})/artifacts/{re.escape(RESULT)}", re.ASCII)


class Webhook(BaseModel):
    """Messages about a job."""

    webhook: str | None = Field(None, max_length=2000, description="URL that gets messages about the job.")
    webhook_events: list[WebhookEvent] | None = Field(
        None,
        min_length=1,
        description="Messages that it gets: when the job has `started`, about its `progress` (one in 5 s at most), and "
        "when it has `completed`, well or not. Null: the last one.",
    )


class JobFromUploads(Webhook):
    """A job from files that the service already has, or that it fetches.

    Each file is named by the id of its upload (`POST /v1/uploads`), by the path of an input of an earlier job, such as
    `/v1/jobs/JOB/inputs/style:1`, or of its result, `/v1/jobs/JOB/artifacts/stylized.ply`, or by a URL that the service
    fetches, if its operator allows the host. A job has `style` files or `painted` files.
    """

    model_config = ConfigDict(
        extra="forbid",
        json_schema_extra={
            "examples": [
                {
                    "scene": UPLOAD_ID,
                    "style": "upl_1a1fe701b52a0c11d0ab9f6ad0c2a54",
                    "cameras": ["upl_1a1fe701b9e8e2a45b1c1d8c6bd8a90"],
                    "parameters": {"preset": "preview"},
                }
            ]
        },
    )

    scene: str = Field(
        description=f"Id of the upload with the 3DGS scene: {TITLES}; or the path of an input or result, or a URL."
    )
    style: str | Annotated[list[str], Field(max_length=MOST_STYLES)] = Field(
        default_factory=list,
        description="Id of the upload with the style image, the path of an input, or a URL; or a list of several, "
        "which are mixed by `style_weights`, or belong to `regions`.",
    )
    cameras: list[str] = Field(default_factory=list, max_length=8, description="Camera files; empty for an orbit.")
    photos: list[str] = Field(default_factory=list, max_length=10_000, description="Photos for the content term.")
    mask: list[str] = Field(default_factory=list, max_length=10_000, description="Masks that `regions` name.")
    painted: list[str] = Field(
        default_factory=list,
        max_length=MOST_PAINTED,
        description="Painted images of views, which the scene follows; `parameters.painted` has the views.",
    )
    parameters: JobParameters = Field(default_factory=JobParameters)


_FILE = {"type": "string", "format": "binary"}
_FORM = {
    "type": "object",
    "required": ["scene"],
    "properties": {
        "scene": {**_FILE, "description": f"3DGS scene: {TITLES}; or text, as for JSON."},
        "style": {
            "type": "array",
            "items": _FILE,
            "maxItems": MOST_STYLES,
            "description": "Style image; or text, as for JSON. Needed without `painted`. Several are mixed by "
            "`style_weights`; those that `regions` name belong to the regions.",
        },
        "cameras": {
            "type": "array",
            "items": _FILE,
            "description": "cameras.json, transforms.json, or the files of a COLMAP model.",
        },
        "photos": {"type": "array", "items": _FILE, "description": "Photos with the names that the cameras give."},
        "mask": {
            "type": "array",
            "items": _FILE,
            "description": "Mask that a region in `regions` names: one bit per Gaussian (.bin), or .npy; or images of "
            "views in a folder.",
        },
        "painted": {
            "type": "array",
            "items": _FILE,
            "maxItems": MOST_PAINTED,
            "description": "Painted image of a view, in place of style images; or text, as for JSON. The scene follows "
            "it where it is opaque.",
        },
        "parameters": {"type": "string", "description": "JSON: see JobParameters."},
        "webhook": {"type": "string", "description": "URL that gets messages about the job."},
        "webhook_events": {
            "type": "string",
            "description": "Messages that it gets, as for JSON, separated by commas: `started,completed`.",
        },
    },
    "examples": [
        {
            "scene": "ply\nformat binary_little_endian 1.0\nelement vertex 616\n(and so on: the file's bytes)",
            "style": ["(the bytes of style.jpg)"],
            "cameras": ['[{"id": 0, "img_name": "view_0", "width": 64, "height": 48}]'],
            "parameters": '{"preset": "preview"}',
        }
    ],
}
_BODY = {
    "requestBody": {
        "required": True,
        "content": {
            "multipart/form-data": {"schema": _FORM},
            "application/json": {"schema": {"$ref": "#/components/schemas/JobFromUploads"}},
        },
    }
}


@router.post(
    "",
    status_code=202,
    response_model=JobView,
    openapi_extra=_BODY,
    responses={
        200: DRY_RUN,
        202: {
            "description": "The job is queued.",
            "headers": headers("Location", "Retry-After", maybe=("Idempotency-Replayed",)),
            "links": links(*FOLLOWING_OPERATIONS, job_id="$response.body#/id"),
        },
    },
)
async def create_job(
    request: Request,
    context: ContextDep,
    caller: CallerDep,
    idempotency_key: IdempotencyHeader = None,
    dry_run: Annotated[
        bool, Query(description="Check everything and plan, but queue nothing.", examples=[True])
    ] = False,
    sure_up: Annotated[
        bool,
        Query(
            description="Refuse an orbit whose up direction the scene does not determine with `unsure-up`, whose "
            "`candidates` are values of `up` to choose from, and cameras that hardly show the scene with "
            "`unsure-cameras`. A dry run answers with `up` and `warnings` in any case.",
            examples=[True],
        ),
    ] = False,
) -> Response:
    """Queue a job. All files are read and checked before the answer; unusable ones are refused with 422."""
    async with AsyncExitStack() as stack:
        receipt = await stack.enter_async_context(receiving.Receipt(context.receipts, caller.owner, caller.quotas))
        is_json = receiving.media_type(request) == "application/json"
        reading = _from_json(request, context) if is_json else _from_form(request, context, receipt)
        received, parameters, webhook = await reading
        find_inputs = partial(_find_inputs, context, caller, received, parameters, webhook)
        fetched = await _adopt_results(context, caller, received, receipt)
        if urls := context.fetcher.urls(received.uploads):
            await context.threads.run(caller.owner, find_inputs, fetched)
            with suspended():  # fetching has its own deadline
                fetched |= await context.fetcher.fetch(urls, receipt)
        inputs, rows = await context.threads.run(caller.owner, find_inputs, fetched)
        findings = await context.inspector.inspect("validate", caller.owner, inputs, rows, parameters)
        if not dry_run:
            up, foreign = (findings["up"], findings["foreign"]) if sure_up else (None, None)
            if foreign:
                raise problems.UNSURE_CAMERAS(reason=foreign, input="cameras")
            if up and not up["sure"]:
                likely = " or ".join(up["candidates"])
                raise problems.UNSURE_UP(reason=up["reason"], likely=likely, candidates=up["candidates"], input="up")
            idempotency = _idempotency(idempotency_key, inputs, parameters, webhook)
            queue_job = partial(_queue_job, context, caller, inputs, parameters, webhook)
            return await asyncio.to_thread(queue_job, idempotency, receipt)
        stack.pop_all()  # keep the files, which planning needs after this function returns

    async def plan(show: Show) -> PlanView:
        async with receipt:
            findings = await context.inspector.inspect("plan", caller.owner, inputs, rows, parameters, show)
        return PlanView(**findings, workers=parameters.workers)

    return await answer_work(request, plan, "planning", "plan", context.hub.working)


def _find_inputs(
    context: Context,
    caller: Caller,
    received: receiving.Received,
    parameters: JobParameters,
    webhook: Webhook,
    fetched: Mapping[str, str],
) -> tuple[list[dict[str, Any]], dict[str, BlobRow]]:
    """Return the entries of all files of a job and their blobs, after the checks that need no file's content.

    Args:
        fetched: SHA-256 of each input by URL, and of each result by its path; missing ones are entries without a blob.
    """
    check_weights()
    most = context.settings.retention_days
    if parameters.retention_days is not None and parameters.retention_days > most:
        raise problems.INVALID_REQUEST(
            f"retention_days: must be at most {most:g}, as long as this service keeps results.", input="retention_days"
        )
    inputs, rows = _resolve_inputs(context, caller, received, fetched)
    if (count := sum(entry["role"] == "painted" for entry in inputs)) or parameters.painted:
        parameters.check_painted(count)
    regions = parameters.region_requests
    check_roles(inputs, orbit=parameters.orbit is not None, weights=parameters.style_weights, regions=regions)
    if webhook.webhook:
        check_url(webhook.webhook, context.settings)
    elif webhook.webhook_events:
        raise problems.INVALID_REQUEST("webhook_events: there is no webhook. Give its URL, or omit the events.")
    return inputs, rows


def _queue_job(
    context: Context,
    caller: Caller,
    inputs: list[dict[str, Any]],
    parameters: JobParameters,
    webhook: Webhook,
    idempotency: Idempotency | None,
    receipt: receiving.Receipt,
) -> Response:
    """Queue a checked job, and return the response."""
    values = parameters.model_dump(mode="json", exclude_unset=True)
    name = parameters.name or default_job_name(inputs, parameters.region_requests)
    new = NewJob(caller.owner, name, caller.priority, values, inputs, webhook.webhook, webhook.webhook_events)
    jobs = context.store.jobs
    job, created = jobs.create(
        new, limit=context.settings.max_jobs_per_key, quotas=caller.quotas, idempotency=idempotency, receipt=receipt.id
    )
    if created:
        receipt.hand_over()
    response_headers = {"Location": address(f"/v1/jobs/{job.id}"), "Retry-After": "2"}
    if not created:
        response_headers["Idempotency-Replayed"] = "true"
    shown = jobs.shown_new(job) if created else jobs.detail(job.id, caller.owner)[0]
    return Response(job_view(shown).model_dump_json(), 202, response_headers, media_type="application/json")


#: Files and texts of a request, with the parameters and the webhook of the job.
_Parts = tuple[receiving.Received, JobParameters, Webhook]


async def _from_form(request: Request, context: Context, receipt: receiving.Receipt) -> _Parts:
    received = await receiving.receive(request, context.blobs, context.settings, receipt, context.threads)
    values = receiving.parse_json(received.texts.get("parameters", "").strip() or "{}", "parameters")
    if not isinstance(values, dict):
        raise problems.INVALID_REQUEST("parameters: is not a JSON object.", input="parameters")
    parameters = JobParameters.model_validate(values)
    parameters.settings()
    url, events = (received.texts.get(name, "").strip() for name in ("webhook", "webhook_events"))
    listed = [event.strip() for event in events.split(",")] if events else None
    webhook = Webhook.model_validate({"webhook_events": listed})  # `check_url` checks the URL
    return received, parameters, webhook.model_copy(update={"webhook": url or None})


async def _from_json(request: Request, context: Context) -> _Parts:
    job = JobFromUploads.model_validate(await receiving.read_json(request, context.settings, _MAX_JSON))
    job.parameters.settings()
    if len(job.parameters.model_dump_json(exclude_unset=True)) > receiving.MAX_TEXT:
        raise problems.INVALID_REQUEST(f"parameters: has more than {receiving.MAX_TEXT} bytes.", input="parameters")
    styles = [job.style] if isinstance(job.style, str) else job.style
    named = [("scene", job.scene), *(("style", each) for each in styles)]
    named += [(role, each) for role in ("cameras", "photos", "mask", "painted") for each in getattr(job, role)]
    if len(named) > (most := receiving.most_files(context.settings)):
        raise problems.TOO_MANY_FILES(limit=most, what="files")
    uploads = [(index, *each) for index, each in enumerate(named)]
    return receiving.Received(uploads=uploads), job.parameters, job


def _resolve_inputs(
    context: Context, caller: Caller, received: receiving.Received, fetched: Mapping[str, str]
) -> tuple[list[dict[str, Any]], dict[str, BlobRow]]:
    """Return the entries of all files of a job, and their blobs by digest.

    The files come from the request, from earlier uploads, from inputs of earlier jobs and from URLs. Their blobs are
    protected from deletion for some time.
    """
    inputs = list(received.files)
    ids = [text for _, _, text in received.uploads if is_id(text)]
    uploads = context.store.inputs.uploads(ids, caller.owner) if ids else {}
    is_released = cache(lambda job_id: context.store.jobs.get(job_id, caller.owner).status == JobStatus.EXPIRED)
    resolved: list[tuple[str, str]] = []
    for _, role, text in received.uploads:
        if receiving.is_url(text):
            resolved.append((receiving.file_name(text), fetched.get(text, "")))
        elif text in fetched:
            resolved.append((RESULT, fetched[text]))
        elif reference := _PATH.fullmatch(text.removeprefix(subpath.get())):
            entry = _referred_input(context, reference[1], reference[2], role, is_released)
            resolved.append((entry["name"], entry["sha256"]))
        elif upload := uploads.get(text):
            resolved.append((uploaded_name(upload.metadata_header), _upload_digest(context, upload, role)))
        else:
            raise problems.UNKNOWN_UPLOAD(upload_id=text[:60], input=role)
    digests = {sha256 for _, sha256 in resolved} | {entry["sha256"] for entry in inputs}
    rows = context.store.inputs.hold(sorted(filter(None, digests)))
    for number, ((index, role, _), (filename, sha256)) in enumerate(zip(received.uploads, resolved, strict=True)):
        name = staged_name(role, filename, number)
        # Keep the order of the request: style weights follow the order of the styles.
        size = rows[sha256].size if sha256 else 0
        inputs.insert(index, {"role": role, "name": name, "sha256": sha256, "size": size})
    return inputs, rows


async def _adopt_results(
    context: Context, caller: Caller, received: receiving.Received, receipt: receiving.Receipt
) -> dict[str, str]:
    """Turn results of the caller's jobs that a request names into blobs, and return their SHA-256 by path.

    Raises:
        UNKNOWN_INPUT: If a job does not exist, or has no result.
    """
    results = await asyncio.to_thread(_referred_results, context, caller, received)
    run = partial(context.threads.run, caller.owner, _adopt_result, context, receipt)
    return {path: await run(row, size=row.size) for path, row in results.items()}


def _referred_results(context: Context, caller: Caller, received: receiving.Received) -> dict[str, ArtifactRow]:
    results = {}
    for _, role, text in received.uploads:
        if reference := _RESULT_PATH.fullmatch(text.removeprefix(subpath.get())):
            row = None
            with suppress(NotFoundError):
                row = context.store.jobs.artifact(context.store.jobs.get(reference[1], caller.owner).id, RESULT)
            if row is None:
                raise problems.UNKNOWN_INPUT(job_id=reference[1], name=RESULT, input=role)
            results[text] = row
    return results


def _adopt_result(context: Context, receipt: receiving.Receipt, row: ArtifactRow) -> str:
    receipt.charge(row.size)
    context.blobs.ensure_space(row.size)
    copy = context.blobs.incoming / f"{secrets.token_hex(12)}.part"
    context.artifacts.fetch(row.location, copy, row.sha256)
    return context.blobs.add(copy, receipt.id)


def _referred_input(
    context: Context, job_id: str, name: str, role: str, is_released: Callable[[str], bool]
) -> dict[str, Any]:
    """Return the entry of an input of one of the caller's jobs. No other entry of the job is read.

    Args:
        is_released: Function that returns whether one of the caller's jobs has released its inputs.

    Raises:
        UNKNOWN_INPUT: If the input does not exist, or was released.
    """
    with suppress(NotFoundError):
        place = parse_input(name)
        entry = context.store.jobs.input(job_id, *place) if place and not is_released(job_id) else None
        if entry is not None:
            return entry
    raise problems.UNKNOWN_INPUT(job_id=job_id, name=name, input=role)


def _upload_digest(context: Context, upload: UploadRow, role: str) -> str:
    """Return the SHA-256 of an upload, which must be complete."""
    sha256 = upload.sha256
    if sha256 is None and upload.offset == upload.length:  # the service died before it recorded the upload as complete
        sha256 = context.blobs.finish_upload(upload, context.settings.upload_hours * 3600)
    if sha256 is None:
        raise problems.UNFINISHED_UPLOAD(upload_id=upload.id, offset=upload.offset, length=upload.length, input=role)
    return sha256


def _idempotency(
    key: str | None, inputs: Sequence[Mapping[str, Any]], parameters: JobParameters, webhook: Webhook
) -> Idempotency | None:
    if key is None:
        return None
    # Defaults are excluded so that the digest stays the same if a later version adds parameters.
    values = parameters.model_dump(mode="json", exclude_defaults=True)
    events = [webhook.webhook_events] if webhook.webhook_events else []
    text = json.dumps([list(inputs), values, webhook.webhook, *events], sort_keys=True)
    return Idempotency(key, hashlib.sha256(text.encode()).hexdigest())
