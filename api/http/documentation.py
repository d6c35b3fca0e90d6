"""Parts of the OpenAPI document that route types do not cover: headers of responses, and errors with examples.

Examples of bodies are defined with their models (`api.http.schemas`, `api.http.submission`, `service.parameters`).
"""

from __future__ import annotations

import copy
import json
import re
from collections.abc import Sequence
from typing import Any

from pydantic import BaseModel

from api.http.context import CrossOriginError, ForeignSiteError, NoKeyError
from api.http.problems import (
    MEDIA_TYPE,
    HeadTooLargeError,
    InternalError,
    MalformedRequestError,
    TooManyConnectionsError,
    from_service,
)
from service.errors import (
    ChangedMeanwhileError,
    DatabaseBusyError,
    DatabaseUnavailableError,
    DeadlineError,
    RateLimitError,
    RefusedInputError,
    ServiceError,
)
from service.examples import JOB_ID, SHA256

Responses = dict[int | str, dict[str, Any]]

_TEXT: dict[str, Any] = {"type": "string"}
_COUNT: dict[str, Any] = {"type": "integer", "minimum": 0}
_DATE = {"type": "string", "pattern": "GMT$"}

#: Headers of responses: description, schema, example.
_HEADERS: dict[str, tuple[str, dict[str, Any], object]] = {
    "Accept-Ranges": ("Ranges can be requested.", {"const": "bytes"}, "bytes"),
    "Cache-Control": ("Responses are private to one key, and change.", _TEXT, "private, no-cache"),
    "Content-Disposition": ("Suggested name of the file.", _TEXT, 'attachment; filename="plush-stylized.ply"'),
    "Content-Length": ("Size of the body in bytes.", _COUNT, 42301),
    "Content-Range": ("Range of this part, and size of the file in bytes.", _TEXT, "bytes 0-1023/42301"),
    "Content-Security-Policy": ("HTML results run in a sandbox.", _TEXT, "sandbox allow-scripts"),
    "ETag": ("Tag of this state, for `If-None-Match`.", {"type": "string", "pattern": '^"[0-9a-f]+"$'}, f'"{SHA256}"'),
    "Idempotency-Replayed": ("Nothing was created: it existed already.", {"const": "true"}, "true"),
    "Location": ("Address of the new resource.", _TEXT, f"/v1/jobs/{JOB_ID}"),
    "Referrer-Policy": ("The address contains a secret.", {"const": "no-referrer"}, "no-referrer"),
    "Retry-After": ("Seconds to wait before the next request.", _COUNT, 2),
    "Set-Cookie": (
        "Session cookie.",
        {"type": "string", "pattern": "^sgsst_session="},
        'sgsst_session=""; HttpOnly; Max-Age=0; Path=/; SameSite=strict',
    ),
    "Tus-Checksum-Algorithm": ("Algorithms for `Upload-Checksum`.", _TEXT, "sha256,sha1,md5"),
    "Tus-Extension": ("Supported extensions of the protocol.", _TEXT, "creation,expiration,checksum,termination"),
    "Tus-Max-Size": ("Maximum size of a file in bytes.", _COUNT, 16_000_000_000),
    "Tus-Resumable": ("Protocol version.", {"const": "1.0.0"}, "1.0.0"),
    "Tus-Version": ("Supported protocol versions.", _TEXT, "1.0.0"),
    "Upload-Expires": (
        "Time at which the upload is deleted, unless more bytes arrive.",
        _DATE,
        "Sun, 22 Nov 2026 14:02:11 GMT",
    ),
    "Upload-Length": ("Size of the whole file in bytes.", _COUNT, 42301),
    "Upload-Metadata": ("Metadata as given at creation.", _TEXT, "filename c2NlbmUucGx5"),
    "Upload-Offset": ("Number of received bytes, where the next part starts.", _COUNT, 16384),
    "WWW-Authenticate": ("Authentication scheme.", _TEXT, "Bearer"),
    "X-Accel-Buffering": ("Proxies must not buffer events.", {"const": "no"}, "no"),
    "X-Content-Type-Options": ("Browsers must not guess the media type.", {"const": "nosniff"}, "nosniff"),
}


def headers(*names: str, maybe: tuple[str, ...] = ()) -> dict[str, Any]:
    """Return the documentation of the headers that a response always has (`names`) or may have (`maybe`)."""
    documented = {}
    for name in (*names, *maybe):
        description, schema, example = _HEADERS[name]
        documented[name] = {
            "description": description,
            "required": name in names,
            "schema": {"type": "string", **schema},
            "example": example,
        }
    return documented


#: Errors of every operation, and errors of operations that may require a key.
_ANYWHERE = (
    MalformedRequestError,
    HeadTooLargeError,
    InternalError,
    TooManyConnectionsError,
    DatabaseUnavailableError,
    DatabaseBusyError,
    ChangedMeanwhileError,
    DeadlineError,
)
_WITH_KEY = (RateLimitError, NoKeyError, ForeignSiteError, CrossOriginError)


def problems(*errors: type[ServiceError] | ServiceError, key: bool = True) -> Responses:
    """Return the documentation of an operation's errors by status, with an example response for each.

    Args:
        errors: Errors that are specific to this operation, one for each `code`; an instance is its own example. Errors
            of all operations are added.
        key: Whether the operation may require a key.
    """
    responses: Responses = {}
    for error in (*_ANYWHERE, *(_WITH_KEY if key else ()), *errors):
        example = error if isinstance(error, ServiceError) else error.of_example()
        answer = from_service(example)
        body = json.loads(bytes(answer.body))
        response = responses.setdefault(example.status, _no_problem_yet(example.status, body["title"]))
        response["content"][MEDIA_TYPE]["examples"][example.code] = {"value": body}
        names = [name for name in _HEADERS if name.lower() in answer.headers and name != "Content-Length"]
        response.setdefault("headers", {}).update(headers(*names))
    return responses


def _no_problem_yet(status: int, title: str) -> dict[str, Any]:
    schema = {"$ref": f"#/components/schemas/{_problem_name(status)}"}  # see `complete`
    return {"description": f"{title}: see `code`.", "content": {MEDIA_TYPE: {"schema": schema, "examples": {}}}}


def _problem_name(status: int) -> str:
    return f"Problem{status}"


def invalid(at: str, message: str) -> ServiceError:
    """Return an example error for an invalid header or parameter."""
    return RefusedInputError(f"{at}: {message}", "invalid-request", errors=[{"at": at, "message": message}])


def links(*operations: str, **parameters: str) -> dict[str, Any]:
    """Return OpenAPI links from a response to operations that take these parameters from it."""
    return {name: {"operationId": name, "parameters": parameters} for name in operations}


def complete(document: dict[str, Any], models: Sequence[type[BaseModel]]) -> None:
    """Complete FastAPI's OpenAPI document in place.

    FastAPI omits models that no route takes as an argument, drops nulls from examples, and has its own error schemas.
    Generators of clients support neither schemas that narrow another one nor constants in headers, and use the first
    media type of a response.
    """
    schemas = document["components"]["schemas"]
    for model in models:
        schema = model.model_json_schema(ref_template="#/components/schemas/{model}")
        schemas |= schema.pop("$defs", {})
        schemas[model.__name__] = schema
    for path in document["paths"].values():
        for method, operation in path.items():
            operation["summary"] = operation["description"].partition("\n")[0].partition(". ")[0].rstrip(".")
            for parameter in operation.get("parameters", []):
                # The header is required. It has a default only because tus requires status 412, not 422, without it.
                if parameter["name"] == "Tus-Resumable":
                    parameter["required"] = True
                    version = parameter["schema"].pop("const")
                    parameter["schema"].pop("default", None)
                    parameter["schema"]["pattern"] = f"^{re.escape(version)}$"
            answers = operation["responses"]
            if "application/json" in answers.get("422", {}).get("content", {}):
                del answers["422"]  # FastAPI's own error schema, on operations whose parameters cannot be invalid
            for answer in answers.values():
                if "application/json" in answer.get("content", {}):
                    answer["content"] = {"application/json": None, **answer["content"]}
                if method == "head":
                    answer.pop("content", None)
    _add_problem_schemas(document)
    for unused in ("HTTPValidationError", "ValidationError"):
        schemas.pop(unused, None)


def _add_problem_schemas(document: dict[str, Any]) -> None:
    """Add a schema for the problems of each status, with all codes that any operation documents for it."""
    schemas = document["components"]["schemas"]
    examples: dict[int, dict[str, Any]] = {}
    for path in document["paths"].values():
        for operation in path.values():
            for status, answer in operation["responses"].items():
                problem = answer.get("content", {}).get(MEDIA_TYPE)
                if problem:
                    known = {code: example["value"] for code, example in problem["examples"].items()}
                    examples.setdefault(int(status), {}).update(known)
    for status, by_code in sorted(examples.items()):
        properties = copy.deepcopy(schemas["Problem"]["properties"])
        properties["status"] |= {"const": status}
        properties["code"] |= {"enum": sorted(by_code)}
        title = {"title": _problem_name(status), "examples": [next(iter(by_code.values()))]}
        schemas[_problem_name(status)] = {**schemas["Problem"], "properties": properties, **title}
