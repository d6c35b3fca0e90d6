"""One way to SQLite and PostgreSQL: engine, transactions, migrations."""

from __future__ import annotations

import fcntl
import secrets
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache, partial
from pathlib import Path
from typing import Any

from sqlalchemy import Connection, Engine, create_engine, event, text
from sqlalchemy.dialects import postgresql, sqlite
from sqlalchemy.engine import make_url
from sqlalchemy.exc import DBAPIError
from sqlalchemy.orm import Session

from service.errors import IdempotencyError
from service.store.clocks import Clock, ServerClock, expiry_time
from service.store.outages import Gate, busy, impatient_connection, translated
from service.store.rollback import NEWEST_EVENT, Marker
from service.store.tables import Base, CounterRow, IdempotencyRow

#: The newest migration; a database that says so needs no look at the migrations themselves.
SCHEMA = "0006"
MIGRATIONS = Path(__file__).with_name("migrations")
#: Seconds that a transaction waits by default: for its turn, for a connection, for each answer. All are short.
ANSWER_SECONDS = 30.0
#: Seconds that health checks wait, and those who ask the server for its time: on connections of their own.
_ASIDE_SECONDS = 2.0
#: Of PostgreSQL's connections: a server that is cut off is noticed within some seconds, and not when TCP gives up.
_LOST_AFTER = {
    "connect_timeout": 5,
    "keepalives_idle": 5,
    "keepalives_interval": 2,
    "keepalives_count": 3,
    "tcp_user_timeout": 10_000,
}
#: Seconds that an Idempotency-Key is remembered at least: housekeeping forgets it.
IDEMPOTENCY_SECONDS = 86_400.0
#: Number of an advisory lock that nothing else in a PostgreSQL database is likely to use.
_LOCK = 7_347_758
_SERVER_TIME = text("SELECT extract(epoch FROM clock_timestamp())")
#: Upper bounds of a histogram's buckets, seconds: from a click to a day.
BUCKETS = (1, 5, 15, 60, 300, 900, 1800, 3600, 7200, 14400, 43200, 86400)


class Database:
    """Transactions on the store's database, and the clock that its times come from.

    Every transaction raises `DatabaseUnavailableError` if the database is away, or locked for too long.

    Args:
        url: URL of the database, as SQLAlchemy has it.
        clock: Clock to use; None for the server's, or this machine's for SQLite.
        answer_seconds: Seconds that a transaction waits for its turn, for a connection, and for each answer.
    """

    def __init__(self, url: str, clock: Clock | None = None, answer_seconds: float = ANSWER_SECONDS) -> None:
        self.url = make_url(url)
        self.sqlite = self.url.get_backend_name() == "sqlite"
        self.clock: Clock = clock or (time.time if self.sqlite else ServerClock(self._server_time))
        if self.sqlite and self.url.database:
            Path(self.url.database).parent.mkdir(parents=True, exist_ok=True)
        self._answer_seconds = answer_seconds
        self.engine = self._make_engine(answer_seconds, pool_size=20, max_overflow=30)
        self._writer = self.engine.execution_options(sgsst_writes=True)
        self._marker = Marker(Path(self.url.database)) if self.sqlite and self.url.database else None
        self._aside = self._make_engine(_ASIDE_SECONDS, pool_size=2, max_overflow=0)
        # SQLite's writers wait by sleeping and asking again; those of one process need not
        self._turn = threading.Lock() if self.sqlite else None
        self._reads, self._writes = Gate(), Gate()

    def _make_engine(self, seconds: float | None, **pool: int) -> Engine:
        """Return an engine whose transactions wait for so many seconds; None for no bound (SQLite always has one)."""
        bound = ANSWER_SECONDS if seconds is None else seconds
        options: dict[str, Any] = {**pool, "pool_use_lifo": True, "pool_timeout": bound}
        if self.sqlite:
            options["connect_args"] = {"timeout": bound, "check_same_thread": False}
        else:
            options |= {"pool_pre_ping": True, "connect_args": _LOST_AFTER}
        engine = create_engine(self.url, **options)
        if self.sqlite:
            event.listen(engine, "connect", partial(_set_pragmas, busy_seconds=bound))
            event.listen(engine, "begin", _begin)
        elif seconds is not None:
            event.listen(engine, "do_connect", partial(_connect, seconds=seconds))
        return engine

    @contextmanager
    def writing(self) -> Iterator[Session]:
        """A transaction that is committed at the end of the block; on SQLite it is the only writer from the start."""
        with (
            self._writes.guarded(),
            self._taking_turns(),
            Session(self._writer, expire_on_commit=False) as session,
            session.begin(),
        ):
            yield session
            newest = session.scalar(NEWEST_EVENT) if self._marker is not None else None
        if self._marker is not None and newest is not None:
            self._marker.reach(newest)

    @contextmanager
    def _taking_turns(self) -> Iterator[None]:
        """Be the only writer of this process on SQLite."""
        if self._turn is None:
            yield
            return
        if not self._turn.acquire(timeout=self._answer_seconds):
            raise busy()
        try:
            yield
        finally:
            self._turn.release()

    @contextmanager
    def reading(self) -> Iterator[Session]:
        """A transaction that sees one state of the database, and never waits for a writer."""
        with self._reads.guarded(), Session(self.engine, expire_on_commit=False) as session:
            yield session

    @contextmanager
    def reading_rows(self) -> Iterator[Connection]:
        """As `reading`, for plain rows: a third of the work, for what is asked hundreds of times a second."""
        with self._reads.guarded(), self.engine.connect() as connection:
            yield connection

    @contextmanager
    def aside(self) -> Iterator[Connection]:
        """As `reading_rows`, on one of two connections that are kept for this, and with a shorter wait."""
        with translated(), self._aside.connect() as connection:
            yield connection

    def expiry(self) -> float:
        """Return the time by which things expire (`service.store.clocks`): never ahead of the clock."""
        now = self.clock()
        with self.reading_rows() as connection:
            return expiry_time(connection, now)

    def _server_time(self) -> float:
        with self.aside() as connection:
            return float(connection.execute(_SERVER_TIME).scalar_one())

    def upgrade(self) -> None:
        """Bring the tables to this version; of several processes that start at once one does it.

        Tables of a later version are used as they are: its migrations only add, so that this version's processes go on,
        and start, while they are replaced one by one.
        """
        if self.is_up_to_date():
            return
        engine = self._make_engine(None)  # an index may take its time
        try:
            with translated(), self._upgrading(engine):
                if not self.is_up_to_date():
                    _migrate(engine)
        finally:
            engine.dispose()

    def look_back(self) -> None:
        """Find out whether an SQLite database has gone back in time; `rolled_back` says so from then on."""
        if self._marker is not None:
            with self._upgrading(self.engine):
                marked = self._marker.read()
                with self.reading() as session:
                    newest = session.scalar(NEWEST_EVENT)
                self._marker.compare(marked, newest or 0)

    @property
    def rolled_back(self) -> bool:
        """Whether there may be files that this database should know and does not."""
        return self._marker is not None and self._marker.note.exists()

    def is_up_to_date(self) -> bool:
        """Whether the tables are those of this version, or of a later one."""
        return (self._version() or "") >= SCHEMA  # numbers of four digits, in the order of the migrations

    def close(self) -> None:
        """Close all connections."""
        self.engine.dispose()
        self._aside.dispose()

    def _version(self) -> str | None:
        try:
            with self.reading() as session:
                return session.execute(text("SELECT version_num FROM alembic_version")).scalar()
        except DBAPIError:  # a new database
            return None

    @contextmanager
    def _upgrading(self, engine: Engine) -> Iterator[None]:
        if self.sqlite and self.url.database:
            with Path(self.url.database).with_suffix(".lock").open("w") as file:
                fcntl.flock(file, fcntl.LOCK_EX)
                yield
        elif self.sqlite:
            yield
        else:
            with engine.connect() as connection:
                connection.execute(text("SELECT pg_advisory_lock(:lock)"), {"lock": _LOCK})
                try:
                    yield
                finally:
                    connection.execute(text("SELECT pg_advisory_unlock(:lock)"), {"lock": _LOCK})


def _migrate(engine: Engine) -> None:
    from alembic import command
    from alembic.config import Config

    config = Config()
    config.set_main_option("script_location", str(MIGRATIONS))
    config.attributes["engine"] = engine
    command.upgrade(config, "head")


def _connect(_dialect: Any, _record: Any, arguments: Any, options: Any, *, seconds: float) -> Any:
    """Connect to PostgreSQL."""
    return impatient_connection(seconds).connect(*arguments, **options)


def _set_pragmas(connection: Any, _record: Any, *, busy_seconds: float) -> None:
    connection.isolation_level = None  # else the driver begins transactions by itself, and too late
    cursor = connection.cursor()
    for pragma in (
        "journal_mode=WAL",
        "synchronous=FULL",
        "foreign_keys=ON",
        f"busy_timeout={busy_seconds * 1000:.0f}",
    ):
        cursor.execute(f"PRAGMA {pragma}")
    cursor.close()


def _begin(connection: Connection) -> None:
    """A transaction that reads first and writes later could fail halfway on SQLite: writers take the lock at once."""
    writes = connection.get_execution_options().get("sgsst_writes")
    if writes:
        connection.exec_driver_sql("BEGIN IMMEDIATE")
    else:  # waits for nobody, so that it has no errors which SQLAlchemy would have to name
        connection.connection.cursor().execute("BEGIN")


def new_id(prefix: str, now: float) -> str:
    """An id that sorts by time and cannot be guessed: milliseconds, then 80 random bits."""
    return f"{prefix}_{int(now * 1000):011x}{secrets.token_hex(10)}"


def idempotency_row(session: Session, owner: str, key: str, fingerprint: str, now: float) -> IdempotencyRow:
    """The row of an Idempotency-Key: with a `created_id` where it was used before, for that request.

    Raises:
        IdempotencyError: it was used for another request.
    """
    # of two requests at once, the second waits here for the end of the first, on every database
    insert = upsert(session)(IdempotencyRow).values(
        owner=owner, key=key, fingerprint=fingerprint, created_id="", created_at=now
    )
    session.execute(insert.on_conflict_do_nothing())
    row = session.get_one(IdempotencyRow, (owner, key), with_for_update=True)
    if row.fingerprint != fingerprint:
        raise IdempotencyError("This Idempotency-Key was used for another request. Give each request its own key.")
    return row


def count(session: Session, name: str, labels: str = "", amount: float = 1.0) -> None:
    """Add to a counter, within the transaction of what is counted."""
    statement = _add_statement(session.get_bind().dialect.name)
    session.execute(statement, {"name": name, "labels": labels, "value": amount})


def observe(session: Session, name: str, seconds: float) -> None:
    """Add to a histogram, as `count`: to its sum, its number, and the one bucket that the value lies in.

    Buckets are counters `NAME_bucket` with the label `le`, each without those below it; who shows them adds them up.
    """
    count(session, f"{name}_sum", amount=seconds)
    count(session, f"{name}_count")
    bound = next((bound for bound in BUCKETS if seconds <= bound), None)
    if bound is not None:  # what is longer than all is in the number alone
        count(session, f"{name}_bucket", f'le="{bound}"')


@cache
def _add_statement(dialect: str) -> Any:
    table = Base.metadata.tables[CounterRow.__tablename__]
    insert = (sqlite.insert if dialect == "sqlite" else postgresql.insert)(table)
    added = table.c.value + insert.excluded.value
    return insert.on_conflict_do_update(index_elements=["name", "labels"], set_={"value": added})


def upsert(session: Session) -> Any:
    """The `insert` that knows ON CONFLICT, of the database that the session is on."""
    return sqlite.insert if session.get_bind().dialect.name == "sqlite" else postgresql.insert
