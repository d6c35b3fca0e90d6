"""Errors as RFC 9457 problem documents with a stable `code`, and their part of the OpenAPI document.

The OpenAPI document gets what route types do not cover: headers of responses, and errors with examples. Examples of
bodies are defined with their models (`api.http.schemas`, `api.http.submission`, `service.inputs`).
"""

import errno
import json
import logging
from collections.abc import Callable, Iterator, Sequence
from http import HTTPStatus
from typing import Any, TypeVar

from fastapi import Request
from fastapi.dependencies.models import Dependant
from fastapi.exceptions import RequestValidationError
from fastapi.responses import JSONResponse
from fastapi.routing import APIRoute
from pydantic import BaseModel, ConfigDict, Field, ValidationError
from starlette.exceptions import HTTPException
from starlette.routing import BaseRoute, Match
from starlette.types import Scope

from api.http.schemas import address, path_of
from service import problems
from service.files.objects import is_full
from service.inputs import JobParameters
from service.problems import JOB_ID, SHA256, ProblemType, ServiceError
from sgsst_core.errors import (
    CameraError,
    ImageError,
    InvalidInputError,
    MaskError,
    OutputError,
    SceneError,
    SettingsError,
    TooManyIntersectionsError,
    WeightsError,
)
from sgsst_core.settings import merged, reason, unknown_text
from worker.options import RegionOptions

MEDIA_TYPE = "application/problem+json"
#: Names of statuses that HTTPStatus lacks; 460 is defined by the tus protocol.
_TITLES = {460: "Checksum Mismatch"}
METHODS = ("GET", "HEAD", "POST", "PATCH", "PUT", "DELETE", "OPTIONS")
#: Start of paths that contain the token of a share.
_SHARED = ("/v1/shared/", "/shared/")
#: Maximum number of characters of an input that a problem document quotes.
_SHOWN = 100

_log = logging.getLogger(__name__)


class Problem(BaseModel):
    """RFC 9457 problem document. Programs read `code` and `status`; people read `detail`, which says what to do."""

    model_config = ConfigDict(
        extra="allow",
        json_schema_extra={
            "examples": [
                {
                    "type": "about:blank",
                    "title": "Unprocessable Content",
                    "status": 422,
                    "code": "invalid-scene",
                    "detail": "scene.ply: holds no Gaussians (element vertex 0). Export the scene again.",
                    "input": "scene",
                }
            ]
        },
    )

    type: str = "about:blank"
    title: str = Field(description="The status in words.")
    status: int
    code: str = Field(description="Stable identifier of the kind of error.")
    detail: str = Field(description="What was wrong and what to do, for people.")


def from_service(error: ServiceError) -> JSONResponse:
    """Return the problem document of a service error."""
    headers = dict(error.headers)
    if error.retry_after is not None:
        headers["Retry-After"] = str(error.retry_after)
    title = _TITLES.get(error.status) or HTTPStatus(error.status).phrase
    body = Problem(title=title, status=error.status, code=error.code, detail=str(error), **error.extra)
    return JSONResponse(body.model_dump(mode="json"), error.status, headers, media_type=MEDIA_TYPE)


async def _expected(request: Request, error: ServiceError | InvalidInputError) -> JSONResponse:
    known = error if isinstance(error, ServiceError) else problems.INVALID_INPUT(str(error), code=error.code)
    return from_service(known)


async def _invalid_request(request: Request, error: RequestValidationError | ValidationError) -> JSONResponse:
    outer = int(
        isinstance(error, RequestValidationError)
    )  # its locations start with a part of the request: query, body
    known = {*JobParameters.model_fields, *RegionOptions.model_fields}
    errors = [
        {
            "at": (at := ".".join(str(part) for part in entry["loc"][outer:])[:_SHOWN]),
            "message": unknown_text(at.rpartition(".")[2], known)
            if entry["type"] == "extra_forbidden"
            else reason(entry),
        }
        for entry in merged(error.errors())[:20]
    ]
    first = errors[0] if errors else {"at": "", "message": "invalid"}
    return from_service(problems.INVALID_REQUEST(f"{first['at'] or 'body'}: {first['message']}", errors=errors))


async def _not_routed(request: Request, error: HTTPException) -> JSONResponse:
    path = request.scope["path"][:_SHOWN]
    if error.status_code == 404:
        return from_service(problems.NOT_FOUND(f"There is nothing at {path!r}. {address('/docs')} lists all paths."))
    routed = routed_methods(request.scope)  # the router's own header lists only those of the first route
    allowed = [method for method in METHODS if method in routed or (method == "HEAD" and "GET" in routed)]
    method = request.method[:_SHOWN]
    return from_service(problems.METHOD_NOT_ALLOWED(path=path, method=method, allowed=", ".join(allowed)))


def routed_methods(scope: Scope) -> list[str]:
    """Return the methods that the path of a request has routes for."""
    routes = scope["app"].router.routes
    scopes = {method: {**scope, "method": method} for method in METHODS}
    return [method for method in METHODS if any(route.matches(scopes[method])[0] is Match.FULL for route in routes)]


async def _system_error(request: Request, error: OSError) -> JSONResponse:
    if is_full(error):
        return from_service(problems.NO_SPACE())
    if error.errno not in (errno.EMFILE, errno.ENFILE):
        raise error
    return from_service(
        problems.TOO_MANY_CONNECTIONS("The service has reached its limit of open files. Try again later.")
    )


async def _unexpected(request: Request, error: Exception) -> JSONResponse:
    scope, request_id = request.scope, request.scope["request_id"]
    extra = {"request_id": request_id}
    _log.exception("%s %s failed unexpectedly", request.method, logged_path(scope), exc_info=error, extra=extra)
    return from_service(problems.INTERNAL(request_id=request_id))


#: Functions that convert every error of the app to a problem document.
HANDLERS: dict[Any, Any] = {
    ServiceError: _expected,
    InvalidInputError: _expected,
    RequestValidationError: _invalid_request,
    ValidationError: _invalid_request,
    HTTPException: _not_routed,
    OSError: _system_error,
    Exception: _unexpected,
}


def route_of(scope: Scope) -> str:
    """Return the path of the route that answers a request, with the names of its parameters."""
    return getattr(scope.get("route"), "path", "(none)")


def logged_path(scope: Scope) -> str:
    """Return the path of a request for the log; that of its route if the path contains a secret token."""
    path = path_of(scope)
    return route_of(scope) if path.startswith(_SHARED) else path


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


#: Problems of every operation.
_ANYWHERE = (
    problems.MALFORMED_REQUEST,
    problems.HEAD_TOO_LARGE,
    problems.INTERNAL,
    problems.TOO_MANY_CONNECTIONS,
    problems.DATABASE_UNAVAILABLE,
    problems.DATABASE_BUSY,
    problems.CHANGED_MEANWHILE,
    problems.DEADLINE_EXCEEDED,
)
#: Problems of operations on the resources that paths name.
_OF_PATHS = {"{job_id}": problems.NO_JOB, "{upload_id}": problems.NO_UPLOAD, "{share_id}": problems.NO_SHARE}

#: Problems of operations that read stored files, and of those that make files of results.
_READING = (problems.STORE_UNAVAILABLE, problems.FILE_LOST, problems.FILE_DAMAGED)
_MAKING = (
    *_READING,
    problems.NO_ARTIFACT,
    problems.INSPECTION_LIMIT,
    problems.STORED_BYTES_EXCEEDED,
    problems.BUSY,
    problems.NO_SPACE,
)
_UNWRITABLE = problems.INVALID_INPUT(
    "stylized.spz: SPZ cannot hold a Gaussian 1e+07 from the origin. Write a PLY, or a .compressed.ply.",
    code=OutputError.code,
)
_UNREADABLE = problems.INVALID_INPUT("stylized.ply: the file is incomplete.", code=SceneError.code)
#: Errors of the core that the inspection of a job's files reports: code, part of the request and example.
_UNUSABLE = (
    (SceneError.code, "scene", "scene.ply: holds no Gaussians (element vertex 0). Export the scene again."),
    (ImageError.code, "style", "style.jpg: is not an image that can be read. Give a PNG or JPEG."),
    (CameraError.code, "cameras", "cameras.json: holds no cameras. Export them again."),
    (
        MaskError.code,
        "mask",
        "head.bin: has 100 bytes, but scene.ply has 616 Gaussians. One bit for each makes 77 bytes.",
    ),
    (SettingsError.code, None, "Both numbers of steps are 0, so that nothing would change. Give some."),
    (WeightsError.code, None, "The service has no weights of vgg19: its operator has to fetch them."),
    (
        TooManyIntersectionsError.code,
        None,
        "view 'view_0' (5187x3361): its 9,000,000 visible Gaussians touch raster tiles 3,000,000,000 times, more than "
        "can be addressed. Render at a lower resolution.",
    ),
)
#: Problems of single operations, beyond those that follow from their paths and dependencies (`raises`). Operations
#: `head_...` have those of `get_...`.
_OF_OPERATIONS: dict[str, tuple[ProblemType | ServiceError, ...]] = {
    "create_job": (
        *(problems.INVALID_INPUT(message, code=code, input=role) for code, role, message in _UNUSABLE),
        *_READING,
        problems.MALFORMED_BODY,
        problems.TOO_SLOW,
        problems.TOO_LARGE,
        problems.UNSUPPORTED_TYPE,
        problems.LOST_UPLOAD,
        problems.INVALID_INPUT,
        problems.TOO_MANY_GAUSSIANS,
        problems.TOO_MANY_VIEWS,
        problems.UNSURE_UP,
        problems.UNSURE_CAMERAS,
        problems.TOO_MANY_PIXELS,
        problems.IMAGE_TOO_LARGE,
        problems.TOO_MANY_FILES,
        problems.INSPECTION_LIMIT,
        problems.UNKNOWN_UPLOAD,
        problems.UNKNOWN_INPUT,
        problems.UNFINISHED_UPLOAD,
        problems.URLS_OFF,
        problems.INVALID_URL,
        problems.URL_NOT_FETCHED,
        problems.WEBHOOKS_OFF,
        problems.INVALID_WEBHOOK,
        problems.IDEMPOTENCY_KEY_REUSED,
        problems.QUEUE_FULL,
        problems.QUOTA_EXCEEDED,
        problems.BUSY,
        problems.NO_SPACE,
        problems.WEIGHTS_DAMAGED,
        problems.UPLOAD_LOCKED,
    ),
    "finish_job": (problems.NOT_RUNNING,),
    "cancel_job": (problems.NOT_CANCELABLE,),
    "retry_job": (
        problems.NOT_RETRYABLE,
        problems.QUEUE_FULL,
        problems.QUOTA_EXCEEDED,
        problems.WEIGHTS_DAMAGED,
        problems.INVALID_INPUT(
            "Setting sharpness = 3: Extra inputs are not permitted. The job was stored by an earlier version that "
            "accepted this. Submit a new job without it.",
            code=SettingsError.code,
        ),
    ),
    "delete_job": (problems.NOT_ENDED,),
    "change_job": (*_MAKING, _UNREADABLE, problems.NO_RESULT),
    "get_artifact": (*_MAKING, _UNWRITABLE),
    "get_input": (*_READING, problems.NO_INPUT),
    "create_blend": (
        *_MAKING,
        _UNWRITABLE,
        problems.TOO_MANY_BLENDS,
        problems.INVALID_INPUT(
            "scene.ply: has 616 Gaussians, but stylized.ply has 800. Blend scenes with the same Gaussians; refining "
            "splits some.",
            code=SceneError.code,
        ),
    ),
    "make_video": _MAKING,
    "create_share": (*_MAKING, _UNREADABLE, problems.NO_RESULT, problems.TOO_MANY_SHARES),
    "get_shared_file": (*_READING, problems.NO_SHARED_FILE),
    "create_upload": (
        problems.MALFORMED_BODY,
        problems.TOO_LARGE,
        problems.TOO_MANY_UPLOADS,
        problems.IDEMPOTENCY_KEY_REUSED,
        problems.STORED_BYTES_EXCEEDED,
        problems.NO_SPACE,
        problems.STORE_UNAVAILABLE,
    ),
    "append_upload": (
        problems.MALFORMED_BODY,
        problems.TOO_SLOW,
        problems.TOO_LARGE,
        problems.UNSUPPORTED_TYPE(supported="application/offset+octet-stream"),
        problems.WRONG_OFFSET,
        problems.UPLOAD_LOCKED,
        problems.CHECKSUM_MISMATCH,
        problems.NO_SPACE,
        problems.STORE_UNAVAILABLE,
    ),
    "get_usage": (
        problems.INVALID_REQUEST(
            "since, until: 120 days, but must be between 1 and 92 days, with both ends included.", input="since"
        ),
    ),
    "sign_in": (problems.UNKNOWN_KEY, problems.TOO_MANY_TRIES),
    "sign_out": (problems.CROSS_ORIGIN,),
}

#: Problems that dependencies of routes raise, and models of the JSON bodies that they read.
_RAISED: dict[Callable[..., Any], tuple[tuple[ProblemType, ...], type[BaseModel] | None]] = {}

Function = TypeVar("Function", bound=Callable[..., Any])


def raises(*raised: ProblemType, body: type[BaseModel] | None = None) -> Callable[[Function], Function]:
    """Return a decorator that documents a dependency of routes.

    Args:
        body: Model of the JSON body that it reads; None if it reads none.
    """

    def record(function: Function) -> Function:
        _RAISED[function] = raised, body
        return function

    return record


def _dependencies(dependant: Dependant) -> Iterator[Callable[..., Any]]:
    """Yield the functions of all dependencies, those of dependencies included."""
    for each in dependant.dependencies:
        if each.call is not None:
            yield each.call
        yield from _dependencies(each)


def _describe(operation: dict[str, Any], route: APIRoute, schemas: dict[str, Any]) -> None:
    """Add the JSON body and the problems of a route to its operation, with an example for each code."""
    raised: list[ProblemType | ServiceError] = list(_ANYWHERE)
    for function in _dependencies(route.dependant):
        problems_of_it, model = _RAISED.get(function, ((), None))
        raised += problems_of_it
        if model:
            _add_schema(schemas, model)
            body = {"schema": {"$ref": f"#/components/schemas/{model.__name__}"}}
            operation["requestBody"] = {"required": True, "content": {"application/json": body}}
    raised += [problem for part, problem in _OF_PATHS.items() if part in route.path]
    checked = [each["name"] for each in operation.get("parameters", []) if _is_limited(each)]
    if "application/json" in operation.get("requestBody", {}).get("content", {}):
        checked.append("body")
    if checked:
        errors = [{"at": checked[0], "message": "is not valid"}]
        raised.append(problems.INVALID_REQUEST(f"{checked[0]}: is not valid", errors=errors))
    raised += _OF_OPERATIONS.get(operation["operationId"].replace("head_", "get_"), ())
    responses = operation["responses"]
    responses.pop("422", None)  # FastAPI's own error schema
    for problem in raised:
        example = problem if isinstance(problem, ServiceError) else problem(**problem.example)
        answer = from_service(example)
        document = json.loads(bytes(answer.body))
        response = responses.setdefault(str(example.status), {"description": f"{document['title']}: see `code`."})
        schema = {"$ref": "#/components/schemas/Problem"}
        content = response.setdefault("content", {}).setdefault(MEDIA_TYPE, {"schema": schema, "examples": {}})
        content["examples"][example.code] = {"value": document}
        names = [name for name in _HEADERS if name.lower() in answer.headers and name != "Content-Length"]
        response.setdefault("headers", {}).update(headers(*names))


def _is_limited(parameter: dict[str, Any]) -> bool:
    """Return whether there are values that a parameter may not have."""
    schema = parameter["schema"]
    known = schema.keys() | schema.get("anyOf", [{}])[0].keys()
    # Tus-Resumable has a problem of its own
    return parameter["name"] != "Tus-Resumable" and not known.isdisjoint(("le", "lt", "pattern", "maxLength", "enum"))


def links(*operations: str, **parameters: str) -> dict[str, Any]:
    """Return OpenAPI links from a response to operations that take these parameters from it."""
    return {name: {"operationId": name, "parameters": parameters} for name in operations}


def complete(document: dict[str, Any], routes: Sequence[BaseRoute], models: Sequence[type[BaseModel]]) -> None:
    """Complete FastAPI's OpenAPI document in place.

    FastAPI omits models that no route takes as an argument, drops nulls from examples, and has its own error schemas.
    Generators of clients use the first media type of a response.
    """
    schemas = document["components"]["schemas"]
    for model in models:
        _add_schema(schemas, model)
    by_operation = {route.operation_id or route.name: route for route in routes if isinstance(route, APIRoute)}
    for path in document["paths"].values():
        for method, operation in path.items():
            operation["summary"] = operation["description"].partition("\n")[0].partition(". ")[0].rstrip(".")
            _describe(operation, by_operation[operation["operationId"]], schemas)
            for parameter in operation.get("parameters", []):
                # The header is required. It has a default only because tus requires status 412, not 422, without it.
                if parameter["name"] == "Tus-Resumable":
                    parameter["required"] = True
                    del parameter["schema"]["default"]
            for answer in operation["responses"].values():
                if "application/json" in answer.get("content", {}):
                    answer["content"] = {"application/json": None, **answer["content"]}
                if method == "head":
                    answer.pop("content", None)
    for unused in ("HTTPValidationError", "ValidationError"):
        schemas.pop(unused, None)


def _add_schema(schemas: dict[str, Any], model: type[BaseModel]) -> None:
    schema = model.model_json_schema(ref_template="#/components/schemas/{model}")
    schemas |= schema.pop("$defs", {})
    schemas[model.__name__] = schema
