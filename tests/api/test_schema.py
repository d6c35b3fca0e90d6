"""Schemathesis against the real API: whatever the document allows and does not, no 5xx, no answer outside of it."""

from __future__ import annotations

import base64
import copy
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import httpx
import pytest
import schemathesis
from hypothesis import HealthCheck, Phase, settings
from schemathesis.checks import CHECKS, load_all_checks
from schemathesis.core.transport import Response
from schemathesis.generation.stateful.state_machine import StepInput, StepOutput
from schemathesis.specs.openapi.checks import negative_data_rejection

from api.app import create_app
from service.artifacts import Artifacts
from service.settings import ServiceSettings
from service.store import Store, open_store
from tests.api.service import Service
from tests.small_scenes import wall, write_files

DOCUMENT: dict[str, Any] = create_app(ServiceSettings()).openapi()
schemathesis.serializer.alias("application/offset+octet-stream", "application/octet-stream")

load_all_checks()


def refuses_what_is_wrong(ctx: Any, response: Response, case: schemathesis.Case) -> bool | None:
    """As the library has it, but for headers that nobody knows: HTTP has them ignored."""
    if "x-schemathesis-unknown-property" in case.headers:
        return None
    return negative_data_rejection(ctx, response, case)


def checks() -> list[Any]:
    """All of the library, but for one: a body of the right form is refused for more reasons than a document can tell
    (files that were never sent, an offset that is not the next one), so that not every such request is accepted."""
    own = {"positive_data_acceptance": None, "negative_data_rejection": refuses_what_is_wrong}
    found = [own.get(check.__name__, check) for check in CHECKS.get_all()]
    return [check for check in found if check is not None]


@pytest.fixture(scope="module")
def service(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Service]:
    # a huge Upload-Length is no reason to look for the room that it would take
    limits = {"SGSST_MAX_UPLOAD_BYTES": "1000000", "SGSST_REQUIRE_KEYS": "true"}
    with Service(tmp_path_factory.mktemp("schema") / "data", alone=True, **limits) as running:
        yield running


@pytest.fixture(scope="module")
def store(service: Service) -> Iterator[Store]:
    opened = open_store(ServiceSettings(data=service.data))
    yield opened
    opened.close()


@pytest.fixture(scope="module")
def key(store: Store) -> str:
    return store.keys.create("schemathesis")[1]


@schemathesis.openapi.from_dict(DOCUMENT).parametrize()
@settings(max_examples=20, derandomize=True, deadline=None, suppress_health_check=list(HealthCheck), database=None)
def test_every_operation(case: schemathesis.Case, service: Service, key: str) -> None:
    """Examples, edges of every parameter, methods that are none, and rubbish."""
    case.call_and_validate(
        base_url=service.url, checks=checks(), timeout=60, headers={"Authorization": f"Bearer {key}"}
    )
