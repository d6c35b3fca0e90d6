"""Jobs in the store: created, listed, leased, written under a lease, ended, and forgotten.

A job is leased for a few seconds at a time by the dispatcher that runs it. Each lease of a job has a number, its epoch;
every write of a dispatcher names the epoch that it holds and does nothing but raise `LeaseLostError` where the job has
been leased again since. So two dispatchers may both believe that they run a job, and still only one can write.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Literal

from sqlalchemy import (
    ColumnElement,
    Connection,
    Float,
    Select,
    String,
    and_,
    bindparam,
    case,
    delete,
    func,
    insert,
    or_,
    select,
    tuple_,
    update,
)
from sqlalchemy.orm import Session

from service.errors import ConflictError, LeaseLostError, NotFoundError, QueueFullError
from service.store.database import IDEMPOTENCY_SECONDS, Database, count, new_id, remembered, upsert
from service.store.tables import (
    ArtifactRow,
    AttemptRow,
    Base,
    BlobUseRow,
    DeliveryRow,
    EventRow,
    IdempotencyRow,
    JobRow,
    TurnRow,
)

Status = Literal["queued", "starting", "running", "canceling", "succeeded", "failed", "canceled", "expired"]
#: A dispatcher works on it.
ACTIVE: tuple[Status, ...] = ("starting", "running", "canceling")
UNFINISHED: tuple[Status, ...] = ("queued", *ACTIVE)
FINISHED: tuple[Status, ...] = ("succeeded", "failed", "canceled")
#: Progress events of a job that are kept; who resumes a stream from before them has missed nothing but old progress.
KEPT_PROGRESS = 200
#: A wait between attempts doubles, but not beyond this.
_MAX_RETRY_SECONDS = 300.0
DAY = 86_400.0

_JOBS, _ATTEMPTS, _EVENTS, _BLOB_USES = (
    Base.metadata.tables[name] for name in ("jobs", "attempts", "events", "blob_uses")
)
# What is asked most, built once: building a query takes longer than answering it.
_JOB = select(_JOBS).where(_JOBS.c.id == bindparam("job_id"))
_ATTEMPTS_OF = select(_ATTEMPTS).where(_ATTEMPTS.c.job_id == bindparam("job_id")).order_by(_ATTEMPTS.c.number)
_UNFINISHED_OF = select(func.count()).where(_JOBS.c.owner == bindparam("owner"), _JOBS.c.status.in_(UNFINISHED))


def _ahead() -> Select[int]:
    """How many queued jobs come before one: two ranges of the queue's index."""
    queued = select(func.count()).select_from(_JOBS).where(_JOBS.c.status == "queued")
    higher = queued.where(_JOBS.c.priority > bindparam("priority"))
    own_place = tuple_(bindparam("queued_at", type_=Float), bindparam("job_id", type_=String))
    earlier = queued.where(_JOBS.c.priority == bindparam("priority"), tuple_(_JOBS.c.queued_at, _JOBS.c.id) < own_place)
    return select(higher.scalar_subquery() + earlier.scalar_subquery())


_AHEAD = _ahead()


@dataclass(frozen=True)
class NewJob:
    """What a job is created from.

    Attributes:
        inputs: for each file its `role`, `name`, `sha256` and `size`.
    """

    owner: str
    name: str
    priority: int
    parameters: dict[str, Any]
    inputs: list[dict[str, Any]]
    webhook: str | None = None


@dataclass(frozen=True)
class Idempotency:
    """The key that a client gave a request, and a digest of the request."""

    key: str
    fingerprint: str


@dataclass(frozen=True)
class Lease:
    """The right to write to a job, until somebody else has a higher epoch."""

    job: JobRow
    dispatcher: str
    epoch: int

    @property
    def job_id(self) -> str:
        """The job's id."""
        return self.job.id


@dataclass(frozen=True)
class Published:
    """A file that was put to its place, for the row that makes it visible; `step` is a checkpoint's."""

    name: str
    location: str
    size: int
    sha256: str
    step: int | None = None


class Jobs:
    """The job part of the store."""

    def __init__(self, database: Database, lease_seconds: float, max_attempts: int, retry_seconds: float) -> None:
        self._database = database
        self._lease_seconds = lease_seconds
        self._max_attempts = max_attempts
        self._retry_seconds = retry_seconds

    # --- what users do ---------------------------------------------------------------------------------------------

    def create(
        self,
        new: NewJob,
        *,
        limit: int,
        idempotency: Idempotency | None = None,
    ) -> tuple[JobRow, bool]:
        """Queue a job; its blobs are held from now on.

        Returns:
            The job, and whether it is new: with an Idempotency-Key that was used before it is the job of that time.

        Raises:
            IdempotencyError: the key was used for another request.
            QueueFullError: the owner has `limit` unfinished jobs.
        """
        now = self._database.clock()
        with self._database.writing() as session:
            memory = None
            if idempotency is not None:
                memory = remembered(session, new.owner, idempotency.key, idempotency.fingerprint, now)
            if memory is not None and memory.created_id:
                known = session.get(JobRow, memory.created_id)
                if known is not None:
                    return known, False
            if session.execute(_UNFINISHED_OF, {"owner": new.owner}).scalar_one() >= limit:
                raise QueueFullError(
                    f"There are {limit} unfinished jobs of this key already. Wait for one to end, or cancel one.",
                    limit=limit,
                )
            values = _first_values(new, now)
            session.execute(insert(_JOBS), values)
            job = JobRow(**values)
            if memory is not None:
                memory.created_id = job.id
            digests = sorted({entry["sha256"] for entry in new.inputs})
            uses = [{"holder": f"job:{job.id}", "sha256": sha256} for sha256 in digests]
            session.execute(insert(_BLOB_USES), uses)
            _say(session, job, now)
            count(session, "sgsst_jobs_submitted_total")
        return job, True

    def get(self, job_id: str, owner: str | None) -> JobRow:
        """A job of this owner; of anybody for None.

        Raises:
            NotFoundError: there is none, or it is another's.
        """
        with self._database.reading() as session:
            return _owned(session, job_id, owner)

    def attempts(self, job_id: str) -> list[AttemptRow]:
        """All attempts of a job, the first one first."""
        with self._database.reading() as session:
            found = select(AttemptRow).where(AttemptRow.job_id == job_id).order_by(AttemptRow.number)
            return list(session.scalars(found))

    def detail(self, job_id: str, owner: str | None) -> tuple[JobRow, int | None, list[AttemptRow]]:
        """A job, its place in the queue and its attempts, as of one moment.

        Raises:
            NotFoundError: as `get`.
        """
        with self._database.looking() as connection:
            row = connection.execute(_JOB, {"job_id": job_id}).one_or_none()
            if row is None or (owner is not None and row.owner != owner):
                raise NotFoundError(f"There is no job {job_id}.")
            job = JobRow(**row._mapping)
            found = connection.execute(_ATTEMPTS_OF, {"job_id": job_id}) if job.attempt else ()
            attempts = [AttemptRow(**each._mapping) for each in found]
            return job, _position(connection, job), attempts

    def page(
        self, owner: str | None, *, status: Sequence[str] = (), before: str | None = None, limit: int = 50
    ) -> list[JobRow]:
        """Jobs of an owner, the newest first, those older than the job `before`."""
        query = select(JobRow).order_by(JobRow.id.desc()).limit(limit)
        if owner is not None:
            query = query.where(JobRow.owner == owner)
        if status:
            query = query.where(JobRow.status.in_(status))
        if before is not None:
            query = query.where(JobRow.id < before)
        with self._database.reading() as session:
            return list(session.scalars(query))

    def queue_position(self, job: JobRow) -> int | None:
        """How many queued jobs are ahead by priority and age, plus one; None for a job that is not queued.

        Turns between owners, which change with every lease, are left out.
        """
        with self._database.looking() as connection:
            return _position(connection, job)

    def cancel(self, job_id: str, owner: str | None) -> JobRow:
        """Cancel a job: at once where it is queued, else as soon as its dispatcher sees it.

        Raises:
            ConflictError: it has ended otherwise. A canceled job is returned as it is.
        """
        now = self._database.clock()
        with self._database.writing() as session:
            job = _owned(session, job_id, owner, lock=True)
            if job.status == "queued":
                self._end(session, job, "canceled", now)
            elif job.status in ("starting", "running"):
                job.status = "canceling"
                _say(session, job, now)
            elif job.status in ("succeeded", "failed", "expired"):
                raise ConflictError(f"The job has {_said(job)} and cannot be canceled.", job_status=job.status)
        return job

    def retry(self, job_id: str, owner: str | None, *, limit: int) -> JobRow:
        """Queue a job again that failed or was canceled; it goes on from its last checkpoint, where it has one.

        Raises:
            ConflictError: it is in another state.
            QueueFullError: the owner has `limit` unfinished jobs.
        """
        now = self._database.clock()
        with self._database.writing() as session:
            job = _owned(session, job_id, owner, lock=True)
            if job.status not in ("failed", "canceled"):
                raise ConflictError(
                    f"The job has status {job.status}; only one that failed or was canceled can be tried again.",
                    job_status=job.status,
                )
            if session.execute(_UNFINISHED_OF, {"owner": job.owner}).scalar_one() >= limit:
                raise QueueFullError(f"There are {limit} unfinished jobs of this key already.", limit=limit)
            job.status, job.queued_at, job.not_before, job.failures = "queued", now, now, 0
            job.swept = False
            job.finished_at = job.expires_at = job.error = job.progress = None
            _say(session, job, now)
        return job

    def delete(self, job_id: str, owner: str | None) -> None:
        """Forget a job that has ended, and let go of its inputs. Its files are the caller's to remove, afterwards.

        Raises:
            ConflictError: it has not ended.
        """
        with self._database.writing() as session:
            job = _owned(session, job_id, owner, lock=True)
            if job.status in UNFINISHED:
                first = "It ends in some seconds" if job.status == "canceling" else "Cancel it first"
                raise ConflictError(
                    f"The job has status {job.status}. {first}; delete it once it has ended.", job_status=job.status
                )
            _forget(session, job)

    def artifacts(self, job_id: str) -> list[ArtifactRow]:
        """The published files of a job, by name; those for the service alone start with a dot."""
        with self._database.reading() as session:
            found = select(ArtifactRow).where(ArtifactRow.job_id == job_id).order_by(ArtifactRow.name)
            return list(session.scalars(found))

    def artifact(self, job_id: str, name: str) -> ArtifactRow | None:
        """One published file."""
        with self._database.reading() as session:
            return session.get(ArtifactRow, (job_id, name))

    def events(self, job_id: str, after: int, limit: int = 500) -> list[EventRow]:
        """What happened to a job after the event of that number."""
        query = select(EventRow).where(EventRow.job_id == job_id, EventRow.id > after)
        with self._database.reading() as session:
            return list(session.scalars(query.order_by(EventRow.id).limit(limit)))

    def last_events(self, job_ids: Sequence[str]) -> dict[str, int]:
        """The number of the newest event of each job; jobs without events, or that are gone, are left out."""
        query = select(EventRow.job_id, func.max(EventRow.id)).where(EventRow.job_id.in_(job_ids))
        with self._database.reading() as session:
            return dict(session.execute(query.group_by(EventRow.job_id)).tuples().all())

    # --- what a dispatcher does ------------------------------------------------------------------------------------

    def lease(self, dispatcher: str, fits: Callable[[JobRow], bool] = lambda job: True) -> Lease | None:
        """Take the next job: the highest priority, then the owner who has waited longest, then the oldest job.

        Jobs whose lease has run out come with the queued ones. One that has used up its attempts ends as failed
        here, one that was being canceled as canceled, and the next is looked at.

        Args:
            fits: whether there is room for the job. It is asked for the next one only: smaller jobs do not
                overtake a big one for ever.
        """
        while True:
            now = self._database.clock()
            with self._database.writing() as session:
                job = session.scalar(self._next(now))
                if job is None:
                    return None
                lost = job.status != "queued"
                if lost and self._settle_lost(session, job, now):
                    continue
                if not fits(job):
                    return None
                return self._take(session, job, dispatcher, now)

    def waiting(self) -> int:
        """How many jobs could be leased now."""
        with self._database.reading() as session:
            query = select(func.count()).select_from(JobRow).where(_ready(self._database.clock()))
            return session.scalar(query) or 0

    @staticmethod
    def _next(now: float) -> Select[JobRow]:
        turn = case((TurnRow.served.is_(None), 0), else_=TurnRow.served)
        query = select(JobRow).outerjoin(TurnRow, TurnRow.owner == JobRow.owner).where(_ready(now))
        order = (JobRow.priority.desc(), turn, JobRow.queued_at, JobRow.id)
        return query.order_by(*order).limit(1).with_for_update(skip_locked=True, of=JobRow)

    def _settle_lost(self, session: Session, job: JobRow, now: float) -> bool:
        """Close the attempt of a dispatcher that was not heard of again; True if the job has ended with it."""
        error = {"code": "dispatcher-lost", "message": "The process that ran the job was not heard of again."}
        _close_attempt(session, job, "lost", error, now)
        count(session, "sgsst_lease_expirations_total")
        if job.status == "canceling":
            self._end(session, job, "canceled", now)
            return True
        _count_failure(job)
        if job.failures >= self._max_attempts:
            job.error = error | {"message": f"{error['message']} This was attempt {job.attempt}."}
            self._end(session, job, "failed", now)
            return True
        return False

    def _take(self, session: Session, job: JobRow, dispatcher: str, now: float) -> Lease:
        job.status = "starting"
        job.attempt += 1
        job.lease_epoch += 1
        job.lease_owner, job.lease_expires_at = dispatcher, now + self._lease_seconds
        job.started_at = job.started_at or now
        attempt = AttemptRow(job_id=job.id, number=job.attempt, epoch=job.lease_epoch, dispatcher=dispatcher)
        attempt.started_at = now
        session.add(attempt)
        served = (session.scalar(select(func.max(TurnRow.served))) or 0) + 1
        turn = upsert(session)(TurnRow).values(owner=job.owner, served=served)
        session.execute(turn.on_conflict_do_update(index_elements=["owner"], set_={"served": served}))
        _say(session, job, now)
        count(session, "sgsst_attempts_total")
        count(session, "sgsst_queue_wait_seconds_sum", amount=max(0.0, now - job.queued_at))
        count(session, "sgsst_queue_wait_seconds_count")
        return Lease(job, dispatcher, job.lease_epoch)

    def renew(self, leases: Sequence[Lease]) -> dict[str, Status | None]:
        """Hold leases for another term; a job's status where it is still held, None where the lease is lost."""
        until = self._database.clock() + self._lease_seconds
        found: dict[str, Status | None] = {}
        with self._database.writing() as session:
            for lease in leases:
                job = self._held(session, lease)
                if job is not None:
                    job.lease_expires_at = until
                found[lease.job_id] = job.status if job is not None else None  # type: ignore[assignment]
        return found

    def look(self, leases: Sequence[Lease]) -> dict[str, Status | None]:
        """As `renew`, without renewing: what has become of leased jobs."""
        with self._database.reading() as session:
            rows = {row.id: row for row in session.scalars(select(JobRow).where(_any_of(leases)))}
        held = {lease.job_id: _is_held(rows.get(lease.job_id), lease) for lease in leases}
        return {job_id: rows[job_id].status if yes else None for job_id, yes in held.items()}  # type: ignore[misc]

    def lease_owners(self) -> list[str]:
        """Names of all dispatchers that hold a lease."""
        with self._database.reading() as session:
            query = select(JobRow.lease_owner).where(JobRow.status.in_(ACTIVE), JobRow.lease_owner.is_not(None))
            return sorted({str(owner) for owner in session.scalars(query)})

    def end_leases(self, dispatcher: str) -> None:
        """Let the leases of a dispatcher run out now: it is known to be dead."""
        now = self._database.clock()
        with self._database.writing() as session:
            held = and_(JobRow.lease_owner == dispatcher, JobRow.status.in_(ACTIVE))
            session.execute(update(JobRow).where(held).values(lease_expires_at=now - 1e-3))

    def running(self, lease: Lease) -> None:
        """Tell that the job's inputs are read and its steps begin; a job that is being canceled stays so."""
        now = self._database.clock()
        with self._database.writing() as session:
            job = self._held_or_raise(session, lease)
            if job.status == "starting":
                job.status = "running"
                _say(session, job, now)

    def progress(self, lease: Lease, progress: dict[str, Any]) -> None:
        """Replace the job's progress."""
        now = self._database.clock()
        with self._database.writing() as session:
            job = self._held_or_raise(session, lease)
            job.progress = {**progress, "updated_at": now}
            _note(session, job.id, "progress", job.progress, now)
            mine = and_(EventRow.job_id == job.id, EventRow.kind == "progress")
            oldest = select(EventRow.id).where(mine).order_by(EventRow.id.desc()).offset(KEPT_PROGRESS).limit(1)
            found = session.scalar(oldest)
            if found is not None:
                session.execute(delete(EventRow).where(mine, EventRow.id <= found))

    def publish(self, lease: Lease, files: Sequence[Published]) -> list[str]:
        """Make files visible; those of the same names are replaced. Returns locations that nothing refers to now."""
        now = self._database.clock()
        with self._database.writing() as session:
            job = self._held_or_raise(session, lease)
            return _publish(session, job, files, now)

    def succeed(self, lease: Lease, files: Sequence[Published], result: dict[str, Any], retention: float) -> list[str]:
        """End a job with its results, all in one transaction; as `publish` otherwise.

        A job whose cancellation came too late has succeeded.
        """
        now = self._database.clock()
        with self._database.writing() as session:
            job = self._held_or_raise(session, lease)
            unused = _publish(session, job, files, now)
            hidden = ArtifactRow.name.startswith(".")  # what an unfinished job would go on from
            session.execute(delete(ArtifactRow).where(ArtifactRow.job_id == job.id, hidden))
            job.result, job.error = result, None
            _close_attempt(session, job, "succeeded", None, now)
            count(session, "sgsst_job_seconds_sum", amount=max(0.0, now - (job.started_at or now)))
            count(session, "sgsst_job_seconds_count")
            self._end(session, job, "succeeded", now, retention)
            return unused

    def fail(self, lease: Lease, error: dict[str, Any], *, permanent: bool, retention: float) -> bool:
        """End an attempt that failed: the job is queued again after a wait, or failed for good.

        It fails for good after so many attempts in a row that saved no later step than those before.

        Args:
            permanent: another attempt would fail the same way.

        Returns:
            Whether the job will be tried again.
        """
        now = self._database.clock()
        with self._database.writing() as session:
            job = self._held_or_raise(session, lease)
            _close_attempt(session, job, "failed", error, now)
            if job.status == "canceling":
                self._end(session, job, "canceled", now, retention)
                return False
            _count_failure(job)
            job.error = error
            if permanent or job.failures >= self._max_attempts:
                self._end(session, job, "failed", now, retention)
                return False
            wait = min(self._retry_seconds * 2 ** max(job.failures - 1, 0), _MAX_RETRY_SECONDS)
            self._requeue(session, job, now, now + wait)
            return True

    def release(self, lease: Lease) -> None:
        """Give a job back unfinished, without counting the attempt as failed: the dispatcher is shutting down."""
        now = self._database.clock()
        with self._database.writing() as session:
            job = self._held_or_raise(session, lease)
            _close_attempt(session, job, "released", None, now)
            if job.status == "canceling":
                self._end(session, job, "canceled", now)
            else:
                self._requeue(session, job, now, now)

    def canceled(self, lease: Lease, retention: float) -> None:
        """End a job that was being canceled."""
        now = self._database.clock()
        with self._database.writing() as session:
            job = self._held_or_raise(session, lease)
            _close_attempt(session, job, "canceled", None, now)
            self._end(session, job, "canceled", now, retention)

    def expire(self, retention: float) -> list[str]:
        """End the time of results that have been kept long enough, and forget jobs long after.

        Returns:
            Ids of jobs whose files are to be removed.
        """
        now = self._database.clock()
        with self._database.writing() as session:
            due = session.scalars(select(JobRow).where(JobRow.expires_at < now).limit(100).with_for_update()).all()
            for job in due:
                if job.status == "expired":
                    _forget(session, job)
                    continue
                job.status, job.expires_at = "expired", now + retention
                session.execute(delete(ArtifactRow).where(ArtifactRow.job_id == job.id))
                session.execute(delete(BlobUseRow).where(BlobUseRow.holder == f"job:{job.id}"))
                _say(session, job, now)
            session.execute(delete(IdempotencyRow).where(IdempotencyRow.created_at < now - IDEMPOTENCY_SECONDS))
            return [job.id for job in due]

    def unswept(self, limit: int) -> list[tuple[str, int]]:
        """Jobs that have ended and may have left files that no row refers to, each with its last lease's epoch."""
        query = select(JobRow.id, JobRow.lease_epoch).where(JobRow.swept.is_(False), JobRow.status.in_(FINISHED))
        with self._database.reading() as session:
            return [(job_id, epoch) for job_id, epoch in session.execute(query.limit(limit))]

    def swept(self, job_id: str, epoch: int) -> None:
        """Note that no such files are left; a job that was queued again since is left alone."""
        same = and_(JobRow.id == job_id, JobRow.lease_epoch == epoch, JobRow.status.in_(FINISHED))
        with self._database.writing() as session:
            session.execute(update(JobRow).where(same).values(swept=True))

    # --- shared ----------------------------------------------------------------------------------------------------

    def _held(self, session: Session, lease: Lease) -> JobRow | None:
        job = session.get(JobRow, lease.job_id, with_for_update=True)
        return job if _is_held(job, lease) else None

    def _held_or_raise(self, session: Session, lease: Lease) -> JobRow:
        job = self._held(session, lease)
        if job is None:
            raise LeaseLostError(f"{lease.job_id}: lease {lease.epoch} of {lease.dispatcher} is no longer held.")
        return job

    def _requeue(self, session: Session, job: JobRow, now: float, not_before: float) -> None:
        job.status, job.not_before = "queued", not_before
        job.lease_owner = job.lease_expires_at = None
        _say(session, job, now)

    def _end(self, session: Session, job: JobRow, status: Status, now: float, retention: float = 30 * DAY) -> None:
        job.status, job.finished_at, job.expires_at = status, now, now + retention
        job.lease_owner = job.lease_expires_at = None
        _say(session, job, now)
        count(session, "sgsst_jobs_finished_total", f'status="{status}"')
        if job.webhook:
            body = {"type": f"job.{status}", "timestamp": now, "data": {"id": job.id, "name": job.name}}
            body["data"] |= {"status": status, "error": job.error}  # type: ignore[operator]
            delivery = DeliveryRow(id=new_id("msg", now), job_id=job.id, url=job.webhook, body=body)
            delivery.tries, delivery.next_at = 0, now
            session.add(delivery)


def _first_values(new: NewJob, now: float) -> dict[str, Any]:
    """The row of a job that has just been accepted."""
    return {
        "id": new_id("job", now),
        "owner": new.owner,
        "name": new.name,
        "status": "queued",
        "priority": new.priority,
        "parameters": new.parameters,
        "inputs": new.inputs,
        "created_at": now,
        "queued_at": now,
        "not_before": now,
        "attempt": 0,
        "failures": 0,
        "lease_epoch": 0,
        "webhook": new.webhook,
    }


def _owned(session: Session, job_id: str, owner: str | None, *, lock: bool = False) -> JobRow:
    job = session.get(JobRow, job_id, with_for_update=lock)
    if job is None or (owner is not None and job.owner != owner):
        raise NotFoundError(f"There is no job {job_id}.")
    return job


def _ready(now: float) -> ColumnElement[bool]:
    """Queued and to be started, or held by a dispatcher that was not heard of again."""
    queued = and_(JobRow.status == "queued", JobRow.not_before <= now)
    expired = and_(JobRow.status.in_(ACTIVE), JobRow.lease_expires_at < now)
    return or_(queued, expired)


def _count_failure(job: JobRow) -> None:
    """A failure counts where nothing has been saved since the last one: a long job outlives many accidents, and one
    that breaks at the same step each time does not.
    """
    progress = (job.saved_step or 0) > (job.failed_step or 0)
    job.failures = 0 if progress else job.failures + 1
    job.failed_step = job.saved_step


def _position(connection: Connection, job: JobRow) -> int | None:
    if job.status != "queued":
        return None
    own = {"priority": job.priority, "queued_at": job.queued_at, "job_id": job.id}
    return 1 + int(connection.execute(_AHEAD, own).scalar_one())


def _is_held(job: JobRow | None, lease: Lease) -> bool:
    return (
        job is not None
        and job.status in ACTIVE
        and job.lease_epoch == lease.epoch
        and job.lease_owner == lease.dispatcher
    )


def _any_of(leases: Sequence[Lease]) -> ColumnElement[bool]:
    return JobRow.id.in_([lease.job_id for lease in leases])


def _said(job: JobRow) -> str:
    return "expired" if job.status == "expired" else job.status


def _say(session: Session, job: JobRow, now: float) -> None:
    data: dict[str, Any] = {"status": job.status, "attempt": job.attempt}
    if job.error:
        data["error"] = job.error
    _note(session, job.id, "status", data, now)


def _note(session: Session, job_id: str, kind: str, data: dict[str, Any], now: float) -> None:
    session.execute(insert(_EVENTS), {"job_id": job_id, "kind": kind, "data": data, "created_at": now})


def _publish(session: Session, job: JobRow, files: Sequence[Published], now: float) -> list[str]:
    unused = []
    for file in files:
        if file.step is not None:
            job.saved_step = max(job.saved_step or 0, file.step)
        row = session.get(ArtifactRow, (job.id, file.name))
        if row is None:
            row = ArtifactRow(job_id=job.id, name=file.name)
            session.add(row)
        elif row.location != file.location:
            unused.append(row.location)
        row.location, row.size, row.sha256, row.created_at = file.location, file.size, file.sha256, now
        if not file.name.startswith("."):
            data = {"name": file.name, "size": file.size, "sha256": file.sha256}
            _note(session, job.id, "artifact", data, now)
    return unused


def _close_attempt(session: Session, job: JobRow, outcome: str, error: dict[str, Any] | None, now: float) -> None:
    session.execute(
        update(AttemptRow)
        .where(AttemptRow.job_id == job.id, AttemptRow.number == job.attempt)
        .values(finished_at=now, outcome=outcome, error=error)
    )
    count(session, "sgsst_attempts_ended_total", f'outcome="{outcome}"')


def _forget(session: Session, job: JobRow) -> None:
    session.execute(delete(BlobUseRow).where(BlobUseRow.holder == f"job:{job.id}"))
    session.delete(job)  # its attempts, events and artifacts go with it
