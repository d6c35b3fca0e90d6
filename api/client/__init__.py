"""Clients of the REST API: `Client` and `AsyncClient` have the same methods."""

from api.client.answers import Event, Job
from api.client.async_client import AsyncClient
from api.client.client import Client

__all__ = ["AsyncClient", "Client", "Event", "Job"]
