"""Tests of the OpenAPI document and of the real API against it.

The document is complete and has valid examples of everything; with Schemathesis, no request causes a 5xx or a response
that it lacks.
"""

import ast
from collections.abc import Iterator
from pathlib import Path
from string import Formatter
from typing import Any

import pytest
import schemathesis
from hypothesis import HealthCheck, settings
from jsonschema import Draft202012Validator, FormatChecker
from openapi_spec_validator import validate
from schemathesis.checks import CHECKS, load_all_checks
from schemathesis.core.transport import Response
from schemathesis.specs.openapi.checks import missing_required_header, negative_data_rejection

from api.http.app import create_app
from api.http.problems import MEDIA_TYPE
from service import problems
from service.problems import ProblemType
from service.settings import ServiceSettings
from service.store import Store
from sgsst_core.files.formats import RESULT_FORMATS
from tests.api.conftest import Services
from tests.api.service import Service

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
@settings(max_examples=4, derandomize=True, deadline=None, suppress_health_check=list(HealthCheck), database=None)
def test_every_operation_follows_schema(case: schemathesis.Case, service: Service, key: str) -> None:
    """Requests include the examples, limits of every parameter, unsupported methods and random input."""
    case.call_and_validate(
        base_url=service.url, checks=checks(), timeout=60, headers={"Authorization": f"Bearer {key}"}
    )


PROBLEMS = {name: value for name, value in vars(problems).items() if isinstance(value, ProblemType)}
SCHEMAS: dict[str, Any] = DOCUMENT["components"]["schemas"]
OPERATIONS: list[tuple[str, dict[str, Any]]] = [
    (f"{method.upper()} {path}", operation)
    for path, methods in DOCUMENT["paths"].items()
    for method, operation in methods.items()
]


def resolved(schema: dict[str, Any]) -> dict[str, Any]:
    target: dict[str, Any] = SCHEMAS[schema["$ref"].rsplit("/", 1)[1]] if "$ref" in schema else schema
    return target


def examples_of(described: dict[str, Any]) -> list[object]:
    """Return the examples of a media type, a parameter or a header, or those of its schema."""
    own = [entry["value"] for entry in described.get("examples", {}).values()]
    if "example" in described:
        own.append(described["example"])
    return own or list(resolved(described["schema"]).get("examples", []))


def check(where: str, described: dict[str, Any]) -> None:
    """Fail if there is no example, or if one violates its schema."""
    examples = examples_of(described)
    assert examples, f"{where}: no example"
    schema = {**described["schema"], "components": DOCUMENT["components"]}
    validator = Draft202012Validator(schema, format_checker=FormatChecker())
    for example in examples:
        wrong = [f"{error.json_path}: {error.message}" for error in validator.iter_errors(example)]
        assert not wrong, f"{where}: its example is not as its schema says: {wrong}"


def bodies(operation: dict[str, Any]) -> Iterator[tuple[str, dict[str, Any]]]:
    """Yield every media type of the request and of the responses."""
    for kind, body in operation.get("requestBody", {}).get("content", {}).items():
        yield f"request {kind}", body
    for status, answer in operation["responses"].items():
        for kind, body in answer.get("content", {}).items():
            yield f"{status} {kind}", body


@pytest.mark.parametrize(("label", "operation"), OPERATIONS, ids=[label for label, _ in OPERATIONS])
def test_summary_says_what_the_operation_does(label: str, operation: dict[str, Any]) -> None:
    """Summaries are sentences, not names of functions."""
    summary = operation["summary"]
    assert operation["description"].startswith(summary)
    assert summary.lower() != operation["operationId"].replace("_", " ")
    assert len(summary.split()) > 2
    assert len(summary) < 100


def test_document_is_valid_openapi() -> None:
    validate(DOCUMENT)  # type: ignore[arg-type]


@pytest.mark.parametrize("name", SCHEMAS)
def test_every_schema_has_an_example(name: str) -> None:
    check(name, {"schema": {"$ref": f"#/components/schemas/{name}"}})


@pytest.mark.parametrize(("label", "operation"), OPERATIONS, ids=[label for label, _ in OPERATIONS])
def test_every_operation_has_examples(label: str, operation: dict[str, Any]) -> None:
    for where, body in bodies(operation):
        check(f"{label}: {where}", body)
    for parameter in operation.get("parameters", []):
        assert parameter.get("description"), f"{label}: {parameter['name']}: no description"
        check(f"{label}: parameter {parameter['name']}", parameter)
    for status, answer in operation["responses"].items():
        assert answer["description"], f"{label}: {status}: no description"
        for name, header in answer.get("headers", {}).items():
            check(f"{label}: {status}: header {name}", header)


@pytest.mark.parametrize(("label", "operation"), OPERATIONS, ids=[label for label, _ in OPERATIONS])
def test_every_refusal_has_its_codes(label: str, operation: dict[str, Any]) -> None:
    """Each error status lists its codes, and each code has an example of that status."""
    refusals = {int(status): answer for status, answer in operation["responses"].items() if int(status) >= 400}
    assert {400, 431, 500} <= refusals.keys()
    assert {401, 403} <= refusals.keys() or "security" not in operation
    for status, answer in refusals.items():
        if MEDIA_TYPE not in answer.get("content", {}):
            assert label.startswith("HEAD") or (label, status) == ("GET /readyz", 503)
            continue
        body = answer["content"][MEDIA_TYPE]
        assert body["schema"] == {"$ref": "#/components/schemas/Problem"}
        shown = {code: example["value"] for code, example in body["examples"].items()}
        assert shown
        assert all(value["code"] == code and value["status"] == status for code, value in shown.items())


def test_document_lists_every_error_code() -> None:
    """Errors of the service that reach a client are documented by at least one operation."""
    documented = {
        code
        for _, operation in OPERATIONS
        for answer in operation["responses"].values()
        if MEDIA_TYPE in answer.get("content", {})
        for code in answer["content"][MEDIA_TYPE]["examples"]
    }
    hidden = (problems.LEASE_LOST, problems.METHOD_NOT_ALLOWED)  # of dispatchers, and of no operation
    assert {problem.code for problem in PROBLEMS.values() if problem not in hidden} <= documented


def test_calls_of_problems_name_all_values_of_their_messages() -> None:
    """A missing value would show only when the error occurs."""
    called = set()
    for file in (file for package in ("api", "service") for file in Path(package).rglob("*.py")):
        for node in ast.walk(ast.parse(file.read_text())):
            name = ast.unparse(node.func).partition("problems.")[2] if isinstance(node, ast.Call) else ""
            if not isinstance(node, ast.Call) or name not in PROBLEMS or any(key.arg is None for key in node.keywords):
                continue
            given, problem = {key.arg for key in node.keywords}, PROBLEMS[name]
            fields = {field for text in problem.headers.values() for _, field, _, _ in Formatter().parse(text)}
            if not node.args:
                fields |= {field for _, field, _, _ in Formatter().parse(problem.message)}
            assert fields - {None} <= given, f"{file}:{node.lineno}"
            assert node.args or problem.message, f"{file}:{node.lineno}: no message"
            called.add(name)
    assert len(called) > 60


def test_media_type_of_every_result_format_is_documented() -> None:
    content = DOCUMENT["paths"]["/v1/jobs/{job_id}/artifacts/{name}"]["get"]["responses"]["200"]["content"]
    assert {each.media_type for each in RESULT_FORMATS} <= content.keys()
