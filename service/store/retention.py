"""Housekeeping of ended jobs: their results expire, and leftovers of attempts are swept."""

from __future__ import annotations

from sqlalchemy import and_, delete, select, update

from service.states import FINISHED, JobStatus, Transition
from service.store.changes import forget, holder_name, move
from service.store.database import IDEMPOTENCY_SECONDS, Database
from service.store.tables import ArtifactRow, BlobUseRow, DispatcherRow, IdempotencyRow, JobRow

#: Time in seconds after which a dispatcher without heartbeat is forgotten.
_FORGET_SECONDS = 86_400.0


class Retention:
    """Housekeeping of the store, which any dispatcher may do.

    Args:
        retention: Time in seconds until results expire; the record of an expired job is deleted after another such
            period.
    """

    def __init__(self, database: Database, retention: float) -> None:
        self._database = database
        self._retention = retention

    def expire(self) -> list[str]:
        """Expire old results, and delete the records of jobs that expired long ago.

        Returns:
            Ids of jobs whose files are to be removed.
        """
        now = self._database.clock()
        with self._database.writing() as session:
            old = select(JobRow).where(JobRow.expires_at < now).order_by(JobRow.id).limit(100)
            due = session.scalars(old.with_for_update(skip_locked=True)).all()
            for job in due:
                if job.status == JobStatus.EXPIRED:
                    forget(session, job)
                    continue
                job.expires_at = now + self._retention
                session.execute(delete(ArtifactRow).where(ArtifactRow.job_id == job.id))
                # blobs without other holders are collected later
                session.execute(delete(BlobUseRow).where(BlobUseRow.holder == holder_name(job.id)))
                move(session, job, Transition.EXPIRE, now)
            session.execute(delete(DispatcherRow).where(DispatcherRow.seen_at < now - _FORGET_SECONDS))
            session.execute(delete(IdempotencyRow).where(IdempotencyRow.created_at < now - IDEMPOTENCY_SECONDS))
            return [job.id for job in due]

    def unswept(self, limit: int) -> list[tuple[str, int]]:
        """Return ended jobs that may have files without database rows, each with the epoch of its last lease."""
        query = select(JobRow.id, JobRow.lease_epoch).where(JobRow.swept.is_(False), JobRow.status.in_(FINISHED))
        with self._database.reading() as session:
            return [(job_id, epoch) for job_id, epoch in session.execute(query.limit(limit))]

    def mark_swept(self, job_id: str, epoch: int) -> None:
        """Mark a job as having no files without rows, unless it has been queued again."""
        same = and_(JobRow.id == job_id, JobRow.lease_epoch == epoch, JobRow.status.in_(FINISHED))
        with self._database.writing() as session:
            session.execute(update(JobRow).where(same).values(swept=True))
