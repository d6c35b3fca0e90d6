"""The durable store: jobs, inputs, keys, in SQLite or PostgreSQL behind the same code."""

from __future__ import annotations

import time

from service.settings import ServiceSettings
from service.store.database import Clock, Database
from service.store.inputs import Inputs
from service.store.jobs import Jobs
from service.store.keys import Keys
from service.store.leases import Leases
from service.store.operations import Operations
from service.store.retention import Retention
from service.store.retries import RetryPolicy
from service.store.sessions import Sessions


class Store:
    """All parts of the store on one database."""

    def __init__(self, settings: ServiceSettings, clock: Clock = time.time) -> None:
        self.database = Database(settings.database_url, clock)
        self.jobs = Jobs(self.database, settings.retention_seconds)
        policy = RetryPolicy(settings.max_attempts, settings.retry_seconds)
        self.leases = Leases(self.database, settings.lease_seconds, policy, settings.retention_seconds)
        self.retention = Retention(self.database, settings.retention_seconds)
        self.inputs = Inputs(self.database)
        self.keys = Keys(self.database)
        self.sessions = Sessions(self.database, settings.session_seconds)
        self.operations = Operations(self.database, settings.lease_seconds)

    def close(self) -> None:
        """Close all connections."""
        self.database.close()


def open_store(settings: ServiceSettings, clock: Clock = time.time) -> Store:
    """The store, with its tables created or brought up to date."""
    store = Store(settings, clock)
    store.database.upgrade()
    return store
