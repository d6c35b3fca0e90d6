"""Clients of the REST API: `Client` and `AsyncClient` have the same methods."""

from api.client.answers import Event, Job
from api.client.client import AsyncClient, Client

__all__ = ["AsyncClient", "Client", "Event", "Job"]
