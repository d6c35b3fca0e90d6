"""Loss history of a job, thinned as it is written; the job's events contain only the most recent progress.

A point is stored when the job's running time has grown by one percent since the previous one. Points are thus evenly
spaced on the logarithmic time axis of loss charts: 25 hours of an attempt with a point per second give 784 points. If a
job with many attempts has too many points, every second point is deleted.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Any

from sqlalchemy import Connection, bindparam, delete, func, select
from sqlalchemy.orm import Session

from service.store.database import upsert
from service.store.tables import Base, ProgressPointRow

#: Ratio of the running times of consecutive points.
GROWTH = 1.01
#: Number of points of a job above which every second one is deleted at the start of an attempt.
MOST_POINTS = 2000


@dataclass(frozen=True, slots=True)
class Point:
    """Point of a job's loss history.

    Attributes:
        attempt, step: Attempt and step of the point; points are ordered by both.
        total: Maximum number of steps.
        stage: Stage of the job.
        seconds: Duration of all steps so far.
        loss: Loss of the step.
        scales: Loss per scale, full size first; None for scales that the step left out.
        updated_at: Time of the report in seconds since 1970.
        mean_loss, mean_scales: Loss of the last round of views, and per scale; None in points of earlier versions.
    """

    attempt: int
    step: int
    total: int
    stage: str
    seconds: float
    loss: float
    scales: list[float | None] | None
    updated_at: float
    mean_loss: float | None = None
    mean_scales: list[float | None] | None = None


_POINTS = Base.metadata.tables[ProgressPointRow.__tablename__]
_OF_JOB = _POINTS.c.job_id == bindparam("job_id")
_OF_ATTEMPT = _POINTS.c.attempt == bindparam("attempt")
_LAST = select(_POINTS.c.step, _POINTS.c.seconds).where(_OF_JOB, _OF_ATTEMPT).order_by(_POINTS.c.step.desc()).limit(1)
_ALL = (
    select(*(_POINTS.c[field.name] for field in fields(Point)))
    .where(_OF_JOB)
    .order_by(_POINTS.c.attempt, _POINTS.c.step)
)
_STEPS = select(_POINTS.c.attempt, _POINTS.c.step).where(_OF_JOB).order_by(_POINTS.c.attempt, _POINTS.c.step)
_COUNT = select(func.count()).where(_OF_JOB)


def add_point(session: Session, job_id: str, progress: dict[str, Any]) -> None:
    """Store a job's progress as a point if one is due; progress without a loss is ignored.

    Args:
        progress: Progress as stored by `Leases.report_progress`.
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
    values |= {name: progress.get(name) for name in ("mean_loss", "mean_scales")}
    values |= {"job_id": job_id, "attempt": attempt, "step": step, "seconds": seconds, "scales": progress.get("scales")}
    session.execute(upsert(session)(_POINTS).values(values).on_conflict_do_nothing())


def _halve(session: Session, job_id: str) -> None:
    """Delete every second point of a job that has too many; the first one remains."""
    if (session.scalar(_COUNT, {"job_id": job_id}) or 0) <= MOST_POINTS:
        return
    steps = session.execute(_STEPS, {"job_id": job_id}).all()
    one = delete(_POINTS).where(_OF_JOB, _OF_ATTEMPT, _POINTS.c.step == bindparam("at"))
    session.execute(one, [{"job_id": job_id, "attempt": attempt, "at": step} for attempt, step in steps[1::2]])


def points(connection: Connection, job_id: str, current: dict[str, Any] | None, most: int) -> list[Point]:
    """Return a job's loss history: its points, and its current progress as the last one.

    Args:
        current: Current progress of the job; ignored if it is None or has no loss.
        most: Maximum number of points, at least 2; longer histories are sampled evenly, including both ends.
    """
    rows: list[Sequence[Any]] = list(connection.execute(_ALL, {"job_id": job_id}))
    if current and current.get("loss") is not None and current.get("seconds") is not None:
        now = [current.get(field.name) for field in fields(Point)]
        if not rows or now[:2] > list(rows[-1][:2]):
            rows.append(now)
    if len(rows) > most:
        rows = [rows[number * (len(rows) - 1) // (most - 1)] for number in range(most)]
    return [Point(*values) for values in rows]
