"""Schemathesis against the real API: whatever the document allows and does not, no 5xx, no answer outside of it."""

from __future__ import annotations

import base64
from collections.abc import Iterator
from pathlib import Path

import httpx
import pytest
import schemathesis
from hypothesis import HealthCheck, given, settings
from schemathesis.checks import CHECKS
from schemathesis.core.transport import Response

from api.app import create_app
from service.settings import ServiceSettings
from service.store import open_store
from tests.api.service import Service
from tests.small_scenes import wall, write_files


@pytest.fixture(scope="module")
def service(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Service]:
    # a huge Upload-Length is no reason to look for the room that it would take
    limits = {"SGSST_MAX_UPLOAD_BYTES": "1000000", "SGSST_REQUIRE_KEYS": "true"}
    with Service(tmp_path_factory.mktemp("schema") / "data", alone=True, **limits) as running:
        yield running


@pytest.fixture(scope="module")
def key(service: Service) -> str:
    store = open_store(ServiceSettings(data=service.data))
    text = store.keys.create("schemathesis")[1]
    store.close()
    return text


@pytest.fixture(scope="module")
def document(service: Service) -> schemathesis.schemas.BaseSchema:
    return schemathesis.openapi.from_url(f"{service.url}/openapi.json")


schemathesis.serializer.alias("application/offset+octet-stream", "application/octet-stream")

#: Of the library's checks: bodies are refused for more reasons than the document can tell, and `Tus-Resumable` may be
#: left out.
_LEFT_OUT = ("positive_data_acceptance", "missing_required_header", "unsupported_method", "negative_data_rejection")


def _checks() -> list:
    return [check for check in CHECKS.get_all() if check.__name__ not in _LEFT_OUT]


OPERATIONS = sorted(
    f"{method.upper()} {path}"
    for path, methods in create_app(ServiceSettings()).openapi()["paths"].items()
    for method in methods
)


@pytest.mark.parametrize("label", OPERATIONS)
def test_every_operation(document: schemathesis.schemas.BaseSchema, key: str, label: str) -> None:
    operation = next(found for each in document.get_all_operations() if (found := each.ok()).label == label)

    @given(case=operation.as_strategy())
    @settings(max_examples=20, derandomize=True, deadline=None, suppress_health_check=list(HealthCheck), database=None)
    def check(case: schemathesis.Case) -> None:
        case.call_and_validate(checks=_checks(), timeout=60, headers={"Authorization": f"Bearer {key}"})

    check()


#: The same chains at every run.
BOUNDS = settings(
    max_examples=12,
    stateful_step_count=6,
    derandomize=True,
    deadline=None,
    database=None,
    suppress_health_check=list(HealthCheck),
)


def test_chains_of_requests(service: Service, key: str, tmp_path: Path) -> None:
    """Stateful: ids that answers give are used in the requests that the document links to them."""
    ply, cameras, style = write_files(tmp_path, wall())
    with service.client(key) as client:
        ids = {path.name: _upload(client, path) for path in (ply, cameras, style)}
        body = {"scene": ids["scene.ply"], "style": ids["style.png"], "cameras": [ids["cameras.json"]]}
        for _ in range(3):
            assert client.post("/v1/jobs", json=body).status_code == 202
    # streams of jobs that wait would not end
    loaded = schemathesis.openapi.from_url(f"{service.url}/openapi.json").exclude(operation_id="watch_job")

    class Chains(loaded.as_state_machine()):  # type: ignore[misc]
        def get_call_kwargs(self, case: schemathesis.Case) -> dict:
            return {"headers": {"Authorization": f"Bearer {key}"}, "timeout": 60}

        def validate_response(self, response: Response, case: schemathesis.Case, **ignored: object) -> None:
            case.validate_response(response, checks=_checks())

    Chains.run(settings=BOUNDS)


def _upload(client: httpx.Client, path: Path) -> str:
    name = base64.b64encode(path.name.encode()).decode()
    headers = {"Upload-Length": str(path.stat().st_size), "Upload-Metadata": f"filename {name}"}
    made = client.post("/v1/uploads", headers=headers).json()
    headers = {"Upload-Offset": "0", "Content-Type": "application/offset+octet-stream"}
    client.patch(f"/v1/uploads/{made['id']}", content=path.read_bytes(), headers=headers)
    return str(made["id"])
