"""Fixtures for tests of the store on SQLite and on PostgreSQL."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from service.store import Store, open_store
from tests.postgres import fresh_database, is_installed, server
from tests.service.store.helpers import SHA, Clock, store_settings


@pytest.fixture(scope="session")
def postgres() -> Iterator[str]:
    """Run a PostgreSQL server for the tests; skip them if it is not installed."""
    if not is_installed():
        pytest.skip("PostgreSQL's server is not installed")
    with server() as url:
        yield url


@pytest.fixture(params=["sqlite", "postgresql"])
def database(request: pytest.FixtureRequest, tmp_path: Path) -> str | None:
    """Return the URL of an empty PostgreSQL database, or None for SQLite at its default path."""
    return None if request.param == "sqlite" else fresh_database(request.getfixturevalue("postgres"))


@pytest.fixture
def clock() -> Clock:
    return Clock()


@pytest.fixture
def store(database: str | None, tmp_path: Path, clock: Clock) -> Iterator[Store]:
    opened = open_store(store_settings(tmp_path, database), clock)
    opened.inputs.add_blob(SHA, "aa/blob", 3)
    yield opened
    opened.close()
