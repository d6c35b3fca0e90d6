"""Renewal of the leases of a dispatcher's running attempts."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Mapping

from service.scheduling.running import RunningAttempt
from service.store import Store

#: Fractions of a lease's duration: the age at which a lease is renewed, and the age at which its job is killed if
#: renewing has failed. The latter is below 1, because other dispatchers may take an expired lease and clocks differ.
RENEW_FRACTION, _ABANDON_FRACTION = 1 / 3, 3 / 4
#: Time to wait for the thread when it is stopped, in seconds.
_JOIN_SECONDS = 5.0

_log = logging.getLogger(__name__)


class LeaseKeeper:
    """Keeper of leases: it renews them, and ends attempts whose jobs are canceled or whose leases are lost.

    Args:
        seconds: Duration of a lease.
        running: Running attempts by job id, which the dispatcher updates.
    """

    def __init__(self, store: Store, seconds: float, running: Mapping[str, RunningAttempt]) -> None:
        self._store, self._seconds, self._running = store, seconds, running
        self._renewed_at = float("-inf")
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._abandon_late, name="lease-keeper", daemon=True)

    def start(self) -> None:
        """Start the thread that abandons attempts whose leases could not be renewed."""
        self._thread.start()

    def stop(self) -> None:
        """Stop the thread."""
        self._stop.set()
        self._thread.join(_JOIN_SECONDS)

    def update(self) -> None:
        """Renew all leases if that is due, and pass the statuses of the jobs to their attempts; abandon lost jobs."""
        now = time.monotonic()  # taken before the request, so that a lease is never assumed to last too long
        if not self._running:
            self._renewed_at = now
            return
        leases = [attempt.lease for attempt in self._running.values()]
        if now - self._renewed_at >= RENEW_FRACTION * self._seconds:
            statuses = self._store.leases.renew(leases)
            self._renewed_at = now
        else:
            statuses = self._store.leases.statuses(leases)
        for job_id, status in statuses.items():
            attempt = self._running[job_id]
            if status is not None:
                attempt.obey(status)
            elif attempt.alive:
                attempt.abandon()

    def _abandon_late(self) -> None:
        """Abandon jobs whose leases could not be renewed, before the leases expire.

        This runs in a thread of its own, because the thread that renews leases may wait for a database that does not
        respond.
        """
        limit = _ABANDON_FRACTION * self._seconds
        while not self._stop.wait(RENEW_FRACTION * (self._seconds - limit)):
            late = time.monotonic() - self._renewed_at
            if late > limit:
                for attempt in [each for each in dict(self._running).values() if not each.abandoned]:
                    _log.error("attempt abandoned: lease not renewed for %.0f s", late, extra=attempt.lease.log_fields)
                    attempt.abandon()
