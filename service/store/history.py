"""The course of a job's loss from its first step on, thinned as it is written: events keep the newest alone.

A point is kept when the job's seconds have grown by a hundredth since the one before, which is even on the logarithmic
axis that a loss is looked at on: 784 points in 25 hours of one attempt at a point a second. What many attempts bring
together is halved.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Any

from sqlalchemy import Connection, bindparam, delete, func, select
from sqlalchemy.orm import Session

from service.store.database import upsert
from service.store.tables import Base, ProgressPointRow

#: A point is this much later than the one before it: in seconds, times these.
GROWTH = 1.01
#: Of a job, when an attempt begins; more are halved then.
MOST_POINTS = 2000


@dataclass(frozen=True, slots=True)
class Point:
    """A point of a job's course.

    Attributes:
        attempt, step: where it stands; later ones are greater.
        total: steps at most.
        stage: of the job.
        seconds: of all steps so far.
        loss: of the step.
        scales: the loss of each scale, full size first; None for scales that the step has left out.
        updated_at: when it was reported, seconds since 1970.
    """

    attempt: int
    step: int
    total: int
    stage: str
    seconds: float
    loss: float
    scales: list[float | None] | None
    updated_at: float


_POINTS = Base.metadata.tables[ProgressPointRow.__tablename__]
_OF_JOB = _POINTS.c.job_id == bindparam("job_id")
_OF_ATTEMPT = _POINTS.c.attempt == bindparam("attempt")
_LAST = select(_POINTS.c.step, _POINTS.c.seconds).where(_OF_JOB, _OF_ATTEMPT).order_by(_POINTS.c.step.desc()).limit(1)
_ALL = (
    select(*(_POINTS.c[field.name] for field in fields(Point)))
    .where(_OF_JOB)
    .order_by(_POINTS.c.attempt, _POINTS.c.step)
)
_PLACES = select(_POINTS.c.attempt, _POINTS.c.step).where(_OF_JOB).order_by(_POINTS.c.attempt, _POINTS.c.step)
_COUNT = select(func.count()).where(_OF_JOB)


def keep_point(session: Session, job_id: str, progress: dict[str, Any]) -> None:
    """Take a job's progress into its course, if it is time for a point; what has no loss is none.

    Args:
        progress: as `Leases.report_progress` stores it.
    """
    if progress.get("loss") is None or progress.get("seconds") is None:
        return
    attempt, step, seconds = progress["attempt"], progress["step"], progress["seconds"]
    last = session.execute(_LAST, {"job_id": job_id, "attempt": attempt}).one_or_none()
    if last is None:
        _halve(session, job_id)
    elif step <= last.step or seconds < GROWTH * last.seconds:
        return
    values = {name: progress[name] for name in ("total", "stage", "loss", "updated_at")}
    values |= {"job_id": job_id, "attempt": attempt, "step": step, "seconds": seconds, "scales": progress.get("scales")}
    session.execute(upsert(session)(_POINTS).values(values).on_conflict_do_nothing())


def _halve(session: Session, job_id: str) -> None:
    """Drop every second point of a job that has too many; the first one stays."""
    if (session.scalar(_COUNT, {"job_id": job_id}) or 0) <= MOST_POINTS:
        return
    places = session.execute(_PLACES, {"job_id": job_id}).all()
    one = delete(_POINTS).where(_OF_JOB, _OF_ATTEMPT, _POINTS.c.step == bindparam("at"))
    session.execute(one, [{"job_id": job_id, "attempt": attempt, "at": step} for attempt, step in places[1::2]])


def points(connection: Connection, job_id: str, present: dict[str, Any] | None, most: int) -> list[Point]:
    """A job's course: its points and, as the last of them, its present progress.

    Args:
        present: the job's progress; None, or one without a loss, is no point.
        most: points, 2 or more; of more, so many are taken evenly, the first and the last among them.
    """
    found: list[Sequence[Any]] = list(connection.execute(_ALL, {"job_id": job_id}))
    if present and present.get("loss") is not None and present.get("seconds") is not None:
        now = [present.get(field.name) for field in fields(Point)]
        if not found or now[:2] > list(found[-1][:2]):
            found.append(now)
    if len(found) > most:
        found = [found[number * (len(found) - 1) // (most - 1)] for number in range(most)]
    return [Point(*values) for values in found]
