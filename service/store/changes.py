"""Changes to a job's rows that both users and dispatchers make: its status, its events, and its end.

All functions run within the caller's transaction. Every transaction takes its locks in one order, so that no two wait
for each other: the owner's limits, uploads by id, jobs by id, then the rows of each job, blobs by digest, counters.
"""

from __future__ import annotations

from typing import Any

from sqlalchemy import delete, insert, select
from sqlalchemy.orm import Session

from service import problems
from service.states import Transition, next_status
from service.store.clocks import retained_until
from service.store.database import count, new_id
from service.store.tables import Base, BlobRow, BlobUseRow, DeliveryRow, EventRow, JobRow

_EVENTS = Base.metadata.tables[EventRow.__tablename__]


def job_of_owner(session: Session, job_id: str, owner: str | None, *, lock: bool = False) -> JobRow:
    """Return a job of this owner, or of any owner if None.

    Args:
        lock: Whether to lock the row. Whoever adds rows that refer to the job does so first; it is then not deleted.

    Raises:
        NoJobError: If there is no such job or it belongs to another owner.
    """
    job = session.get(JobRow, job_id, with_for_update=lock, populate_existing=lock)
    if job is None or (owner is not None and job.owner != owner):
        raise problems.NO_JOB(job_id=job_id)
    return job


def move(session: Session, job: JobRow, transition: Transition, now: float) -> None:
    """Change a job's status and add an event for clients that watch the job.

    Raises:
        TransitionError: If the job's status does not allow the transition.
    """
    job.status = next_status(job.status, transition)
    add_status_event(session, job, now)


def end(session: Session, job: JobRow, transition: Transition, now: float, retention: float) -> None:
    """End a job.

    Args:
        retention: Time in seconds until its results expire.
    """
    status = next_status(job.status, transition)
    job.finished_at, job.expires_at = now, retained_until(session, now, retention)
    job.lease_owner = job.lease_expires_at = None
    move(session, job, transition, now)
    count(session, "sgsst_jobs_finished_total", f'status="{status}"')
    if job.webhook:
        data = {"id": job.id, "name": job.name, "status": status, "error": job.error}
        body = {"type": f"job.{status}", "timestamp": now, "data": data}
        message_id = new_id("msg", now)
        session.add(DeliveryRow(id=message_id, job_id=job.id, url=job.webhook, body=body, tries=0, next_at=now))


def add_status_event(session: Session, job: JobRow, now: float) -> None:
    """Add an event about a job's status."""
    data: dict[str, Any] = {"status": job.status, "attempt": job.attempt}
    if job.error:
        data["error"] = job.error
    add_event(session, job.id, "status", data, now)


def add_event(session: Session, job_id: str, kind: str, data: dict[str, Any], now: float) -> None:
    """Add an event to a job."""
    session.execute(insert(_EVENTS), {"job_id": job_id, "kind": kind, "data": data, "created_at": now})


def release_blobs(session: Session, holder: str) -> list[str]:
    """Release a holder's blobs and delete the rows of those without other holders.

    Returns:
        Locations of the deleted blobs. The caller removes their files once the transaction is committed.
    """
    held = select(BlobUseRow.sha256).where(BlobUseRow.holder == holder)
    # lock blobs in a fixed order before deleting their uses: of two concurrent releases, the second one then sees that
    # no other use remains
    rows = session.scalars(
        select(BlobRow).where(BlobRow.sha256.in_(held)).order_by(BlobRow.sha256).with_for_update()
    ).all()
    session.execute(delete(BlobUseRow).where(BlobUseRow.holder == holder))
    digests = [row.sha256 for row in rows]
    used = set(session.scalars(select(BlobUseRow.sha256).where(BlobUseRow.sha256.in_(digests))))
    unused = [row for row in rows if row.sha256 not in used]
    for row in unused:
        session.delete(row)
    return [row.location for row in unused]


def holder_name(job_id: str) -> str:
    """Return the name under which a job holds its inputs."""
    return f"job:{job_id}"


def forget(session: Session, job: JobRow) -> list[str]:
    """Delete a job's rows and return the locations of unused inputs, as `release_blobs` does."""
    unused = release_blobs(session, holder_name(job.id))
    session.delete(job)  # deletes attempts, events and artifacts by cascade
    return unused
