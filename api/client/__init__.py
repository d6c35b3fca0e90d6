"""Clients of the REST API: `Client` and `AsyncClient` have the same methods."""

from api.client.client import AsyncClient, Client
from api.client.transport import Event, Job

__all__ = ["AsyncClient", "Client", "Event", "Job"]
