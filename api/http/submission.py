"""`POST /v1/jobs`: queue a job, or plan it, after all its files have been read and checked."""

from __future__ import annotations

import asyncio
import hashlib
import json
import re
import secrets
from collections.abc import Mapping, Sequence
from contextlib import AsyncExitStack, suppress
from functools import partial
from typing import Annotated, Any

from fastapi import APIRouter, Query, Request, Response
from pydantic import BaseModel, ConfigDict, Field

from api.http.context import Caller, CallerDep, Context, ContextDep, is_id
from api.http.events import DRY_RUN, answer_work
from api.http.jobs import FOLLOWING_OPERATIONS, find, parse_input
from api.http.problems import headers, links
from api.http.receiving import (
    MAX_TEXT,
    Receipt,
    Received,
    check_size,
    file_name,
    is_url,
    media_type,
    most_files,
    parse_json,
    read_json,
    receive,
)
from api.http.schemas import JobView, PlanView, address, job_view, subpath
from api.http.uploads import IdempotencyHeader, uploaded_name
from service import problems
from service.deadlines import suspended
from service.inputs import MOST_STYLES, RESULT, JobParameters, check_roles, default_job_name, staged_name
from service.inspection.inspector import Show
from service.problems import UPLOAD_ID, NoJobError
from service.scheduling.webhooks import check_url
from service.settings import check_weights
from service.states import JobStatus, WebhookEvent
from service.store.jobs import Idempotency, NewJob
from service.store.tables import ArtifactRow, BlobRow, UploadRow
from sgsst_core.files.formats import TITLES
from worker.options import MOST_PAINTED

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
        receipt = await stack.enter_async_context(Receipt(context.receipts, caller.owner, caller.quotas))
        is_json = media_type(request) == "application/json"
        reading = _from_json(request, context) if is_json else _from_form(request, context, receipt)
        received, parameters, webhook = await reading
        find_inputs = partial(_find_inputs, context, caller, received, parameters, webhook)
        fetched = await _adopt_results(context, caller, received, receipt)
        if urls := context.fetcher.urls(received.uploads):
            await context.threads.run(caller.owner, find_inputs, fetched)
            with suspended():  # fetching has its own deadline
                fetched |= await context.fetcher.fetch(urls, receipt)
        inputs, rows = await context.threads.run(caller.owner, find_inputs, fetched)
        recall = partial(context.inspector.recall, "validate", caller.owner, inputs, parameters)
        findings = await context.threads.run(caller.owner, recall)
        if findings is None:
            for entry in inputs:
                check_size(entry["role"], entry["name"], entry["size"])
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

    checked = asyncio.Event()
    checked.set()

    async def plan(show: Show) -> PlanView:
        async with receipt:
            findings = await context.inspector.inspect("plan", caller.owner, inputs, rows, parameters, show)
        return PlanView(**findings, workers=parameters.workers)

    return await answer_work(request, plan, "planning", "plan", context.hub.working, checked)


def _find_inputs(
    context: Context,
    caller: Caller,
    received: Received,
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
    receipt: Receipt,
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
    shown, _ = jobs.detail(job.id, caller.owner)
    body = job_view(shown).model_dump_json()
    return Response(body, 202, response_headers, media_type="application/json")


#: Files and texts of a request, with the parameters and the webhook of the job.
_Parts = tuple[Received, JobParameters, Webhook]


async def _from_form(request: Request, context: Context, receipt: Receipt) -> _Parts:
    received = await receive(request, context.blobs, context.settings, receipt, context.threads)
    text = received.texts.get("parameters", "").strip() or "{}"
    values = parse_json(text, "parameters")
    if not isinstance(values, dict):
        raise problems.INVALID_REQUEST("parameters: is not a JSON object.", input="parameters")
    parameters = JobParameters.model_validate(values)
    parameters.settings()
    url, events = (received.texts.get(name, "").strip() for name in ("webhook", "webhook_events"))
    listed = [event.strip() for event in events.split(",")] if events else None
    webhook = Webhook.model_validate({"webhook_events": listed})  # `check_url` checks the URL
    return received, parameters, webhook.model_copy(update={"webhook": url or None})


async def _from_json(request: Request, context: Context) -> _Parts:
    job = JobFromUploads.model_validate(await read_json(request, context.settings, _MAX_JSON))
    job.parameters.settings()
    if len(job.parameters.model_dump_json(exclude_unset=True)) > MAX_TEXT:
        raise problems.INVALID_REQUEST(f"parameters: has more than {MAX_TEXT} bytes.", input="parameters")
    styles = [job.style] if isinstance(job.style, str) else job.style
    named = [("scene", job.scene), *(("style", each) for each in styles)]
    named += [(role, each) for role in ("cameras", "photos", "mask", "painted") for each in getattr(job, role)]
    if len(named) > (most := most_files(context.settings)):
        raise problems.TOO_MANY_FILES(limit=most, what="files")
    uploads = [(index, *each) for index, each in enumerate(named)]
    return Received(uploads=uploads), job.parameters, job


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
    released: dict[str, bool] = {}
    resolved: list[tuple[str, str]] = []
    for _, role, text in received.uploads:
        if is_url(text):
            resolved.append((file_name(text), fetched.get(text, "")))
            continue
        if text in fetched:
            resolved.append((RESULT, fetched[text]))
            continue
        if reference := _PATH.fullmatch(text.removeprefix(subpath.get())):
            entry = _referred_input(context, caller, reference[1], reference[2], role, released)
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


async def _adopt_results(context: Context, caller: Caller, received: Received, receipt: Receipt) -> dict[str, str]:
    """Turn results of the caller's jobs that a request names into blobs, and return their SHA-256 by path.

    Raises:
        UNKNOWN_INPUT: If a job does not exist, or has no result.
    """
    results = await asyncio.to_thread(_referred_results, context, caller, received)
    run = partial(context.threads.run, caller.owner, _adopt_result, context, receipt)
    return {path: await run(row, size=row.size) for path, row in results.items()}


def _referred_results(context: Context, caller: Caller, received: Received) -> dict[str, ArtifactRow]:
    results = {}
    for _, role, text in received.uploads:
        if reference := _RESULT_PATH.fullmatch(text.removeprefix(subpath.get())):
            row = None
            with suppress(NoJobError):
                row = context.store.jobs.artifact(find(context, caller, reference[1]).id, RESULT)
            if row is None:
                raise problems.UNKNOWN_INPUT(job_id=reference[1], name=RESULT, input=role)
            results[text] = row
    return results


def _adopt_result(context: Context, receipt: Receipt, row: ArtifactRow) -> str:
    receipt.charge(row.size)
    context.blobs.ensure_space(row.size)
    copy = context.blobs.incoming / f"{secrets.token_hex(12)}.part"
    context.artifacts.fetch(row.location, copy, row.sha256)
    return context.blobs.add(copy, receipt.id)


def _referred_input(
    context: Context, caller: Caller, job_id: str, name: str, role: str, released: dict[str, bool]
) -> dict[str, Any]:
    """Return the entry of an input of one of the caller's jobs. No other entry of the job is read.

    Args:
        released: Whether jobs that other references name have released their inputs; this one's job is added.

    Raises:
        UNKNOWN_INPUT: If the input does not exist, or was released.
    """
    with suppress(NoJobError):
        if job_id not in released:
            released[job_id] = find(context, caller, job_id).status == JobStatus.EXPIRED
        place = parse_input(name)
        entry = context.store.jobs.input(job_id, *place) if place and not released[job_id] else None
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
