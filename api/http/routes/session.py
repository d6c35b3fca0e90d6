"""`/v1/session`: a browser sends an API key once, and gets a cookie."""

from __future__ import annotations

import asyncio

from fastapi import APIRouter, Request, Response

from api.http.addresses import subpath
from api.http.context import (
    SESSION_COOKIE,
    Context,
    ContextDep,
    CrossOriginError,
    UnknownKeyError,
    check_origin,
)
from api.http.documentation import headers, invalid, problems
from api.http.multipart import BodyTypeError, NotUtf8Error, TooSlowError, check_media_type, read_json
from api.http.schemas import SessionView, SignIn
from api.http.sign_ins import TooManyTriesError
from service.errors import ServiceError, TooLargeError

router = APIRouter(prefix="/v1/session", tags=["session"])

#: Maximum bytes of a body, which holds only a key.
_MAX_BODY = 4096


@router.post(
    "",
    status_code=204,
    response_class=Response,
    operation_id="sign_in",
    openapi_extra={
        "requestBody": {
            "required": True,
            "content": {"application/json": {"schema": {"$ref": "#/components/schemas/SignIn"}}},
        }
    },
    responses={
        204: {
            "description": "Signed in; the cookie is the session.",
            "headers": headers("Set-Cookie", "Cache-Control"),
        },
        **problems(
            UnknownKeyError,
            CrossOriginError,
            TooManyTriesError,
            invalid("key", "Field required"),
            BodyTypeError("application/json"),
            TooLargeError("The request has more than 4,096 bytes. JSON only names uploads, or a key.", _MAX_BODY),
            NotUtf8Error,
            TooSlowError,
            key=False,
        ),
    },
)
async def sign_in(request: Request, context: ContextDep) -> Response:
    """Sign in: exchange an API key for a session cookie.

    The cookie is HttpOnly, and browsers send it only from pages of this site. A session ends after some days
    (`SGSST_SESSION_DAYS`), with `DELETE`, or when its key is revoked.
    """
    check_origin(request, required=False)
    check_media_type(request, "application/json")
    sign_in = SignIn.model_validate(await read_json(request, context.settings, _MAX_BODY))
    address = request.client.host if request.client else ""
    context.sign_ins.attempt(address)
    try:
        key = await asyncio.to_thread(context.store.keys.find, sign_in.key)
    except ServiceError:
        context.sign_ins.withdraw(address)
        raise
    if key is None:
        raise UnknownKeyError
    context.sign_ins.succeeded(address)
    await _end(request, context)
    text = await asyncio.to_thread(context.store.sessions.create, key.id)
    return _answer(request, text, int(context.store.sessions.seconds))


@router.get("", response_model=SessionView, operation_id="get_session", responses=problems(key=False))
async def get_session(request: Request, context: ContextDep, response: Response) -> SessionView:
    """Get whether a key is required, and whether this browser has a session."""
    response.headers["Cache-Control"] = "no-store"
    cookie = request.cookies.get(SESSION_COOKIE)
    key = await asyncio.to_thread(context.store.sessions.find, cookie) if cookie else None
    return SessionView(keys_needed=context.settings.keys_required, signed_in=key is not None)


@router.delete(
    "",
    status_code=204,
    response_class=Response,
    operation_id="sign_out",
    responses={
        204: {"description": "The session has ended.", "headers": headers("Set-Cookie", "Cache-Control")},
        **problems(CrossOriginError, key=False),
    },
)
async def sign_out(request: Request, context: ContextDep) -> Response:
    """End the session and delete its cookie. Without a session, nothing happens."""
    check_origin(request, required=SESSION_COOKIE in request.cookies)
    await _end(request, context)
    return _answer(request, "", 0)


async def _end(request: Request, context: Context) -> None:
    """End the session of the request's cookie, if there is one."""
    cookie = request.cookies.get(SESSION_COOKIE)
    if cookie:
        await asyncio.to_thread(context.store.sessions.end, cookie)


def _answer(request: Request, text: str, seconds: int) -> Response:
    """Return a response with status 204 that sets the session cookie.

    The scheme comes from `Origin`: behind a proxy that terminates TLS, the request itself arrives over plain HTTP.
    """
    secure = request.url.scheme == "https" or request.headers.get("origin", "").startswith("https://")
    response = Response(status_code=204, headers={"Cache-Control": "no-store"})
    path = subpath.get() or "/"
    response.set_cookie(
        SESSION_COOKIE, text, max_age=seconds, path=path, secure=secure, httponly=True, samesite="strict"
    )
    return response
