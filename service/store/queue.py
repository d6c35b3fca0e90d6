"""Queries for the next job, which every dispatcher runs continually, and reservations for jobs that do not fit yet.

The queue may have tens of thousands of jobs, most of them of a few owners. Only the first job of each owner can be
next. The query therefore steps from owner to owner in an index and compares only their first jobs: the time grows with
the number of waiting owners, not of jobs.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from typing import Any

from sqlalchemy import (
    BindParameter,
    ColumnElement,
    CompoundSelect,
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


def queued_now(now: float | BindParameter[float]) -> ColumnElement[bool]:
    """Return the condition for queued jobs that may start now."""
    return and_(JobRow.status == JobStatus.QUEUED, _may_start(JobRow, now))


def expired(now: float | BindParameter[float]) -> ColumnElement[bool]:
    """Return the condition for jobs with expired leases by this clock; see `service.scheduling.clock_watch`."""
    expires = JobRow.lease_expires_at
    return and_(or_(expires < now, expires > now + _IMPLAUSIBLE_SECONDS), JobRow.status.in_(ACTIVE))


def _may_start(job: type[JobRow], now: float | BindParameter[float]) -> ColumnElement[bool]:
    """Return the condition for jobs whose retry delay is over."""
    return or_(job.not_before <= now, job.not_before > now + _IMPLAUSIBLE_SECONDS)


def _count(condition: ColumnElement[bool]) -> Select[int]:
    some = select(JobRow.id).where(condition).limit(bindparam("most", type_=Integer)).subquery()
    return select(func.count()).select_from(some)


# Built once, because building a query takes longer than running it.
_NOW: BindParameter[float] = bindparam("now", type_=Float)
#: Queries that count the jobs that may start `now`, and the jobs with expired leases, up to `most`.
WAITING, LOST = _count(queued_now(_NOW)), _count(expired(_NOW))


def reserved_by(dispatcher: str | BindParameter[str]) -> ColumnElement[bool]:
    """Return the condition for a dispatcher's reservations."""
    return ReservationRow.dispatcher == dispatcher


def next_job(session: Session, dispatcher: str, now: float, skipped: Sequence[str] = ()) -> JobRow | None:
    """Return a dispatcher's next job: by priority, then the dispatcher's reservation, then owners' turns, then age.

    The job's row is locked; rows locked by other transactions are skipped.

    Args:
        skipped: Ids of jobs to skip.
    """
    return next(iter(next_jobs(session, dispatcher, now, skipped, most=1)), None)


def next_jobs(session: Session, dispatcher: str, now: float, skipped: Sequence[str], most: int) -> Sequence[JobRow]:
    """Return up to `most` next jobs in order, at most one queued job per owner; otherwise as `next_job`."""
    parameters = {"dispatcher": dispatcher, "now": now, "skipped": list(skipped)}
    candidates = [job_id for job_id in session.scalars(_candidates(), parameters) if job_id is not None]
    if not candidates:
        return []
    # a separate statement: inside one query, PostgreSQL overestimates the candidates and reads all jobs
    return session.scalars(
        _first(), {"dispatcher": dispatcher, "now": now, "candidates": candidates, "most": most}
    ).all()


@cache
def _candidates() -> Select[Any] | CompoundSelect[Any]:
    """Return the query for the ids of the jobs that may be next."""
    dispatcher, now = bindparam("dispatcher", type_=String), bindparam("now", type_=Float)
    skipped = bindparam("skipped", type_=String, expanding=True)
    lost = select(JobRow.id).where(expired(now), JobRow.id.not_in(skipped))
    reserved = select(ReservationRow.job_id).where(reserved_by(dispatcher), ReservationRow.job_id.not_in(skipped))
    return union_all(_first_of_each_owner(now, skipped), lost, reserved)


@cache
def _first() -> Select[JobRow]:
    """Return the query for the first candidates, up to `most`."""
    dispatcher, now = bindparam("dispatcher", type_=String), bindparam("now", type_=Float)
    turn = case((TurnRow.served.is_(None), 0), else_=TurnRow.served)
    not_reserved = case((reserved_by(dispatcher), 0), else_=1)
    query = (
        select(JobRow)
        .options(undefer(JobRow.inputs))
        .outerjoin(TurnRow, TurnRow.owner == JobRow.owner)
        .outerjoin(ReservationRow, ReservationRow.job_id == JobRow.id)
        .where(JobRow.id.in_(bindparam("candidates", type_=String, expanding=True)))
        # checked again, because rows may have changed since they were selected
        .where(or_(queued_now(now), expired(now)))
    )
    order = (JobRow.priority.desc(), not_reserved, turn, JobRow.queued_at, JobRow.id)
    return query.order_by(*order).limit(bindparam("most", type_=Integer)).with_for_update(skip_locked=True, of=JobRow)


def _first_of_each_owner(now: BindParameter[float], skipped: BindParameter[str]) -> Select[Any]:
    """Return the query for the id of each owner's next job."""
    job = aliased(JobRow)
    queued = job.status == JobStatus.QUEUED
    owners = select(func.min(job.owner).label("owner")).where(queued).cte("owners", recursive=True)
    following = select(func.min(job.owner)).where(queued, job.owner > owners.c.owner).scalar_subquery()
    owners = owners.union_all(select(following).where(owners.c.owner.is_not(None)))
    each = (
        select(job.id)
        .where(queued, job.owner == owners.c.owner, _may_start(job, now), job.id.not_in(skipped))
        .order_by(job.priority.desc(), job.queued_at, job.id)
        .limit(1)
        .scalar_subquery()
    )
    return select(each.label("id")).where(owners.c.owner.is_not(None))


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
