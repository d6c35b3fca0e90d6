"""`/v1/jobs`: list, show, rename, watch, finish, cancel, retry and delete jobs; their events, inputs and artifacts.

`/v1/jobs/{id}/blends` and `/video` make artifacts of results. Requests that take long are answered with progress
events, then the result. One task polls the database for the events of all watched jobs.
"""

from __future__ import annotations

import asyncio
import hashlib
import json
import logging
import re
from collections.abc import AsyncIterator, Callable, Coroutine, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import PurePosixPath
from typing import Annotated, Any

from fastapi import APIRouter, Depends, Header, Path, Query, Request, Response
from fastapi.responses import JSONResponse, StreamingResponse
from pydantic import AfterValidator, BaseModel
from pydantic_core import to_jsonable_python

from api.http import schemas
from api.http.context import Caller, CallerDep, Context, ContextDep, Digits, is_id
from api.http.problems import from_service, headers, links
from api.http.receiving import json_body
from api.http.sending import ConditionsDep, IfNoneMatch, SentFile, file_answers, names_etag, send_file, send_list
from api.static_files import exported_viewer
from service import problems
from service.files.objects import ObjectStore, media_type
from service.inputs import RESULT, JobParameters, default_job_name, stored_parameters
from service.inspection.derived import PAGE, Blend
from service.problems import JOB_ID, SHA256, DatabaseUnavailableError, LostFileError, ServiceError
from service.settings import check_weights
from service.states import ENDED, JobStatus
from service.store import Store
from service.store.files import BLOBS
from service.store.tables import ArtifactRow, BlobRow, EventRow, JobRow
from sgsst_core.files.formats import EXTRA_FORMATS, DownloadName, by_name, listed, result_name
from sgsst_core.files.formats.ply import PLY
from worker.options import JobVideo

# --- events ----------------------------------------------------------------------------------------------------------

#: Seconds between polls of the database. On average, watchers receive an event after half of this time.
_POLL_SECONDS = 0.3
#: Seconds without an event after which a comment is sent, so that proxies do not drop the connection as idle.
HEARTBEAT_SECONDS = 15.0
_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class _Sent:
    """Event as it is sent.

    Attributes:
        ends: Whether the job has ended with it.
    """

    id: int
    text: bytes
    ends: bool


@dataclass
class _Watched:
    """Job with watchers.

    Attributes:
        newest: Number of its newest event at the last poll; 0 before the first one, None if the job was deleted.
        latest: Events that the last poll has found, which all watchers share; all after number `since`, if not None.
        changed: Event that is set when there are newer events, and then replaced.
    """

    newest: int | None = 0
    latest: Sequence[_Sent] = ()
    since: int | None = None
    changed: asyncio.Event = field(default_factory=asyncio.Event)
    watchers: int = 0


class Hub:
    """Poller of job events that notifies the watchers of each job."""

    def __init__(self, store: Store) -> None:
        self._store = store
        self._watched: dict[str, _Watched] = {}
        self._closing = False
        #: Work that clients wait for, which is canceled when the service stops.
        self.working: set[asyncio.Task[Any]] = set()
        self._task = asyncio.create_task(self._poll())

    async def close(self) -> None:
        """End all streams and cancel work; watchers reconnect with the id of their last event."""
        self._closing = True
        for task in self.working:
            task.cancel()
        for watched in self._watched.values():
            watched.changed.set()
        self._task.cancel()

    async def resumed(self, job_id: str, after: int) -> int | None:
        """Return the id of the event after which to continue a stream whose last event had the id `after`.

        It is 0 if the job has not had such an event, because the database was restored from a backup: the stream starts
        again. It is None if the job has ended, and has no later events.
        """
        last = (await asyncio.to_thread(self._store.jobs.last_events, [job_id])).get(job_id)
        if last is None or last > after:
            return after
        rows = await asyncio.to_thread(self._store.jobs.events, job_id, last - 1, 1)
        if rows and _ends(rows[0]):
            return None
        return after if after == last else 0

    async def watch(self, job_id: str, after: int) -> AsyncIterator[bytes]:
        """Yield the encoded events of a job after the one with id `after`, until the job has ended."""
        watched = self._watched.setdefault(job_id, _Watched())
        watched.watchers += 1
        ended = False
        try:
            yield b"retry: 2000\n\n"
            while not self._closing and watched.newest is not None:
                changed = watched.changed
                events = await self._events_after(job_id, watched, after)
                for event in events:
                    yield event.text
                    after, ended = event.id, event.ends
                if events:
                    continue
                if ended:
                    return
                try:
                    await asyncio.wait_for(changed.wait(), HEARTBEAT_SECONDS)
                except TimeoutError:
                    yield b": still here\n\n"
        finally:
            watched.watchers -= 1
            if not watched.watchers:
                self._watched.pop(job_id, None)

    async def _events_after(self, job_id: str, watched: _Watched, after: int) -> list[_Sent]:
        if watched.since is not None and after >= watched.since:
            return [event for event in watched.latest if event.id > after]
        try:
            return [_sent(row) for row in await asyncio.to_thread(self._store.jobs.events, job_id, after)]
        except DatabaseUnavailableError:  # The stream waits until the database is back, and the next poll wakes it.
            watched.newest = 0
            return []

    async def _poll(self) -> None:
        while True:
            await asyncio.sleep(_POLL_SECONDS)
            try:
                if self._watched:
                    await self._find_new_events()
            except DatabaseUnavailableError:
                pass  # watchers wait until the database is back; requests and checks report the outage
            except Exception:
                _log.exception("reading events failed")

    async def _find_new_events(self) -> None:
        watched = dict(self._watched)
        newest = await asyncio.to_thread(self._store.jobs.last_events, list(watched))
        for job_id, each in watched.items():
            known, number = each.newest, newest.get(job_id)
            if number == known:
                continue
            rows = await asyncio.to_thread(self._store.jobs.events, job_id, known) if number and known else []
            each.newest, each.since = rows[-1].id if rows else number, known if rows else None
            each.latest = [_sent(row) for row in rows]
            changed, each.changed = each.changed, asyncio.Event()
            changed.set()


def _sent(row: EventRow) -> _Sent:
    data = row.data
    if row.kind == "progress":  # same format as in responses that show the job
        data = {**data, "updated_at": to_jsonable_python(schemas.utc(data["updated_at"]))}
    return _Sent(row.id, f"id: {row.id}\nevent: {row.kind}\ndata: {json.dumps(data)}\n\n".encode(), _ends(row))


def _ends(row: EventRow) -> bool:
    return row.kind == "status" and row.data["status"] in ENDED


_EVENTS = "text/event-stream"
#: Status in the log if the client has closed the connection, as in nginx. It is never sent.
_CLOSED = 499
_PROGRESS = {"stage": "planning", "step": 5, "total": 24, "fraction": 0.208, "eta_s": 31.5}


def _work_documentation(model: type[BaseModel], description: str, progress: str, result: str) -> dict[str, Any]:
    """Return the documentation of such a response, given the names of its events."""
    event = {
        "type": "object",
        "required": ["event", "data"],
        "properties": {
            "event": {"type": "string", "enum": [progress, result, "problem"]},
            "data": {"type": "string", "contentMediaType": "application/json"},
        },
    }
    examples = {progress: {"value": {"event": progress, "data": json.dumps(_PROGRESS)}}}
    return {"model": model, "description": description, "content": {_EVENTS: {"schema": event, "examples": examples}}}


#: Documentation of the responses for the OpenAPI document.
DRY_RUN = _work_documentation(
    schemas.PlanView,
    "With `dry_run`: the plan. Nothing was queued. With `Accept: text/event-stream`, events: `planning`, the stage "
    "(`planning` or `refining`) and its number of completed views (`total` is 0 if it has none); finally "
    "`plan`, or a `problem` that occurred after the response started.",
    "planning",
    "plan",
)
VIDEO = _work_documentation(
    schemas.ArtifactView,
    "The video, which has been rendered. With `Accept: text/event-stream`, events: `rendering`, the number of rendered "
    "frames; finally `video`, or a `problem` that occurred after the response started.",
    "rendering",
    "video",
)


#: Function that makes a result, and calls its argument with the data of each progress event.
Work = Callable[[Any], Coroutine[Any, Any, BaseModel]]


async def answer_work(
    request: Request, work: Work, progress: str, result: str, working: set[asyncio.Task[Any]]
) -> Response:
    """Return the result as JSON, or a stream of events if the request accepts one.

    JSON is returned when the result is complete; a stream starts at once, and reports a later error. If the client
    closes the connection, the work is canceled.

    Args:
        request: Request, whose body has been read.
        work: Function that makes the result.
        progress: Name of the progress events.
        result: Name of the event with the result.
        working: Tasks of all such work, which are canceled when the service stops.
    """
    reports: asyncio.Queue[dict[str, Any] | None] = asyncio.Queue()
    # Started here rather than in `_events`, so that the work releases its resources even if no event is read.
    task = asyncio.create_task(work(reports.put_nowait))
    task.add_done_callback(lambda _: reports.put_nowait(None))
    working.add(task)
    task.add_done_callback(working.discard)
    if _EVENTS in request.headers.get("accept", ""):
        response_headers = {"Cache-Control": "no-store", "X-Accel-Buffering": "no"}
        return StreamingResponse(_events(task, reports, progress, result), 200, response_headers, _EVENTS)
    disconnected = asyncio.create_task(_wait_for_disconnect(request))
    try:
        await asyncio.wait([task, disconnected], return_when=asyncio.FIRST_COMPLETED)
        return JSONResponse(_result(task).model_dump(mode="json")) if task.done() else Response(status_code=_CLOSED)
    finally:
        task.cancel()
        disconnected.cancel()


def _result(task: asyncio.Task[BaseModel]) -> BaseModel:
    """Return the result of work that has ended.

    Raises:
        STOPPING: If it was canceled because the service stops.
    """
    if task.cancelled():
        raise problems.STOPPING()
    return task.result()


async def _wait_for_disconnect(request: Request) -> None:
    """Return once the client has closed its connection; the body of the request must have been read."""
    while (await request.receive())["type"] != "http.disconnect":
        pass


async def _events(
    task: asyncio.Task[BaseModel], reports: asyncio.Queue[dict[str, Any] | None], progress: str, result: str
) -> AsyncIterator[bytes]:
    """Yield the events of some work until it is done; ending the iteration cancels the work."""
    try:
        while True:
            try:
                report = await asyncio.wait_for(reports.get(), HEARTBEAT_SECONDS)
            except TimeoutError:
                yield b": still here\n\n"
                continue
            if report is None:
                break
            yield _encoded(progress, report)
        try:
            yield _encoded(result, _result(task).model_dump(mode="json"))
        except ServiceError as error:
            yield _encoded("problem", json.loads(bytes(from_service(error).body)))
        except Exception as error:
            _log.exception("%s failed unexpectedly", progress, exc_info=error)
            yield _encoded("problem", json.loads(bytes(from_service(problems.INTERNAL()).body)))
    finally:
        task.cancel()


def _encoded(kind: str, data: Mapping[str, Any]) -> bytes:
    return f"event: {kind}\ndata: {json.dumps(data)}\n\n".encode()


# --- jobs ------------------------------------------------------------------------------------------------------------

router = APIRouter(prefix="/v1/jobs", tags=["jobs"])


def _check_id(job_id: str) -> str:
    """Return the id of a job; raise NO_JOB if a text cannot be one, which needs no query."""
    if not is_id(job_id):
        raise problems.NO_JOB(job_id=job_id[:60])
    return job_id


JobId = Annotated[str, AfterValidator(_check_id), Path(description="ID of a job.", examples=[JOB_ID])]
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
    response_model=schemas.JobPage,
    responses={200: {"links": links(*FOLLOWING_OPERATIONS, job_id="$response.body#/jobs/0/id")}},
)
async def list_jobs(
    context: ContextDep,
    caller: CallerDep,
    status: Annotated[
        list[schemas.StatusName] | None,
        Query(description="Show only jobs with this status; may be repeated.", examples=[["queued", "running"]]),
    ] = None,
    cursor: Annotated[
        str | None, Query(pattern="^job_[0-9a-f]{31}$", description="`next_cursor` of a page.", examples=[JOB_ID])
    ] = None,
    limit: Annotated[Digits, Query(ge=1, le=200, description="Jobs on a page.", examples=[20])] = 50,
) -> Response:
    """List the jobs of this key, newest first."""

    def read(before: str | None, most: int) -> list[tuple[str, schemas.JobView]]:
        page = context.store.jobs.page(caller.owner, status=status or (), before=before, limit=most)
        return [(job.row.id, schemas.job_view(job)) for job in page]

    return await send_list("jobs", read, cursor, limit, context.readers.of(caller.owner), at_once=16)


@router.get(
    "/{job_id}",
    response_model=schemas.JobDetail,
    responses={
        200: _documented(*FOLLOWING_OPERATIONS[1:]),
        304: {"description": "Nothing has changed since the ETag of `If-None-Match`.", "headers": _SHOWN},
    },
)
def get_job(job_id: JobId, context: ContextDep, caller: CallerDep, if_none_match: IfNoneMatch = None) -> Response:
    """Get a job. `Retry-After` says when to poll again; `If-None-Match` avoids sending an unchanged body."""
    return _job_response(context, caller, job_id, if_none_match)


@router.patch(
    "/{job_id}",
    response_model=schemas.JobDetail,
    responses={200: _documented(*FOLLOWING_OPERATIONS[1:])},
)
async def change_job(
    job_id: JobId,
    context: ContextDep,
    caller: CallerDep,
    change: Annotated[schemas.JobChange, Depends(json_body(schemas.JobChange))],
) -> Response:
    """Rename a job, whatever its status, or set the viewpoints of a finished one."""
    job = await asyncio.to_thread(context.store.jobs.get, job_id, caller.owner)
    if change.viewpoints is not None:
        if job.status != JobStatus.SUCCEEDED:
            raise problems.NO_RESULT(job_status=job.status)
        await context.derived.set_viewpoints(job, change.viewpoints, caller.quotas)
    if change.name is not None:
        await asyncio.to_thread(_rename, context, caller, job_id, change.name)
    return await asyncio.to_thread(_job_response, context, caller, job_id)


def _rename(context: Context, caller: Caller, job_id: str, name: str) -> None:
    if not name:
        job, _ = context.store.jobs.detail(job_id, caller.owner)
        name = default_job_name(job.inputs, JobParameters(**job.row.parameters).region_requests)
    context.store.jobs.rename(job_id, caller.owner, name)


@router.get("/{job_id}/progress", response_model=schemas.ProgressHistory)
def get_progress(job_id: JobId, context: ContextDep, caller: CallerDep) -> schemas.ProgressHistory:
    """Get the loss history of a job from its first step on, while it runs and after its end."""
    points = context.store.jobs.loss_history(context.store.jobs.get(job_id, caller.owner), schemas.MOST_POINTS)
    return schemas.ProgressHistory.model_validate({"points": points})


@router.post(
    "/{job_id}/finish",
    response_model=schemas.JobDetail,
    responses={200: _documented("get_job", "cancel_job", "watch_job", "list_artifacts")},
)
def finish_job(job_id: JobId, context: ContextDep, caller: CallerDep) -> Response:
    """End a running job after its current step and keep its result so far. Until then, its status is `finishing`."""
    context.store.jobs.finish(job_id, caller.owner)
    return _job_response(context, caller, job_id)


@router.post(
    "/{job_id}/cancel",
    response_model=schemas.JobDetail,
    responses={200: _documented("get_job", "retry_job", "delete_job", "watch_job")},
)
def cancel_job(job_id: JobId, context: ContextDep, caller: CallerDep) -> Response:
    """Cancel a job. A waiting job is canceled at once, a running one within seconds (`canceling` until then)."""
    context.store.jobs.cancel(job_id, caller.owner)
    return _job_response(context, caller, job_id)


@router.post(
    "/{job_id}/retry",
    status_code=202,
    response_model=schemas.JobDetail,
    responses={202: _documented("get_job", "cancel_job", "list_artifacts", description="The job is queued again.")},
)
def retry_job(job_id: JobId, context: ContextDep, caller: CallerDep) -> Response:
    """Queue a failed or canceled job again, or one that was stopped early. It resumes from its last checkpoint."""
    stored_parameters(context.store.jobs.get(job_id, caller.owner).parameters)
    check_weights()
    context.store.jobs.retry(job_id, caller.owner, limit=context.settings.max_jobs_per_key, quotas=caller.quotas)
    return _job_response(context, caller, job_id, status=202)


@router.delete("/{job_id}", status_code=204, responses={204: {"description": "The job and its results are deleted."}})
async def delete_job(job_id: JobId, context: ContextDep, caller: CallerDep) -> None:
    """Delete a job that has ended, with its results."""
    unused = await asyncio.to_thread(context.store.jobs.delete, job_id, caller.owner)
    results, inputs = partial(context.artifacts.objects.remove_below, job_id), partial(context.blobs.remove, unused)
    await context.receipts.remove(caller.owner, results, inputs)


def _job_response(
    context: Context, caller: Caller, job_id: str, if_none_match: str | None = None, status: int = 200
) -> Response:
    job, attempts = context.store.jobs.detail(job_id, caller.owner)
    body = schemas.job_detail(job, attempts).model_dump_json().encode()
    tag = f'"{hashlib.sha256(body).hexdigest()[:32]}"'
    response_headers = {"ETag": tag, "Cache-Control": "private, no-cache"}
    wait = schemas.poll_seconds(job.row)
    if wait is not None:
        response_headers["Retry-After"] = str(wait)
    if names_etag(if_none_match, tag):
        return Response(status_code=304, headers=response_headers)
    return Response(body, status, response_headers, media_type="application/json")


#: Schema of a single event, because OpenAPI 3.1 cannot describe a stream.
_EVENT = {
    "type": "object",
    "required": ["id", "event", "data"],
    "properties": {
        "id": {"type": "string", "pattern": "^[0-9]+$", "description": "Number for `Last-Event-ID`."},
        "event": {"type": "string", "enum": ["status", "progress", "artifact"]},
        "data": {"type": "string", "contentMediaType": "application/json"},
    },
}
_EXAMPLES = {
    "status": {"status": "running", "attempt": 1},
    "progress": schemas.example_of(schemas.ProgressView),
    "artifact": {"name": "previews/step_0000100.jpg", "size": 41239, "sha256": SHA256},
}


@router.get(
    "/{job_id}/events",
    response_class=StreamingResponse,
    responses={
        200: {
            "description": "Events `status`, `progress` and `artifact`, until the job has ended. Each is sent as the "
            "lines `id: `, `event: ` and `data: `, followed by an empty line.",
            "headers": headers("Cache-Control", "X-Accel-Buffering"),
            "content": {
                "text/event-stream": {
                    "schema": _EVENT,
                    "examples": {
                        kind: {"value": {"id": str(number), "event": kind, "data": json.dumps(data)}}
                        for number, (kind, data) in enumerate(_EXAMPLES.items(), start=4)
                    },
                }
            },
        },
        204: {"description": "The job has ended, and `Last-Event-ID` was its last event: do not reconnect."},
    },
)
async def watch_job(
    job_id: JobId,
    context: ContextDep,
    caller: CallerDep,
    last_event_id: Annotated[
        Digits | None,
        Header(
            alias="Last-Event-ID",
            ge=0,
            lt=2**62,
            description="ID of the last received event; later ones follow. After an ID that the job has not had, all "
            "events follow.",
            examples=[42],
        ),
    ] = None,
) -> Response:
    """Watch a job. Resume an interrupted stream with `Last-Event-ID`, which browsers' `EventSource` sends by itself."""
    await asyncio.to_thread(context.store.jobs.get, job_id, caller.owner)
    after = await context.hub.resumed(job_id, last_event_id) if last_event_id else 0
    if after is None:
        return Response(status_code=204)
    response_headers = {"Cache-Control": "no-store", "X-Accel-Buffering": "no"}
    return StreamingResponse(context.hub.watch(job_id, after), 200, response_headers, "text/event-stream")


inputs_router = APIRouter(prefix="/v1/jobs", tags=["inputs"])

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


_INPUT_CONTENT: dict[str, Any] = {
    "application/octet-stream": "ply\nformat binary_little_endian 1.0\nelement vertex 616\n",
    "application/json": [{"id": 0, "img_name": "view_0", "width": 64, "height": 48}],
    "image/jpeg": "\xff\xd8\xff\xe0",
    "image/png": "\x89PNG\r\n\x1a\n",
    "image/webp": "RIFF",
}
_INPUT_ANSWERS = file_answers(_INPUT_CONTENT, always_policy=True)


@inputs_router.get(
    "/{job_id}/inputs",
    response_model=schemas.InputList,
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
    await asyncio.to_thread(context.store.jobs.get, job_id, caller.owner)

    def read(start: str | None, most: int) -> list[tuple[str, schemas.InputFileView]]:
        page = enumerate(context.store.jobs.input_page(job_id, int(start or 0), most), int(start or 0) + 1)
        return [(str(number), schemas.input_view(job_id, *entry)) for number, entry in page]

    return await send_list("inputs", read, str(cursor), limit, context.readers.of(caller.owner))


@inputs_router.head(
    "/{job_id}/inputs/{role}", operation_id="head_input", response_class=Response, responses=_INPUT_ANSWERS
)
@inputs_router.get(
    "/{job_id}/inputs/{role}", operation_id="get_input", response_class=StreamingResponse, responses=_INPUT_ANSWERS
)
async def get_input(
    request: Request,
    job_id: JobId,
    role: Annotated[
        str,
        Path(
            description="`scene`, `style`, `cameras`, `photos`, `mask` or `painted`; of several files the first one, "
            "or `style:1` and so on, counted from 0 in the order of the list.",
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
    path, objects = f"{BLOBS}/{row.location}", context.blobs.objects
    check = partial(_check, objects, path, row.sha256, lambda: row.sha256 in context.store.inputs.blobs([row.sha256]))
    return SentFile(owner, row.sha256, row.size, name, kind, check, partial(objects.read, path), policy=INPUT_POLICY)


def _check(objects: ObjectStore, name: str, sha256: str, is_current: Callable[[], bool]) -> None:
    """Check that a stored file matches its database row.

    Args:
        is_current: Callback that returns whether the row still refers to the file.

    Raises:
        LostFileError, DamagedFileError: If the file is missing or damaged.
        NotFoundError: If the file has just been replaced by another one, or deleted with its job.
    """
    try:
        objects.check_once(name, sha256)
    except LostFileError:
        if is_current():
            raise
        raise problems.FILE_REMOVED() from None


def _find_input(context: Context, caller: Caller, job_id: str, role: str) -> tuple[dict[str, Any], BlobRow]:
    """Return the job's entry for an input file, and the database row of its blob.

    Raises:
        NO_INPUT: If the job has no such input, or has expired and released its inputs.
    """
    stored = find_input(context, context.store.jobs.get(job_id, caller.owner), role)
    if stored is None:
        raise problems.NO_INPUT(job_id=job_id, name=role[:40])
    return stored


def parse_input(name: str) -> tuple[str, int] | None:
    """Return role and index of an input such as "scene" or "style:1", or None if it is not such a name."""
    match = _INPUT.fullmatch(name)
    return (match[1], int(match[2] or 0)) if match else None


def find_input(context: Context, job: JobRow, name: str) -> tuple[dict[str, Any], BlobRow] | None:
    """Return a job's entry for an input such as "scene" or "style:1" and its blob; None if it is gone or never was."""
    place = parse_input(name)
    entry = None if place is None or job.status == JobStatus.EXPIRED else context.store.jobs.input(job.id, *place)
    row = context.store.inputs.blobs([entry["sha256"]]).get(entry["sha256"]) if entry else None
    return (entry, row) if entry and row else None


artifacts_router = APIRouter(prefix="/v1/jobs", tags=["artifacts"])

#: Media types that a browser may show inline. The HTML report may run its own script, but is isolated from this site.
_INLINE = ("image/", "video/", "text/html", "application/json", "text/plain")
#: Spaces and punctuation, but for those that names of files have.
_NO_WORD = re.compile(r"[\x00-,/:-@\[-^`{-\xbf\u2000-\u206f\s]+")
_SANDBOX = (
    "sandbox allow-scripts; default-src 'none'; style-src 'unsafe-inline'; script-src 'unsafe-inline'; img-src data:"
)


@artifacts_router.get(
    "/{job_id}/artifacts",
    response_model=schemas.ArtifactList,
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
    await asyncio.to_thread(context.store.jobs.get, job_id, caller.owner)

    def read(after: str | None, most: int) -> list[tuple[str, schemas.ArtifactView | None]]:
        page = context.store.jobs.artifacts(job_id, after or "", most)
        return [(row.name, None if row.name.startswith(".") else schemas.artifact_view(row)) for row in page]

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


@artifacts_router.head(
    "/{job_id}/artifacts/{name:path}", operation_id="head_artifact", response_class=Response, responses=_ANSWERS
)
@artifacts_router.get(
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
    job = await asyncio.to_thread(context.store.jobs.get, job_id, caller.owner)
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
    objects = context.artifacts.objects

    def is_current() -> bool:
        now = context.store.jobs.artifact(row.job_id, row.name)
        return now is not None and now.location == row.location

    check, read = partial(_check, objects, row.location, row.sha256, is_current), partial(objects.read, row.location)
    policy = _SANDBOX if kind.startswith("text/html") else None
    inline = kind.startswith(_INLINE) and row.name != PAGE  # the policy would not let the page show anything
    return SentFile(owner, row.sha256, row.size, name, kind, check, read, policy, inline=inline)


@artifacts_router.post(
    "/{job_id}/blends",
    status_code=201,
    response_model=schemas.ArtifactView,
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
    body: Annotated[schemas.BlendRequest, Depends(json_body(schemas.BlendRequest))],
) -> Response:
    """Blend a finished job's scene with its result, and store the blend among the job's artifacts."""
    others = {part.job_id: part.weight for part in body.others}
    if len({job_id, *others}) != 1 + len(body.others):
        raise problems.INVALID_REQUEST("others: A job is named twice. Give each job one weight.")
    for other in others:
        await asyncio.to_thread(context.store.jobs.get, other, caller.owner)
    job = await asyncio.to_thread(context.store.jobs.get, job_id, caller.owner)
    row = await context.derived.blended(job, Blend(body.weight, others, by_name(body.format)), caller.quotas)
    view = schemas.artifact_view(row)
    return Response(view.model_dump_json(), 201, {"Location": view.url}, media_type="application/json")


@artifacts_router.post("/{job_id}/video", response_model=schemas.ArtifactView, responses={200: VIDEO})
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
    job = await asyncio.to_thread(context.store.jobs.get, job_id, caller.owner)

    async def work(show: Any) -> schemas.ArtifactView:
        return schemas.artifact_view(await context.derived.video(job, options, caller.quotas, show))

    return await answer_work(request, work, "rendering", "video", context.hub.working)
