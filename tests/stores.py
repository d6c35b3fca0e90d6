"""Stores for tests, opened in copies of a database that has its tables already."""

import tempfile
from functools import cache
from pathlib import Path

from service.settings import ServiceSettings
from service.store import Store, open_store
from service.store.database import Clock
from tests.postgres import fresh_database


def new_store(settings: ServiceSettings, clock: Clock | None = None) -> Store:
    """Open a store whose SQLite database does not exist yet; a copy takes a fraction of the time of the migrations."""
    settings.folder.mkdir(parents=True, exist_ok=True)
    (settings.folder / "sgsst.db").write_bytes(_migrated_sqlite())
    return open_store(settings, clock)


def migrated_database(server: str) -> str:
    """Create a database with the tables of the store on a PostgreSQL server, and return the database's URL."""
    return fresh_database(server, template=_migrated_postgres(server))


@cache
def _migrated_sqlite() -> bytes:
    with tempfile.TemporaryDirectory() as folder:
        settings = ServiceSettings(data=Path(folder))
        open_store(settings).close()
        return (settings.folder / "sgsst.db").read_bytes()


@cache
def _migrated_postgres(server: str) -> str:
    url = fresh_database(server)
    open_store(ServiceSettings(database=url)).close()
    return url.rsplit("/", 1)[1]
