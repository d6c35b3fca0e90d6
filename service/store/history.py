"""Loss history of a job, thinned as it is written; the job's events contain only the most recent progress.

A point is stored when the job's running time has grown by one percent since the previous one. Points are thus evenly
spaced on the logarithmic time axis of loss charts: 25 hours of an attempt with a point per second give 784 points. If a
job with many attempts has too many points, every second point is deleted.
"""

from __future__ import annotations

from typing import Any

from sqlalchemy import Connection, bindparam, delete, func, select
from sqlalchemy.orm import Session

from service.store.database import upsert
from service.store.tables import Base, ProgressPointRow

#: Ratio of the running times of consecutive points.
GROWTH = 1.01
#: Number of points of a job above which every second one is deleted at the start of an attempt.
MOST_POINTS = 2000

_POINTS = Base.metadata.tables[ProgressPointRow.__tablename__]
_OF_JOB = _POINTS.c.job_id == bindparam("job_id")
_OF_ATTEMPT = _POINTS.c.attempt == bindparam("attempt")
_LAST = select(_POINTS.c.step, _POINTS.c.seconds).where(_OF_JOB, _OF_ATTEMPT).order_by(_POINTS.c.step.desc()).limit(1)
_ALL = select(_POINTS.c.progress).where(_OF_JOB).order_by(_POINTS.c.attempt, _POINTS.c.step)
_STEPS = select(_POINTS.c.attempt, _POINTS.c.step).where(_OF_JOB).order_by(_POINTS.c.attempt, _POINTS.c.step)
_COUNT = select(func.count()).where(_OF_JOB)


def add_point(session: Session, job_id: str, progress: dict[str, Any]) -> None:
    """Store a job's progress as a point if one is due; progress without a loss is ignored.

    Args:
        progress: Progress as stored by `Leases.report_progress`.
    """
    if not _is_step(progress):
        return
    attempt, step, seconds = progress["attempt"], progress["step"], progress["seconds"]
    last = session.execute(_LAST, {"job_id": job_id, "attempt": attempt}).one_or_none()
    if last is None:
        _halve(session, job_id)
    elif step <= last.step or seconds < GROWTH * last.seconds:
        return
    values = {"job_id": job_id, "attempt": attempt, "step": step, "seconds": seconds, "progress": progress}
    session.execute(upsert(session)(_POINTS).values(values).on_conflict_do_nothing())


def _halve(session: Session, job_id: str) -> None:
    """Delete every second point of a job that has too many; the first one remains."""
    if (session.scalar(_COUNT, {"job_id": job_id}) or 0) <= MOST_POINTS:
        return
    steps = session.execute(_STEPS, {"job_id": job_id}).all()
    one = delete(_POINTS).where(_OF_JOB, _OF_ATTEMPT, _POINTS.c.step == bindparam("at"))
    session.execute(one, [{"job_id": job_id, "attempt": attempt, "at": step} for attempt, step in steps[1::2]])


def points(connection: Connection, job_id: str, current: dict[str, Any] | None, most: int) -> list[dict[str, Any]]:
    """Return a job's loss history: its points, and its current progress as the last one, as in `add_point`.

    Args:
        current: Current progress of the job; ignored if it is None or has no loss.
        most: Maximum number of points, at least 2; longer histories are sampled evenly, including both ends.
    """
    known: list[dict[str, Any]] = list(connection.execute(_ALL, {"job_id": job_id}).scalars())
    if current and _is_step(current) and (not known or _position(current) > _position(known[-1])):
        known.append(current)
    if len(known) > most:
        known = [known[number * (len(known) - 1) // (most - 1)] for number in range(most)]
    return known


def _is_step(progress: dict[str, Any]) -> bool:
    return progress.get("loss") is not None and progress.get("seconds") is not None


def _position(progress: dict[str, Any]) -> tuple[int, int]:
    return progress["attempt"], progress["step"]
