"""`/v1/jobs`: list, show, rename, finish, cancel, retry and delete jobs."""

from __future__ import annotations

import asyncio
import hashlib
from collections.abc import Sequence
from functools import partial
from typing import Annotated, Any

from fastapi import APIRouter, Depends, Path, Query, Response

from api.http.context import Caller, CallerDep, Context, ContextDep, Digits, is_id
from api.http.documentation import headers, links
from api.http.multipart import json_body
from api.http.schemas import (
    MOST_POINTS,
    JobChange,
    JobDetail,
    JobPage,
    JobView,
    ProgressHistory,
    StatusName,
    job_detail,
    job_view,
    poll_seconds,
)
from api.http.sending import IfNoneMatch, names_etag, send_list
from service import problems
from service.inputs import JobParameters, default_job_name, stored_parameters
from service.problems import JOB_ID
from service.settings import check_weights
from service.store.tables import JobRow

router = APIRouter(prefix="/v1/jobs", tags=["jobs"])

JobId = Annotated[str, Path(description="ID of a job.", examples=[JOB_ID])]
#: Headers of a response that shows a job.
_SHOWN = headers("ETag", "Cache-Control", maybe=("Retry-After",))
#: Operations that a client may call next on a job.
FOLLOWING_OPERATIONS = (
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


def _documented(*following: str, **more: str) -> dict[str, Any]:
    """Return the documentation of a response that shows a job, with the operations that may follow."""
    return {**more, "headers": _SHOWN, "links": links(*following, job_id="$response.body#/id")}


@router.get(
    "",
    response_model=JobPage,
    responses={200: {"links": links(*FOLLOWING_OPERATIONS, job_id="$response.body#/jobs/0/id")}},
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

    return await send_list("jobs", read, cursor, limit, context.readers.of(caller.owner), at_once=16)


@router.get(
    "/{job_id}",
    response_model=JobDetail,
    responses={
        200: _documented(*FOLLOWING_OPERATIONS[1:]),
        304: {"description": "Nothing has changed since the ETag of `If-None-Match`.", "headers": _SHOWN},
    },
)
def get_job(job_id: JobId, context: ContextDep, caller: CallerDep, if_none_match: IfNoneMatch = None) -> Response:
    """Get a job. `Retry-After` says when to poll again; `If-None-Match` avoids sending an unchanged body."""
    check_id(job_id)
    return _job_response(context, caller, job_id, if_none_match)


@router.patch(
    "/{job_id}",
    response_model=JobDetail,
    responses={200: _documented(*FOLLOWING_OPERATIONS[1:])},
)
async def change_job(
    job_id: JobId, context: ContextDep, caller: CallerDep, change: Annotated[JobChange, Depends(json_body(JobChange))]
) -> Response:
    """Rename a job, whatever its status."""
    return await asyncio.to_thread(_rename, context, caller, job_id, change.name)


def _rename(context: Context, caller: Caller, job_id: str, name: str) -> Response:
    check_id(job_id)
    job, _ = context.store.jobs.detail(job_id, caller.owner)
    regions = JobParameters(**job.row.parameters).region_requests
    context.store.jobs.rename(job_id, caller.owner, name or default_job_name(job.inputs, regions))
    return _job_response(context, caller, job_id)


@router.get("/{job_id}/progress", response_model=ProgressHistory)
def get_progress(job_id: JobId, context: ContextDep, caller: CallerDep) -> ProgressHistory:
    """Get the loss history of a job from its first step on, while it runs and after its end."""
    points = context.store.jobs.loss_history(find(context, caller, job_id), MOST_POINTS)
    return ProgressHistory.model_validate({"points": points})


@router.post(
    "/{job_id}/finish",
    response_model=JobDetail,
    responses={200: _documented("get_job", "cancel_job", "watch_job", "list_artifacts")},
)
def finish_job(job_id: JobId, context: ContextDep, caller: CallerDep) -> Response:
    """End a running job after its current step and keep its result so far. Until then, its status is `finishing`."""
    check_id(job_id)
    context.store.jobs.finish(job_id, caller.owner)
    return _job_response(context, caller, job_id)


@router.post(
    "/{job_id}/cancel",
    response_model=JobDetail,
    responses={200: _documented("get_job", "retry_job", "delete_job", "watch_job")},
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
    responses={202: _documented("get_job", "cancel_job", "list_artifacts", description="The job is queued again.")},
)
def retry_job(job_id: JobId, context: ContextDep, caller: CallerDep) -> Response:
    """Queue a failed or canceled job again, or one that was stopped early. It resumes from its last checkpoint."""
    stored_parameters(find(context, caller, job_id).parameters)
    check_weights()
    context.store.jobs.retry(job_id, caller.owner, limit=context.settings.max_jobs_per_key, quotas=caller.quotas)
    return _job_response(context, caller, job_id, status=202)


@router.delete("/{job_id}", status_code=204, responses={204: {"description": "The job and its results are deleted."}})
async def delete_job(job_id: JobId, context: ContextDep, caller: CallerDep) -> None:
    """Delete a job that has ended, with its results."""
    check_id(job_id)
    unused = await asyncio.to_thread(context.store.jobs.delete, job_id, caller.owner)
    await context.receipts.remove(caller.owner, partial(_remove_files, context, job_id, unused))


def _remove_files(context: Context, job_id: str, unused: Sequence[str]) -> None:
    context.artifacts.objects.remove_below(job_id)
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
    body = job_detail(job, attempts).model_dump_json().encode()
    tag = f'"{hashlib.sha256(body).hexdigest()[:32]}"'
    response_headers = {"ETag": tag, "Cache-Control": "private, no-cache"}
    wait = poll_seconds(job.row)
    if wait is not None:
        response_headers["Retry-After"] = str(wait)
    if names_etag(if_none_match, tag):
        return Response(status_code=304, headers=response_headers)
    return Response(body, status, response_headers, media_type="application/json")
