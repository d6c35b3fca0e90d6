"""What the service answers, as its clients see it: jobs, events, and errors."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import httpx
from httpx_sse import ServerSentEvent

from sgsst_core.errors import InvalidInputError, SgsstError

_ENDED = ("succeeded", "failed", "canceled", "expired")
#: Statuses that say "not now": locked by another request, damaged on its way, overloaded, starting.
_PASSING = (423, 460, 502, 503, 504)


class ApiError(SgsstError):
    """The service refused a request, or could not be reached.

    Attributes:
        status: HTTP status; 0 where there was no answer.
        problem: the problem document.
    """

    code = "api-error"

    def __init__(self, message: str, status: int = 0, problem: Mapping[str, Any] | None = None) -> None:
        super().__init__(message)
        self.status = status
        self.problem = dict(problem or {})


class RequestError(ApiError, InvalidInputError):
    """The request is at fault: its files, parameters, key or id."""

    code = "api-request"


@dataclass(frozen=True)
class Job:
    """A job as the service last showed it; `data` is the whole answer."""

    id: str
    status: str
    progress: Mapping[str, Any] | None
    error: Mapping[str, Any] | None
    data: Mapping[str, Any]

    @property
    def finished(self) -> bool:
        """Whether nothing more will happen to it."""
        return self.status in _ENDED

    @staticmethod
    def of(data: Mapping[str, Any]) -> Job:
        """From the service's JSON."""
        return Job(data["id"], data["status"], data.get("progress"), data.get("error"), data)


@dataclass(frozen=True)
class Event:
    """Something that happened to a job: `status`, `progress` or `artifact`."""

    id: int
    kind: str
    data: Mapping[str, Any]

    @staticmethod
    def of(sent: ServerSentEvent) -> Event:
        """From the service's stream."""
        return Event(int(sent.id or 0), sent.event, json.loads(sent.data))


def checked(response: httpx.Response) -> httpx.Response:
    """The response, if it is a good one; its body has been read.

    Raises:
        RequestError, ApiError: the service refused the request.
    """
    if response.status_code < 400:
        return response
    try:
        problem = response.json()
        message = str(problem["detail"])
    except (ValueError, KeyError, TypeError):
        problem, message = {}, f"{response.request.url} answered {response.status_code}"
    raise refusal(message, response.status_code, problem)


def refusal(message: str, status: int, problem: Mapping[str, Any]) -> ApiError:
    """A refused request as an error: its own fault, or the service's."""
    return (RequestError if status < 500 else ApiError)(message, status, problem)


def is_passing(error: Exception) -> bool:
    """Whether the same request may succeed later: nothing was answered, or that it is not possible now."""
    return isinstance(error, httpx.TransportError) or (isinstance(error, ApiError) and error.status in _PASSING)


def unreachable(base: str, error: Exception) -> ApiError:
    """What to say where the service did not answer."""
    return ApiError(f"{base} cannot be reached ({error}). Is `sgsst serve` running? --url names another address.")
