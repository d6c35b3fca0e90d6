"""HTTP connections that do not wait, nor take in, for ever: uvicorn's own protocol bounds neither time nor size of a
request's head.
"""

from __future__ import annotations

import asyncio
from http import HTTPStatus
from typing import Any

from uvicorn.protocols.http.httptools_impl import HttpToolsProtocol

from api.http.problems import HeadTooLargeError, MalformedRequestError, TooManyConnectionsError, from_service
from service.errors import ServiceError

#: Bytes of a request's line and headers, counted in the pieces in which they come.
MAX_HEAD_BYTES = 1 << 17


class Connection(HttpToolsProtocol):
    """A connection that is closed when a request's head has begun and takes too long, or is too long.

    Attributes:
        head_seconds: from the connection, or a head's first byte, to the head's end.
        most: connections of this process at the same time; a further one is told to come back.
    """

    head_seconds = 60.0
    most = 10_000

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self._in_head, self._head_bytes, self._messages_seen = True, 0, 0
        self._head_timer: asyncio.TimerHandle | None = None

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """The time of the first head begins."""
        super().connection_made(transport)
        if len(self.connections) > self.most:
            error = f"There are {self.most:,} connections already. Try again later."
            self._refuse(TooManyConnectionsError(error, retry_after=5))
            return
        self._start_timer()

    def connection_lost(self, exc: Exception | None) -> None:
        """Nothing is waited for any more."""
        self._stop_timer()
        super().connection_lost(exc)

    def data_received(self, data: bytes) -> None:
        """Take bytes in, as long as a head that they belong to may still grow."""
        seen = self._messages_seen
        super().data_received(data)
        if not self._in_head or self._messages_seen != seen or self.transport.is_closing():
            return  # all or some of it was no part of a head that is still open
        self._head_bytes += len(data)
        if self._head_bytes > MAX_HEAD_BYTES:
            self._refuse(HeadTooLargeError(f"The request's line and headers have more than {MAX_HEAD_BYTES:,} bytes."))
        elif self._head_timer is None:
            self._start_timer()

    def on_headers_complete(self) -> None:
        """The head is whole."""
        self._in_head, self._head_bytes = False, 0
        self._messages_seen += 1
        self._stop_timer()
        super().on_headers_complete()

    def on_message_complete(self) -> None:
        """What comes from now on is the next head."""
        self._in_head = True
        self._messages_seen += 1
        super().on_message_complete()

    def _start_timer(self) -> None:
        self._head_timer = self.loop.call_later(self.head_seconds, self._close_late)

    def _stop_timer(self) -> None:
        if self._head_timer is not None:
            self._head_timer.cancel()
            self._head_timer = None

    def _close_late(self) -> None:
        self._head_timer = None
        if self.cycle is not None and not self.cycle.response_complete:
            self._start_timer()  # an answer is still on its way to the same client
        elif not self.transport.is_closing():
            self.transport.close()

    def send_400_response(self, msg: str) -> None:
        """Say that it is no HTTP, as a problem document: uvicorn's own answer is plain text."""
        self._refuse(MalformedRequestError(f"{msg} Its first line, a header or a chunk is not as HTTP has it."))

    def _refuse(self, error: ServiceError) -> None:
        """Answer below the app, and close; where an answer is on its way already, only close."""
        if self.cycle is None or self.cycle.response_complete or not self.cycle.response_started:
            answer = from_service(error)
            lines = [f"HTTP/1.1 {error.status} {HTTPStatus(error.status).phrase}".encode()]
            lines += [name + b": " + value for name, value in (*answer.raw_headers, (b"connection", b"close"))]
            self.transport.write(b"\r\n".join(lines) + b"\r\n\r\n" + bytes(answer.body))
        self.transport.close()
