"""Clients of the REST API: `Client` and `AsyncClient` have the same methods."""

from api.client.client import AsyncClient, Client
from api.client.transport import ApiError, Event, Job, RequestError

__all__ = ["ApiError", "AsyncClient", "Client", "Event", "Job", "RequestError"]
