"""Queries for the next job, which every dispatcher runs continually.

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
    func,
    or_,
    select,
    union_all,
)
from sqlalchemy.orm import Session, aliased, undefer

from service.states import ACTIVE, JobStatus
from service.store.tables import JobRow, TurnRow

#: Maximum number of candidates, each of another owner.
_MOST_CANDIDATES = 16

# Queries are built once, because building one takes longer than running it.
_NOW: BindParameter[float] = bindparam("now", type_=Float)
_MOST: BindParameter[int] = bindparam("most", type_=Integer)


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
        .where(queued, job.owner == owners.c.owner, job.not_before <= _NOW)
        .order_by(job.priority.desc(), job.queued_at, job.id)
        .limit(1)
        .scalar_subquery()
    )
    return select(each.label("id")).where(owners.c.owner.is_not(None))


#: Conditions for queued jobs that may start now, and for jobs with expired leases; queries that count them, up to
#: `most`.
_QUEUED = and_(JobRow.status == JobStatus.QUEUED, JobRow.not_before <= _NOW)
_EXPIRED = and_(JobRow.lease_expires_at < _NOW, JobRow.status.in_(ACTIVE))
WAITING, LOST = _count(_QUEUED), _count(_EXPIRED)
#: Ids of the jobs that may be next.
_CANDIDATES = union_all(_first_of_each_owner(), select(JobRow.id).where(_EXPIRED))
#: First candidates in order. Their conditions are checked again, because rows may have changed.
_FIRST = (
    select(JobRow)
    .options(undefer(JobRow.inputs))
    .outerjoin(TurnRow, TurnRow.owner == JobRow.owner)
    .where(JobRow.id.in_(bindparam("candidates", type_=String, expanding=True)), or_(_QUEUED, _EXPIRED))
    .order_by(
        JobRow.priority.desc(),
        case((TurnRow.served.is_(None), 0), else_=TurnRow.served),
        JobRow.queued_at,
        JobRow.id,
    )
    .limit(_MOST_CANDIDATES)
    .with_for_update(skip_locked=True, of=JobRow)
)


def next_jobs(session: Session, now: float) -> Sequence[JobRow]:
    """Return the next jobs: by priority, then owners' turns, then age, at most one queued job of each owner.

    Their rows are locked; rows that others have locked are skipped.
    """
    ids = [job_id for job_id in session.scalars(_CANDIDATES, {"now": now}) if job_id is not None]
    # a separate statement: inside one query, PostgreSQL overestimates the candidates and reads all jobs
    return session.scalars(_FIRST, {"now": now, "candidates": ids}).all() if ids else []
