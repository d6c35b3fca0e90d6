"""Shares: links that show the result of one job to everybody who has them, until they expire or are revoked."""

from __future__ import annotations

import hmac
import re
import secrets
from collections.abc import Sequence
from dataclasses import dataclass

from sqlalchemy import delete, func, select

from service import problems
from service.states import JobStatus
from service.store.changes import job_of_owner
from service.store.clocks import expiry_time
from service.store.database import Database, new_id
from service.store.keys import digest
from service.store.tables import JobRow, KeyRow, ShareRow

#: Maximum number of shares of a job that have not expired.
MOST_SHARES = 20
_TOKEN = re.compile(r"(shr_[0-9a-f]{20,36})\.[A-Za-z0-9_-]{43}", re.ASCII)


@dataclass(frozen=True)
class Shared:
    """Valid share, with its job."""

    share: ShareRow
    job: JobRow


class Shares:
    """Shares in the store; only the SHA-256 of a share's token is stored."""

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
            session.execute(delete(ShareRow).where(of_job, ShareRow.expires_at <= expiry_time(session, now)))
            valid = select(func.count()).select_from(ShareRow).where(of_job, ShareRow.expires_at > now)
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
