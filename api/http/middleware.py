"""Middleware around the whole app: the access log, what proxies send, and methods that stand for others."""

from __future__ import annotations

import logging
import secrets
import time
from typing import Any

from starlette.types import ASGIApp, Message, Receive, Scope, Send
from uvicorn.middleware.proxy_headers import ProxyHeadersMiddleware

from api.http.addresses import path_of, subpath
from api.http.problems import METHODS, logged_path, route_of, routed_methods
from service.settings import ServiceSettings, is_subpath

#: Path of the uploads, whose protocol lets a header replace the method, for clients that can only send GET and POST.
_UPLOADS = "/v1/uploads"

_access = logging.getLogger("api.access")


class Observed:
    """Middleware that counts and logs requests by route instead of by path, and gives each an id.

    It is the outermost one, so that it sees every response, those to unexpected errors included. A response that breaks
    off is counted again with status 500.
    """

    def __init__(self, app: ASGIApp, state: Any) -> None:
        self._app, self._state = app, state

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Serve a request; record its status and the time until its response starts."""
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        started, request_id = time.perf_counter(), secrets.token_hex(8)
        request: Scope = {**scope, "request_id": request_id}  # other middleware changes the copy, not the server's
        status = 0

        def note(new_status: int) -> None:
            nonlocal status
            status = new_status
            self._note(scope["method"], request, status, time.perf_counter() - started)

        async def observed(message: Message) -> None:
            if message["type"] == "http.response.start":
                note(message["status"])
                message = {**message, "headers": [*message["headers"], (b"x-request-id", request_id.encode())]}
            await send(message)

        try:
            await self._app(request, receive, observed)
        except BaseException:
            if status < 500:
                note(500)
            raise

    def _note(self, method: str, request: Scope, status: int, seconds: float) -> None:
        known = method if method in METHODS else "(other)"
        self._state.context.metrics.observe(known, route_of(request), status, seconds)
        extra = {"method": method, "path": logged_path(request), "status": status, "seconds": round(seconds, 4)}
        _access.info("request", extra={**extra, "request_id": request["request_id"]})


class Proxied:
    """Middleware that takes the client's address, the scheme and the subpath of a request from a trusted proxy.

    The proxy may pass the subpath on or strip it. A subpath in the settings replaces the proxy's.
    """

    def __init__(self, app: ASGIApp, settings: ServiceSettings) -> None:
        self._subpath = settings.root_path
        self._app = ProxyHeadersMiddleware(app, settings.trusted_proxies)  # type: ignore[arg-type]

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Serve a request."""
        if scope["type"] == "http":
            root = self._subpath or self._forwarded(scope)
            subpath.set(root)
            scope["root_path"] = root
            if not f"{scope['path']}/".startswith(f"{root}/"):
                scope["path"] = root + scope["path"]
        await self._app(scope, receive, send)  # type: ignore[arg-type]

    def _forwarded(self, scope: Scope) -> str:
        """Return the `X-Forwarded-Prefix` of a trusted proxy; an empty string for none."""
        client = scope.get("client")
        if not client or client[0] not in self._app.trusted_hosts:
            return ""
        prefix = _header(scope, b"x-forwarded-prefix").rstrip("/")
        return prefix if is_subpath(prefix) else ""


class Methods:
    """Middleware that chooses the method by which the routes answer a request.

    HEAD is answered wherever GET is: with the same headers, and without the body.
    """

    def __init__(self, app: ASGIApp) -> None:
        self._app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Serve a request."""
        if scope["type"] == "http":
            if f"{path_of(scope)}/".startswith(f"{_UPLOADS}/"):
                scope["method"] = _header(scope, b"x-http-method-override") or scope["method"]
            if scope["method"] == "HEAD" and "GET" in (routed := routed_methods(scope)) and "HEAD" not in routed:
                scope["method"], send = "GET", _head_of(send)
        await self._app(scope, receive, send)


def _head_of(send: Send) -> Send:
    """Return a function that sends the head of a response, and ends the response there."""

    async def send_head(message: Message) -> None:
        if message["type"] == "http.response.start":
            await send(message)
            await send({"type": "http.response.body"})

    return send_head


def _header(scope: Scope, name: bytes) -> str:
    """Return a header of a request; an empty string if it is missing."""
    values: list[bytes] = [value for key, value in scope["headers"] if key == name]
    return values[0].decode("latin-1").strip() if values else ""
