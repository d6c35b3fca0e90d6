"""State of one watcher of a job's events: its position, and the waits after lost connections. It does no I/O itself."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import httpx
from httpx_sse import ServerSentEvent

from api.client.answers import Event, checked

#: Seconds of silence after which a stream is considered dead; the service sends something every 15 s.
_SILENCE_SECONDS = 60.0
#: Seconds to wait before reconnecting. The wait doubles with each further connection that breaks without an event.
FIRST_WAIT = 1.0


class EventStream:
    """Position of a watcher in the events of a job.

    Attributes:
        path: Path of the stream on the service.
        failures: Number of successive connections that broke without an event.
        over: Whether the job has ended and all its events were received.
    """

    def __init__(self, job_id: str, after: int) -> None:
        self.path = f"/v1/jobs/{job_id}/events"
        self.failures = 0
        self.over = False
        self._after = after

    def options(self) -> dict[str, Any]:
        """Return the options of the request, which resume after the last event."""
        headers = {"Last-Event-ID": str(self._after)} if self._after else {}
        return {"headers": headers, "timeout": httpx.Timeout(30.0, read=_SILENCE_SECONDS)}

    def refuse(self, response: httpx.Response) -> None:
        """Handle a response without events, which ends the watch.

        Raises:
            RequestError, ApiError: If the response is an error.
        """
        checked(response)
        self.over = True

    def take(self, sent: ServerSentEvent) -> Iterator[Event]:
        """Yield the event of a server-sent message. Messages without data only keep the connection alive."""
        if sent.data:
            event = Event.of(sent)
            self._after, self.failures = event.id, 0
            yield event

    def broken(self) -> float:
        """Count a broken connection, and return the seconds to wait before reconnecting."""
        self.failures += 1
        return FIRST_WAIT * 2.0 ** (self.failures - 1)
