"""Fixtures for tests of the service."""

from collections.abc import Iterator

import pytest

from tests.postgres import is_installed, server
from tests.service.files.s3 import s3_server


@pytest.fixture(scope="session")
def s3_url() -> Iterator[str]:
    """Run an S3 server for the tests, and yield its URL."""
    with s3_server() as url:
        yield url


@pytest.fixture(scope="session")
def postgres() -> Iterator[str]:
    """Run a PostgreSQL server for the tests, and yield its URL; skip them if it is not installed."""
    if not is_installed():
        pytest.skip("PostgreSQL's server is not installed")
    with server() as url:
        yield url
