"""Jobs of users, from creation to expiry, with their inputs, files, events, history and shares.

Changes that dispatchers make too are functions that run within the caller's transaction. Every transaction takes its
locks in one order, so that no two wait for each other: the owner's limits, uploads by id, jobs by id, then the rows of
each job, blobs by digest, counters.

The loss history is thinned as it is written: a point is stored when the job's running time has grown by one percent
since the previous one, so points are evenly spaced on the logarithmic time axis of loss charts (784 for 25 hours).
"""

import hmac
import json
import re
import secrets
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any

import sqlalchemy as sa
from sqlalchemy.orm import Session

from service import problems, states
from service.store.database import IDEMPOTENCY_SECONDS, Database, count, idempotency_row, new_id, upsert
from service.store.files import close_receipt, release_blobs
from service.store.keys import NO_QUOTAS, Quotas, add_usage, check_bytes, count_job, digest, lock_owner
from service.store.tables import (
    ArtifactRow,
    AttemptRow,
    Base,
    BlobUseRow,
    DeliveryRow,
    DispatcherRow,
    EventRow,
    IdempotencyRow,
    JobRow,
    KeyRow,
    ProgressPointRow,
    ShareRow,
)

#: Type of messages about progress, which are sent once, and a job's message of this type.
PROGRESS_MESSAGE = "job.progress"
_WAITING_PROGRESS = (
    sa.select(DeliveryRow)
    .where(DeliveryRow.job_id == sa.bindparam("job_id"), DeliveryRow.body["type"].as_string() == PROGRESS_MESSAGE)
    .with_for_update()
)
_ADD_EVENT = sa.insert(Base.metadata.tables[EventRow.__tablename__]).inline()


def job_of_owner(session: Session, job_id: str, owner: str | None, *, lock: bool = False) -> JobRow:
    """Return a job of this owner, or of any owner if None.

    Args:
        lock: Whether to lock the row. Whoever adds rows that refer to the job does so first; it is then not deleted.

    Raises:
        NO_JOB: If there is no such job or it belongs to another owner.
    """
    job = session.get(JobRow, job_id, with_for_update=lock, populate_existing=lock)
    if job is None or (owner is not None and job.owner != owner):
        raise problems.NO_JOB(job_id=job_id)
    return job


def move(session: Session, job: JobRow, transition: states.Transition, now: float) -> None:
    """Change a job's status and add an event for clients that watch the job.

    Raises:
        KeyError: If the job's status does not allow the transition.
    """
    job.status = states.next_status(job.status, transition)
    add_status_event(session, job, now)


def end(session: Session, job: JobRow, transition: states.Transition, now: float, retention: float) -> None:
    """End a job.

    Args:
        retention: Most seconds until its results expire; see `retention_of`.
    """
    job.finished_at, job.expires_at = now, now + retention_of(job, retention)
    job.lease_owner = job.lease_expires_at = None
    move(session, job, transition, now)
    count(session, "sgsst_jobs_finished_total", f'status="{job.status}"')
    for waiting in session.scalars(_WAITING_PROGRESS, {"job_id": job.id}) if job.webhook_events else ():
        session.delete(waiting)
    send_webhook(session, job, "completed", job.status, now)


def retention_of(job: JobRow, most: float) -> float:
    """Return the seconds until a job's results expire: as its user has requested, but at most `most`."""
    days = job.parameters.get("retention_days")
    return most if days is None else min(most, days * 86_400.0)


def send_webhook(session: Session, job: JobRow, event: states.WebhookEvent, kind: str, now: float, **more: Any) -> None:
    """Queue a message about an event of a job, if its webhook gets such messages; by default only the last one.

    A message about progress replaces the one before if that still waits to be sent.

    Args:
        kind: Last part of the message's type.
        more: Further values about the job.
    """
    if not job.webhook or event not in (job.webhook_events or ("completed",)):
        return
    data = {"id": job.id, "name": job.name, "status": job.status, "error": job.error, **more}
    body = {"type": f"job.{kind}", "timestamp": now, "data": data}
    waiting = session.scalar(_WAITING_PROGRESS, {"job_id": job.id}) if event == "progress" else None
    if waiting is None:
        message_id = new_id("msg", now)
        session.add(DeliveryRow(id=message_id, job_id=job.id, url=job.webhook, body=body, tries=0, next_at=now))
    elif not waiting.tries:
        waiting.body = body


def add_status_event(session: Session, job: JobRow, now: float) -> None:
    """Add an event about a job's status."""
    data: dict[str, Any] = {"status": job.status, "attempt": job.attempt}
    if job.error:
        data["error"] = job.error
    add_event(session, job.id, "status", data, now)


def add_event(session: Session, job_id: str, kind: str, data: dict[str, Any], now: float) -> None:
    """Add an event to a job."""
    session.execute(_ADD_EVENT, {"job_id": job_id, "kind": kind, "data": data, "created_at": now})


def put_artifact(session: Session, job_id: str, file: states.Published, now: float) -> list[str]:
    """Write the row of a job's file; return the location of the file of the same name that it replaces, if any."""
    row = session.get(ArtifactRow, (job_id, file.name))
    replaced = [row.location] if row is not None and row.location != file.location else []
    if row is None:
        row = ArtifactRow(job_id=job_id, name=file.name)
        session.add(row)
    row.location, row.size, row.sha256, row.created_at = file.location, file.size, file.sha256, now
    return replaced


def holder_name(job_id: str) -> str:
    """Return the name under which a job holds its inputs."""
    return f"job:{job_id}"


def forget(session: Session, job: JobRow) -> list[str]:
    """Delete a job's rows and return the locations of unused inputs, as `release_blobs` does."""
    unused = release_blobs(session, holder_name(job.id))
    session.delete(job)  # deletes attempts, events and artifacts by cascade
    return unused


#: Ratio of the running times of consecutive points.
GROWTH = 1.01

_POINTS = Base.metadata.tables[ProgressPointRow.__tablename__]
_OF_JOB = _POINTS.c.job_id == sa.bindparam("job_id")
_OF_ATTEMPT = _POINTS.c.attempt == sa.bindparam("attempt")
_LAST = (
    sa.select(_POINTS.c.step, _POINTS.c.seconds).where(_OF_JOB, _OF_ATTEMPT).order_by(_POINTS.c.step.desc()).limit(1)
)
_ALL = sa.select(_POINTS.c.progress).where(_OF_JOB).order_by(_POINTS.c.attempt, _POINTS.c.step)


def add_point(session: Session, job_id: str, progress: dict[str, Any]) -> None:
    """Store a job's progress as a point if one is due; progress without a loss is ignored.

    Args:
        progress: Progress as stored by `Leases.report_progress`.
    """
    if not _is_step(progress):
        return
    attempt, step, seconds = progress["attempt"], progress["step"], progress["seconds"]
    last = session.execute(_LAST, {"job_id": job_id, "attempt": attempt}).one_or_none()
    if last is not None and (step <= last.step or seconds < GROWTH * last.seconds):
        return
    values = {"job_id": job_id, "attempt": attempt, "step": step, "seconds": seconds, "progress": progress}
    session.execute(upsert(session)(_POINTS).values(values).on_conflict_do_nothing())


def _is_step(progress: dict[str, Any]) -> bool:
    return progress.get("loss") is not None and progress.get("seconds") is not None


def _position(progress: dict[str, Any]) -> tuple[int, int]:
    return progress["attempt"], progress["step"]


#: Roles of few files, which are shown with every job.
_NAMED_ROLES = ("scene", "style", "cameras", "painted")

#: Table of the entries in `jobs.inputs`, and expressions for the position, the JSON and the role of an entry.
_ENTRIES = {
    "sqlite": ("json_each(jobs.inputs) AS entry", "entry.key", "entry.value", "json_extract(entry.value, '$.role')"),
    "postgresql": (
        "json_array_elements(jobs.inputs) WITH ORDINALITY AS entry(value, number)",
        "entry.number - 1",
        "CAST(entry.value AS TEXT)",
        "entry.value ->> 'role'",
    ),
}


@cache
def _queries(dialect: str) -> dict[str, sa.TextClause]:
    table, position, value, role = _ENTRIES[dialect]
    of_jobs = f"FROM jobs, {table} WHERE jobs.id IN :ids"
    index = f"row_number() OVER (PARTITION BY {role} ORDER BY {position}) - 1"
    texts = {
        "shown": f"SELECT jobs.id, {role} AS role, CASE WHEN {role} IN :roles THEN {value} END AS shown, count(*) "
        f"{of_jobs} GROUP BY jobs.id, role, shown ORDER BY min({position})",
        "one": f"SELECT {value} {of_jobs} AND {role} IN :roles ORDER BY {position} LIMIT 1 OFFSET :index",
        "page": f"SELECT number, value FROM (SELECT {position} AS position, {value} AS value, {index} AS number "
        f"{of_jobs}) AS entries WHERE position >= :start ORDER BY position LIMIT :most",
    }
    return {
        name: sa.text(sql).bindparams(
            *(sa.bindparam(each, expanding=True) for each in ("ids", "roles") if f":{each}" in sql)
        )
        for name, sql in texts.items()
    }


_JOBS, _ATTEMPTS, _ARTIFACTS, _BLOBS, _BLOB_USES = (
    Base.metadata.tables[name] for name in ("jobs", "attempts", "artifacts", "blobs", "blob_uses")
)
# Frequent queries are built once, because building a query takes longer than running it.
_OTHERS = _JOBS.alias("others")
_QUEUED = sa.select(sa.func.count()).select_from(_OTHERS).where(_OTHERS.c.status == states.JobStatus.QUEUED)
_HIGHER = _QUEUED.where(_OTHERS.c.priority > _JOBS.c.priority)
_EARLIER = _QUEUED.where(
    _OTHERS.c.priority == _JOBS.c.priority,
    sa.tuple_(_OTHERS.c.queued_at, _OTHERS.c.id) < sa.tuple_(_JOBS.c.queued_at, _JOBS.c.id),
)
#: One more than the number of queued jobs ahead of a queued job, which are in two ranges of the queue's index.
_POSITION = sa.case(
    (_JOBS.c.status == states.JobStatus.QUEUED, 1 + _HIGHER.scalar_subquery() + _EARLIER.scalar_subquery())
)
_PREVIEWS = sa.select(sa.func.max(_ARTIFACTS.c.name)).where(_ARTIFACTS.c.name.like("previews/%"))  # names sort by step
_COLUMNS = [column for column in _JOBS.c if column.name != "inputs"]
_SHOWN_JOBS = sa.select(*_COLUMNS, _POSITION, _PREVIEWS.where(_ARTIFACTS.c.job_id == _JOBS.c.id).scalar_subquery())
_JOB, _POSITION_OF = (each.where(_JOBS.c.id == sa.bindparam("job_id")) for each in (_SHOWN_JOBS, sa.select(_POSITION)))
_ATTEMPTS_OF = sa.select(_ATTEMPTS).where(_ATTEMPTS.c.job_id == sa.bindparam("job_id")).order_by(_ATTEMPTS.c.number)
# Their number is rendered once, unlike that of a list of values.
_STATUSES = [sa.literal(status, sa.String) for status in states.UNFINISHED]
_UNFINISHED_OF = sa.select(sa.func.count()).where(_JOBS.c.owner == sa.bindparam("owner"), _JOBS.c.status.in_(_STATUSES))
_ADD_JOB = sa.insert(_JOBS)
# Locks the blobs in the same order as `release_blobs`; one that is deleted meanwhile is left out.
_HOLD = (
    sa.insert(_BLOB_USES)
    .from_select(
        ("holder", "sha256"),
        sa.select(sa.bindparam("holder", type_=sa.String), _BLOBS.c.sha256)
        .where(_BLOBS.c.sha256.in_(sa.bindparam("digests", expanding=True)))
        .order_by(_BLOBS.c.sha256)
        .with_for_update(read=True, key_share=True),
    )
    .execution_options(preserve_rowcount=True)
)

#: Time in seconds after which a dispatcher without heartbeat is forgotten.
_FORGET_SECONDS = 86_400.0
#: Maximum number of shares of a job that have not expired.
MOST_SHARES = 20
_TOKEN = re.compile(r"(shr_[0-9a-f]{20,36})\.[A-Za-z0-9_-]{43}", re.ASCII)


@dataclass(frozen=True)
class NewJob:
    """Values of a job to be created.

    Attributes:
        inputs: `role`, `name`, `sha256` and `size` of each file.
    """

    owner: str
    name: str
    priority: int
    parameters: dict[str, Any]
    inputs: list[dict[str, Any]]
    webhook: str | None = None
    webhook_events: list[states.WebhookEvent] | None = None

    def row(self, now: float) -> dict[str, Any]:
        """Return the columns of the queued job."""
        times = {"created_at": now, "queued_at": now, "not_before": 0.0}
        counts = dict.fromkeys(("attempt", "failures", "lease_epoch"), 0)
        return {**vars(self), **times, **counts, "id": new_id("job", now), "status": states.JobStatus.QUEUED}


@dataclass(frozen=True)
class Idempotency:
    """Idempotency-Key of a request, with a digest of the request."""

    key: str
    fingerprint: str


@dataclass(frozen=True)
class ShownJob:
    """Job as users see it.

    Attributes:
        row: Its record, without inputs.
        inputs: Entries of scene, style images and camera files, in their order.
        position: Number of queued jobs ahead by priority and age, plus one; None if it is not queued. The turns of
            owners are ignored, because they change with every lease.
        preview: Name of its newest preview; None if there is none.
    """

    row: JobRow
    inputs: list[dict[str, Any]]
    input_counts: Mapping[str, int]
    position: int | None
    preview: str | None


class Jobs:
    """Jobs of users in the store. Methods that take an `owner` accept None for any.

    Args:
        retention: Time in seconds until the results of an ended job expire.

    Raises:
        NO_JOB: If a method gets a job that does not exist or belongs to another owner.
    """

    def __init__(self, database: Database, retention: float) -> None:
        self._database = database
        self._retention = retention

    def create(
        self,
        new: NewJob,
        *,
        limit: int,
        quotas: Quotas = NO_QUOTAS,
        idempotency: Idempotency | None = None,
        receipt: str | None = None,
    ) -> tuple[JobRow, bool]:
        """Queue a job and hold its blobs.

        Args:
            limit: Maximum number of unfinished jobs of the owner.
            receipt: Receipt for the request's files, which the new job takes over; None if the request has no files.

        Returns:
            Job, and whether it is new; if the Idempotency-Key was used before, the job created then.

        Raises:
            IDEMPOTENCY_KEY_REUSED: If the key was used for a different request.
            QUEUE_FULL: If the owner has `limit` unfinished jobs.
            QUOTA_EXCEEDED: If the job would exceed one of the owner's quotas.
            NotFoundError: If an input was deleted meanwhile.
        """
        now = self._database.clock()
        values = new.row(now)
        job = JobRow(**values)
        with self._database.writing() as session:
            # Before the lock, which the owner's other requests wait for, come rows that no other transaction sees. A
            # request that is refused, and one that is repeated, roll them back.
            session.execute(_ADD_JOB, values)
            add_status_event(session, job, now)
            lock_owner(session, new.owner)
            if idempotency is not None:
                used_key = idempotency_row(session, new.owner, idempotency.key, idempotency.fingerprint, now)
                known = session.get(JobRow, used_key.created_id) if used_key.created_id else None
                if known is not None:
                    session.expunge(known)  # a rollback would expire it
                    session.rollback()
                    return known, False
                used_key.created_id = job.id
            _check_queue(session, new.owner, limit, own=1)
            count_job(session, new.owner, quotas, now, sum(entry["size"] for entry in new.inputs))
            if receipt is not None:
                close_receipt(session, receipt)
            digests = {entry["sha256"] for entry in new.inputs}
            held = session.execute(_HOLD, {"holder": holder_name(job.id), "digests": list(digests)})
            if held.rowcount < len(digests):  # type: ignore[attr-defined]
                raise problems.NOT_FOUND("An input was deleted while it was being checked. Upload it again.")
            check_bytes(session, new.owner, quotas)
            count(session, "sgsst_jobs_submitted_total")
        return job, True

    def shown_new(self, job: JobRow) -> ShownJob:
        """Return a job that has just been created as users see it: queued, whatever has happened since."""
        with self._database.reading_rows() as connection:
            position = connection.execute(_POSITION_OF, {"job_id": job.id}).scalar() or 1
        named = [entry for entry in job.inputs if entry["role"] in _NAMED_ROLES]
        return ShownJob(job, named, Counter(entry["role"] for entry in job.inputs), position, None)

    def get(self, job_id: str, owner: str | None) -> JobRow:
        """Return a job without its inputs."""
        with self._database.reading() as session:
            return job_of_owner(session, job_id, owner)

    def inputs(self, job_id: str) -> list[dict[str, Any]]:
        """Return `role`, `name`, `sha256` and `size` of all inputs of a job."""
        with self._database.reading() as session:
            inputs: list[dict[str, Any]] | None = session.scalar(sa.select(JobRow.inputs).where(JobRow.id == job_id))
        if inputs is None:
            raise problems.NO_JOB(job_id=job_id)
        return inputs

    def input_page(self, job_id: str, start: int, limit: int) -> list[tuple[int, dict[str, Any]]]:
        """Return a job's inputs from a position on, each with its index among those of its role."""
        with self._database.reading_rows() as connection:
            parameters = {"ids": [job_id], "start": start, "most": limit}
            rows = connection.execute(_queries(connection.dialect.name)["page"], parameters)
            return [(index, json.loads(entry)) for index, entry in rows]

    def input(self, job_id: str, role: str, index: int) -> dict[str, Any] | None:
        """Return an input of a job by its role and its index among those of the role; None if there is none."""
        with self._database.reading_rows() as connection:
            parameters = {"ids": [job_id], "roles": [role], "index": index}
            entry = connection.execute(_queries(connection.dialect.name)["one"], parameters).scalar()
            return None if entry is None else dict(json.loads(entry))

    def detail(self, job_id: str, owner: str | None) -> tuple[ShownJob, list[AttemptRow]]:
        """Return a job as it is shown, and its attempts, all in one snapshot."""
        with self._database.reading_rows(one_snapshot=True) as connection:
            row = connection.execute(_JOB, {"job_id": job_id}).one_or_none()
            if row is None or (owner is not None and row.owner != owner):
                raise problems.NO_JOB(job_id=job_id)
            (shown,) = _shown(connection, [row])
            rows = connection.execute(_ATTEMPTS_OF, {"job_id": job_id}) if shown.row.attempt else ()
            return shown, [AttemptRow(**each._mapping) for each in rows]

    def page(
        self, owner: str | None, *, status: Sequence[str] = (), before: str | None = None, limit: int = 50
    ) -> list[ShownJob]:
        """Return a page of an owner's jobs, newest first, starting after the job `before`."""
        query = _SHOWN_JOBS.order_by(_JOBS.c.id.desc()).limit(limit)
        if owner is not None:
            query = query.where(_JOBS.c.owner == owner)
        if status:
            query = query.where(_JOBS.c.status.in_(status))
        if before is not None:
            query = query.where(_JOBS.c.id < before)
        with self._database.reading_rows(one_snapshot=True) as connection:
            return _shown(connection, connection.execute(query).all())

    def finish(self, job_id: str, owner: str | None) -> JobRow:
        """Make a running job end after its current step, with its present colors as the result.

        The request is kept if the attempt fails: the next one ends in the same way. A job that is already finishing is
        returned unchanged.

        Raises:
            NOT_RUNNING: If the job is not running.
        """
        now = self._database.clock()
        with self._database.writing() as session:
            job = job_of_owner(session, job_id, owner, lock=True)
            if not states.allowed(job.status, states.Transition.FINISH):
                raise problems.NOT_RUNNING(job_status=job.status)
            if job.status in states.ACTIONS[states.Transition.FINISH].statuses:
                job.finish_requested = True
                move(session, job, states.Transition.FINISH, now)
        return job

    def cancel(self, job_id: str, owner: str | None) -> JobRow:
        """Cancel a job: immediately if it is queued, otherwise as soon as its dispatcher notices.

        A job that is already canceled is returned unchanged.

        Raises:
            NOT_CANCELABLE: If the job has ended in another way.
        """
        now = self._database.clock()
        with self._database.writing() as session:
            job = job_of_owner(session, job_id, owner, lock=True)
            if not states.allowed(job.status, states.Transition.CANCEL):
                raise problems.NOT_CANCELABLE(job_status=job.status)
            if job.status in states.ACTIONS[states.Transition.CANCEL].statuses:
                if states.next_status(job.status, states.Transition.CANCEL) in states.ENDED:
                    end(session, job, states.Transition.CANCEL, now, self._retention)
                else:
                    move(session, job, states.Transition.CANCEL, now)
        return job

    def retry(self, job_id: str, owner: str | None, *, limit: int, quotas: Quotas = NO_QUOTAS) -> JobRow:
        """Queue a failed, canceled or stopped job again; it resumes from its last checkpoint if there is one.

        A retry counts toward the day's jobs. A stopped job keeps its result until it has a new one, but not the files
        derived from it, which are newer than its end.

        Raises:
            NOT_RETRYABLE: If the job has another status, or has succeeded and kept no checkpoint.
            QUEUE_FULL: If the owner has `limit` unfinished jobs.
            QUOTA_EXCEEDED: If the job would exceed one of the owner's quotas.
        """
        now = self._database.clock()
        with self._database.writing() as session:
            lock_owner(session, job_of_owner(session, job_id, owner).owner)
            job = job_of_owner(session, job_id, owner, lock=True)
            files = sa.select(ArtifactRow).where(ArtifactRow.job_id == job.id)
            ended_well = job.status == states.JobStatus.SUCCEEDED
            checkpoint = session.scalar(files.where(ArtifactRow.name.startswith(".", autoescape=True)).limit(1))
            if not states.allowed(job.status, states.Transition.RETRY) or (ended_well and checkpoint is None):
                raise problems.NOT_RETRYABLE(job_status=job.status)
            _check_queue(session, job.owner, limit)
            count_job(session, job.owner, quotas, now)
            check_bytes(session, job.owner, quotas)
            job.queued_at, job.not_before, job.failures, job.swept = now, 0.0, 0, False
            if ended_well:
                derived = ArtifactRow.created_at > job.finished_at
                session.execute(sa.delete(ArtifactRow).where(ArtifactRow.job_id == job.id, derived))
            job.finished_at = job.expires_at = job.error = job.progress = job.result = None
            job.finish_requested = False
            move(session, job, states.Transition.RETRY, now)
        return job

    def rename(self, job_id: str, owner: str | None, name: str) -> None:
        """Change the display name of a job."""
        with self._database.writing() as session:
            job_of_owner(session, job_id, owner, lock=True).name = name

    def set_viewpoints(self, job_id: str, viewpoints: dict[str, Any], outdated: Sequence[str]) -> list[str]:
        """Set the viewpoints of a result's page, and withdraw the files that show others.

        Args:
            viewpoints: `worker.options.Viewpoints` as JSON.
            outdated: Names of these files.

        Returns:
            Locations of these files.

        Raises:
            NO_RESULT: If the job has no result.
        """
        files = sa.and_(ArtifactRow.job_id == job_id, ArtifactRow.name.in_(outdated))
        with self._database.writing() as session:
            job = job_of_owner(session, job_id, None, lock=True)
            if job.status != states.JobStatus.SUCCEEDED:
                raise problems.NO_RESULT(job_status=job.status)
            job.viewpoints = viewpoints
            return list(session.scalars(sa.delete(ArtifactRow).where(files).returning(ArtifactRow.location)))

    def delete(self, job_id: str, owner: str | None) -> list[str]:
        """Delete an ended job and release its inputs; the caller removes its results afterwards.

        Returns:
            Locations of inputs that are no longer used, for `Blobs.remove`.

        Raises:
            NOT_ENDED: If the job has not ended.
        """
        with self._database.writing() as session:
            job = job_of_owner(session, job_id, owner, lock=True)
            if job.status not in states.ENDED:
                advice = "It ends in some seconds" if job.status == states.JobStatus.CANCELING else "Cancel it first"
                raise problems.NOT_ENDED(job_status=job.status, advice=advice)
            return forget(session, job)

    def artifacts(self, job_id: str, after: str = "", limit: int | None = None) -> list[ArtifactRow]:
        """Return the published files of a job by name, starting after a name; internal ones start with a dot."""
        query = sa.select(ArtifactRow).where(ArtifactRow.job_id == job_id, ArtifactRow.name > after)
        with self._database.reading() as session:
            return list(session.scalars(query.order_by(ArtifactRow.name).limit(limit)))

    def artifact(self, job_id: str, name: str) -> ArtifactRow | None:
        """Return a published file; None if there is none."""
        with self._database.reading() as session:
            return session.get(ArtifactRow, (job_id, name))

    def add_derived(
        self,
        source: ArtifactRow,
        files: Sequence[states.Published],
        owner: str,
        quotas: Quotas = NO_QUOTAS,
    ) -> list[str]:
        """Publish files derived from `source`, replacing those of the same names, unless `source` is gone.

        Args:
            source: Row of the file that they were derived from.

        Returns:
            Locations of files without a row: replaced ones, and those whose `source` is gone or replaced.

        Raises:
            QUOTA_EXCEEDED: If the files exceed the owner's quota of stored bytes; none is published.
        """
        now, replaced = self._database.clock(), []
        with self._database.writing() as session:
            lock_owner(session, owner)
            session.get(JobRow, source.job_id, with_for_update=True)  # before its files, as everybody else
            row = session.get(ArtifactRow, (source.job_id, source.name))
            if row is None or row.location != source.location:
                return [file.location for file in files]
            for file in files:
                replaced += put_artifact(session, source.job_id, file, now)
                add_usage(session, owner, now, bytes=file.size)
            session.flush()
            check_bytes(session, owner, quotas)
        return replaced

    def loss_history(self, job: JobRow, most: int) -> list[dict[str, Any]]:
        """Return a job's loss history: its points, and its current progress as the last one, as in `add_point`.

        Args:
            most: Maximum number of points, at least 2; longer histories are sampled evenly, including both ends.
        """
        with self._database.reading_rows() as connection:
            known: list[dict[str, Any]] = list(connection.execute(_ALL, {"job_id": job.id}).scalars())
        current = job.progress
        if current and _is_step(current) and (not known or _position(current) > _position(known[-1])):
            known.append(current)
        if len(known) > most:
            known = [known[number * (len(known) - 1) // (most - 1)] for number in range(most)]
        return known

    def events(self, job_id: str, after: int, limit: int = 500) -> list[EventRow]:
        """Return a job's events after the event number `after`."""
        query = sa.select(EventRow).where(EventRow.job_id == job_id, EventRow.id > after)
        with self._database.reading() as session:
            return list(session.scalars(query.order_by(EventRow.id).limit(limit)))

    def last_events(self, job_ids: Sequence[str]) -> dict[str, int]:
        """Return the number of the newest event of each job; jobs without events and missing jobs are left out."""
        query = sa.select(EventRow.job_id, sa.func.max(EventRow.id)).where(EventRow.job_id.in_(job_ids))
        with self._database.reading() as session:
            return dict(session.execute(query.group_by(EventRow.job_id)).all())

    # --- housekeeping, which any dispatcher may do -------------------------------------------------------------------

    def expire(self) -> list[str]:
        """Expire old results, and delete the records of jobs that expired as long ago.

        Returns:
            Ids of jobs whose files are to be removed.
        """
        now = self._database.clock()
        with self._database.writing() as session:
            old = sa.select(JobRow).where(JobRow.expires_at < now).order_by(JobRow.id).limit(100)
            due = session.scalars(old.with_for_update(skip_locked=True)).all()
            for job in due:
                if job.status == states.JobStatus.EXPIRED:
                    forget(session, job)
                    continue
                job.expires_at = now + retention_of(job, self._retention)
                session.execute(sa.delete(ArtifactRow).where(ArtifactRow.job_id == job.id))
                # blobs without other holders are collected later
                session.execute(sa.delete(BlobUseRow).where(BlobUseRow.holder == holder_name(job.id)))
                move(session, job, states.Transition.EXPIRE, now)
            session.execute(sa.delete(DispatcherRow).where(DispatcherRow.seen_at < now - _FORGET_SECONDS))
            session.execute(sa.delete(IdempotencyRow).where(IdempotencyRow.created_at < now - IDEMPOTENCY_SECONDS))
            return [job.id for job in due]

    def unswept(self, limit: int) -> list[tuple[str, int]]:
        """Return ended jobs that may have files without database rows, each with the epoch of its last lease."""
        query = sa.select(JobRow.id, JobRow.lease_epoch).where(
            JobRow.swept.is_(False), JobRow.status.in_(states.FINISHED)
        )
        with self._database.reading() as session:
            return [(job_id, epoch) for job_id, epoch in session.execute(query.limit(limit))]

    def mark_swept(self, job_id: str, epoch: int) -> None:
        """Mark a job as having no files without rows, unless it has been queued again."""
        same = sa.and_(JobRow.id == job_id, JobRow.lease_epoch == epoch, JobRow.status.in_(states.FINISHED))
        with self._database.writing() as session:
            session.execute(sa.update(JobRow).where(same).values(swept=True))


def _check_queue(session: Session, owner: str, limit: int, own: int = 0) -> None:
    """Raise QUEUE_FULL if an owner has `limit` unfinished jobs besides `own` of this transaction."""
    if session.execute(_UNFINISHED_OF, {"owner": owner}).scalar_one() - own >= limit:
        raise problems.QUEUE_FULL(limit=limit)


def _shown(connection: sa.Connection, rows: Sequence[Any]) -> list[ShownJob]:
    """Return jobs as users see them, from rows of `_SHOWN_JOBS` that are of the connection's snapshot."""
    counts = {row.id: Counter[str]() for row in rows}
    named: dict[str, list[dict[str, Any]]] = {row.id: [] for row in rows}
    if rows:  # PostgreSQL compares with no type in an empty list
        query, parameters = _queries(connection.dialect.name)["shown"], {"ids": list(counts), "roles": _NAMED_ROLES}
        for job_id, role, entry, number in connection.execute(query, parameters):
            counts[job_id][role] += number
            named[job_id] += [json.loads(entry)] * number if entry else []
    names = [column.name for column in _COLUMNS]
    return [
        ShownJob(JobRow(**dict(zip(names, row, strict=False))), named[row.id], counts[row.id], *row[-2:])
        for row in rows
    ]


@dataclass(frozen=True)
class Shared:
    """Valid share, with its job."""

    share: ShareRow
    job: JobRow


class ShareLinks:
    """Links to shared results."""

    def __init__(self, database: Database) -> None:
        self._database = database

    def create(self, job_id: str, owner: str, seconds: float) -> tuple[ShareRow, str]:
        """Share the result of a job; return the share and the only copy of its token.

        Args:
            seconds: Lifetime of the share.

        Raises:
            NO_JOB: If there is no such job or it belongs to another owner.
            NO_RESULT: If the job has no result.
            TOO_MANY_SHARES: If the job has `MOST_SHARES` shares.
        """
        now = self._database.clock()
        with self._database.writing() as session:
            job = job_of_owner(session, job_id, owner, lock=True)  # which a deletion then waits for
            if job.status != states.JobStatus.SUCCEEDED:
                raise problems.NO_RESULT(job_status=job.status)
            of_job = ShareRow.job_id == job_id
            session.execute(sa.delete(ShareRow).where(of_job, ShareRow.expires_at <= now))
            valid = sa.select(sa.func.count()).select_from(ShareRow).where(of_job)
            if (session.scalar(valid) or 0) >= MOST_SHARES:
                raise problems.TOO_MANY_SHARES(limit=MOST_SHARES)
            row = ShareRow(id=new_id("shr", now), job_id=job_id, created_at=now, expires_at=now + seconds)
            token = f"{row.id}.{secrets.token_urlsafe(32)}"
            row.sha256 = digest(token)
            session.add(row)
        return row, token

    def of_job(self, job_id: str) -> Sequence[ShareRow]:
        """Return the shares of a job that have not expired, oldest first."""
        now = self._database.clock()
        with self._database.reading() as session:
            query = sa.select(ShareRow).where(ShareRow.job_id == job_id, ShareRow.expires_at > now)
            return session.scalars(query.order_by(ShareRow.id)).all()

    def revoke(self, job_id: str, share_id: str) -> None:
        """Delete a share, so that its link no longer works.

        Raises:
            NO_SHARE: If the job has no such share.
        """
        with self._database.writing() as session:
            deleted = session.execute(sa.delete(ShareRow).where(ShareRow.id == share_id, ShareRow.job_id == job_id))
            if not deleted.rowcount:  # type: ignore[attr-defined]
                raise problems.NO_SHARE()

    def find(self, token: str) -> Shared:
        """Return the share with this token, and its job.

        Raises:
            NO_SHARE: If there is none, it has expired or was revoked, its job has no result any more, or the key of
                its owner was revoked.
        """
        match = _TOKEN.fullmatch(token)
        if match is None:
            raise problems.NO_SHARE()
        with self._database.reading() as session:
            row = session.get(ShareRow, match[1])
            # compared in constant time, so that the time of the answer tells nothing about the digest
            if row is None or not hmac.compare_digest(row.sha256, digest(token)):
                raise problems.NO_SHARE()
            job = session.get_one(JobRow, row.job_id)  # both are of one snapshot
            key = session.get(KeyRow, job.owner)
            revoked = key is not None and key.revoked_at is not None
            if row.expires_at <= self._database.clock() or job.status != states.JobStatus.SUCCEEDED or revoked:
                raise problems.NO_SHARE()
            return Shared(row, job)
