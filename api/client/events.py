"""The events of one job: where its watcher is, and what becomes of a stream that broke. Connects to nothing itself."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import httpx
from httpx_sse import ServerSentEvent

from api.client.answers import Event, checked

#: A stream that is silent for longer is dead: the service sends something every 15 s.
_SILENCE_SECONDS = 60.0
#: Before the second connection, where the first one broke without an event; each further wait is twice as long.
FIRST_WAIT = 1.0


class EventStream:
    """A watcher's place in the events of a job.

    Attributes:
        path: of the stream on the service.
        failures: connections that broke in a row without an event.
        over: the service has nothing more to tell, and never will.
    """

    def __init__(self, job_id: str, after: int) -> None:
        self.path = f"/v1/jobs/{job_id}/events"
        self.failures = 0
        self.over = False
        self._after = after

    def options(self) -> dict[str, Any]:
        """Of the request: where to go on."""
        headers = {"Last-Event-ID": str(self._after)} if self._after else {}
        return {"headers": headers, "timeout": httpx.Timeout(30.0, read=_SILENCE_SECONDS)}

    def refuse(self, response: httpx.Response) -> None:
        """Take an answer without events.

        Raises:
            RequestError, ApiError: it is an error.
        """
        checked(response)
        self.over = True

    def take(self, sent: ServerSentEvent) -> Iterator[Event]:
        """What the service has sent, unless it is no event but a word to the connection."""
        if sent.data:
            event = Event.of(sent)
            self._after, self.failures = event.id, 0
            yield event

    def broken(self) -> float:
        """Note that a connection broke; returns the seconds to wait before the next one."""
        self.failures += 1
        return FIRST_WAIT * 2.0 ** (self.failures - 1)
