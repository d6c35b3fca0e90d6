"""Housekeeping of the file store: deletion of expired files and of files that no database row refers to.

Files of failed attempts are swept when their job ends. Stray files come from interrupted attempts that stored another
file after the job had already ended elsewhere.
"""

from __future__ import annotations

import logging
import threading
import time

from service.errors import NotFoundError
from service.files.artifacts import Artifacts
from service.files.blobs import Blobs
from service.scheduling.publishing import sweep
from service.states import UNFINISHED
from service.store import Store

#: Interval between rounds of housekeeping, and between searches for stray files, in seconds.
_ROUND_SECONDS, _STRAY_SEARCH_SECONDS = 60.0, 3600.0
#: Maximum number of jobs whose leftover files are removed per round.
_MAX_SWEEPS = 20
#: Minimum age of a stray file in seconds; younger files may not have their database row yet.
_STRAY_SECONDS = 6 * 3600.0
_JOB_PREFIX = "job_"
#: Time to wait for the thread when it is stopped, in seconds.
_JOIN_SECONDS = 5.0

_log = logging.getLogger(__name__)


class Housekeeper:
    """Periodic housekeeping in its own thread, so that a slow file store does not delay renewing leases."""

    def __init__(self, store: Store, artifacts: Artifacts, blobs: Blobs) -> None:
        self._store, self._artifacts, self._blobs = store, artifacts, blobs
        self._searched_at = float("-inf")
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="housekeeper", daemon=True)

    def start(self) -> None:
        """Start the thread."""
        self._thread.start()

    def stop(self) -> None:
        """Stop the thread."""
        self._stop.set()
        self._thread.join(_JOIN_SECONDS)

    def _run(self) -> None:
        while not self._stop.is_set():
            try:
                self._clean_up()
            except Exception:  # file stores raise arbitrary errors; running jobs must not suffer
                _log.exception("housekeeping failed, retrying: seconds=%.0f", _ROUND_SECONDS)
            self._stop.wait(_ROUND_SECONDS)

    def _clean_up(self) -> None:
        for job_id in self._store.retention.expire():
            self._artifacts.objects.remove_below(job_id)
        for job_id, epoch in self._store.retention.unswept(_MAX_SWEEPS):
            sweep(self._store, self._artifacts, job_id, epoch)
        self._blobs.collect()
        if time.monotonic() - self._searched_at > _STRAY_SEARCH_SECONDS:
            self._searched_at = time.monotonic()
            remove_strays(self._store, self._artifacts)


def remove_strays(store: Store, artifacts: Artifacts) -> int:
    """Delete stray files and return their number."""
    before = time.time() - _STRAY_SECONDS
    old: dict[str, list[str]] = {}
    for name, changed in artifacts.objects.below("").items():
        job_id = name.partition("/")[0]
        if job_id.startswith(_JOB_PREFIX) and changed < before:
            old.setdefault(job_id, []).append(name)
    removed = 0
    for job_id, names in old.items():
        for name in strays_of_job(store, job_id, names):
            artifacts.objects.remove(name)
            removed += 1
    return removed


def strays_of_job(store: Store, job_id: str, names: list[str]) -> list[str]:
    """Return the files of a job that no database row refers to or will refer to."""
    try:
        job = store.jobs.get(job_id, None)
    except NotFoundError:
        return names
    known = {row.location for row in store.jobs.artifacts(job_id)}
    unknown = [name for name in names if name not in known]
    if job.status not in UNFINISHED:
        return unknown
    # the running attempt may still write rows; earlier ones cannot
    return [name for name in unknown if int(name.split("/")[1]) < job.lease_epoch]
