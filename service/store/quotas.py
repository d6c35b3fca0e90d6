"""Quotas of keys: jobs and GPU seconds per day (UTC), and stored bytes; usage is counted as it occurs."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields, replace
from typing import Any, Self

from sqlalchemy import BindParameter, String, bindparam, func, or_, select, text, union
from sqlalchemy.orm import Session

from service import problems
from service.settings import ServiceSettings
from service.store.database import upsert
from service.store.tables import ArtifactRow, Base, BlobRow, BlobUseRow, JobRow, UploadRow, UsageRow

_DAY = 86_400

_USAGE = Base.metadata.tables[UsageRow.__tablename__]
#: Prefix of the ids of receipts, and the SQL condition for receipts. A receipt charges a key for the bytes of one
#: request (`service.store.inputs`).
RECEIPT = "rcp"
IS_RECEIPT = UploadRow.id.startswith(f"{RECEIPT}_", autoescape=True)


@dataclass(frozen=True)
class Quotas:
    """Quotas of one key; None for no limit.

    Attributes:
        jobs_a_day: Accepted jobs.
        gpu_seconds_a_day: GPU seconds of attempts; further jobs are rejected, running ones continue.
        stored_bytes: Bytes of unfinished uploads, incoming requests, inputs and results; an input of several jobs
            counts once.
        requests_a_second: Requests to each API process, on average over some seconds.
    """

    jobs_a_day: int | None = None
    gpu_seconds_a_day: float | None = None
    stored_bytes: int | None = None
    requests_a_second: float | None = None

    @classmethod
    def of_settings(cls, settings: ServiceSettings) -> Self:
        """Return the default quotas of keys without their own."""
        return cls(
            settings.max_jobs_a_day_per_key,
            settings.max_gpu_seconds_a_day_per_key,
            settings.max_bytes_per_key,
            settings.max_requests_a_second_per_key,
        )

    def with_own(self, own: Mapping[str, Any] | None) -> Self:
        """Return these quotas overridden by a key's own; names from other versions of the service are ignored."""
        known = {field.name for field in fields(self)}
        return replace(self, **{name: value for name, value in (own or {}).items() if name in known})

    def given(self) -> dict[str, Any]:
        """Return the quotas that are not None by name, for `with_own`."""
        return {name: value for name, value in asdict(self).items() if value is not None}


NO_QUOTAS = Quotas()


def day_of(now: float) -> int:
    """Return the number of the day since 1970."""
    return int(now // _DAY)


def lock_owner(session: Session, owner: str) -> None:
    """Lock an owner's limits until the end of the transaction, so that concurrent checks of the same owner wait.

    Call this before taking other locks and before the check. Otherwise two concurrent transactions, which do not see
    each other's rows, could both pass the check. On SQLite a writing transaction is exclusive anyway.
    """
    if session.get_bind().dialect.name == "postgresql":
        session.execute(_LOCK_OWNER, {"owner": f"sgsst-owner:{owner}"})


def count_job(session: Session, owner: str, quotas: Quotas, now: float) -> None:
    """Count a new job, within the transaction that creates it.

    Raises:
        QUOTA_EXCEEDED: If the job exceeds the daily number of jobs, or today's GPU seconds are used up.
    """
    insert = upsert(session)(_USAGE).values(owner=owner, day=day_of(now), jobs=1, gpu_seconds=0.0)
    counted = insert.on_conflict_do_update(index_elements=["owner", "day"], set_={"jobs": _USAGE.c.jobs + 1})
    jobs, seconds = session.execute(counted.returning(_USAGE.c.jobs, _USAGE.c.gpu_seconds)).one()
    tomorrow = _DAY - int(now % _DAY)
    if quotas.jobs_a_day is not None and jobs > quotas.jobs_a_day:
        raise problems.QUOTA_EXCEEDED(
            f"This key has submitted its {quotas.jobs_a_day:,} jobs of the day. Try again tomorrow (UTC).",
            quota="jobs-a-day",
            limit=quotas.jobs_a_day,
            retry_after=tomorrow,
        )
    if quotas.gpu_seconds_a_day is not None and seconds >= quotas.gpu_seconds_a_day:
        raise problems.QUOTA_EXCEEDED(
            f"This key has used its {quotas.gpu_seconds_a_day:,.0f} GPU seconds of the day. Try again tomorrow (UTC).",
            quota="gpu-seconds-a-day",
            limit=quotas.gpu_seconds_a_day,
            retry_after=tomorrow,
        )


def count_gpu_seconds(session: Session, owner: str, seconds: float, now: float) -> None:
    """Add an attempt's GPU seconds to its owner's usage of the day."""
    insert = upsert(session)(_USAGE).values(owner=owner, day=day_of(now), jobs=0, gpu_seconds=seconds)
    added = _USAGE.c.gpu_seconds + insert.excluded.gpu_seconds
    session.execute(insert.on_conflict_do_update(index_elements=["owner", "day"], set_={"gpu_seconds": added}))


def check_bytes(session: Session, owner: str, quotas: Quotas) -> None:
    """Check an owner's stored bytes against the quota, in the transaction that has added to them.

    Raises:
        QUOTA_EXCEEDED: If the quota is exceeded; the caller must roll back the transaction.
    """
    limit = quotas.stored_bytes
    if limit is not None and (used := stored_bytes(session, owner)) > limit:
        raise problems.STORED_BYTES_EXCEEDED(used=used, limit=limit, quota="stored-bytes")


def stored_bytes(session: Session, owner: str) -> int:
    """Return the bytes of unfinished uploads and requests, of inputs (each content once), and of results."""
    return sum(int(session.scalar(query, {"owner": owner}) or 0) for query in _STORED)


_LOCK_OWNER = text("SELECT pg_advisory_xact_lock(hashtextextended(:owner, 0))")
_OWNER: BindParameter[str] = bindparam("owner", type_=String)
_OF_JOBS = select(BlobUseRow.sha256).join(JobRow, BlobUseRow.holder == "job:" + JobRow.id).where(JobRow.owner == _OWNER)
# an unfinished upload counts by its length, and its blob only once it is finished
_OF_UPLOADS = (
    select(BlobUseRow.sha256)
    .join(UploadRow, BlobUseRow.holder == "upload:" + UploadRow.id)
    .where(UploadRow.owner == _OWNER, or_(UploadRow.sha256.is_not(None), IS_RECEIPT))
)
_STORED = (
    select(func.sum(UploadRow.length)).where(UploadRow.owner == _OWNER, UploadRow.sha256.is_(None)),
    select(func.sum(BlobRow.size)).where(BlobRow.sha256.in_(union(_OF_JOBS, _OF_UPLOADS))),
    select(func.sum(ArtifactRow.size)).join(JobRow, JobRow.id == ArtifactRow.job_id).where(JobRow.owner == _OWNER),
)
