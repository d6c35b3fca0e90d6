"""Contents of the service's responses, for users of the clients: jobs, events and errors."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import httpx2

from service.states import ENDED
from sgsst_core.errors import InvalidInputError, SgsstError

#: Statuses of temporary failures: locked by another request, damaged in transit, overloaded, starting.
_TEMPORARY = (423, 460, 502, 503, 504)


class ApiError(SgsstError):
    """A request that the service refused, or a service that cannot be reached.

    Attributes:
        status: HTTP status; 0 if there was no response.
        problem: Problem document; empty if there is none.
    """

    code = "api-error"

    def __init__(self, message: str, status: int = 0, problem: Mapping[str, Any] | None = None) -> None:
        super().__init__(message)
        self.status = status
        self.problem = dict(problem or {})


class RequestError(ApiError, InvalidInputError):
    """Request that the service refused because of its files, parameters, key or id."""

    code = "api-request"


@dataclass(frozen=True)
class Job:
    """State of a job as the service last sent it; `data` is the complete JSON response."""

    id: str
    status: str
    progress: Mapping[str, Any] | None
    error: Mapping[str, Any] | None
    data: Mapping[str, Any]

    @property
    def finished(self) -> bool:
        """Whether the job has ended."""
        return self.status in ENDED

    @staticmethod
    def of(data: Mapping[str, Any]) -> Job:
        """Return the job from the service's JSON."""
        return Job(data["id"], data["status"], data.get("progress"), data.get("error"), data)


@dataclass(frozen=True)
class Event:
    """Event of a job: `status`, `progress` or `artifact`."""

    id: int
    kind: str
    data: Mapping[str, Any]

    @staticmethod
    def of(event: httpx2.ServerSentEvent) -> Event:
        """Return the event from the service's stream."""
        return Event(int(event.id or 0), event.event, json.loads(event.data))


def checked(response: httpx2.Response) -> httpx2.Response:
    """Return the response if it is not an error. Its body must have been read.

    Raises:
        RequestError: If the service refused the request as faulty.
        ApiError: If the service failed, or another program answered.
    """
    if response.status_code < 400:
        _check_origin(response)
        return response
    try:
        problem = response.json()
        message = str(problem["detail"])
    except (ValueError, KeyError, TypeError):
        problem, message = {}, f"{response.request.url} answered {response.status_code}"
    raise refusal(message, response.status_code, problem)


def _check_origin(response: httpx2.Response) -> None:
    """Raise an ApiError if a successful response is not the service's, whose responses are JSON or empty."""
    kind = response.headers.get("content-type", "no type")
    if response.has_redirect_location:
        what = f"it redirects to {response.headers['location']}"
    elif response.content and not kind.startswith("application/json"):
        what = f"it sends {kind}"
    else:
        return
    url = response.request.url
    raise ApiError(f"{url} does not answer like the service: {what}. Check the address.", response.status_code)


def refusal(message: str, status: int, problem: Mapping[str, Any]) -> ApiError:
    """Return the error for a refused request: RequestError if the request is at fault, ApiError if the service is."""
    return (RequestError if status < 500 else ApiError)(message, status, problem)


def is_temporary(error: Exception) -> bool:
    """Return whether the same request may succeed later: there was no response, or it reports a temporary failure."""
    return isinstance(error, httpx2.TransportError) or (isinstance(error, ApiError) and error.status in _TEMPORARY)
