"""Fixtures for tests of the dispatcher: a database with one blob, and the lease of a job that reads it."""

from collections.abc import Iterator
from pathlib import Path

import pytest

from service.settings import ServiceSettings
from service.store import Store
from service.store.queue import Lease
from tests.service.store import helpers
from tests.service.store.helpers import SHA, queue
from tests.stores import new_store


@pytest.fixture
def settings(tmp_path: Path) -> ServiceSettings:
    return ServiceSettings(data=tmp_path / "data", poll_seconds=0.05)


@pytest.fixture
def store(settings: ServiceSettings) -> Iterator[Store]:
    opened = new_store(settings)
    opened.inputs.add_blob(SHA, "aa/blob", 3)
    yield opened
    opened.close()


@pytest.fixture
def lease(store: Store) -> Lease:
    return new_lease(store)


def new_lease(store: Store, dispatcher: str = "one") -> Lease:
    """Create a job, and return its lease."""
    queue(store)
    return helpers.lease(store, dispatcher)
