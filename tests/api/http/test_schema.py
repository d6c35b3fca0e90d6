"""Tests of the real API with Schemathesis: no request causes a 5xx or a response that the OpenAPI document lacks."""

from __future__ import annotations

import base64
import copy
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import httpx2
import pytest
import schemathesis
from hypothesis import HealthCheck, Phase, settings
from schemathesis import GenerationMode
from schemathesis.checks import CHECKS, load_all_checks
from schemathesis.core.transport import Response
from schemathesis.generation.stateful.state_machine import StepInput, StepOutput
from schemathesis.specs.openapi.checks import missing_required_header, negative_data_rejection

from api.http.app import create_app
from service.files.objects import Artifacts
from service.settings import ServiceSettings
from service.store import Store
from tests.api.conftest import Services
from tests.api.service import Service
from tests.small_scenes import wall, write_files

DOCUMENT: dict[str, Any] = create_app(ServiceSettings()).openapi()
schemathesis.serializer.alias("application/offset+octet-stream", "application/octet-stream")

load_all_checks()


def refuses_what_is_wrong(ctx: Any, response: Response, case: schemathesis.Case) -> bool | None:
    """Run Schemathesis's check that invalid requests are refused, with two exceptions.

    The API may ignore unknown headers and query parameters, as usual in HTTP. It may refuse requests with any 4xx
    status, such as 412 and 460 of the tus protocol.
    """
    known = {parameter["name"] for parameter in case.operation.definition.raw.get("parameters", [])}
    unknown = "x-schemathesis-unknown-property" in case.headers or not known.issuperset(case.query or {})
    if unknown or 400 <= response.status_code < 500:
        return None
    return negative_data_rejection(ctx, response, case)


def refuses_what_lacks_a_header(ctx: Any, response: Response, case: schemathesis.Case) -> bool | None:
    """Run Schemathesis's check of missing headers, but accept 412, which tus requires if its version is missing."""
    return None if response.status_code == 412 else missing_required_header(ctx, response, case)


def checks() -> list[Any]:
    """Return all checks of Schemathesis except that valid bodies are accepted.

    A body that matches the schema may be refused for reasons that a schema cannot express, such as files that were
    never uploaded, or a wrong offset.
    """
    own = {
        "positive_data_acceptance": None,
        "negative_data_rejection": refuses_what_is_wrong,
        "missing_required_header": refuses_what_lacks_a_header,
    }
    chosen = [own.get(check.__name__, check) for check in CHECKS.get_all()]
    return [check for check in chosen if check is not None]


@pytest.fixture(scope="module")
def service(services: Services) -> Service:
    # A huge Upload-Length must not fail for lack of disk space.
    return services(SGSST_MAX_UPLOAD_BYTES="1000000", SGSST_REQUIRE_KEYS="true")


@pytest.fixture(scope="module")
def key(store: Store) -> str:
    return store.keys.create("schemathesis")[1]


@schemathesis.openapi.from_dict(DOCUMENT).parametrize()
@settings(max_examples=8, derandomize=True, deadline=None, suppress_health_check=list(HealthCheck), database=None)
def test_every_operation_follows_schema(case: schemathesis.Case, service: Service, key: str) -> None:
    """Requests include the examples, limits of every parameter, unsupported methods and random input."""
    case.call_and_validate(
        base_url=service.url, checks=checks(), timeout=60, headers={"Authorization": f"Bearer {key}"}
    )


# --- chains --------------------------------------------------------------------------------------------------------

#: Settings with which each run generates the same chains of requests.
BOUNDS = settings(
    max_examples=40,
    stateful_step_count=8,
    derandomize=True,
    deadline=None,
    database=None,
    phases=[Phase.generate],
    suppress_health_check=list(HealthCheck),
)
#: Operations that chains only reach by links, because ids cannot be guessed.
JOBS = ("get_job", "cancel_job", "delete_job", "watch_job")
ENDS = ("cancel_job", "retry_job")
ARTIFACTS = ("list_artifacts", "get_artifact")
INPUTS = ("get_progress", "list_inputs", "get_input")
UPLOADS = ("get_upload", "head_upload", "append_upload", "delete_upload")
#: Parameters that are not only well-formed but valid, so that requests create resources that links refer to.
RIGHT: dict[str, dict[str, Any]] = {
    "dry_run": {"type": "boolean", "enum": [False]},
    "Upload-Length": {"type": "integer", "minimum": 100, "maximum": 200},
    "Upload-Metadata": {"type": "string", "const": "filename c2NlbmUucGx5"},
    "Upload-Checksum": {"type": "string", "const": ""},
}


class Uploaded:
    """Small scene whose files are uploaded once, with methods that finish its jobs in place of a dispatcher."""

    def __init__(self, service: Service, store: Store, key: str, folder: Path) -> None:
        self._store = store
        self._artifacts = Artifacts(ServiceSettings(data=service.data).artifacts_url)
        self._ply, cameras, style = write_files(folder, wall())
        self._client = service.client(key)
        self._ids = [_upload(self._client, path) for path in (self._ply, style, cameras)]

    def document(self) -> dict[str, Any]:
        """Return the OpenAPI document with these files' ids in all jobs: schemas cannot express which ids exist."""
        changed = copy.deepcopy(DOCUMENT)
        scene, style, cameras = self._ids
        seed = {"type": "integer", "minimum": 0, "maximum": 9}
        changed["components"]["schemas"]["JobFromUploads"]["properties"] = {
            "scene": {"const": scene},
            "style": {"const": style},
            "cameras": {"const": [cameras]},
            "parameters": {"type": "object", "additionalProperties": False, "properties": {"seed": seed}},
        }
        changed["components"]["schemas"]["JobFromUploads"]["required"] = ["scene", "style", "cameras"]
        del changed["paths"]["/v1/jobs"]["post"]["requestBody"]["content"]["multipart/form-data"]
        for operations in changed["paths"].values():
            for operation in operations.values():
                for parameter in operation.get("parameters", []):
                    parameter["schema"] = RIGHT.get(parameter["name"], parameter["schema"])
        return changed

    def finish_jobs(self) -> None:
        """Finish all queued jobs with results, in place of a dispatcher (`test_service` runs a real one)."""
        while (lease := self._store.leases.take("test")) is not None:
            result = self._artifacts.put(lease.job_id, lease.epoch, "stylized.ply", self._ply)
            self._store.leases.start(lease)
            self._store.leases.publish(lease, [result])
            self._store.leases.succeed(lease, [result], {"steps": 1})

    def delete_jobs(self) -> None:
        """Delete all jobs, so that each sequence of requests starts without jobs."""
        self.finish_jobs()
        for job in self._client.get("/v1/jobs", params={"limit": 200}).json()["jobs"]:
            assert self._client.delete(f"/v1/jobs/{job['id']}").status_code == 204


@pytest.fixture(scope="module")
def uploaded(service: Service, store: Store, key: str, tmp_path_factory: pytest.TempPathFactory) -> Uploaded:
    return Uploaded(service, store, key, tmp_path_factory.mktemp("inputs"))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("path", "behind"),
    [
        ("/v1/jobs(?!.*(artifacts|inputs|progress))", JOBS),
        # Separate chains, because those above rarely cancel and then retry a job, or list and then get its files.
        ("/v1/jobs($|/{job_id}/(cancel|retry))", ENDS),
        ("/v1/jobs($|/{job_id}/artifacts)", ARTIFACTS),
        ("/v1/jobs($|/{job_id}/(inputs|progress))", INPUTS),
        ("/v1/uploads", UPLOADS),
    ],
)
def test_request_chains_follow_schema(
    service: Service, key: str, uploaded: Uploaded, path: str, behind: tuple[str, ...]
) -> None:
    """Stateful test: ids from responses are used in the requests that the document links to them."""
    followed: Counter[str] = Counter()
    loaded = schemathesis.openapi.from_dict(uploaded.document()).include(path_regex=f"^{path}")
    loaded.config.update(base_url=service.url)
    loaded.config.generation.update(modes=[GenerationMode.POSITIVE])  # invalid requests are tested above

    class Chains(loaded.as_state_machine()):  # type: ignore[misc]
        def setup(self) -> None:
            uploaded.delete_jobs()

        def get_call_kwargs(self, case: schemathesis.Case) -> dict[str, Any]:
            return {"headers": {"Authorization": f"Bearer {key}"}, "timeout": 60}

        def before_call(self, case: schemathesis.Case) -> None:
            if name_of(case) in ("list_artifacts", "watch_job"):  # the stream of a waiting job would not end
                uploaded.finish_jobs()

        def validate_response(self, response: Response, case: schemathesis.Case, **ignored: object) -> None:
            case.validate_response(response, checks=checks(), recorder=self.recorder)

        def step(self, input: StepInput) -> StepOutput:
            output = super().step(input)
            if input.transition is not None and input.is_applied and 200 <= output.response.status_code < 300:
                followed[name_of(input.case)] += 1
            return output

    missed: Sequence[str] = behind
    for chains in (40, 80, 160):  # chains depend on answers too, so try longer runs if some operation was not reached
        if missed:
            Chains.run(settings=settings(BOUNDS, max_examples=chains))
            missed = [name for name in behind if not followed[name]]
    assert not missed, f"no chain has succeeded with {missed}; others: {dict(followed)}"


def name_of(case: schemathesis.Case) -> str:
    return str(case.operation.definition.raw["operationId"])


def _upload(client: httpx2.Client, path: Path) -> str:
    name = base64.b64encode(path.name.encode()).decode()
    tus = {"Tus-Resumable": "1.0.0"}
    headers = {**tus, "Upload-Length": str(path.stat().st_size), "Upload-Metadata": f"filename {name}"}
    upload = client.post("/v1/uploads", headers=headers).json()
    headers = {**tus, "Upload-Offset": "0", "Content-Type": "application/offset+octet-stream"}
    client.patch(f"/v1/uploads/{upload['id']}", content=path.read_bytes(), headers=headers)
    return str(upload["id"])
