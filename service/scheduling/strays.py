"""Files of jobs that nothing refers to, found by looking through the store of files itself.

Attempts that fail are swept when their job ends. What is left are files of those that were cut off, and put one more
when the job had ended elsewhere already.
"""

from __future__ import annotations

import time

from service.errors import NotFoundError
from service.files.artifacts import Artifacts
from service.store import Store
from service.store.states import UNFINISHED

#: A younger file's row may still be on its way.
_STRAY_SECONDS = 6 * 3600.0
_PREFIX = "job_"


def remove_strays(store: Store, artifacts: Artifacts) -> int:
    """Delete stray files, and return how many; a database that has gone back in time cannot tell which these are."""
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
    """Return those of a job's files that nothing refers to, nor will."""
    try:
        job = store.jobs.get(job_id, None)
    except NotFoundError:
        return names
    kept = {row.location for row in store.jobs.artifacts(job_id)}
    unknown = [name for name in names if name not in kept]
    if job.status not in UNFINISHED:
        return unknown
    # the attempt that runs may have rows to write; those before it have not
    return [name for name in unknown if int(name.split("/")[1]) < job.lease_epoch]
