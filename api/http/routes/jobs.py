"""`/v1/jobs`: create, list, show, rename, finish, cancel, retry and delete jobs."""

from __future__ import annotations

import asyncio
import hashlib
import json
from collections.abc import Mapping, Sequence
from contextlib import AsyncExitStack
from dataclasses import dataclass
from functools import partial
from typing import Annotated, Any

from fastapi import APIRouter, Depends, Header, Path, Query, Request, Response

from api.http.addresses import address
from api.http.context import Caller, CallerDep, Context, ContextDep, is_id
from api.http.documentation import headers, links
from api.http.fetching import file_name, is_url
from api.http.input_references import parse_input, parse_reference, uploaded_name
from api.http.multipart import (
    MAX_TEXT,
    Received,
    check_file,
    json_body,
    media_type,
    most_files,
    parse_json,
    read_json,
    receive,
)
from api.http.numbers import Digits
from api.http.progress import DRY_RUN, answer_work
from api.http.receipts import Receipt
from api.http.schemas import (
    MOST_POINTS,
    JobChange,
    JobDetail,
    JobPage,
    JobView,
    PlanView,
    ProgressHistory,
    StatusName,
    job_detail,
    job_view,
    poll_seconds,
)
from api.http.sending import IfNoneMatch, names_etag, send_list
from api.http.submission import BODY, JobFromUploads
from service import problems
from service.deadlines import suspended
from service.errors import NoJobError
from service.examples import JOB_ID
from service.files.staging import check_roles, default_job_name, staged_name
from service.inspection.inspector import Show
from service.parameters import JobParameters, stored_parameters
from service.scheduling.webhooks import check_url
from service.states import JobStatus
from service.store.jobs import Idempotency, NewJob
from service.store.tables import BlobRow, JobRow, UploadRow
from service.weights import check_weights

router = APIRouter(prefix="/v1/jobs", tags=["jobs"])
#: Maximum bytes of a JSON body. Such a body contains no files, only the ids of uploads.
_MAX_JSON = 1 << 20

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


JobId = Annotated[str, Path(description="ID of a job.", examples=[JOB_ID])]
#: Headers of a response that shows a job.
_SHOWN = headers("ETag", "Cache-Control", maybe=("Retry-After",))
#: Operations that a client may call next on a job.
_FOLLOWING_OPERATIONS = (
    "get_job",
    "change_job",
    "finish_job",
    "cancel_job",
    "retry_job",
    "delete_job",
    "watch_job",
    "get_progress",
    "list_inputs",
    "list_artifacts",
)


@router.post(
    "",
    status_code=202,
    response_model=JobView,
    openapi_extra=BODY,
    responses={
        200: DRY_RUN,
        202: {
            "description": "The job is queued.",
            "headers": headers("Location", "Retry-After", maybe=("Idempotency-Replayed",)),
            "links": links(*_FOLLOWING_OPERATIONS, job_id="$response.body#/id"),
        },
    },
    operation_id="create_job",
)
async def create_job(
    request: Request,
    context: ContextDep,
    caller: CallerDep,
    idempotency_key: IdempotencyHeader = None,
    dry_run: Annotated[
        bool, Query(description="Check everything and plan, but queue nothing.", examples=[True])
    ] = False,
) -> Response:
    """Queue a job. All files are read and checked before the answer; unusable ones are refused with 422."""
    async with AsyncExitStack() as stack:
        receipt = await stack.enter_async_context(context.receipts.of(caller.owner, caller.quotas))
        is_json = media_type(request) == "application/json"
        reading = _from_json(request, context) if is_json else _from_form(request, context, receipt)
        parts = await reading
        fetched: dict[str, str] = {}
        if urls := context.fetcher.urls(parts[0].uploads):
            await context.threads.run(caller.owner, _find_inputs, context, caller, parts, fetched)
            with suspended():  # fetching has its own deadline
                fetched = await context.fetcher.fetch(urls, receipt)
        resolved = await context.threads.run(caller.owner, _find_inputs, context, caller, parts, fetched)
        size = sum(row.size for row in resolved[1].values())
        job_request = await context.threads.run(
            caller.owner, _check_files, context, caller, parts, *resolved, size=size
        )
        if not job_request.checked:
            await context.inspector.inspect(
                "validate", caller.owner, job_request.inputs, job_request.rows, job_request.parameters
            )
        if not dry_run:
            return await asyncio.to_thread(_queue_job, context, caller, job_request, idempotency_key, receipt)
        stack.pop_all()  # keep the files, which planning needs after this function returns

    async def plan(show: Show) -> PlanView:
        async with receipt:
            findings = await context.inspector.inspect(
                "plan", caller.owner, job_request.inputs, job_request.rows, job_request.parameters, show
            )
        return PlanView(**findings, workers=job_request.parameters.workers)

    return await answer_work(request, plan, "planning", "plan")


@dataclass(frozen=True)
class _JobRequest:
    """Job that a client has requested.

    Attributes:
        inputs: `role`, `name`, `sha256`, `size` of each file.
        rows: Blobs by SHA-256.
        checked: Whether the same files have already passed inspection.
    """

    inputs: list[dict[str, Any]]
    rows: dict[str, BlobRow]
    parameters: JobParameters
    webhook: str | None
    checked: bool


Parts = tuple[Received, JobParameters, str | None]


def _find_inputs(
    context: Context, caller: Caller, parts: Parts, fetched: Mapping[str, str]
) -> tuple[list[dict[str, Any]], dict[str, BlobRow]]:
    """Return the entries of all files of a job and their blobs, after the checks that need no file's content.

    Args:
        fetched: SHA-256 of each input by URL; missing ones are entries without a blob.
    """
    received, parameters, webhook = parts
    check_weights()
    inputs, rows = _resolve_inputs(context, caller, received, fetched)
    regions = parameters.region_requests
    check_roles(inputs, orbit=parameters.orbit is not None, weights=parameters.style_weights, regions=regions)
    if webhook:
        check_url(webhook, context.settings)
    return inputs, rows


def _check_files(
    context: Context, caller: Caller, parts: Parts, inputs: list[dict[str, Any]], rows: dict[str, BlobRow]
) -> _JobRequest:
    """Run all checks of a job's files that need no inspection process."""
    _, parameters, webhook = parts
    checked = context.inspector.recall("validate", caller.owner, inputs, parameters) is not None
    if not checked:
        with context.blobs.local_files(rows) as paths:
            for entry in inputs:
                check_file(entry["role"], entry["name"], paths[entry["sha256"]], entry["size"], context.settings)
    return _JobRequest(inputs, rows, parameters, webhook, checked)


def _queue_job(
    context: Context, caller: Caller, job_request: _JobRequest, idempotency_key: str | None, receipt: Receipt
) -> Response:
    """Queue a checked job, and return the response."""
    parameters, webhook = job_request.parameters, job_request.webhook
    idempotency = _idempotency(idempotency_key, job_request.inputs, parameters, webhook)
    values = parameters.model_dump(mode="json", exclude_unset=True)
    name = parameters.name or default_job_name(job_request.inputs, parameters.region_requests)
    new = NewJob(caller.owner, name, caller.priority, values, job_request.inputs, webhook or None)
    jobs = context.store.jobs
    job, created = jobs.create(
        new,
        limit=context.settings.max_jobs_per_key,
        quotas=caller.quotas,
        idempotency=idempotency,
        receipt=receipt.id,
    )
    if created:
        receipt.hand_over()
    response_headers = {"Location": address(f"/v1/jobs/{job.id}"), "Retry-After": "2"}
    if not created:
        response_headers["Idempotency-Replayed"] = "true"
    body = job_view(jobs.detail(job.id, caller.owner)[0]).model_dump_json()
    return Response(body, 202, response_headers, media_type="application/json")


async def _from_form(request: Request, context: Context, receipt: Receipt) -> Parts:
    received = await receive(request, context.blobs, context.settings, receipt, context.threads)
    text = received.texts.get("parameters", "").strip() or "{}"
    values = parse_json(text, "parameters")
    if not isinstance(values, dict):
        raise problems.INVALID_REQUEST("parameters: is not a JSON object.", input="parameters")
    parameters = JobParameters.model_validate(values)
    parameters.settings()
    return received, parameters, received.texts.get("webhook", "").strip() or None


async def _from_json(request: Request, context: Context) -> Parts:
    job = JobFromUploads.model_validate(await read_json(request, context.settings, _MAX_JSON))
    job.parameters.settings()
    if len(job.parameters.model_dump_json(exclude_unset=True)) > MAX_TEXT:
        raise problems.INVALID_REQUEST(f"parameters: has more than {MAX_TEXT} bytes.", input="parameters")
    styles = [job.style] if isinstance(job.style, str) else job.style
    named = [("scene", job.scene), *(("style", each) for each in styles)]
    named += [(role, each) for role in ("cameras", "photos", "mask") for each in getattr(job, role)]
    if len(named) > (most := most_files(context.settings)):
        raise problems.TOO_MANY_FILES(limit=most, what="files")
    uploads = [(index, *each) for index, each in enumerate(named)]
    return Received(uploads=uploads), job.parameters, job.webhook


def _resolve_inputs(
    context: Context, caller: Caller, received: Received, fetched: Mapping[str, str]
) -> tuple[list[dict[str, Any]], dict[str, BlobRow]]:
    """Return the entries of all files of a job, and their blobs by digest.

    The files come from the request, from earlier uploads, from inputs of earlier jobs and from URLs. Their blobs are
    protected from deletion for some time.
    """
    inputs = list(received.files)
    ids = [text for _, _, text in received.uploads if is_id(text)]
    uploads = context.store.inputs.uploads(ids, caller.owner) if ids else {}
    jobs: dict[str, list[dict[str, Any]]] = {}
    resolved: list[tuple[str, str]] = []
    for _, role, text in received.uploads:
        if is_url(text):
            resolved.append((file_name(text), fetched.get(text, "")))
            continue
        reference = parse_reference(text)
        if reference is not None:
            entry = _referred_input(context, caller, *reference, role, jobs)
            resolved.append((entry["name"], entry["sha256"]))
            continue
        upload = uploads.get(text)
        if upload is None:
            raise problems.UNKNOWN_UPLOAD(upload_id=text[:60], input=role)
        resolved.append((uploaded_name(upload.metadata_header), _upload_digest(context, upload, role)))
    digests = {sha256 for _, sha256 in resolved} | {entry["sha256"] for entry in inputs}
    rows = context.store.inputs.hold(sorted(filter(None, digests)))
    for number, ((index, role, _), (filename, sha256)) in enumerate(zip(received.uploads, resolved, strict=True)):
        name = staged_name(role, filename, number)
        # Keep the order of the request: style weights follow the order of the styles.
        size = rows[sha256].size if sha256 else 0
        inputs.insert(index, {"role": role, "name": name, "sha256": sha256, "size": size})
    return inputs, rows


def _referred_input(
    context: Context, caller: Caller, job_id: str, name: str, role: str, jobs: dict[str, list[dict[str, Any]]]
) -> dict[str, Any]:
    """Return the entry of an input of one of the caller's jobs.

    Args:
        jobs: Inputs of jobs that were read for other references, to which this one's are added.

    Raises:
        UNKNOWN_INPUT: If the input does not exist, or was released.
    """
    try:
        if job_id not in jobs:
            released = find(context, caller, job_id).status == JobStatus.EXPIRED
            jobs[job_id] = [] if released else context.store.jobs.inputs(job_id)
    except NoJobError:
        raise problems.UNKNOWN_INPUT(job_id=job_id, name=name, input=role) from None
    place = parse_input(name)
    entries = [entry for entry in jobs[job_id] if place and entry["role"] == place[0]]
    if place is None or place[1] >= len(entries):
        raise problems.UNKNOWN_INPUT(job_id=job_id, name=name, input=role)
    return entries[place[1]]


def _upload_digest(context: Context, upload: UploadRow, role: str) -> str:
    """Return the SHA-256 of an upload, which must be complete."""
    sha256 = upload.sha256
    if sha256 is None and upload.offset == upload.length:  # the service died before it recorded the upload as complete
        sha256 = context.blobs.finish_upload(upload, context.settings.upload_hours * 3600)
    if sha256 is None:
        raise problems.UNFINISHED_UPLOAD(upload_id=upload.id, offset=upload.offset, length=upload.length, input=role)
    return sha256


def _idempotency(
    key: str | None, inputs: Sequence[Mapping[str, Any]], parameters: JobParameters, webhook: str | None
) -> Idempotency | None:
    if key is None:
        return None
    # Defaults are excluded so that the digest stays the same if a later version adds parameters.
    values = parameters.model_dump(mode="json", exclude_defaults=True)
    text = json.dumps([list(inputs), values, webhook], sort_keys=True)
    return Idempotency(key, hashlib.sha256(text.encode()).hexdigest())


@router.get(
    "",
    response_model=JobPage,
    responses={
        200: {"links": links(*_FOLLOWING_OPERATIONS, job_id="$response.body#/jobs/0/id")},
    },
    operation_id="list_jobs",
)
async def list_jobs(
    context: ContextDep,
    caller: CallerDep,
    status: Annotated[
        list[StatusName] | None,
        Query(description="Show only jobs with this status; may be repeated.", examples=[["queued", "running"]]),
    ] = None,
    cursor: Annotated[
        str | None, Query(pattern="^job_[0-9a-f]{31}$", description="`next_cursor` of a page.", examples=[JOB_ID])
    ] = None,
    limit: Annotated[Digits, Query(ge=1, le=200, description="Jobs on a page.", examples=[20])] = 50,
) -> Response:
    """List the jobs of this key, newest first."""

    def read(before: str | None, most: int) -> tuple[list[JobView], str | None]:
        page = context.store.jobs.page(caller.owner, status=status or (), before=before, limit=most + 1)
        following = page[most - 1].row.id if len(page) > most else None  # one more shows if more follow
        return [job_view(job) for job in page[:most]], following

    return await send_list("jobs", read, cursor, limit, context.readers, caller.owner, at_once=16)


@router.get(
    "/{job_id}",
    response_model=JobDetail,
    responses={
        200: {"headers": _SHOWN, "links": links(*_FOLLOWING_OPERATIONS[1:], job_id="$response.body#/id")},
        304: {"description": "Nothing has changed since the ETag of `If-None-Match`.", "headers": _SHOWN},
    },
    operation_id="get_job",
)
def get_job(
    job_id: JobId,
    context: ContextDep,
    caller: CallerDep,
    if_none_match: IfNoneMatch = None,
) -> Response:
    """Get a job. `Retry-After` says when to poll again; `If-None-Match` avoids sending an unchanged body."""
    check_id(job_id)
    return _job_response(context, caller, job_id, if_none_match)


@router.patch(
    "/{job_id}",
    response_model=JobDetail,
    responses={
        200: {"headers": _SHOWN, "links": links(*_FOLLOWING_OPERATIONS[1:], job_id="$response.body#/id")},
    },
    operation_id="change_job",
)
async def change_job(
    job_id: JobId,
    context: ContextDep,
    caller: CallerDep,
    change: Annotated[JobChange, Depends(json_body(JobChange))],
) -> Response:
    """Rename a job, whatever its status."""
    return await asyncio.to_thread(_rename, context, caller, job_id, change.name)


def _rename(context: Context, caller: Caller, job_id: str, name: str) -> Response:
    check_id(job_id)
    job, _ = context.store.jobs.detail(job_id, caller.owner)
    regions = JobParameters(**job.row.parameters).region_requests
    context.store.jobs.rename(job_id, caller.owner, name or default_job_name(job.inputs.named, regions))
    return _job_response(context, caller, job_id)


@router.get(
    "/{job_id}/progress",
    response_model=ProgressHistory,
    operation_id="get_progress",
)
def get_progress(job_id: JobId, context: ContextDep, caller: CallerDep) -> ProgressHistory:
    """Get the loss history of a job from its first step on, while it runs and after its end."""
    points = context.store.jobs.loss_history(find(context, caller, job_id), MOST_POINTS)
    return ProgressHistory.model_validate({"points": points})


@router.post(
    "/{job_id}/finish",
    response_model=JobDetail,
    responses={
        200: {
            "headers": _SHOWN,
            "links": links("get_job", "cancel_job", "watch_job", "list_artifacts", job_id="$response.body#/id"),
        },
    },
    operation_id="finish_job",
)
def finish_job(job_id: JobId, context: ContextDep, caller: CallerDep) -> Response:
    """End a running job after its current step and keep its result so far. Until then, its status is `finishing`."""
    check_id(job_id)
    context.store.jobs.finish(job_id, caller.owner)
    return _job_response(context, caller, job_id)


@router.post(
    "/{job_id}/cancel",
    response_model=JobDetail,
    responses={
        200: {
            "headers": _SHOWN,
            "links": links("get_job", "retry_job", "delete_job", "watch_job", job_id="$response.body#/id"),
        },
    },
    operation_id="cancel_job",
)
def cancel_job(job_id: JobId, context: ContextDep, caller: CallerDep) -> Response:
    """Cancel a job. A waiting job is canceled at once, a running one within seconds (`canceling` until then)."""
    check_id(job_id)
    context.store.jobs.cancel(job_id, caller.owner)
    return _job_response(context, caller, job_id)


@router.post(
    "/{job_id}/retry",
    status_code=202,
    response_model=JobDetail,
    responses={
        202: {
            "description": "The job is queued again.",
            "headers": _SHOWN,
            "links": links("get_job", "cancel_job", "list_artifacts", job_id="$response.body#/id"),
        },
    },
    operation_id="retry_job",
)
def retry_job(job_id: JobId, context: ContextDep, caller: CallerDep) -> Response:
    """Queue a failed or canceled job again. It resumes from its last checkpoint."""
    stored_parameters(find(context, caller, job_id).parameters)
    check_weights()
    context.store.jobs.retry(job_id, caller.owner, limit=context.settings.max_jobs_per_key, quotas=caller.quotas)
    return _job_response(context, caller, job_id, status=202)


@router.delete(
    "/{job_id}",
    status_code=204,
    responses={
        204: {"description": "The job and its results are deleted."},
    },
    operation_id="delete_job",
)
async def delete_job(job_id: JobId, context: ContextDep, caller: CallerDep) -> None:
    """Delete a job that has ended, with its results."""
    check_id(job_id)
    unused = await asyncio.to_thread(context.store.jobs.delete, job_id, caller.owner)
    await context.receipts.remove(caller.owner, partial(_remove_files, context, job_id, unused))


def _remove_files(context: Context, job_id: str, unused: Sequence[str]) -> None:
    context.artifacts.remove_job(job_id)
    context.blobs.remove(unused)


def find(context: Context, caller: Caller, job_id: str) -> JobRow:
    """Return the caller's job with this id.

    Raises:
        NoJobError: If there is no such job, or it belongs to another caller.
    """
    check_id(job_id)
    return context.store.jobs.get(job_id, caller.owner)


def check_id(job_id: str) -> None:
    """Raise NoJobError if a text cannot be a job's id."""
    if not is_id(job_id):
        raise problems.NO_JOB(job_id=job_id[:60])


def _job_response(
    context: Context, caller: Caller, job_id: str, if_none_match: str | None = None, status: int = 200
) -> Response:
    job, attempts = context.store.jobs.detail(job_id, caller.owner)
    view = job_detail(job, attempts)
    body = view.model_dump_json().encode()
    tag = f'"{hashlib.sha256(body).hexdigest()[:32]}"'
    response_headers = {"ETag": tag, "Cache-Control": "private, no-cache"}
    wait = poll_seconds(job.row)
    if wait is not None:
        response_headers["Retry-After"] = str(wait)
    if names_etag(if_none_match, tag):
        return Response(status_code=304, headers=response_headers)
    return Response(body, status, response_headers, media_type="application/json")
