"""Changes to a job's rows that both users and dispatchers make: its status, its events, and its end.

All functions run within the caller's transaction. Every transaction takes its locks in one order, so that no two wait
for each other: the owner's limits, uploads by id, jobs by id, then the rows of each job, blobs by digest, counters.
"""

from __future__ import annotations

from typing import Any

from sqlalchemy import bindparam, delete, insert, select
from sqlalchemy.orm import Session

from service import problems
from service.states import Transition, WebhookEvent, next_status
from service.store.database import count, new_id
from service.store.tables import Base, BlobRow, BlobUseRow, DeliveryRow, EventRow, JobRow

#: Type of messages about progress, which are sent once, and a job's message of this type.
PROGRESS_MESSAGE = "job.progress"
_WAITING_PROGRESS = (
    select(DeliveryRow)
    .where(DeliveryRow.job_id == bindparam("job_id"), DeliveryRow.body["type"].as_string() == PROGRESS_MESSAGE)
    .with_for_update()
)
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
    job.finished_at, job.expires_at = now, now + retention
    job.lease_owner = job.lease_expires_at = None
    move(session, job, transition, now)
    count(session, "sgsst_jobs_finished_total", f'status="{status}"')
    for waiting in session.scalars(_WAITING_PROGRESS, {"job_id": job.id}) if job.webhook_events else ():
        session.delete(waiting)
    send_webhook(session, job, "completed", status, now)


def send_webhook(session: Session, job: JobRow, event: WebhookEvent, kind: str, now: float, **more: Any) -> None:
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
