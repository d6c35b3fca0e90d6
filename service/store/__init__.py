"""Durable store of jobs, inputs and keys, in SQLite or PostgreSQL with the same code."""

from service.deadlines import until_answered
from service.settings import ServiceSettings
from service.store.database import ANSWER_SECONDS, Clock, Database
from service.store.files import InputRows
from service.store.jobs import Jobs, ShareLinks
from service.store.keys import Keys, Sessions
from service.store.queue import Leases, Operations, RetryPolicy

#: Seconds of a day.
_DAY = 86_400.0


class Store:
    """Complete store on one database; `clock` and `answer_seconds` are passed to `Database`."""

    def __init__(
        self, settings: ServiceSettings, clock: Clock | None = None, answer_seconds: float = ANSWER_SECONDS
    ) -> None:
        self.database = Database(settings.database_url, clock, answer_seconds)
        retention = settings.retention_days * _DAY
        self.jobs = Jobs(self.database, retention)
        policy = RetryPolicy(settings.max_attempts, settings.retry_seconds)
        self.leases = Leases(self.database, settings.lease_seconds, policy, retention)
        self.inputs = InputRows(self.database)
        self.keys = Keys(self.database)
        self.sessions = Sessions(self.database, settings.session_days * _DAY)
        self.shares = ShareLinks(self.database)
        self.operations = Operations(self.database, settings.lease_seconds)

    def close(self) -> None:
        """Close all connections."""
        self.database.close()


def open_store(
    settings: ServiceSettings, clock: Clock | None = None, patience: float = 0.0, answer_seconds: float = ANSWER_SECONDS
) -> Store:
    """Open the store, and create its tables or migrate them to the current version.

    Args:
        patience: Time in seconds to wait for a database server that does not respond, because services may start before
            the server.

    Raises:
        DatabaseUnavailableError: If the database does not respond.
    """
    store = Store(settings, clock, answer_seconds)
    until_answered(store.database.upgrade, 0.0 if store.database.sqlite else patience)
    return store
