"""Errors of the database that are no bugs: it is away or locked, or another transaction has removed a row."""

from __future__ import annotations

import logging
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from sqlalchemy.exc import InterfaceError, NoResultFound, OperationalError
from sqlalchemy.exc import TimeoutError as PoolTimeoutError

from service import problems
from service.errors import DatabaseUnavailableError, ServiceError

#: Time in seconds that a transaction waits for a probing transaction before it is rejected.
_PROBE_SECONDS = 0.2
#: Names of SQLite's errors, and classes of PostgreSQL's, for locks and conflicting transactions.
_BUSY = ("SQLITE_BUSY", "SQLITE_LOCKED", "40", "55")
#: The same for errors that concern a statement or its values, so they are bugs of the service. All others are outages,
#: in whatever words: a server that is a standby, shuts down, or has no memory or connections left.
_BUGS = (*(f"SQLITE_{each}" for each in ("CONSTRAINT", "ERROR", "MISMATCH", "MISUSE", "RANGE", "TOOBIG")),)
_BUGS += ("21", "22", "23", "42", "44", "54")
#: Names of SQLite's and codes of PostgreSQL's errors for rows that refer to a missing one or exist already.
_CHANGED = (*(f"SQLITE_CONSTRAINT_{each}" for each in ("FOREIGNKEY", "PRIMARYKEY", "UNIQUE")), "23503", "23505")

_log = logging.getLogger(__name__)


class Gate:
    """Circuit breaker for transactions on a database that does not respond.

    After a transaction failed because of an outage, one transaction at a time probes the database, and all others are
    rejected almost immediately. Otherwise every thread of a process would wait for its own timeout, and none would be
    left for requests that need no database.
    """

    def __init__(self) -> None:
        self._refusal: DatabaseUnavailableError | None = None
        self._probe = threading.Lock()

    @contextmanager
    def guarded(self) -> Iterator[None]:
        """Run a transaction.

        Raises:
            DatabaseUnavailableError: If the database does not respond, or an earlier outage continues.
        """
        refusal = self._refusal
        if refusal is not None and not self._probe.acquire(timeout=_PROBE_SECONDS):
            raise refusal.problem()
        try:
            with translated():
                yield
        except DatabaseUnavailableError as error:
            if refusal is None:
                _log.warning("database unavailable: %s", getattr(error.__cause__, "orig", error))  # without the SQL
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
    """Convert errors of an outage, and of rows that another transaction has removed or added; others are unchanged.

    Raises:
        DatabaseUnavailableError: If the database is down or locked.
        ConflictError: If a row that this transaction refers to is gone, or one that it adds is there.
    """
    try:
        yield
    except PoolTimeoutError as error:
        raise problems.DATABASE_BUSY() from error
    except NoResultFound as error:
        raise problems.CHANGED_MEANWHILE() from error
    except Exception as error:  # SQLAlchemy does not wrap all errors of drivers
        refusal = _refusal(error)
        if refusal is None:
            raise
        raise refusal from error


def _refusal(error: Exception) -> ServiceError | None:
    """Convert a driver's error to an exception for callers; return None if the error is a bug of the service."""
    cause = getattr(error, "orig", error)
    code: str = getattr(cause, "sqlite_errorname", None) or getattr(cause, "sqlstate", None) or ""
    if code.startswith(_BUSY):
        return problems.DATABASE_BUSY()
    if code in _CHANGED:
        return problems.CHANGED_MEANWHILE()
    away = not code.startswith(_BUGS) if code else isinstance(error, OperationalError | InterfaceError)
    return problems.DATABASE_UNAVAILABLE() if away or getattr(error, "connection_invalidated", False) else None


def impatient_connection(seconds: float) -> Any:
    """Return a subclass of psycopg's connection that bounds each wait for the server.

    A stopped server or a frozen machine still acknowledges packets, so no TCP timeout detects it.
    """
    import psycopg

    class ImpatientConnection(psycopg.Connection[Any]):
        """Connection that is closed if the server takes too long to respond."""

        def wait(self, gen: Any, *args: Any, **options: Any) -> Any:
            """Wait for the server for at most the timeout."""
            try:
                return super().wait(gen, *args, **{"timeout": seconds, **options})
            except psycopg.OperationalError:
                if self.pgconn.transaction_status == psycopg.pq.TransactionStatus.ACTIVE:
                    self.pgconn.finish()  # a late response would be taken for that of another query
                raise

    return ImpatientConnection
