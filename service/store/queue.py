"""The queue: which job is next, leases of jobs by dispatchers, the policy for repeating attempts, and monitoring.

A dispatcher holds a lease of each job that it runs. A lease lasts some seconds unless it is renewed. Each lease of a
job has a number, its epoch. Every write of a dispatcher names the epoch that it holds, and raises `LeaseLostError`
without effect if the job has been leased again since. Two dispatchers may thus both believe that they run a job, but
only one of them can write.

The queue may have tens of thousands of jobs, most of them of a few owners. Only the first job of each owner can be
next. The query therefore steps from owner to owner in an index: its time grows with the number of waiting owners.

Only the job's own failures count against it. An attempt that a machine, the network, the database, the disk or the file
store has ended is repeated until it succeeds.
"""

import base64
import secrets
from collections import Counter
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import sqlalchemy as sa
from sqlalchemy.orm import Session, aliased, undefer

from service import problems
from service.problems import ServiceError
from service.states import ACTIVE, AttemptOutcome, Cause, JobStatus, Published, Transition
from service.store.database import Database, count, observe, upsert
from service.store.jobs import add_event, add_point, end, move, put_artifact, send_webhook
from service.store.keys import add_usage
from service.store.tables import (
    ArtifactRow,
    AttemptRow,
    CounterRow,
    DeliveryRow,
    DispatcherRow,
    EventRow,
    JobRow,
    ProgressPointRow,
    SecretRow,
    TurnRow,
)
from sgsst_core.errors import InfrastructureError
from sgsst_core.progress import Progress
from worker.job import CONTINUABLE

#: Maximum number of candidates, each of another owner.
_MOST_CANDIDATES = 16

# Queries are built once, because building one takes longer than running it.
_NOW: sa.BindParameter[float] = sa.bindparam("now", type_=sa.Float)
_MOST: sa.BindParameter[int] = sa.bindparam("most", type_=sa.Integer)


def _first_of_each_owner() -> sa.Select[Any]:
    """Return the query for the id of each owner's next job."""
    job = aliased(JobRow)
    queued = job.status == JobStatus.QUEUED
    owners = sa.select(sa.func.min(job.owner).label("owner")).where(queued).cte("owners", recursive=True)
    following = sa.select(sa.func.min(job.owner)).where(queued, job.owner > owners.c.owner).scalar_subquery()
    owners = owners.union_all(sa.select(following).where(owners.c.owner.is_not(None)))
    each = (
        sa.select(job.id)
        .where(queued, job.owner == owners.c.owner, job.not_before <= _NOW)
        .order_by(job.priority.desc(), job.queued_at, job.id)
        .limit(1)
        .scalar_subquery()
    )
    return sa.select(each.label("id")).where(owners.c.owner.is_not(None))


#: Conditions for queued jobs that may start now, and for jobs with expired leases.
_QUEUED = sa.and_(JobRow.status == JobStatus.QUEUED, JobRow.not_before <= _NOW)
_EXPIRED = sa.and_(JobRow.lease_expires_at < _NOW, JobRow.status.in_(ACTIVE))
#: Number of both, up to `most`.
_WAITING = sa.select(sa.func.count()).select_from(
    sa.union_all(sa.select(JobRow.id).where(_QUEUED), sa.select(JobRow.id).where(_EXPIRED)).limit(_MOST).subquery()
)
#: Ids of the jobs that may be next.
_CANDIDATES = sa.union_all(_first_of_each_owner(), sa.select(JobRow.id).where(_EXPIRED))
#: First candidates in order. Their conditions are checked again, because rows may have changed.
_FIRST = (
    sa.select(JobRow)
    .options(undefer(JobRow.inputs))
    .outerjoin(TurnRow, TurnRow.owner == JobRow.owner)
    .where(JobRow.id.in_(sa.bindparam("candidates", type_=sa.String, expanding=True)), sa.or_(_QUEUED, _EXPIRED))
    .order_by(
        JobRow.priority.desc(),
        sa.case((TurnRow.served.is_(None), 0), else_=TurnRow.served),
        JobRow.queued_at,
        JobRow.id,
    )
    .limit(_MOST_CANDIDATES)
    .with_for_update(skip_locked=True, of=JobRow)
)


def _next_jobs(session: Session, now: float) -> Sequence[JobRow]:
    """Return the next jobs: by priority, then owners' turns, then age, at most one queued job of each owner.

    Their rows are locked; rows that others have locked are skipped.
    """
    ids = [job_id for job_id in session.scalars(_CANDIDATES, {"now": now}) if job_id is not None]
    # a separate statement: inside one query, PostgreSQL overestimates the candidates and reads all jobs
    return session.scalars(_FIRST, {"now": now, "candidates": ids}).all() if ids else []


#: Maximum delay between attempts in seconds; the delay doubles up to this limit.
MAX_RETRY_SECONDS = 300.0
#: Number of attempts in a row without a step that were lost with their dispatcher, after which a job fails. The
#: dispatcher may have died of the job itself: some container runtimes end all processes of a container that has run out
#: of memory.
MAX_LOSSES = 10
#: Code of the error of an attempt that was lost with its dispatcher.
_DISPATCHER_LOST = "dispatcher-lost"


def cause_of(error: Mapping[str, Any] | None) -> Cause:
    """Return the cause of an attempt's end from its recorded error."""
    code = (error or {}).get("code")
    if code == _DISPATCHER_LOST:
        return Cause.DISPATCHER
    return Cause((error or {}).get("cause", Cause.MACHINE)) if code == InfrastructureError.code else Cause.JOB


@dataclass(frozen=True)
class RetryPolicy:
    """Policy for retrying jobs.

    Attributes:
        max_attempts: Consecutive attempts without progress after which a job fails.
        retry_seconds: Delay after the first failure in seconds; it doubles with each further one, up to
            `MAX_RETRY_SECONDS`.
    """

    max_attempts: int
    retry_seconds: float

    def after_attempt(
        self,
        outcome: AttemptOutcome,
        job: JobRow,
        causes: Sequence[Cause] = (Cause.JOB,),
        *,
        permanent: bool = False,
    ) -> tuple[Transition, float]:
        """Decide what follows an attempt that failed, was lost or was released, and count its failure in the job.

        Args:
            job: Job with its status from before the decision.
            causes: Cause of the attempt's end, then those of earlier attempts back to the last one that made a step.
            permanent: Whether another attempt would fail in the same way.

        Returns:
            STOP, FAIL or REQUEUE, and the delay in seconds before a queued job may be taken again.
        """
        if job.status == JobStatus.CANCELING:
            return Transition.STOP, 0.0
        if outcome == AttemptOutcome.RELEASED:
            return Transition.REQUEUE, 0.0
        if causes[0] == Cause.JOB:
            # progress resets the count: a long job survives many sporadic failures, but not one at the same step again
            progress = (job.saved_step or 0) > (job.failed_step or 0)
            job.failures, job.failed_step = 0 if progress else job.failures + 1, job.saved_step
            failed, repeated = permanent or job.failures >= self.max_attempts, job.failures
        else:
            failed = list(causes[:MAX_LOSSES]) == [Cause.DISPATCHER] * MAX_LOSSES
            repeated = next((number for number, cause in enumerate(causes) if cause == Cause.JOB), len(causes))
        if failed:
            return Transition.FAIL, 0.0
        wait = min(self.retry_seconds * 2.0 ** max(repeated - 1, 0), MAX_RETRY_SECONDS)
        # a lost attempt has already cost the duration of a lease
        return Transition.REQUEUE, 0.0 if outcome == AttemptOutcome.LOST else wait


#: Expiry of a lease whose dispatcher is known to be dead.
EXPIRED = 0.0
#: Number of progress events stored per job; a client that resumes from an older event misses only old progress.
MAX_PROGRESS_EVENTS = 200
#: Prefix of files that only clients of an unfinished job need. They are removed once it has succeeded.
LIVE = "live/"
#: Maximum number of past attempts that the retry policy looks at: by then the delay is at its maximum.
_MAX_CAUSES = 2 * MAX_LOSSES
#: Time in seconds for which jobs of other owners overtake a waiting job that needs more capacity than is free.
OVERTAKEN_SECONDS = 600.0

_PROGRESS = sa.and_(EventRow.job_id == sa.bindparam("of_job"), EventRow.kind == "progress")
_OLD = sa.select(EventRow.id).where(_PROGRESS).order_by(EventRow.id.desc()).offset(MAX_PROGRESS_EVENTS).limit(1)
#: Statement that deletes all but the last progress events of a job.
_DELETE_OLD_PROGRESS = sa.delete(EventRow).where(_PROGRESS, EventRow.id <= _OLD.scalar_subquery())


@dataclass(frozen=True)
class Lease:
    """Right to write to a job, valid until the job is leased again with a higher epoch."""

    job: JobRow
    dispatcher: str
    epoch: int

    @property
    def job_id(self) -> str:
        """Id of the job."""
        return self.job.id

    @property
    def log_fields(self) -> dict[str, Any]:
        """Fields of log records about the attempt."""
        return {"job": self.job.id, "attempt": self.job.attempt}


class Leases:
    """Operations of dispatchers on the store.

    Args:
        seconds: Duration of a lease.
        policy: Policy for jobs whose attempts failed.
        retention: Time in seconds until the results of an ended job expire.
    """

    def __init__(self, database: Database, seconds: float, policy: RetryPolicy, retention: float) -> None:
        self._database = database
        self._seconds = seconds
        self._policy = policy
        self._retention = retention

    # --- taking and holding ----------------------------------------------------------------------------------------

    def take(self, dispatcher: str, fits: Callable[[JobRow], bool] = lambda job: True) -> Lease | None:
        """Take the next job: by highest priority, then the owner who has waited longest, then the oldest job.

        Jobs with expired leases are candidates: they are queued again first. If such a job has used up its attempts, it
        is ended as failed, and if it was being canceled, as canceled; then the next job is tried.

        Jobs of other owners overtake a job that does not fit, but only until it has waited for `OVERTAKEN_SECONDS`.
        Then nothing is taken until it fits here or another dispatcher takes it.

        Args:
            fits: Callback that returns whether there is capacity for a job.
        """
        now = self._database.clock()
        with self._database.writing() as session:
            for job in _next_jobs(session, now):
                if job.status in ACTIVE and self._close_lost(session, job, dispatcher, now) != Transition.REQUEUE:
                    continue
                if fits(job):
                    return self._lease(session, job, dispatcher, now)
                if now - job.queued_at > OVERTAKEN_SECONDS:
                    break
        return None

    def waiting(self, most: int = 1_000_000) -> int:
        """Return the number of jobs that could be leased now, counting up to `most`."""
        parameters = {"now": self._database.clock(), "most": most}
        with self._database.reading_rows() as connection:
            return int(connection.execute(_WAITING, parameters).scalar_one())

    def _lease(self, session: Session, job: JobRow, dispatcher: str, now: float) -> Lease:
        job.attempt += 1
        job.lease_epoch += 1
        job.lease_owner, job.lease_expires_at = dispatcher, now + self._seconds
        job.started_at = job.started_at or now
        attempt = AttemptRow(job_id=job.id, number=job.attempt, epoch=job.lease_epoch, dispatcher=dispatcher)
        attempt.started_at = now
        session.add(attempt)
        served = (session.scalar(sa.select(sa.func.max(TurnRow.served))) or 0) + 1
        turn = upsert(session)(TurnRow).values(owner=job.owner, served=served)
        session.execute(turn.on_conflict_do_update(index_elements=["owner"], set_={"served": served}))
        move(session, job, Transition.TAKE, now)
        count(session, "sgsst_attempts_total")
        observe(session, "sgsst_queue_wait_seconds", max(0.0, now - job.queued_at))
        return Lease(job, dispatcher, job.lease_epoch)

    def renew(self, leases: Sequence[Lease]) -> dict[str, JobStatus | None]:
        """Renew leases; return the status of each job, or None if its lease is lost."""
        until = self._database.clock() + self._seconds
        with self._database.writing() as session:
            for lease in sorted(leases, key=lambda each: each.job_id):
                job = self._leased_job(session, lease)
                if job is not None:
                    job.lease_expires_at = until
        return self.statuses(leases)

    def statuses(self, leases: Sequence[Lease]) -> dict[str, JobStatus | None]:
        """Return what `renew` returns, without renewing the leases."""
        ids = [lease.job_id for lease in leases]
        with self._database.reading() as session:
            rows = {row.id: row for row in session.scalars(sa.select(JobRow).where(JobRow.id.in_(ids)))}
        return {
            lease.job_id: JobStatus(job.status) if (job := rows.get(lease.job_id)) and _is_held(job, lease) else None
            for lease in leases
        }

    def holders(self) -> list[str]:
        """Return the names of all dispatchers that hold a lease."""
        with self._database.reading() as session:
            query = sa.select(JobRow.lease_owner).where(JobRow.status.in_(ACTIVE), JobRow.lease_owner.is_not(None))
            return sorted({str(owner) for owner in session.scalars(query)})

    def expire(self, dispatcher: str) -> None:
        """Expire the leases of a dispatcher that is known to be dead, and forget it."""
        with self._database.writing() as session:
            session.execute(sa.delete(DispatcherRow).where(DispatcherRow.name == dispatcher))
            held = sa.and_(JobRow.lease_owner == dispatcher, JobRow.status.in_(ACTIVE))
            session.execute(sa.update(JobRow).where(held).values(lease_expires_at=EXPIRED))

    def hold_gpus(self, lease: Lease, gpus: int) -> None:
        """Set the number of GPUs that the attempt holds from now on; the job's owner is charged for them at its end."""
        with self._held(lease) as (session, job, now):
            attempt = session.get_one(AttemptRow, (job.id, job.attempt))
            attempt.gpus, attempt.gpus_since = gpus, now

    # --- while the job runs ----------------------------------------------------------------------------------------

    def start(self, lease: Lease) -> None:
        """Mark a job as running once its inputs are read; a job that is being canceled keeps its status.

        A job whose user wanted it to finish during an earlier attempt is marked as finishing again.
        """
        with self._held(lease) as (session, job, now):
            if job.status == JobStatus.STARTING:
                move(session, job, Transition.START, now)
                send_webhook(session, job, "started", "started", now, attempt=job.attempt)
                if job.finish_requested:
                    move(session, job, Transition.FINISH, now)

    def report_progress(self, lease: Lease, progress: Progress, *, notify: bool = False) -> None:
        """Replace the job's progress and add it to the loss history.

        This is by far the most frequent write of dispatchers, so it uses as few statements as possible.

        Args:
            notify: Whether the job's webhook gets a message.
        """
        now = self._database.clock()
        data = {**progress.model_dump(), "attempt": lease.job.attempt, "updated_at": now}
        held = sa.and_(JobRow.lease_epoch == lease.epoch, JobRow.lease_owner == lease.dispatcher)
        with self._database.writing() as session:
            change = sa.update(JobRow).where(JobRow.id == lease.job_id, held, JobRow.status.in_(ACTIVE))
            changed: Any = session.execute(change.values(progress=data))
            if not changed.rowcount:
                raise _lost(lease)
            add_event(session, lease.job_id, "progress", data, now)
            add_point(session, lease.job_id, data)
            session.execute(_DELETE_OLD_PROGRESS, {"of_job": lease.job_id})
            if notify:
                job = session.get_one(JobRow, lease.job_id)
                send_webhook(session, job, "progress", "progress", now, progress=data)

    def publish(self, lease: Lease, files: Sequence[Published]) -> list[str]:
        """Publish files, replacing those of the same names; return the locations of the replaced files."""
        with self._held(lease) as (session, job, now):
            return _publish(session, job, files, now)

    # --- the end of an attempt -------------------------------------------------------------------------------------

    def succeed(self, lease: Lease, files: Sequence[Published], result: dict[str, Any]) -> None:
        """End a job as succeeded and publish its results in one transaction; replaced files are swept.

        If a cancellation came too late, the job still counts as succeeded.
        """
        with self._held(lease) as (session, job, now):
            _publish(session, job, files, now)
            # the colors of the unfinished job, and its checkpoint unless it can be continued
            prefixes = (LIVE,) if result.get("stopped") in CONTINUABLE else (".", LIVE)
            obsolete = sa.or_(*(ArtifactRow.name.startswith(prefix, autoescape=True) for prefix in prefixes))
            session.execute(sa.delete(ArtifactRow).where(ArtifactRow.job_id == job.id, obsolete))
            visible = ~ArtifactRow.name.startswith(".", autoescape=True)
            size = sa.select(sa.func.sum(ArtifactRow.size)).where(ArtifactRow.job_id == job.id, visible)
            add_usage(session, job.owner, now, bytes=int(session.scalar(size) or 0))
            job.result, job.error = result, None
            _close_attempt(session, job, AttemptOutcome.SUCCEEDED, None, now)
            observe(session, "sgsst_job_seconds", max(0.0, now - (job.started_at or now)))
            end(session, job, Transition.SUCCEED, now, self._retention)

    def fail(self, lease: Lease, error: dict[str, Any], *, permanent: bool) -> bool:
        """End a failed attempt: the job is queued again after a delay, or fails.

        An error with the code of `InfrastructureError` is never permanent.

        Args:
            error: `code` and `message`, and the `cause` of an outage (`states.Cause`).
            permanent: Whether another attempt would fail in the same way.

        Returns:
            Whether the job will be retried.
        """
        with self._held(lease) as (session, job, now):
            outcome = AttemptOutcome.FAILED
            return self._close(session, job, outcome, error, now, permanent=permanent) == Transition.REQUEUE

    def release(self, lease: Lease) -> None:
        """Return an unfinished job to the queue without counting a failure, because the dispatcher is shutting down."""
        with self._held(lease) as (session, job, now):
            self._close(session, job, AttemptOutcome.RELEASED, None, now)

    def stop(self, lease: Lease) -> None:
        """End a job that was being canceled."""
        with self._held(lease) as (session, job, now):
            _close_attempt(session, job, AttemptOutcome.CANCELED, None, now)
            end(session, job, Transition.STOP, now, self._retention)

    def _close_lost(self, session: Session, job: JobRow, dispatcher: str, now: float) -> Transition:
        """Close an attempt whose lease `dispatcher` has found expired, as `_close` does."""
        error = {"code": _DISPATCHER_LOST, "message": "The process that ran the job stopped responding."}
        if job.lease_owner == dispatcher or self._lives(session, job):
            message = "The process that ran the job could not reach the database in time. The job will be retried."
            error = {"code": InfrastructureError.code, "message": message, "cause": Cause.DATABASE}
        count(session, "sgsst_lease_expirations_total")
        return self._close(session, job, AttemptOutcome.LOST, error, now)

    def _lives(self, session: Session, job: JobRow) -> bool:
        """Return whether the dispatcher of an expired lease has reported after it failed to renew the lease."""
        owner = session.get(DispatcherRow, job.lease_owner) if job.lease_owner else None
        expired_at = job.lease_expires_at or EXPIRED
        return owner is not None and expired_at > EXPIRED and owner.seen_at > expired_at - self._seconds / 2

    def _close(
        self,
        session: Session,
        job: JobRow,
        outcome: AttemptOutcome,
        error: dict[str, Any] | None,
        now: float,
        *,
        permanent: bool = False,
    ) -> Transition:
        """Close an attempt, then end its job or queue it again; return the job's transition."""
        _close_attempt(session, job, outcome, error, now)
        causes = _causes(session, job)
        if causes[0] not in (Cause.JOB, Cause.DISPATCHER):
            count(session, "sgsst_outages_total", f'cause="{causes[0]}"')
        transition, wait = self._policy.after_attempt(outcome, job, causes, permanent=permanent)
        if transition == Transition.FAIL or (transition == Transition.REQUEUE and outcome == AttemptOutcome.FAILED):
            job.error = error
        if transition == Transition.REQUEUE:
            job.not_before, job.lease_owner, job.lease_expires_at = now + wait, None, None
            move(session, job, transition, now)
        else:
            end(session, job, transition, now, self._retention)
        return transition

    # --- shared ----------------------------------------------------------------------------------------------------

    def _leased_job(self, session: Session, lease: Lease) -> JobRow | None:
        job = session.get(JobRow, lease.job_id, with_for_update=True)
        return job if job is not None and _is_held(job, lease) else None

    @contextmanager
    def _held(self, lease: Lease) -> Iterator[tuple[Session, JobRow, float]]:
        """Provide a transaction, the leased job and the time; raise `LeaseLostError` if the lease is lost."""
        now = self._database.clock()
        with self._database.writing() as session:
            job = self._leased_job(session, lease)
            if job is None:
                raise _lost(lease)
            yield session, job, now


def _lost(lease: Lease) -> ServiceError:
    return problems.LEASE_LOST(job_id=lease.job_id, epoch=lease.epoch, dispatcher=lease.dispatcher)


def _is_held(job: JobRow, lease: Lease) -> bool:
    return job.status in ACTIVE and job.lease_epoch == lease.epoch and job.lease_owner == lease.dispatcher


def _publish(session: Session, job: JobRow, files: Sequence[Published], now: float) -> list[str]:
    replaced = []
    for file in files:
        if file.step is not None:
            job.saved_step = max(job.saved_step or 0, file.step)
        replaced += put_artifact(session, job.id, file, now)
        if not file.name.startswith("."):
            data = {"name": file.name, "size": file.size, "sha256": file.sha256}
            add_event(session, job.id, "artifact", data, now)
    return replaced


def _causes(session: Session, job: JobRow) -> list[Cause]:
    """Return the causes of the ends of the latest attempts, newest first, back to the last one that made a step."""
    attempts = sa.select(AttemptRow.number, AttemptRow.error).where(AttemptRow.job_id == job.id)
    progressed = session.scalar(
        sa.select(sa.func.max(ProgressPointRow.attempt)).where(
            ProgressPointRow.job_id == job.id, ProgressPointRow.attempt < job.attempt
        )
    )
    newer = attempts.where(AttemptRow.number > (progressed or 0)).order_by(AttemptRow.number.desc())
    return [cause_of(error) for _, error in session.execute(newer.limit(_MAX_CAUSES)).all()]


def _close_attempt(
    session: Session, job: JobRow, outcome: AttemptOutcome, error: dict[str, Any] | None, now: float
) -> None:
    attempt = session.get_one(AttemptRow, (job.id, job.attempt))
    attempt.finished_at, attempt.outcome, attempt.error = now, outcome, error
    if outcome != AttemptOutcome.LOST:  # its working time is unknown, and the loss is not the owner's fault
        if attempt.gpus_since is not None:
            add_usage(session, job.owner, now, gpu_seconds=attempt.gpus * max(0.0, now - attempt.gpus_since))
        else:
            add_usage(session, job.owner, now, cpu_seconds=max(0.0, now - attempt.started_at))
    count(session, "sgsst_attempts_ended_total", f'outcome="{outcome}"')


# --- monitoring and webhooks ---------------------------------------------------------------------------------------

#: Whether a PostgreSQL server accepts no writes; a standby does not.
_READ_ONLY = sa.text("SHOW transaction_read_only")


def _counted(counts: Mapping[str, int], column: sa.SQLColumnExpression[str]) -> sa.ColumnElement[int]:
    """Return an SQL expression for the count of a column's value; 0 for values without a count."""
    return sa.case(dict(counts), value=column, else_=0) if counts else sa.literal(0)


class Operations:
    """Operations for monitoring and webhooks."""

    def __init__(self, database: Database, lease_seconds: float) -> None:
        self._database = database
        self._lease_seconds = lease_seconds

    def record_heartbeat(self, name: str, slots: int, free: int) -> None:
        """Record a dispatcher's heartbeat with its total and free capacity."""
        now = self._database.clock()
        values = {"seen_at": now, "slots": slots, "free": free}
        with self._database.writing() as session:
            insert = upsert(session)(DispatcherRow).values(name=name, **values)
            session.execute(insert.on_conflict_do_update(index_elements=["name"], set_=values))

    def remove_dispatcher(self, name: str) -> None:
        """Remove a dispatcher that has ended."""
        with self._database.writing() as session:
            session.execute(sa.delete(DispatcherRow).where(DispatcherRow.name == name))

    def dispatchers(self) -> list[DispatcherRow]:
        """Return the live dispatchers: those with a heartbeat within a lease duration."""
        alive = sa.select(DispatcherRow).where(self._is_alive()).order_by(DispatcherRow.name)
        with self._database.reading() as session:
            return list(session.scalars(alive))

    def check(self) -> int:
        """Query the database for a health check, and return the number of live dispatchers.

        Raises:
            DatabaseUnavailableError: If the database does not respond within some seconds, or accepts no writes.
        """
        alive = sa.select(sa.func.count()).select_from(DispatcherRow).where(self._is_alive())
        with self._database.reserved_connection() as connection:
            if not self._database.sqlite and connection.scalar(_READ_ONLY) == "on":
                raise problems.DATABASE_UNAVAILABLE()
            return connection.execute(alive).scalar_one()

    def _is_alive(self) -> sa.ColumnElement[bool]:
        """Return the condition of a heartbeat within a lease duration. One far in the future is of a wrong clock."""
        now = self._database.clock()
        return DispatcherRow.seen_at.between(now - self._lease_seconds, now + self._lease_seconds)

    def counters(self) -> list[tuple[str, str, float]]:
        """Return name, labels and value of every counter."""
        with self._database.reading() as session:
            rows = session.scalars(sa.select(CounterRow).order_by(CounterRow.name, CounterRow.labels)).all()
        return [(row.name, row.labels, row.value) for row in rows]

    def work(self) -> tuple[dict[str, int], float, float]:
        """Return the number of jobs by status, the waiting time of the oldest queued one, and the steps per second.

        Times are in seconds. They are 0 if no job is queued, and if none makes steps.
        """
        counts = sa.select(JobRow.status, sa.func.count()).group_by(JobRow.status)
        with self._database.reading() as session:
            by_status = dict(session.execute(counts).all())
            oldest = session.scalar(sa.select(sa.func.min(JobRow.queued_at)).where(JobRow.status == JobStatus.QUEUED))
            running = session.scalars(sa.select(JobRow.progress).where(JobRow.status == JobStatus.RUNNING)).all()
        waited = 0.0 if oldest is None else max(0.0, self._database.clock() - oldest)
        rates = (each["step"] / each["seconds"] for each in running if each and each.get("seconds"))
        return by_status, waited, sum(rates)

    def webhook_secret(self) -> str:
        """Return the secret that signs webhooks, in the format of Standard Webhooks; it is created on first use."""
        secret = "whsec_" + base64.b64encode(secrets.token_bytes(32)).decode()
        with self._database.writing() as session:
            insert = upsert(session)(SecretRow).values(name="webhooks", value=secret)
            session.execute(insert.on_conflict_do_nothing())
            return session.get_one(SecretRow, "webhooks").value

    def due_deliveries(
        self,
        hold_seconds: float,
        sending: Collection[tuple[DeliveryRow, str]],
        *,
        total: int,
        per_owner: int,
        per_url: int,
    ) -> list[tuple[DeliveryRow, str]]:
        """Claim due messages for sending; no other dispatcher gets them for `hold_seconds`.

        Each message counts this attempt, and comes with the owner of its job: an empty text if the job is deleted.

        Args:
            sending: Messages that this dispatcher is already sending; they count toward the limits.
            total, per_owner, per_url: Maximum numbers of messages sent at the same time. The latter two keep a receiver
                that does not respond, or an owner with many such receivers, from delaying the messages of others.
        """
        now = self._database.clock()
        owner = sa.func.coalesce(JobRow.owner, "")  # messages of deleted jobs count as those of one owner
        per_url_rank = sa.func.row_number().over(partition_by=DeliveryRow.url, order_by=DeliveryRow.next_at)
        due = (
            sa.select(DeliveryRow.id, DeliveryRow.next_at, owner.label("owner"))
            .add_columns(
                (per_url_rank + _counted(Counter(row.url for row, _ in sending), DeliveryRow.url)).label("rank")
            )
            .outerjoin(JobRow, JobRow.id == DeliveryRow.job_id)
            .where(DeliveryRow.next_at <= now)
            .subquery()
        )
        per_owner_rank = sa.func.row_number().over(partition_by=due.c.owner, order_by=due.c.next_at)
        turns = (
            sa.select(due.c.id, due.c.owner)
            .add_columns(
                (per_owner_rank + _counted(Counter(holder for _, holder in sending), due.c.owner)).label("rank")
            )
            .where(due.c.rank <= per_url)
            .subquery()
        )
        query = (
            sa.select(DeliveryRow, turns.c.owner)
            .join(turns, turns.c.id == DeliveryRow.id)
            .where(turns.c.rank <= per_owner, DeliveryRow.next_at <= now)  # checked again once the row is locked
            .order_by(DeliveryRow.next_at)
            .limit(max(0, total - len(sending)))
            .with_for_update(of=DeliveryRow, skip_locked=True)
        )
        with self._database.writing() as session:
            taken = [(row, holder) for row, holder in session.execute(query).all()]
            for row, _ in taken:
                row.tries += 1
                row.next_at = now + hold_seconds
            return taken

    def settle_delivery(self, delivery_id: str, wait_seconds: float | None) -> None:
        """Make a message due again after `wait_seconds`; if None, delete it because it was delivered or given up."""
        settled = DeliveryRow.id == delivery_id
        with self._database.writing() as session:
            if wait_seconds is None:
                session.execute(sa.delete(DeliveryRow).where(settled))
            else:
                again = self._database.clock() + wait_seconds
                session.execute(sa.update(DeliveryRow).where(settled).values(next_at=again))
