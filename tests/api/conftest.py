"""Fixtures of tests that need a running service."""

from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path

import httpx2
import pytest

from api.cli.main import main
from service.store import Store
from tests.api.service import Service, wait_for
from tests.small_scenes import input_files

#: Function that returns a running service with these settings, which tests of other files use too.
Services = Callable[..., Service]
#: Function that runs a command, and returns what it prints: errors if its exit code should not be 0.
Sgsst = Callable[..., str]
#: Settings of a service that requires keys, and believes no proxy.
KEYED = {"SGSST_REQUIRE_KEYS": "true", "SGSST_TRUSTED_PROXIES": ""}


@pytest.fixture
def sgsst(capsys: pytest.CaptureFixture[str]) -> Sgsst:
    """Return a function that runs a command, and fails unless it ends with an exit code, by default 0."""

    def run(arguments: list[str], code: int = 0) -> str:
        assert main(arguments) == code
        printed = capsys.readouterr()
        return printed.err if code else printed.out

    return run


@pytest.fixture(scope="package")
def services(tmp_path_factory: pytest.TempPathFactory, tiny_cache: Path) -> Iterator[Services]:
    """Yield a function that returns the running service with some settings; the first call starts it.

    Tests may not kill it or change its files, and expect jobs of other tests. `Service` starts one for such tests.
    """
    running: dict[tuple[object, ...], Service] = {}
    with ExitStack() as stack:

        def service(*, alone: bool = True, **settings: str) -> Service:
            key = alone, *sorted(settings.items())
            if key not in running:
                data = tmp_path_factory.mktemp("service") / "data"
                started = Service(data, alone=alone, SGSST_CACHE=str(tiny_cache), **settings)
                running[key] = stack.enter_context(started)
            return running[key]

        yield service


@pytest.fixture(scope="module")
def service(services: Services) -> Service:
    """Return the shared API process with default settings, without a dispatcher: its jobs stay in the queue."""
    return services()


@pytest.fixture(scope="module")
def whole_service(services: Services) -> Iterator[Service]:
    """Yield the shared service, whose jobs run, and delete all jobs afterwards."""
    running = services(alone=False)
    yield running
    with running.client() as client:
        for job in client.get("/v1/jobs", params={"limit": 200}).json()["jobs"]:
            url = job["links"]["self"]
            client.post(f"{url}/cancel")  # refused if it has ended
            wait_for(lambda: client.delete(url).status_code == 204, "the job to end")  # noqa: B023 (called at once)


@pytest.fixture(scope="package")
def paths(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Return the paths of a small scene, its cameras and a style by their role, which tests do not change."""
    return input_files(tmp_path_factory.mktemp("inputs"))


@pytest.fixture(scope="module")
def store(service: Service) -> Iterator[Store]:
    """Yield the database of the service."""
    with service.store() as opened:
        yield opened


@pytest.fixture(scope="module")
def client(service: Service) -> Iterator[httpx2.Client]:
    """Yield an HTTP client of the service."""
    with service.client() as opened:
        yield opened
