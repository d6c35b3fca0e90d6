"""What happens while the database is away or locked: waits are bounded, and callers get `DatabaseUnavailableError`."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from sqlalchemy.exc import DBAPIError, InterfaceError, OperationalError
from sqlalchemy.exc import TimeoutError as PoolTimeoutError

from service.errors import DatabaseBusyError, DatabaseUnavailableError

#: Seconds after which a client is told to try again.
_RETRY_SECONDS = 5
#: Seconds that a transaction waits for the answer to another one before it is refused.
_PROBE_SECONDS = 0.2
#: SQLite's errors of a lock that others hold, and of a file that cannot be used; others are mistakes of the service.
_SQLITE_BUSY = ("SQLITE_BUSY", "SQLITE_LOCKED")
_SQLITE_AWAY = ("SQLITE_CANTOPEN", "SQLITE_FULL", "SQLITE_IOERR", "SQLITE_READONLY")
#: Classes of PostgreSQL's errors of transactions that got into each other's way.
_POSTGRESQL_BUSY = ("40", "55")


class Gate:
    """Keeps transactions off a database that did not answer the last one.

    After an outage one transaction at a time tries the database, and the others are refused at once. Without this every
    thread of a process would wait for its own timeout, and nothing would be left for requests that need no database.
    """

    def __init__(self) -> None:
        self._refusal: DatabaseUnavailableError | None = None
        self._probe = threading.Lock()

    @contextmanager
    def guarded(self) -> Iterator[None]:
        """Run a transaction.

        Raises:
            DatabaseUnavailableError: The database did not answer, or has not answered since it did not.
        """
        refusal = self._refusal
        if refusal is not None and not self._probe.acquire(timeout=_PROBE_SECONDS):
            raise type(refusal)(str(refusal), **refusal.extra)
        try:
            with translated():
                yield
        except DatabaseUnavailableError as error:
            self._refusal = error
            raise
        except BaseException:
            self._refusal = None
            raise
        else:
            self._refusal = None
        finally:
            if refusal is not None:
                self._probe.release()


@contextmanager
def translated() -> Iterator[None]:
    """Turn errors of an outage into `DatabaseUnavailableError`; mistakes of the service stay what they are."""
    try:
        yield
    except PoolTimeoutError as error:
        raise busy() from error
    except DBAPIError as error:
        found = _refusal(error)
        if found is None:
            raise
        raise found from error


def busy() -> DatabaseBusyError:
    """Return the error of a wait that took too long."""
    return DatabaseBusyError("The service's database is busy. Try again later.", retry_after=_RETRY_SECONDS)


def _refusal(error: DBAPIError) -> DatabaseUnavailableError | None:
    """Return what a driver's error means to callers; None if the service itself made a mistake."""
    sqlite: str | None = getattr(error.orig, "sqlite_errorname", None)
    sqlstate: str = getattr(error.orig, "sqlstate", None) or ""
    if (sqlite or "").startswith(_SQLITE_BUSY) or sqlstate.startswith(_POSTGRESQL_BUSY):
        return busy()
    away = isinstance(error, OperationalError | InterfaceError) if sqlite is None else sqlite.startswith(_SQLITE_AWAY)
    if not away and not error.connection_invalidated:
        return None
    return DatabaseUnavailableError(
        "The service's database does not answer. Try again later.", retry_after=_RETRY_SECONDS
    )


def impatient_connection(seconds: float) -> Any:
    """Return psycopg's connection class, with a bound on each wait for the server.

    A server that is stopped, or a machine that is frozen, still acknowledges packets: no timeout of TCP notices it.
    """
    import psycopg

    class ImpatientConnection(psycopg.Connection[Any]):
        """Connection that is closed if the server takes too long to answer."""

        def wait(self, gen: Any, *args: Any, **options: Any) -> Any:
            """Wait for the server as long as allowed."""
            try:
                return super().wait(gen, *args, **{"timeout": seconds, **options})
            except psycopg.OperationalError:
                if self.pgconn.transaction_status == psycopg.pq.TransactionStatus.ACTIVE:
                    self.pgconn.finish()  # the answer may still come, and would be taken for that of another query
                raise

    return ImpatientConnection
