"""Fixtures for tests of the store on SQLite and on PostgreSQL."""

from collections.abc import Iterator
from pathlib import Path

import pytest

from service.store import Store, open_store
from tests.postgres import fresh_database
from tests.service.store.helpers import SHA, Clock, store_settings
from tests.stores import migrated_database, new_store

#: The same statements run on both databases; the fast tests use the one that needs no server.
DATABASES = ["sqlite", pytest.param("postgresql", marks=pytest.mark.slow)]


@pytest.fixture(params=DATABASES)
def database(request: pytest.FixtureRequest, tmp_path: Path) -> str | None:
    """Return the URL of an empty PostgreSQL database, or None for SQLite at its default path."""
    return None if request.param == "sqlite" else fresh_database(request.getfixturevalue("postgres"))


@pytest.fixture
def clock() -> Clock:
    return Clock()


@pytest.fixture(params=DATABASES)
def store(request: pytest.FixtureRequest, tmp_path: Path, clock: Clock) -> Iterator[Store]:
    if request.param == "sqlite":
        opened = new_store(store_settings(tmp_path, None), clock)
    else:
        database = migrated_database(request.getfixturevalue("postgres"))
        opened = open_store(store_settings(tmp_path, database), clock)
    opened.inputs.add_blob(SHA, "aa/blob", 3)
    yield opened
    opened.close()
