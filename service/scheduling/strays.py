"""Search of the file store for stray files: files of jobs that no database row refers to.

Files of failed attempts are swept when their job ends. Strays come from interrupted attempts that stored another file
after the job had already ended elsewhere.
"""

from __future__ import annotations

import time

from service.errors import NotFoundError
from service.files.artifacts import Artifacts
from service.store import Store
from service.store.states import UNFINISHED

#: Minimum age of a stray in seconds; younger files may not have their database row yet.
_STRAY_SECONDS = 6 * 3600.0
_PREFIX = "job_"


def remove_strays(store: Store, artifacts: Artifacts) -> int:
    """Delete stray files and return their number; do nothing after a rollback of the database (rows may be lost)."""
    if store.database.rolled_back:
        return 0
    before = min(time.time(), store.database.expiry()) - _STRAY_SECONDS
    old: dict[str, list[str]] = {}
    for name, changed in artifacts.objects.below("").items():
        job_id = name.partition("/")[0]
        if job_id.startswith(_PREFIX) and changed < before:
            old.setdefault(job_id, []).append(name)
    removed = 0
    for job_id, names in old.items():
        for name in strays_of_job(store, job_id, names):
            artifacts.remove(name)
            removed += 1
    return removed


def strays_of_job(store: Store, job_id: str, names: list[str]) -> list[str]:
    """Return the files of a job that no database row refers to or will refer to."""
    try:
        job = store.jobs.get(job_id, None)
    except NotFoundError:
        return names
    kept = {row.location for row in store.jobs.artifacts(job_id)}
    unknown = [name for name in names if name not in kept]
    if job.status not in UNFINISHED:
        return unknown
    # the running attempt may still write rows; earlier ones cannot
    return [name for name in unknown if int(name.split("/")[1]) < job.lease_epoch]
