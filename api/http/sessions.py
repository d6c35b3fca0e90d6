"""`/v1/session`: a browser sends an API key once, and gets a cookie."""

from __future__ import annotations

import asyncio
from typing import Annotated

from fastapi import APIRouter, Depends, Request, Response

from api.http.context import SESSION_COOKIE, Context, ContextDep, check_origin
from api.http.problems import headers, raises
from api.http.receiving import json_body
from api.http.schemas import SessionView, SignIn, subpath
from service import problems
from service.problems import ServiceError

#: Number of failed attempts from one address until it has one in so many seconds. They are not stored in the database:
#: keys of 256 bits cannot be guessed anyway, and attackers could fill it with rows.
MOST_FAILURES, SECONDS_A_TRY = 10, 60.0

router = APIRouter(prefix="/v1/session", tags=["session"])


@raises(problems.CROSS_ORIGIN)
async def check_page(request: Request) -> None:
    """Raise an error if a request comes from a page of another origin."""
    check_origin(request, required=False)


@router.post(
    "",
    dependencies=[Depends(check_page)],
    status_code=204,
    response_class=Response,
    responses={
        204: {"description": "Signed in; the cookie is the session.", "headers": headers("Set-Cookie", "Cache-Control")}
    },
)
async def sign_in(
    request: Request, context: ContextDep, sign_in: Annotated[SignIn, Depends(json_body(SignIn))]
) -> Response:
    """Sign in: exchange an API key for a session cookie.

    The cookie is HttpOnly, and browsers send it only from pages of this site. A session ends after some days
    (`SGSST_SESSION_DAYS`), with `DELETE`, or when its key is revoked.
    """
    address = request.client.host if request.client else ""
    try:  # counted as failed until the outcome is known, so that parallel attempts cannot pass the limit
        context.sign_ins.take(address, 1 / SECONDS_A_TRY, MOST_FAILURES)
    except ServiceError as error:
        raise problems.TOO_MANY_TRIES(retry_after=error.retry_after) from None
    try:
        key = await asyncio.to_thread(context.store.keys.find, sign_in.key)
    except ServiceError:
        context.sign_ins.give_back(address)
        raise
    if key is None:
        raise problems.UNKNOWN_KEY()
    context.sign_ins.give_back(address)
    await _end(request, context)
    text = await asyncio.to_thread(context.store.sessions.create, key.id)
    return _cookie_answer(request, text, int(context.store.sessions.seconds))


@router.get("", response_model=SessionView)
async def get_session(request: Request, context: ContextDep, response: Response) -> SessionView:
    """Get whether a key is required, and whether this browser has a session."""
    response.headers["Cache-Control"] = "no-store"
    cookie = request.cookies.get(SESSION_COOKIE)
    key = await asyncio.to_thread(context.store.sessions.find, cookie) if cookie else None
    within = await asyncio.to_thread(lambda: context.usual_budget)
    if key is not None or not context.settings.keys_required:
        await context.inspector.processes.warm()  # whoever opens the page may create a job soon
    return SessionView(keys_needed=context.settings.keys_required, signed_in=key is not None, within=within)


@router.delete(
    "",
    status_code=204,
    response_class=Response,
    responses={204: {"description": "The session has ended.", "headers": headers("Set-Cookie", "Cache-Control")}},
)
async def sign_out(request: Request, context: ContextDep) -> Response:
    """End the session and delete its cookie. Without a session, nothing happens."""
    check_origin(request, required=SESSION_COOKIE in request.cookies)
    await _end(request, context)
    return _cookie_answer(request, "", 0)


async def _end(request: Request, context: Context) -> None:
    """End the session of the request's cookie, if there is one."""
    cookie = request.cookies.get(SESSION_COOKIE)
    if cookie:
        await asyncio.to_thread(context.store.sessions.end, cookie)


def _cookie_answer(request: Request, text: str, seconds: int) -> Response:
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
