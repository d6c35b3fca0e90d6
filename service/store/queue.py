"""Queries for the next job, which every dispatcher runs continually, and reservations for jobs that do not fit yet.

The queue may have tens of thousands of jobs, most of them of a few owners. Only the first job of each owner can be
next. The query therefore steps from owner to owner in an index and compares only their first jobs: the time grows with
the number of waiting owners, not of jobs.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from sqlalchemy import (
    BindParameter,
    ColumnElement,
    Float,
    Integer,
    Select,
    String,
    and_,
    bindparam,
    case,
    delete,
    func,
    or_,
    select,
    union_all,
)
from sqlalchemy.orm import Session, aliased, undefer

from service.states import ACTIVE, JobStatus
from service.store.database import upsert
from service.store.tables import JobRow, ReservationRow, TurnRow

#: Upper bound of lease durations and retry delays in seconds; a time further in the future comes from a wrong clock.
_IMPLAUSIBLE_SECONDS = 3600.0
#: Fraction of a reservation's duration; it is renewed when less than that remains, which saves writes.
_RENEW_FRACTION = 0.5


# Queries are built once, because building one takes longer than running it.
_NOW: BindParameter[float] = bindparam("now", type_=Float)
_DISPATCHER: BindParameter[str] = bindparam("dispatcher", type_=String)
_SKIPPED: BindParameter[str] = bindparam("skipped", type_=String, expanding=True)
_MOST: BindParameter[int] = bindparam("most", type_=Integer)


def _may_start(job: type[JobRow]) -> ColumnElement[bool]:
    """Return the condition for jobs whose retry delay is over."""
    return or_(job.not_before <= _NOW, job.not_before > _NOW + _IMPLAUSIBLE_SECONDS)


def reserved_by(dispatcher: str | BindParameter[str]) -> ColumnElement[bool]:
    """Return the condition for a dispatcher's reservations."""
    return ReservationRow.dispatcher == dispatcher


def _count(condition: ColumnElement[bool]) -> Select[int]:
    return select(func.count()).select_from(select(JobRow.id).where(condition).limit(_MOST).subquery())


def _first_of_each_owner() -> Select[Any]:
    """Return the query for the id of each owner's next job."""
    job = aliased(JobRow)
    queued = job.status == JobStatus.QUEUED
    owners = select(func.min(job.owner).label("owner")).where(queued).cte("owners", recursive=True)
    following = select(func.min(job.owner)).where(queued, job.owner > owners.c.owner).scalar_subquery()
    owners = owners.union_all(select(following).where(owners.c.owner.is_not(None)))
    each = (
        select(job.id)
        .where(queued, job.owner == owners.c.owner, _may_start(job), job.id.not_in(_SKIPPED))
        .order_by(job.priority.desc(), job.queued_at, job.id)
        .limit(1)
        .scalar_subquery()
    )
    return select(each.label("id")).where(owners.c.owner.is_not(None))


_EXPIRES = JobRow.lease_expires_at
#: Conditions for queued jobs that may start now, and for jobs with expired leases by this clock (see
#: `service.scheduling.clock_watch`); queries that count them, up to `most`.
_QUEUED = and_(JobRow.status == JobStatus.QUEUED, _may_start(JobRow))
_EXPIRED = and_(or_(_EXPIRES < _NOW, _EXPIRES > _NOW + _IMPLAUSIBLE_SECONDS), JobRow.status.in_(ACTIVE))
WAITING, LOST = _count(_QUEUED), _count(_EXPIRED)
#: Ids of the jobs that may be next.
_CANDIDATES = union_all(
    _first_of_each_owner(),
    select(JobRow.id).where(_EXPIRED, JobRow.id.not_in(_SKIPPED)),
    select(ReservationRow.job_id).where(reserved_by(_DISPATCHER), ReservationRow.job_id.not_in(_SKIPPED)),
)
#: First candidates in order, up to `most`. Their conditions are checked again, because rows may have changed.
_FIRST = (
    select(JobRow)
    .options(undefer(JobRow.inputs))
    .outerjoin(TurnRow, TurnRow.owner == JobRow.owner)
    .outerjoin(ReservationRow, ReservationRow.job_id == JobRow.id)
    .where(JobRow.id.in_(bindparam("candidates", type_=String, expanding=True)), or_(_QUEUED, _EXPIRED))
    .order_by(
        JobRow.priority.desc(),
        case((reserved_by(_DISPATCHER), 0), else_=1),
        case((TurnRow.served.is_(None), 0), else_=TurnRow.served),
        JobRow.queued_at,
        JobRow.id,
    )
    .limit(_MOST)
    .with_for_update(skip_locked=True, of=JobRow)
)


def next_jobs(session: Session, dispatcher: str, now: float, skipped: Sequence[str], most: int) -> Sequence[JobRow]:
    """Return the next jobs: by priority, then the dispatcher's reservation, then owners' turns, then age.

    At most one queued job per owner is among them. Their rows are locked; rows that others have locked are skipped.
    """
    own = {"dispatcher": dispatcher, "now": now}
    ids = [job_id for job_id in session.scalars(_CANDIDATES, {**own, "skipped": list(skipped)}) if job_id is not None]
    # a separate statement: inside one query, PostgreSQL overestimates the candidates and reads all jobs
    return session.scalars(_FIRST, {**own, "candidates": ids, "most": most}).all() if ids else []


def reserve(session: Session, job_id: str, dispatcher: str, now: float, seconds: float) -> bool:
    """Reserve a dispatcher's capacity for one job; return False if another dispatcher has already reserved for it.

    Args:
        session: Session in which the job's row is locked.
        seconds: Duration of the reservation unless it is renewed.
    """
    row = session.get(ReservationRow, job_id)
    if row is not None and row.dispatcher != dispatcher and row.until >= now:
        return False
    if row is None or row.dispatcher != dispatcher or row.until < now + _RENEW_FRACTION * seconds:
        session.execute(delete(ReservationRow).where(reserved_by(dispatcher), ReservationRow.job_id != job_id))
        values = {"dispatcher": dispatcher, "until": now + seconds}
        insert = upsert(session)(ReservationRow).values(job_id=job_id, **values)
        session.execute(insert.on_conflict_do_update(index_elements=["job_id"], set_=values))
    return True
