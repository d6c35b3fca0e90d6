"""Server process of the API: `python -m api.http.server [--fd N]`, with HTTP connections of bounded time and memory.

uvicorn's own protocol bounds neither.
"""

import asyncio
import contextlib
import contextvars
import logging
import os
import resource
import socket
import struct
import sys
from enum import Enum, auto
from http import HTTPStatus
from typing import Any

import uvicorn
from uvicorn.protocols.http.httptools_impl import HttpToolsProtocol, RequestResponseCycle

from api.http.app import create_app
from api.http.context import SESSION_COOKIE, memory
from api.http.problems import from_service
from service import problems
from service.problems import ServiceError
from service.settings import start

#: Maximum bytes of a request line and headers. The limit is lower while many connections are open; see
#: `api.http.context`.
MAX_HEAD_BYTES = 1 << 17
#: Maximum number of headers: each takes far more memory than its bytes.
MAX_HEADERS = 200
#: Maximum number of pipelined requests that may wait on one connection for the response to an earlier one.
MAX_WAITING = 8


#: Start of the session cookie in a Cookie header.
_SESSION = f"{SESSION_COOKIE}=".encode()


def _session_cookie(cookies: bytes) -> bytes:
    """Return the value of a Cookie header without all cookies but the session's.

    Starlette parses all of them, in quadratic time if they are quoted (CVE-2024-7592; Python before 3.11.10 and 3.12.6)
    and on the event loop.
    """
    pairs = (pair.strip() for pair in cookies.split(b";"))
    return b"; ".join(pair for pair in pairs if pair.startswith(_SESSION) and b'"' not in pair)


class _Response(RequestResponseCycle):
    """Response that ends where its connection was closed: an earlier one of pipelined requests is not told of that."""

    async def send(self, message: Any) -> None:
        """Send a part of the response."""
        self.disconnected = self.disconnected or self.transport.is_closing()
        await super().send(message)


class _Undelimited(_Response):
    """Response to an HTTP/1.0 client, which knows no chunks: without a length, it ends with the connection."""

    has_length = True

    async def send(self, message: Any) -> None:
        """Send a part of the response."""
        if message["type"] == "http.response.start":
            self.has_length = any(name.lower() == b"content-length" for name, _ in message["headers"])
            self.chunked_encoding = None if self.has_length else False
        elif not self.has_length:
            self.expected_content_length = len(message.get("body", b""))
        await super().send(message)


class _Stage(Enum):
    """Part of a request that the next byte of a connection belongs to."""

    BETWEEN = auto()
    HEAD = auto()
    BODY = auto()


class Connection(HttpToolsProtocol):
    """A connection that is closed if its client takes too long or sends too much.

    At most one block of a body is read ahead of the app. Trailers are dropped, and cookies of other services.

    Attributes:
        head_seconds: Time limit in seconds for a head (request line and headers), from the start of the connection or
            the first byte of the head. The same limit applies after a response to the body bytes that the app has not
            read, and to the client's reading of each chunk of a response.
        most: Maximum number of simultaneous connections of this process; further ones get status 503.
    """

    # An object with more than 30 attributes in its `__dict__` takes 2 kB more, and the base class has 28.
    __slots__ = ("_error", "_stage", "_steps", "_timer", "_unread_timer", "_unused_bytes")

    head_seconds = 60.0
    most = 10_000

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self._stage = _Stage.BETWEEN
        self._steps = self._unused_bytes = 0
        self._error: ServiceError | None = None
        self._timer: asyncio.TimerHandle | None = None
        self._unread_timer: asyncio.TimerHandle | None = None

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """Start the timer of the first head."""
        super().connection_made(transport)
        memory.connections += 1
        if len(self.connections) > self.most:
            error = f"There are {self.most:,} connections already. Try again later."
            self._refuse(problems.TOO_MANY_CONNECTIONS(error))
            return
        self._start_timer()

    def connection_lost(self, exc: Exception | None) -> None:
        """Stop the timer, and stop counting the connection."""
        memory.connections -= 1
        self._stop_timer()
        self._stop_unread_timer()
        super().connection_lost(exc)

    def pause_writing(self) -> None:
        """Stop sending until the client has read what was sent; close the connection if it takes too long."""
        super().pause_writing()
        self._unread_timer = self.loop.call_later(self.head_seconds, self._drop_unread)

    def resume_writing(self) -> None:
        """Continue sending."""
        self._stop_unread_timer()
        super().resume_writing()

    def _drop_unread(self) -> None:
        """Close the connection, and drop what the system would otherwise go on sending."""
        self.transport.get_extra_info("socket").setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
        self.transport.abort()

    def _stop_unread_timer(self) -> None:
        if self._unread_timer is not None:
            self._unread_timer.cancel()
            self._unread_timer = None

    def data_received(self, data: bytes | memoryview) -> None:
        """Parse received bytes. Refuse the connection if a head, trailers or chunk extensions are too long."""
        steps = self._steps
        super().data_received(data)  # type: ignore[arg-type]
        if self.transport.is_closing():
            return
        self._unused_bytes = self._unused_bytes + len(data) if self._steps == steps else 0
        if self._unused_bytes > memory.share():
            error = f"The request's line and headers, or its trailers, have more than {memory.share():,} bytes."
            self._refuse(problems.HEAD_TOO_LARGE(error))
        elif self._stage is _Stage.HEAD and self._timer is None:
            self._start_timer()

    def on_message_begin(self) -> None:
        """Start a head."""
        self._stage = _Stage.HEAD
        super().on_message_begin()

    def on_header(self, name: bytes, value: bytes) -> None:
        """Store a header; drop a trailer, and all cookies but the session's."""
        if self._stage is _Stage.BODY:
            return
        if name.lower() == b"cookie":
            value = _session_cookie(value)
        if len(self.headers) == MAX_HEADERS:
            self._abort(problems.HEAD_TOO_LARGE(f"The request has more than {MAX_HEADERS} headers."))
        super().on_header(name, value)

    def on_headers_complete(self) -> None:
        """Check the head and start the request."""
        if sum(name == b"host" for name, _ in self.headers) > 1:
            self._abort(problems.MALFORMED_REQUEST("The request has several Host headers. Send one."))
        if len(self.pipeline) == MAX_WAITING:
            self._abort(
                problems.MALFORMED_REQUEST(f"More than {MAX_WAITING} requests were sent before an answer was read.")
            )
        self._stage = _Stage.BODY
        self._steps += 1
        self._stop_timer()
        super().on_headers_complete()
        self.cycle.__class__ = _Undelimited if self.scope["http_version"] == "1.0" else _Response

    def on_body(self, body: bytes) -> None:
        """Pass a block of a body to the app, and pause reading until the app has taken it."""
        self._steps += 1
        super().on_body(body)
        if not self.cycle.response_complete:
            self.flow.pause_reading()

    def on_message_complete(self) -> None:
        """Finish a request."""
        super().on_message_complete()
        self._stage = _Stage.BETWEEN
        self._steps += 1
        self._forget_answered()

    def on_response_complete(self) -> None:
        """Finish a response, and limit the time for the rest of a body that the app did not read."""
        # An empty context: the timer of the idle connection, or a pipelined request, would keep that of this request.
        contextvars.Context().run(super().on_response_complete)
        self._forget_answered()

    def _forget_answered(self) -> None:
        """Free the memory of a request that has its response, then wait for the rest of it or for the next request."""
        if self.cycle is None or not self.cycle.response_complete or self.transport.is_closing():
            return
        if self._stage is _Stage.BODY:
            self.cycle.body = bytearray()
            self._start_timer()
            return
        self.cycle = None  # type: ignore[assignment]
        if self._stage is _Stage.BETWEEN:
            self.scope = self.headers = None  # type: ignore[assignment]
            if self._timer is not None:  # Replaces the timer of the body, since uvicorn's own has stopped.
                self._start_timer()

    def _start_timer(self) -> None:
        self._stop_timer()
        self._timer = self.loop.call_later(self.head_seconds, self._close_late)

    def _stop_timer(self) -> None:
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None

    def _close_late(self) -> None:
        self._timer = None
        if self.cycle is not None and not self.cycle.response_complete:
            self._start_timer()  # a response is still being sent to the same client
        elif not self.transport.is_closing():
            self.transport.close()

    def _abort(self, error: ServiceError) -> None:
        """Stop the parser; `send_400_response` then sends the error."""
        self._error = error
        raise error

    def send_400_response(self, msg: str) -> None:
        """Respond to malformed HTTP with a problem document; uvicorn's own response is plain text."""
        wrong = problems.MALFORMED_REQUEST(f"{msg} Its first line, a header or a chunk violates HTTP.")
        self._refuse(self._error or wrong)

    def _refuse(self, error: ServiceError) -> None:
        """Close the connection. Send the error first, unless a response to this request has already started."""
        started = self.cycle is not None and self.cycle.response_started
        if not started or (self.cycle.response_complete and self._stage is not _Stage.BODY):
            answer = from_service(error)
            lines = [f"HTTP/1.1 {error.status} {HTTPStatus(error.status).phrase}".encode()]
            lines += [name + b": " + value for name, value in (*answer.raw_headers, (b"connection", b"close"))]
            self.transport.write(b"\r\n".join(lines) + b"\r\n\r\n" + bytes(answer.body))
        self.transport.close()


_piece = memoryview(bytearray(MAX_HEAD_BYTES))
#: Events of a transport that a reader passes to its connection.
_EVENTS = ("connection_made", "connection_lost", "eof_received", "pause_writing", "resume_writing")


class Reader(asyncio.BufferedProtocol):
    """Adapter that reads a connection in blocks within its memory budget; uvloop itself reads 256 kB at once."""

    __slots__ = ("_connection", *_EVENTS)

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        self._connection = Connection(*args, **kwargs)
        for event in _EVENTS:
            setattr(self, event, getattr(self._connection, event))

    def get_buffer(self, sizehint: int) -> memoryview:  # noqa: ARG002
        """Return the buffer for the next block. All connections share it, because each block is parsed immediately."""
        return _piece[: memory.share()]

    def buffer_updated(self, nbytes: int) -> None:
        """Parse the block that was read into the buffer."""
        self._connection.data_received(_piece[:nbytes])


#: Seconds that open requests have to finish at a shutdown.
_GRACE = 10


class _Server(uvicorn.Server):
    """Server that ends event streams before it waits for open requests: their watchers reconnect."""

    async def shutdown(self, sockets: list[socket.socket] | None = None) -> None:
        """Stop serving."""
        await self.config.app.state.context.hub.close()  # type: ignore[union-attr]
        await super().shutdown(sockets)


def main() -> None:
    """Serve until SIGTERM, on a socket inherited from the parent process (`--fd`) or on the configured address."""
    if os.environ.get("SGSST_DIE_WITH_PARENT"):
        from worker.processes import die_with_parent

        die_with_parent()
    settings = start()
    # uvicorn gets a socket object rather than a descriptor. It would take a descriptor for a Unix socket and leave
    # Nagle's algorithm on, so that every response waits 40 ms until the client acknowledges its head.
    listeners = [socket.socket(fileno=int(sys.argv[2]))] if sys.argv[1:2] == ["--fd"] else None
    Connection.head_seconds = settings.receive_seconds
    Connection.most = min(settings.max_connections, _affordable_connections())
    config = uvicorn.Config(
        create_app(settings),
        http=Reader,  # type: ignore[arg-type]  # a BufferedProtocol will do, too
        ws="none",
        host=settings.host,
        port=settings.port,
        log_config=None,
        access_log=False,
        timeout_graceful_shutdown=_GRACE,
        timeout_keep_alive=75,
        server_header=False,
        proxy_headers=False,  # `api.http.app` reads them
    )
    server = _Server(config)
    with contextlib.suppress(KeyboardInterrupt):
        server.run(listeners)
    if not server.started:
        sys.exit("The API could not be started.")
    logging.shutdown()
    os._exit(0)  # threads that wait for a hanging file store would be waited for


def _affordable_connections() -> int:
    """Raise the limit of open files as far as the system allows; return the number of connections it suffices for.

    A quarter of the limit is reserved for files, the database, and connections that are being refused.
    """
    _, most = resource.getrlimit(resource.RLIMIT_NOFILE)
    with contextlib.suppress(ValueError, OSError):  # the limit on macOS is not the one that getrlimit reports
        resource.setrlimit(resource.RLIMIT_NOFILE, (most, most))
    soft, _ = resource.getrlimit(resource.RLIMIT_NOFILE)
    return sys.maxsize if soft == resource.RLIM_INFINITY else max(1, soft - soft // 4)


if __name__ == "__main__":
    main()
