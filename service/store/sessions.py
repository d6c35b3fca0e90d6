"""Browser sessions in the store: a browser that has sent an API key once need not send it again."""

from __future__ import annotations

import secrets

from sqlalchemy import bindparam, delete, select

from service.store.clocks import expiry_time
from service.store.database import Database
from service.store.keys import digest
from service.store.tables import Base, KeyRow, SessionRow

#: Maximum number of sessions per key; a new one replaces the oldest.
MOST_SESSIONS = 100

_KEYS, _SESSIONS = (Base.metadata.tables[name] for name in ("api_keys", "sessions"))
_KEY = (
    select(_KEYS)
    .join(_SESSIONS, _SESSIONS.c.key_id == _KEYS.c.id)
    .where(
        _SESSIONS.c.sha256 == bindparam("sha256"),
        _SESSIONS.c.expires_at > bindparam("now"),
        _KEYS.c.revoked_at.is_(None),
    )
)


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
            session.execute(delete(SessionRow).where(SessionRow.expires_at <= expiry_time(session, now)))
            mine = select(SessionRow.sha256).where(SessionRow.key_id == key_id)
            old = session.scalars(mine.order_by(SessionRow.created_at.desc()).offset(MOST_SESSIONS - 1)).all()
            session.execute(delete(SessionRow).where(SessionRow.sha256.in_(old)))
            row = SessionRow(sha256=digest(text), key_id=key_id, created_at=now, expires_at=now + self.seconds)
            session.add(row)
        return text

    def find(self, text: str) -> KeyRow | None:
        """Return the key of a session; None if the session is unknown or expired, or the key was revoked."""
        with self._database.reading_rows() as connection:
            row = connection.execute(_KEY, {"sha256": digest(text), "now": self._database.clock()}).one_or_none()
        return KeyRow(**row._mapping) if row is not None else None

    def end(self, text: str) -> None:
        """End a session if it exists."""
        with self._database.writing() as session:
            session.execute(delete(SessionRow).where(SessionRow.sha256 == digest(text)))
