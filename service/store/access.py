"""Secrets that give access: API keys of clients, sessions of their browsers, and links to the result of a job.

A browser that has sent a key once need not send it again. Everybody who has a link, a share, sees the result until the
share expires or is revoked. Only the SHA-256 of each secret is stored.
"""

from __future__ import annotations

import hashlib
import hmac
import re
import secrets
from collections.abc import Sequence
from dataclasses import dataclass

from sqlalchemy import bindparam, delete, func, select

from service import problems
from service.states import JobStatus
from service.store.changes import job_of_owner
from service.store.database import Database, new_id
from service.store.quotas import NO_QUOTAS, Quotas
from service.store.tables import Base, JobRow, KeyRow, SessionRow, ShareRow

#: Prefix of all keys, by which secret scanners recognize a leaked key.
KEY_PREFIX = "sgsst_"

#: Maximum number of sessions per key; a new one replaces the oldest.
MOST_SESSIONS = 100
#: Maximum number of shares of a job that have not expired.
MOST_SHARES = 20
_TOKEN = re.compile(r"(shr_[0-9a-f]{20,36})\.[A-Za-z0-9_-]{43}", re.ASCII)

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

    def create(self, name: str, priority: int = 0, quotas: Quotas = NO_QUOTAS) -> tuple[KeyRow, str]:
        """Create a key; return its row and the only copy of its text.

        Args:
            quotas: Quotas of the key; the service's defaults apply where they are None.
        """
        text = KEY_PREFIX + secrets.token_urlsafe(32)
        now = self._database.clock()
        with self._database.writing() as session:
            row = KeyRow(id=new_id("key", now), name=name, sha256=digest(text), priority=priority, created_at=now)
            row.quotas = quotas.given() or None
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


@dataclass(frozen=True)
class Shared:
    """Valid share, with its job."""

    share: ShareRow
    job: JobRow


class ShareLinks:
    """Links to shared results."""

    def __init__(self, database: Database) -> None:
        self._database = database

    def create(self, job_id: str, owner: str, seconds: float) -> tuple[ShareRow, str]:
        """Share the result of a job; return the share and the only copy of its token.

        Args:
            seconds: Lifetime of the share.

        Raises:
            NoJobError: If there is no such job or it belongs to another owner.
            NO_RESULT: If the job has no result.
            TOO_MANY_SHARES: If the job has `MOST_SHARES` shares.
        """
        now = self._database.clock()
        with self._database.writing() as session:
            job = job_of_owner(session, job_id, owner, lock=True)  # which a deletion then waits for
            if job.status != JobStatus.SUCCEEDED:
                raise problems.NO_RESULT(job_status=job.status)
            of_job = ShareRow.job_id == job_id
            session.execute(delete(ShareRow).where(of_job, ShareRow.expires_at <= now))
            valid = select(func.count()).select_from(ShareRow).where(of_job)
            if (session.scalar(valid) or 0) >= MOST_SHARES:
                raise problems.TOO_MANY_SHARES(limit=MOST_SHARES)
            row = ShareRow(id=new_id("shr", now), job_id=job_id, created_at=now, expires_at=now + seconds)
            token = f"{row.id}.{secrets.token_urlsafe(32)}"
            row.sha256 = digest(token)
            session.add(row)
        return row, token

    def of_job(self, job_id: str) -> Sequence[ShareRow]:
        """Return the shares of a job that have not expired, oldest first."""
        now = self._database.clock()
        with self._database.reading() as session:
            query = select(ShareRow).where(ShareRow.job_id == job_id, ShareRow.expires_at > now)
            return session.scalars(query.order_by(ShareRow.id)).all()

    def revoke(self, job_id: str, share_id: str) -> None:
        """Delete a share, so that its link no longer works.

        Raises:
            NoShareError: If the job has no such share.
        """
        with self._database.writing() as session:
            row = session.get(ShareRow, share_id, with_for_update=True)
            if row is None or row.job_id != job_id:
                raise problems.NO_SHARE()
            session.delete(row)

    def find(self, token: str) -> Shared:
        """Return the share with this token, and its job.

        Raises:
            NoShareError: If there is none, it has expired or was revoked, its job has no result any more, or the key of
                its owner was revoked.
        """
        match = _TOKEN.fullmatch(token)
        if match is None:
            raise problems.NO_SHARE()
        with self._database.reading() as session:
            row = session.get(ShareRow, match[1])
            # compared in constant time, so that the time of the answer tells nothing about the digest
            if row is None or not hmac.compare_digest(row.sha256, digest(token)):
                raise problems.NO_SHARE()
            job = session.get_one(JobRow, row.job_id)  # both are of one snapshot
            key = session.get(KeyRow, job.owner)
            revoked = key is not None and key.revoked_at is not None
            if row.expires_at <= self._database.clock() or job.status != JobStatus.SUCCEEDED or revoked:
                raise problems.NO_SHARE()
            return Shared(row, job)
