"""Errors as RFC 9457 problem documents with a stable `code`."""

from __future__ import annotations

import errno
import logging
from http import HTTPStatus

from fastapi import FastAPI, Request
from fastapi.exceptions import RequestValidationError
from fastapi.responses import JSONResponse
from pydantic import BaseModel, ConfigDict, Field, ValidationError
from starlette.exceptions import HTTPException
from starlette.routing import Match
from starlette.types import Scope

from api.http.addresses import address, path_of
from service import problems
from service.files.objects import is_full
from service.inputs import JobParameters
from service.problems import ServiceError
from sgsst_core.errors import InvalidInputError
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


def _response(status: int, code: str, detail: str, headers: dict[str, str], **extra: object) -> JSONResponse:
    title = _TITLES.get(status) or HTTPStatus(status).phrase
    body = Problem(title=title, status=status, code=code, detail=detail, **extra)
    return JSONResponse(body.model_dump(mode="json"), status, headers, media_type=MEDIA_TYPE)


def add_handlers(app: FastAPI) -> None:
    """Register handlers that convert every error of the app to a problem document."""
    app.add_exception_handler(ServiceError, _expected)
    app.add_exception_handler(InvalidInputError, _expected)
    app.add_exception_handler(RequestValidationError, _invalid_request)
    app.add_exception_handler(ValidationError, _invalid_request)
    app.add_exception_handler(HTTPException, _http_error)
    app.add_exception_handler(OSError, _system_error)
    app.add_exception_handler(Exception, _unexpected)


def from_service(error: ServiceError) -> JSONResponse:
    """Return the problem document of a service error."""
    headers = dict(error.headers)
    if error.retry_after is not None:
        headers["Retry-After"] = str(error.retry_after)
    return _response(error.status, error.code, str(error), headers, **error.extra)


async def _expected(request: Request, error: Exception) -> JSONResponse:
    assert isinstance(error, ServiceError | InvalidInputError)
    known = error if isinstance(error, ServiceError) else problems.INVALID_INPUT(str(error), code=error.code)
    return from_service(known)


async def _invalid_request(request: Request, error: Exception) -> JSONResponse:
    assert isinstance(error, RequestValidationError | ValidationError)
    outer = int(
        isinstance(error, RequestValidationError)
    )  # its locations start with a part of the request: query, body
    errors = [
        {
            "at": (at := ".".join(str(part) for part in entry["loc"][outer:])[:_SHOWN]),
            "message": _unknown(at) if entry["type"] == "extra_forbidden" else reason(entry),
        }
        for entry in merged(error.errors())[:20]
    ]
    first = errors[0] if errors else {"at": "", "message": "invalid"}
    return from_service(problems.INVALID_REQUEST(f"{first['at'] or 'body'}: {first['message']}", errors=errors))


def _unknown(at: str) -> str:
    """Return the message for an unknown parameter of a job or region."""
    return unknown_text(at.rpartition(".")[2], {*JobParameters.model_fields, *RegionOptions.model_fields})


async def _http_error(request: Request, error: Exception) -> JSONResponse:
    assert isinstance(error, HTTPException)
    path = request.scope["path"][:_SHOWN]
    if error.status_code == 404:
        return from_service(problems.NOT_FOUND(f"There is nothing at {path!r}. {address('/docs')} lists all paths."))
    if error.status_code == 405:  # the router's own header lists only the methods of the first route
        routed = routed_methods(request.scope)
        allowed = [method for method in METHODS if method in routed or (method == "HEAD" and "GET" in routed)]
        method = request.method[:_SHOWN]
        return from_service(problems.METHOD_NOT_ALLOWED(path=path, method=method, allowed=", ".join(allowed)))
    return _response(error.status_code, "http-error", str(error.detail), dict(error.headers or {}))


def routed_methods(scope: Scope) -> list[str]:
    """Return the methods that the path of a request has routes for."""
    routes = scope["app"].router.routes
    scopes = {method: {**scope, "method": method} for method in METHODS}
    return [method for method in METHODS if any(route.matches(scopes[method])[0] is Match.FULL for route in routes)]


async def _system_error(request: Request, error: Exception) -> JSONResponse:
    assert isinstance(error, OSError)
    if is_full(error):
        return from_service(problems.NO_SPACE())
    if error.errno not in (errno.EMFILE, errno.ENFILE):
        raise error
    detail = "The service has reached its limit of open files. Try again later."
    return from_service(problems.TOO_MANY_CONNECTIONS(detail))


async def _unexpected(request: Request, error: Exception) -> JSONResponse:
    scope, request_id = request.scope, request.scope["request_id"]
    extra = {"request_id": request_id}
    _log.exception("%s %s failed unexpectedly", request.method, logged_path(scope), exc_info=error, extra=extra)
    return from_service(problems.INTERNAL(request_id=request_id))


def route_of(scope: Scope) -> str:
    """Return the path of the route that answers a request, with the names of its parameters."""
    return getattr(scope.get("route"), "path", "(none)")


def logged_path(scope: Scope) -> str:
    """Return the path of a request for the log; that of its route if the path contains a secret token."""
    path = path_of(scope)
    return route_of(scope) if path.startswith(_SHARED) else path
