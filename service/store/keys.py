"""API keys, browser sessions and quotas; usage is counted as it occurs.

A browser that has sent a key once need not send it again. Only the SHA-256 of each secret is stored.
"""

import hashlib
import secrets
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from datetime import date, timedelta
from functools import cache
from typing import Any, Self

from sqlalchemy import BindParameter, String, bindparam, delete, func, or_, select, text, union
from sqlalchemy.orm import Session

from service import problems
from service.settings import ServiceSettings
from service.store.database import Database, addition, new_id
from service.store.tables import ArtifactRow, Base, BlobRow, BlobUseRow, JobRow, KeyRow, SessionRow, UploadRow, UsageRow

_DAY = 86_400

_USAGE = Base.metadata.tables[UsageRow.__tablename__]
#: Prefix of the ids of receipts, and the SQL condition for receipts. A receipt charges a key for the bytes of one
#: request (`service.store.files`).
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
        """Return these quotas overridden by a key's own."""
        return replace(self, **(own or {}))

    def given(self) -> dict[str, Any]:
        """Return the quotas that are not None by name, for `with_own`."""
        return {name: value for name, value in asdict(self).items() if value is not None}


NO_QUOTAS = Quotas()


#: Day 0, maximum number of days of a report of usage, and their number by default.
_FIRST_DAY, MOST_USAGE_DAYS, _USUAL_DAYS = date(1970, 1, 1), 92, 30


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


def add_usage(session: Session, owner: str, now: float, **amounts: float) -> tuple[int, float]:
    """Add amounts to an owner's usage of the day, by column; return its jobs and GPU seconds of the day."""
    zeros = dict.fromkeys(("jobs", "gpu_seconds", "cpu_seconds", "bytes"), 0)
    values = {"owner": owner, "day": day_of(now), **zeros, **amounts}
    jobs, seconds = session.execute(_adding_usage(session.get_bind().dialect.name), values).one()
    return jobs, seconds


@cache
def _adding_usage(dialect: str) -> Any:
    return addition(_USAGE, ("owner", "day"), dialect).returning(_USAGE.c.jobs, _USAGE.c.gpu_seconds)


def count_job(session: Session, owner: str, quotas: Quotas, now: float, size: int = 0) -> None:
    """Count a new job, within the transaction that creates it.

    Args:
        size: Bytes of its inputs; 0 for a retry.

    Raises:
        QUOTA_EXCEEDED: If the job exceeds the daily number of jobs, or today's GPU seconds are used up.
    """
    jobs, seconds = add_usage(session, owner, now, jobs=1, bytes=size)
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

#: Prefix of all keys, by which secret scanners recognize a leaked key.
KEY_PREFIX = "sgsst_"

#: Maximum number of sessions per key; a new one replaces the oldest.
MOST_SESSIONS = 100

_KEYS, _SESSIONS = (Base.metadata.tables[name] for name in ("api_keys", "sessions"))
_KEY = select(_KEYS).where(_KEYS.c.sha256 == bindparam("sha256"))
_KEY_OF_SESSION = (
    select(_KEYS)
    .join(_SESSIONS, _SESSIONS.c.key_id == _KEYS.c.id)
    .where(
        _SESSIONS.c.sha256 == bindparam("sha256"),
        _SESSIONS.c.expires_at > bindparam("now"),
        _KEYS.c.revoked_at.is_(None),
    )
)


def digest(key: str) -> str:
    """Return the stored digest of a key; its 256 random bits make a salt or a slow hash unnecessary."""
    return hashlib.sha256(key.encode()).hexdigest()


class Keys:
    """API keys; a key's id is the owner of everything created with it."""

    def __init__(self, database: Database) -> None:
        self._database = database

    def create(
        self, name: str, priority: int = 0, quotas: Quotas = NO_QUOTAS, *, operator: bool = False
    ) -> tuple[KeyRow, str]:
        """Create a key; return its row and the only copy of its text.

        Args:
            quotas: Quotas of the key; the service's defaults apply where they are None.
            operator: Whether the key sees the usage of all keys.
        """
        text = KEY_PREFIX + secrets.token_urlsafe(32)
        now = self._database.clock()
        with self._database.writing() as session:
            row = KeyRow(id=new_id("key", now), name=name, sha256=digest(text), priority=priority, created_at=now)
            row.quotas, row.operator = quotas.given() or None, operator
            session.add(row)
        return row, text

    def all(self) -> list[KeyRow]:
        """Return all keys, oldest first."""
        with self._database.reading() as session:
            return list(session.scalars(select(KeyRow).order_by(KeyRow.id)))

    def revoke(self, key_id: str) -> KeyRow:
        """Revoke a key; objects created with it remain until they expire.

        Raises:
            NotFoundError: If there is no such key.
        """
        with self._database.writing() as session:
            row = session.get(KeyRow, key_id, with_for_update=True)
            if row is None:
                raise problems.NOT_FOUND(f"There is no key {key_id}. `sgsst keys list` shows their ids.")
            row.revoked_at = row.revoked_at or self._database.clock()
            return row

    def usage(self, since: date | None, until: date | None, owner: str | None) -> list[dict[str, Any]]:
        """Return the usage of each day (UTC), oldest first, by owner; days without usage are left out.

        Each entry has `day`, `key` (the owner), `name` (of the key; empty without one), and the amounts of `UsageRow`.

        Args:
            since: First day; None for the 30 days up to `until`.
            until: Last day; None for today.
            owner: Owner; None for all.

        Raises:
            INVALID_REQUEST: If the last day precedes the first one, or there are more than `MOST_USAGE_DAYS`.
        """
        last = day_of(self._database.clock()) if until is None else (until - _FIRST_DAY).days
        first = last - _USUAL_DAYS + 1 if since is None else (since - _FIRST_DAY).days
        if not 0 <= last - first < MOST_USAGE_DAYS:
            count = f"{last - first + 1:,} days" if last >= first else "no day"
            raise problems.INVALID_REQUEST(
                f"since, until: {count}, but must be between 1 and {MOST_USAGE_DAYS} days, with both ends included.",
                input="since",
            )
        query = select(_USAGE, KeyRow.name).outerjoin(KeyRow, KeyRow.id == _USAGE.c.owner)
        query = query.where(_USAGE.c.day.between(first, last)).order_by(_USAGE.c.day, _USAGE.c.owner)
        if owner is not None:
            query = query.where(_USAGE.c.owner == owner)
        with self._database.reading_rows() as connection:
            rows = connection.execute(query).all()
        amounts = ("jobs", "gpu_seconds", "cpu_seconds", "bytes")
        return [
            {"day": _FIRST_DAY + timedelta(row.day), "key": row.owner, "name": row.name or ""}
            | {name: row._mapping[name] for name in amounts}
            for row in rows
        ]

    def find(self, text: str) -> KeyRow | None:
        """Return the key with this text; None if it is unknown or revoked."""
        with self._database.reading_rows() as connection:
            row = connection.execute(_KEY, {"sha256": digest(text)}).one_or_none()
        return KeyRow(**row._mapping) if row is not None and row.revoked_at is None else None


class Sessions:
    """Browser sessions; a session's text is a secret of 256 random bits, and only its SHA-256 is stored.

    Args:
        seconds: Lifetime of a session.
    """

    def __init__(self, database: Database, seconds: float) -> None:
        self._database = database
        self.seconds = seconds

    def create(self, key_id: str) -> str:
        """Create a session of a key and return the only copy of its text; expired sessions are deleted."""
        text, now = secrets.token_urlsafe(32), self._database.clock()
        with self._database.writing() as session:
            session.execute(delete(SessionRow).where(SessionRow.expires_at <= now))
            of_key = select(SessionRow.sha256).where(SessionRow.key_id == key_id)
            old = session.scalars(of_key.order_by(SessionRow.created_at.desc()).offset(MOST_SESSIONS - 1)).all()
            session.execute(delete(SessionRow).where(SessionRow.sha256.in_(old)))
            row = SessionRow(sha256=digest(text), key_id=key_id, created_at=now, expires_at=now + self.seconds)
            session.add(row)
        return text

    def find(self, text: str) -> KeyRow | None:
        """Return the key of a session; None if the session is unknown or expired, or the key was revoked."""
        with self._database.reading_rows() as connection:
            row = connection.execute(
                _KEY_OF_SESSION, {"sha256": digest(text), "now": self._database.clock()}
            ).one_or_none()
        return KeyRow(**row._mapping) if row is not None else None

    def end(self, text: str) -> None:
        """End a session if it exists."""
        with self._database.writing() as session:
            session.execute(delete(SessionRow).where(SessionRow.sha256 == digest(text)))
