"""Time of the store: its clock, and the separate time by which data expire.

On PostgreSQL all processes use the server's clock. SQLite has no clock, so its processes use their machine's. That
clock may be wrong, and deleted data cannot be restored. Deletion therefore uses a separate *expiry time*, which is
stored in the database and never ahead of the clock. A dispatcher advances it toward the clock at most `CATCH_UP` times
as fast as its monotonic clock runs:

- A clock that is 31 days ahead has to stay wrong for 31 hours of work before the first result is deleted too early, and
  then the oldest results go first.
- A machine that was off for 40 days deletes overdue data within 40 hours of work.
- A machine that works for an hour a day keeps up.

A dispatcher whose clock disagrees with the heartbeats of another live one neither advances the expiry time nor deletes
anything (`service.scheduling.clock_watch`), because it is unknown which clock is right. The expiry time never goes
back, so a clock that was temporarily behind does not delay later deletions.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable

from sqlalchemy import Connection, func, select
from sqlalchemy.orm import Session

from service.store.tables import CounterRow, JobRow

Clock = Callable[[], float]

#: Maximum speed of the expiry time, in seconds per second of a dispatcher's work.
CATCH_UP = 24.0
#: Interval between queries of the server's time, in seconds.
_QUERY_SECONDS = 10.0
#: Name of the counter that stores the expiry time.
_NAME = "sgsst_expiry_time"
_EXPIRY = select(CounterRow.value).where(CounterRow.name == _NAME, CounterRow.labels == "")


class ServerClock:
    """Clock of the database server, computed from the monotonic clock and an offset that is measured every few seconds.

    It is never ahead of the server's clock, and behind by at most the duration of a query.

    Args:
        query: Function that queries the server's time in seconds since 1970.
    """

    def __init__(self, query: Clock) -> None:
        self._query = query
        self._queried_at = -math.inf
        self._offset: float | None = None

    def __call__(self) -> float:
        """Return the time in seconds since 1970."""
        now = time.monotonic()
        if self._offset is None or now - self._queried_at > _QUERY_SECONDS:
            self._queried_at = now  # other threads use the old offset meanwhile
            try:
                server = self._query()
            except BaseException:
                self._queried_at = -math.inf
                raise
            self._offset = server - time.monotonic()
        return self._offset + time.monotonic()


def expiry_time(connection: Connection | Session, now: float) -> float:
    """Return the time by which data expire; it equals the clock if no dispatcher has advanced it yet."""
    return min(now, _stored_time(connection, now))


def retained_until(connection: Connection | Session, now: float, seconds: float) -> float:
    """Return the time at which data that are retained for `seconds` expire.

    The period starts at the later of the clock and the expiry time. If the clock is behind, data would otherwise expire
    as soon as the clock is corrected.
    """
    return max(now, _stored_time(connection, now)) + seconds


def _stored_time(connection: Connection | Session, now: float) -> float:
    stored: float | None = connection.execute(_EXPIRY).scalar()
    return now if stored is None else stored


def advance_expiry_time(session: Session, now: float, seconds: float) -> None:
    """Advance the expiry time toward the clock.

    Args:
        seconds: Working time of the dispatcher since its last call, by its monotonic clock.
    """
    row = session.get(CounterRow, (_NAME, ""), with_for_update=True)
    # the first value is limited to the creation time of the newest job: a dispatcher that has just started may have a
    # wrong clock
    if row is None:
        newest = session.scalar(select(func.max(JobRow.created_at)))
        session.add(CounterRow(name=_NAME, labels="", value=now if newest is None else min(now, newest)))
    else:
        row.value = max(row.value, min(now, row.value + CATCH_UP * seconds))
