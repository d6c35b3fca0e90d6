"""API keys in the store."""

from __future__ import annotations

import hashlib
import secrets

from sqlalchemy import bindparam, select

from service.errors import NotFoundError
from service.store.database import Database, new_id
from service.store.quotas import NO_QUOTAS, Quotas
from service.store.tables import Base, KeyRow

#: Prefix of all keys, by which secret scanners recognize a leaked key.
KEY_PREFIX = "sgsst_"

_KEY = select(Base.metadata.tables["api_keys"]).where(KeyRow.sha256 == bindparam("sha256"))


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
                raise NotFoundError(f"There is no key {key_id}. `sgsst keys list` shows their ids.")
            row.revoked_at = row.revoked_at or self._database.clock()
            return row

    def find(self, text: str) -> KeyRow | None:
        """Return the key with this text; None if it is unknown or revoked."""
        with self._database.reading_rows() as connection:
            row = connection.execute(_KEY, {"sha256": digest(text)}).one_or_none()
        return KeyRow(**row._mapping) if row is not None and row.revoked_at is None else None
