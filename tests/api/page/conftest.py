"""Fixtures of the page's tests: a browser and a service."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import pytest

from tests.api.page.browser import Watched, missing, open_browser
from tests.api.service import Service
from tests.small_scenes import cameras, input_files, wall


@pytest.fixture(scope="package")
def browser() -> Iterator[Any]:
    """Yield a browser for the tests of the page. While it is open, nothing else may use asyncio."""
    reason = missing()
    if reason:
        pytest.skip(reason)
    with open_browser() as opened:
        yield opened


@pytest.fixture(scope="module")
def service(whole_service: Service) -> Service:
    return whole_service


@pytest.fixture
def visit(browser: Any, service: Service) -> Iterator[Callable[..., Watched]]:
    """Yield a function that opens pages of the service or of a file, each in a separate browser context.

    Pages are checked after the test; `allowed` has texts of console errors that may occur. Jobs that the test has left
    unfinished are canceled, or those of later tests would wait for them.
    """
    with ExitStack() as stack:
        stack.callback(cancel_all, service)

        def visit(address: str = "/", *, allowed: Sequence[str] = (), **context: Any) -> Watched:
            url = address if "://" in address else service.url + address
            watched = Watched(browser, service.url if url.startswith(service.url) else url, **context)
            stack.callback(watched.context.close)
            stack.callback(watched.check, *allowed)
            watched.page.goto(url)
            return watched

        yield visit


def cancel_all(service: Service) -> None:
    """Cancel all jobs that have not ended."""
    with service.client() as client:
        for job in client.get("/v1/jobs", params={"limit": 200}).json()["jobs"]:
            if job["status"] in ("queued", "running"):
                client.post(f"{job['links']['self']}/cancel")


@pytest.fixture
def files(tmp_path: Path) -> dict[str, Path]:
    """Return the paths of a small scene, its cameras and a style by their role."""
    return input_files(tmp_path, wall(sh_degree=1), cameras(3, 96, 72))


@pytest.fixture(scope="module")
def inputs(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Return the same for fixtures of a module, whose tests do not change them."""
    return input_files(tmp_path_factory.mktemp("files"), wall(sh_degree=1), cameras(3, 96, 72))
