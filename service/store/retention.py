"""What is done for jobs that have ended: their results expire, and what attempts have left behind is swept."""

from __future__ import annotations

from sqlalchemy import and_, delete, select, update

from service.store.changes import forget, move, release_inputs
from service.store.clocks import advance_expiry_time, expiry_time, kept_until
from service.store.database import IDEMPOTENCY_SECONDS, Database
from service.store.states import FINISHED, JobStatus, Transition
from service.store.tables import ArtifactRow, DispatcherRow, IdempotencyRow, JobRow

#: Seconds after which a dispatcher that was not heard of is forgotten.
_FORGET_SECONDS = 86_400.0


class Retention:
    """The housekeeping part of the store; any dispatcher may do it.

    Args:
        retention: seconds that results are kept, and the record of an expired job as long again.
    """

    def __init__(self, database: Database, retention: float) -> None:
        self._database = database
        self._retention = retention

    def advance(self, seconds: float) -> None:
        """Move the expiry time on, by which everything expires (`service.store.clocks`).

        Args:
            seconds: Time that the caller has worked since it moved it last, by its monotonic clock.
        """
        now = self._database.clock()
        with self._database.writing() as session:
            advance_expiry_time(session, now, seconds)

    def expire(self) -> list[str]:
        """End the time of results that have been kept long enough, and forget jobs long after.

        Returns:
            Ids of jobs whose files are to be removed.
        """
        clock = self._database.clock()
        with self._database.writing() as session:
            now = expiry_time(session, clock)
            due = session.scalars(select(JobRow).where(JobRow.expires_at < now).limit(100).with_for_update()).all()
            for job in due:
                if job.status == JobStatus.EXPIRED:
                    forget(session, job)
                    continue
                job.expires_at = kept_until(session, clock, self._retention)
                session.execute(delete(ArtifactRow).where(ArtifactRow.job_id == job.id))
                release_inputs(session, job.id)
                move(session, job, Transition.EXPIRE, clock)
            session.execute(delete(DispatcherRow).where(DispatcherRow.seen_at < now - _FORGET_SECONDS))
            session.execute(delete(IdempotencyRow).where(IdempotencyRow.created_at < now - IDEMPOTENCY_SECONDS))
            return [job.id for job in due]

    def unswept(self, limit: int) -> list[tuple[str, int]]:
        """Jobs that have ended and may have left files that no row refers to, each with its last lease's epoch."""
        query = select(JobRow.id, JobRow.lease_epoch).where(JobRow.swept.is_(False), JobRow.status.in_(FINISHED))
        with self._database.reading() as session:
            return [(job_id, epoch) for job_id, epoch in session.execute(query.limit(limit))]

    def mark_swept(self, job_id: str, epoch: int) -> None:
        """Note that no such files are left; a job that was queued again since is left alone."""
        same = and_(JobRow.id == job_id, JobRow.lease_epoch == epoch, JobRow.status.in_(FINISHED))
        with self._database.writing() as session:
            session.execute(update(JobRow).where(same).values(swept=True))
