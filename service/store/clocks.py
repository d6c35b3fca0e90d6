"""The time that the store works with: which clock it comes from, and which time things expire by.

On PostgreSQL all processes use the server's clock. SQLite has none: its processes use their machine's. That may be
wrong, and what it deletes is gone. Deletion therefore has a time of its own, the *expiry time*, a number in the
database. It is never ahead of the clock, and a dispatcher moves it toward the clock at most `CATCH_UP` times as fast as
the dispatcher's monotonic clock runs. So a clock that is 31 days ahead has to stay wrong for 31 hours of work before
the first result is deleted too early, and then deletes the oldest and not everything; a machine that was off for 40
days deletes what is due within 40 hours of work; one that works for an hour a day keeps up. A dispatcher whose clock
disagrees with the heartbeats of another one that is alive does not move it and deletes nothing
(`service.scheduling.clock_watch`), since nobody knows which of the two is right. The expiry time never goes back, so
that a clock that was behind for a while delays nothing afterwards.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable

from sqlalchemy import Connection, func, select
from sqlalchemy.orm import Session

from service.store.tables import CounterRow, JobRow

Clock = Callable[[], float]

#: Upper bound of the expiry time's speed, in seconds for each second of a dispatcher's work.
CATCH_UP = 24.0
#: Seconds between two questions for the server's time.
_ASK_SECONDS = 10.0
#: Name of the counter that holds the expiry time.
_NAME = "sgsst_expiry_time"
_EXPIRY = select(CounterRow.value).where(CounterRow.name == _NAME, CounterRow.labels == "")


class ServerClock:
    """The database server's clock: its offset from the monotonic clock, measured every few seconds.

    It is never ahead of the server's, and behind by no more than a question takes.

    Args:
        ask: Asks the server for its time, in seconds since 1970.
    """

    def __init__(self, ask: Clock) -> None:
        self._ask = ask
        self._asked_at = -math.inf
        self._offset: float | None = None

    def __call__(self) -> float:
        """Return the time in seconds since 1970."""
        now = time.monotonic()
        if self._offset is None or now - self._asked_at > _ASK_SECONDS:
            self._asked_at = now  # other threads use the old offset meanwhile
            try:
                server = self._ask()
            except BaseException:
                self._asked_at = -math.inf
                raise
            self._offset = server - time.monotonic()
        return self._offset + time.monotonic()


def expiry_time(connection: Connection | Session, now: float) -> float:
    """Return the time by which things expire; the clock's if no dispatcher has ever kept one."""
    return min(now, _stored_time(connection, now))


def kept_until(connection: Connection | Session, now: float, seconds: float) -> float:
    """Return when something expires that is to be kept for so long.

    By a clock that is behind alone, it would expire as soon as the clock is right again.
    """
    return max(now, _stored_time(connection, now)) + seconds


def _stored_time(connection: Connection | Session, now: float) -> float:
    found: float | None = connection.execute(_EXPIRY).scalar()
    return now if found is None else found


def advance_expiry_time(session: Session, now: float, seconds: float) -> None:
    """Move the expiry time toward the clock.

    Args:
        now: Time of the clock.
        seconds: Time that a dispatcher has worked since it moved it last, by its monotonic clock.
    """
    row = session.get(CounterRow, (_NAME, ""), with_for_update=True)
    if row is None:  # jobs are created by others: heartbeats may be those of a wrong clock that has just started
        newest = session.scalar(select(func.max(JobRow.created_at)))
        session.add(CounterRow(name=_NAME, labels="", value=now if newest is None else min(now, newest)))
    else:
        row.value = max(row.value, min(now, row.value + CATCH_UP * seconds))
