"""Plausibility checks of times written by other machines, based on the dispatcher's monotonic clock."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable

from service.store import Store
from service.store.leases import EXPIRED
from service.store.tables import JobRow

#: Tolerated difference between the clocks of cooperating machines, in seconds.
_TOLERANCE = 60.0

_log = logging.getLogger(__name__)


class ClockWatch:
    """Checks of other machines' clocks.

    On PostgreSQL all times come from the server. On SQLite each process writes times of its own machine, whose clock
    may be wrong. A lease that has expired by this machine's clock therefore does not count as lost yet. It counts as
    lost if it is not renewed for another lease duration by the monotonic clock, because a live holder would have
    renewed it several times. Nothing is deleted while another dispatcher sends heartbeats whose times disagree with
    this machine's clock.
    """

    def __init__(self, store: Store, lease_seconds: float, monotonic: Callable[[], float] = time.monotonic) -> None:
        self._store, self._lease_seconds, self._monotonic = store, lease_seconds, monotonic
        self._expired: dict[str, tuple[tuple[int, float], float]] = {}
        self._heartbeats: dict[str, float] = {}
        self._compared_at: float | None = None

    def is_lost(self, job: JobRow) -> bool:
        """Return whether an expired lease is lost, and remember when its expiry was first seen."""
        expires, database = job.lease_expires_at, self._store.database
        if expires is None or expires == EXPIRED:
            return True
        if not database.sqlite and expires < database.clock():
            return True
        lease, now = (job.lease_epoch, expires), self._monotonic()
        seen, since = self._expired.get(job.id, (None, now))
        if seen == lease and now - since >= self._lease_seconds:
            del self._expired[job.id]
            return True
        if seen != lease:
            self._expired[job.id] = lease, now
        return False

    def confirm(self) -> bool:
        """Advance the expiry time unless a live dispatcher contradicts this clock; return whether deleting is allowed.

        Only heartbeats that were sent since the last call are compared with this clock; older ones may come from dead
        dispatchers. Heartbeats of this dispatcher are compared too, which detects a change of this machine's clock.
        """
        before, now = self._compared_at, self._monotonic()
        since = 0.0 if before is None else now - before
        clock, known = self._store.database.clock(), self._heartbeats
        self._heartbeats, self._compared_at = self._store.operations.heartbeats(), now
        offsets = {
            name: seen - clock
            for name, seen in self._heartbeats.items()
            if name in known and seen != known[name] and not -since - _TOLERANCE <= seen - clock <= _TOLERANCE
        }
        if offsets:
            name, seconds = max(offsets.items(), key=lambda item: abs(item[1]))
            _log.error(
                "clocks disagree, nothing is deleted: dispatcher=%s offset_seconds=%+.0f. "
                "Synchronize the clocks of all machines by NTP.",
                name,
                seconds,
            )
            return False
        self._store.retention.advance(since)
        return True
