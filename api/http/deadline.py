"""Deadline of every request, whatever it waits for: the database, the file store, the disk, or a turn."""

from __future__ import annotations

import asyncio
import logging

import anyio
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from api.http.problems import from_service, logged_path
from service import problems
from service.deadlines import Deadline

_log = logging.getLogger(__name__)


class Deadlines:
    """Middleware that answers a request without progress with 503, and ends a response that stalls.

    Every block of a body that arrives, and every block of a response that the client has taken, is progress, so long
    transfers have no total limit. The deadline is suspended while the service waits for the client, whose time is
    limited by `api.http.connection`.

    Args:
        seconds: Time without progress.
    """

    def __init__(self, app: ASGIApp, seconds: float) -> None:
        self._app, self._seconds = app, seconds

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Serve a request within its deadline."""
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        await _Exchange(self._app, self._seconds, scope, receive, send).run()


class _Exchange:
    """Request and its response."""

    def __init__(self, app: ASGIApp, seconds: float, scope: Scope, receive: Receive, send: Send) -> None:
        self._app, self._seconds, self._scope = app, seconds, scope
        self._from_client, self._to_client = receive, send
        self._complete = self._started = self._over = False
        self._cancel = anyio.CancelScope()
        self._expired = asyncio.get_running_loop().create_future()

    async def run(self) -> None:
        self._deadline = Deadline(self._seconds, lambda: self._expired.set_result(None))
        serving = asyncio.create_task(self._serve())
        try:
            await asyncio.wait((serving, self._expired), return_when=asyncio.FIRST_COMPLETED)
            if serving.done():
                await serving
            else:
                await self._expire(serving)
        finally:
            self._deadline.close()
            self._cancel.cancel()

    async def _serve(self) -> None:
        with self._cancel:
            await self._app(self._scope, self._receive, self._send)

    async def _expire(self, serving: asyncio.Task[None]) -> None:
        """Give the request up, and answer it if no response has started; otherwise the server closes the connection."""
        self._over = True
        serving.add_done_callback(lambda task: task.cancelled() or task.exception())  # it ends without an audience
        method, path = self._scope["method"], logged_path(self._scope)
        _log.warning("no progress for %g s, request given up: %s %s", self._seconds, method, path)
        if not self._started:
            await from_service(problems.DEADLINE_EXCEEDED(seconds=self._seconds))(
                self._scope, self._from_client, self._to_client
            )

    async def _receive(self) -> Message:
        if self._complete:  # the app waits for the client to leave
            return await self._from_client()
        with self._deadline.suspended():
            message = await self._from_client()
        self._complete = not message.get("more_body", False)
        return message

    async def _send(self, message: Message) -> None:
        if self._over:
            return
        self._started = True
        with self._deadline.suspended():
            await self._to_client(message)
