"""Common access to SQLite and PostgreSQL: engine, transactions, migrations, and errors that are no bugs."""

import fcntl
import logging
import math
import secrets
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache, partial
from multiprocessing.connection import wait
from pathlib import Path
from typing import Any

from sqlalchemy import Connection, Engine, Table, create_engine, event, text
from sqlalchemy.dialects import postgresql, sqlite
from sqlalchemy.engine import make_url
from sqlalchemy.exc import DBAPIError, DisconnectionError, InterfaceError, NoResultFound, OperationalError
from sqlalchemy.exc import TimeoutError as PoolTimeoutError
from sqlalchemy.orm import Session

from service import problems
from service.problems import DatabaseUnavailableError, ServiceError
from service.store.tables import Base, CounterRow, IdempotencyRow

#: Time in seconds that a transaction waits for a probing transaction before it is rejected.
_PROBE_SECONDS = 0.2
#: Names of SQLite's errors, and classes of PostgreSQL's, for locks and conflicting transactions.
_BUSY = ("SQLITE_BUSY", "SQLITE_LOCKED", "40", "55")
#: The same for errors that concern a statement or its values, so they are bugs of the service. All others are outages,
#: in whatever words: a server that is a standby, shuts down, or has no memory or connections left.
_BUGS = (
    *(f"SQLITE_{each}" for each in ("CONSTRAINT", "ERROR", "MISMATCH", "MISUSE", "RANGE", "TOOBIG")),
    *("21", "22", "23", "42", "44", "54"),
)
#: Names of SQLite's and codes of PostgreSQL's errors for rows that refer to a missing one or exist already.
_CHANGED = (*(f"SQLITE_CONSTRAINT_{each}" for each in ("FOREIGNKEY", "PRIMARYKEY", "UNIQUE")), "23503", "23505")

_COUNTERS = Base.metadata.tables[CounterRow.__tablename__]

_log = logging.getLogger(__name__)


class Gate:
    """Circuit breaker for transactions on a database that does not respond.

    After a transaction failed because of an outage, one transaction at a time probes the database, and all others are
    rejected almost immediately. Otherwise every thread of a process would wait for its own timeout, and none would be
    left for requests that need no database.

    Args:
        seconds: Time in seconds that a transaction waits for the one before it; None if any number may run at once.
    """

    def __init__(self, seconds: float | None = None) -> None:
        self._refusal: DatabaseUnavailableError | None = None
        self._turn, self._seconds = threading.Lock(), seconds

    @contextmanager
    def guarded(self) -> Iterator[None]:
        """Run a transaction.

        Raises:
            DatabaseUnavailableError: If the database does not respond, or an earlier outage continues.
        """
        refusal = self._refusal
        patience = self._seconds if refusal is None else _PROBE_SECONDS
        if patience is not None and not self._turn.acquire(timeout=patience):
            raise problems.DATABASE_BUSY() if refusal is None else refusal.problem()
        failure = None
        try:
            with translated():
                yield
        except DatabaseUnavailableError as error:
            if refusal is None:
                _log.warning("database unavailable: %s", getattr(error.__cause__, "orig", error))  # without the SQL
            failure = error
            raise
        finally:
            self._refusal = failure
            if patience is not None:
                self._turn.release()


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


def _connect(_dialect: Any, _record: Any, arguments: Any, options: Any, *, seconds: float) -> Any:
    """Connect to PostgreSQL with bounded waits.

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

    return ImpatientConnection.connect(*arguments, **options)


def _check_open(connection: Any, record: Any, _proxy: Any) -> None:
    """Have the pool replace a connection that the server has closed.

    An idle server sends nothing but the end of the connection, so no query has to wait for an answer.
    """
    if "used" in record.info and (connection.closed or wait([connection], 0)):  # a new one was open just now
        raise DisconnectionError
    record.info["used"] = True


Clock = Callable[[], float]

#: Version of the newest migration; a database with this version is opened without loading the migrations.
SCHEMA = "0013"
MIGRATIONS = Path(__file__).with_name("migrations")
#: Default timeout in seconds of each wait of a transaction: for the write lock, a connection, and each response.
ANSWER_SECONDS = 30.0
#: Timeout of health checks and of queries of the server's time, on separate connections, in seconds.
_RESERVED_SECONDS = 2.0
#: Connection options for PostgreSQL: an unreachable server is detected within seconds rather than by TCP's own timeout.
#: Nothing is prepared on the server, since pgbouncer may run each transaction on another of its connections.
_POSTGRESQL: dict[str, int | None] = {
    "prepare_threshold": None,
    "connect_timeout": 5,
    "keepalives_idle": 5,
    "keepalives_interval": 2,
    "keepalives_count": 3,
    "tcp_user_timeout": 10_000,
}
#: Minimum lifetime of an Idempotency-Key in seconds; housekeeping deletes it later.
IDEMPOTENCY_SECONDS = 86_400.0
#: Key of the PostgreSQL advisory lock for migrations; other applications are unlikely to use this number.
_LOCK = 7_347_758
#: Interval between queries of the server's time, in seconds.
_CLOCK_SECONDS = 10.0
_SERVER_TIME = text("SELECT extract(epoch FROM clock_timestamp())")
#: Upper bounds of histogram buckets in seconds, from one second to one day.
BUCKETS = (1, 5, 15, 60, 300, 900, 1800, 3600, 7200, 14400, 43200, 86400)


class Database:
    """Transactions on the store's database, and the clock of its times.

    Every transaction raises `DatabaseUnavailableError` if the database is down or locked for too long.

    Args:
        url: SQLAlchemy URL of the database.
        clock: Clock to use; None for the server's clock, or this machine's with SQLite.
        answer_seconds: Timeout in seconds of each wait of a transaction: for the write lock, a connection, and each
            response.
    """

    def __init__(self, url: str, clock: Clock | None = None, answer_seconds: float = ANSWER_SECONDS) -> None:
        self.url = make_url(url)
        self.sqlite = self.url.get_backend_name() == "sqlite"
        self.clock: Clock = clock or (time.time if self.sqlite else self._server_time)
        self._offset, self._asked_at = 0.0, -math.inf
        if self.sqlite and self.url.database:
            Path(self.url.database).parent.mkdir(parents=True, exist_ok=True)
        self.engine = self._make_engine(answer_seconds, pool_size=20, max_overflow=30)
        self._writer = self.engine.execution_options(sgsst_writes=True)
        # PostgreSQL's default gives each statement a snapshot of its own
        one_snapshot = {} if self.sqlite else {"isolation_level": "REPEATABLE READ", "postgresql_readonly": True}
        self._reader = self.engine.execution_options(**one_snapshot)
        # without a transaction, a statement is one round trip to PostgreSQL instead of three
        self._single = self.engine.execution_options(**{} if self.sqlite else {"isolation_level": "AUTOCOMMIT"})
        self._reserved = self._make_engine(_RESERVED_SECONDS, pool_size=2, max_overflow=0)
        # SQLite's writers wait for each other by polling; taking turns avoids that within one process
        self._reads, self._writes = Gate(), Gate(answer_seconds if self.sqlite else None)

    def _make_engine(self, seconds: float | None, **pool: int) -> Engine:
        """Return an engine with this timeout for transactions in seconds; None for no limit (SQLite always has one)."""
        bound = ANSWER_SECONDS if seconds is None else seconds
        options: dict[str, Any] = {**pool, "pool_use_lifo": True, "pool_timeout": bound}
        if self.sqlite:
            options["connect_args"] = {"timeout": bound, "check_same_thread": False}
        else:
            options["connect_args"] = _POSTGRESQL
        engine = create_engine(self.url, **options)
        if self.sqlite:
            event.listen(engine, "connect", partial(_set_pragmas, busy_seconds=bound))
            event.listen(engine, "begin", _begin)
        else:
            event.listen(engine, "checkout", _check_open)
            if seconds is not None:
                event.listen(engine, "do_connect", partial(_connect, seconds=seconds))
        return engine

    @contextmanager
    def writing(self) -> Iterator[Session]:
        """Provide a transaction that is committed at the end of the block; on SQLite it is the only writer."""
        with (
            self._writes.guarded(),
            Session(self._writer, expire_on_commit=False) as session,
            session.begin(),
        ):
            yield session

    @contextmanager
    def reading(self) -> Iterator[Session]:
        """Provide a transaction that sees one snapshot of the database and never waits for a writer."""
        with self._reads.guarded(), Session(self._reader, expire_on_commit=False) as session:
            yield session

    @contextmanager
    def reading_rows(self, *, one_snapshot: bool = False) -> Iterator[Connection]:
        """Provide a connection for reading, without the ORM, that never waits for a writer.

        This takes a third of the time, which matters for queries that run hundreds of times per second.

        Args:
            one_snapshot: Whether all statements see one snapshot; otherwise, each may see its own.
        """
        with self._reads.guarded(), (self._reader if one_snapshot else self._single).connect() as connection:
            yield connection

    @contextmanager
    def reserved_connection(self) -> Iterator[Connection]:
        """Provide one of two reserved connections, as `reading_rows` does but with a shorter timeout."""
        with translated(), self._reserved.connect() as connection:
            yield connection

    def _server_time(self) -> float:
        """Return the server's time, from the monotonic clock and an offset that is measured every few seconds.

        It is never ahead of the server's, and behind by at most the duration of a query.
        """
        now = time.monotonic()
        if now - self._asked_at > _CLOCK_SECONDS:
            with self.reserved_connection() as connection:
                server = float(connection.execute(_SERVER_TIME).scalar_one())
            self._offset, self._asked_at = server - time.monotonic(), now
        return self._offset + time.monotonic()

    def upgrade(self) -> None:
        """Migrate the tables to this version; if several processes start at once, only one does it.

        Tables of a later version are used as they are. Later migrations only add to the schema, so processes of this
        version keep working, and can be restarted, while they are replaced one by one.
        """
        if self.is_up_to_date():
            return
        engine = self._make_engine(None)  # creating an index may take long
        try:
            with translated(), self._upgrading(engine):
                if not self.is_up_to_date():
                    self._migrate(engine)
        finally:
            engine.dispose()

    def is_up_to_date(self) -> bool:
        """Return whether the tables have this version or a later one."""
        return (self._version() or "") >= SCHEMA  # versions have four digits and sort in the order of the migrations

    def close(self) -> None:
        """Close all connections."""
        self.engine.dispose()
        self._reserved.dispose()

    def _version(self) -> str | None:
        try:
            with self.reading() as session:
                return session.execute(text("SELECT version_num FROM alembic_version")).scalar()
        except DBAPIError:  # a new database
            return None

    def _migrate(self, engine: Engine) -> None:
        """Create the tables of this version in a new database; otherwise migrate those of an earlier version."""
        from alembic import command
        from alembic.config import Config

        config = Config()
        config.set_main_option("script_location", str(MIGRATIONS))
        config.attributes["engine"] = engine
        if self._version() is None:
            Base.metadata.create_all(engine.execution_options(sgsst_writes=True))
            command.stamp(config, "head")
        else:
            command.upgrade(config, "head")

    @contextmanager
    def _upgrading(self, engine: Engine) -> Iterator[None]:
        if self.sqlite:
            with Path(str(self.url.database)).with_suffix(".lock").open("w") as file:
                fcntl.flock(file, fcntl.LOCK_EX)
                yield
        else:
            with engine.begin() as connection:
                connection.execute(text("SELECT pg_advisory_xact_lock(:lock)"), {"lock": _LOCK})
                yield


def _set_pragmas(connection: Any, _record: Any, *, busy_seconds: float) -> None:
    connection.isolation_level = None  # otherwise the driver starts transactions itself, and too late
    cursor = connection.cursor()
    for pragma in (
        "journal_mode=WAL",
        "synchronous=FULL",
        "foreign_keys=ON",
        "cache_size=-512",  # kB of each connection; the system caches the file for all of them
        f"busy_timeout={busy_seconds * 1000:.0f}",
    ):
        cursor.execute(f"PRAGMA {pragma}")
    cursor.close()


def _begin(connection: Connection) -> None:
    """Start a transaction.

    On SQLite, a transaction that reads first and writes later could fail halfway. Writers therefore take the lock at
    once.
    """
    writes = connection.get_execution_options().get("sgsst_writes")
    if writes:
        connection.exec_driver_sql("BEGIN IMMEDIATE")
    else:  # never waits, so it has no errors that SQLAlchemy would have to translate
        connection.connection.cursor().execute("BEGIN")


def new_id(prefix: str, now: float) -> str:
    """Return an id that sorts by time and cannot be guessed: milliseconds, then 80 random bits."""
    return f"{prefix}_{int(now * 1000):011x}{secrets.token_hex(10)}"


def idempotency_row(session: Session, owner: str, key: str, fingerprint: str, now: float) -> IdempotencyRow:
    """Return the row of an Idempotency-Key; its `created_id` is set if the key was already used for the same request.

    Raises:
        IDEMPOTENCY_KEY_REUSED: If the key was used for a different request.
    """
    # on both kinds of databases, the second of two concurrent requests waits here for the first
    insert = upsert(session)(IdempotencyRow).values(
        owner=owner, key=key, fingerprint=fingerprint, created_id="", created_at=now
    )
    session.execute(insert.on_conflict_do_nothing())
    row = session.get_one(IdempotencyRow, (owner, key), with_for_update=True)
    if row.fingerprint != fingerprint:
        raise problems.IDEMPOTENCY_KEY_REUSED()
    return row


def count(session: Session, name: str, labels: str = "", amount: float = 1.0) -> None:
    """Add to a counter within the caller's transaction."""
    adding = addition(_COUNTERS, ("name", "labels"), session.get_bind().dialect.name)
    session.execute(adding, {"name": name, "labels": labels, "value": amount})


def observe(session: Session, name: str, seconds: float) -> None:
    """Add a value to a histogram within the caller's transaction: to its sum, its count, and the value's bucket.

    Buckets are counters `NAME_bucket` with the label `le`. Unlike in Prometheus they are not cumulative; the exporter
    adds them up.
    """
    count(session, f"{name}_sum", amount=seconds)
    count(session, f"{name}_count")
    bound = next((bound for bound in BUCKETS if seconds <= bound), None)
    if bound is not None:  # values above all bounds are in the count only
        count(session, f"{name}_bucket", f'le="{bound}"')


@cache
def addition(table: Table, keys: tuple[str, ...], dialect: str) -> Any:
    """Return the statement that adds to all other columns of the row with these keys, which it inserts if needed.

    It is built once, because building it takes longer than running it.
    """
    insert = _INSERTS[dialect](table)
    added = {each.name: each + insert.excluded[each.name] for each in table.c if each.name not in keys}
    return insert.on_conflict_do_update(index_elements=keys, set_=added)


def upsert(session: Session) -> Any:
    """Return the `insert` construct with ON CONFLICT for the session's database."""
    return _INSERTS[session.get_bind().dialect.name]


_INSERTS: dict[str, Any] = {"sqlite": sqlite.insert, "postgresql": postgresql.insert}
