"""API keys in the store."""

from __future__ import annotations

import hashlib
import secrets

from sqlalchemy import bindparam, select

from service.errors import NotFoundError
from service.store.database import Database, new_id
from service.store.quotas import NO_QUOTAS, Quotas
from service.store.tables import Base, KeyRow

#: What every key starts with, so that secret scanners can find one that got lost.
KEY_PREFIX = "sgsst_"

_KEY = select(Base.metadata.tables["api_keys"]).where(KeyRow.sha256 == bindparam("sha256"))


def digest(key: str) -> str:
    """What is stored of a key. It has 256 random bits, so that no salt and no slow hash is needed."""
    return hashlib.sha256(key.encode()).hexdigest()


class Keys:
    """API keys; a key's id is the owner of what its holder creates."""

    def __init__(self, database: Database) -> None:
        self._database = database

    def create(self, name: str, priority: int = 0, quotas: Quotas = NO_QUOTAS) -> tuple[KeyRow, str]:
        """A new key, and the only copy of its text.

        Args:
            quotas: its own; for what they leave open, the service's hold.
        """
        text = KEY_PREFIX + secrets.token_urlsafe(32)
        now = self._database.clock()
        with self._database.writing() as session:
            row = KeyRow(id=new_id("key", now), name=name, sha256=digest(text), priority=priority, created_at=now)
            row.quotas = quotas.given() or None
            session.add(row)
        return row, text

    def all(self) -> list[KeyRow]:
        """All keys, the oldest first."""
        with self._database.reading() as session:
            return list(session.scalars(select(KeyRow).order_by(KeyRow.id)))

    def revoke(self, key_id: str) -> KeyRow:
        """Make a key useless from now on; what it created stays until it expires.

        Raises:
            NotFoundError: there is no such key.
        """
        with self._database.writing() as session:
            row = session.get(KeyRow, key_id, with_for_update=True)
            if row is None:
                raise NotFoundError(f"There is no key {key_id}. `sgsst keys list` shows their ids.")
            row.revoked_at = row.revoked_at or self._database.clock()
            return row

    def find(self, text: str) -> KeyRow | None:
        """The key of this text, unless it is unknown or revoked."""
        with self._database.reading_rows() as connection:
            row = connection.execute(_KEY, {"sha256": digest(text)}).one_or_none()
        return KeyRow(**row._mapping) if row is not None and row.revoked_at is None else None
