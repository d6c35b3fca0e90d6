"""Helpers for tests of the store: a simulated clock, jobs, and the usage of keys."""

import threading
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from service.problems import ServiceError
from service.settings import ServiceSettings
from service.store import Store
from service.store.jobs import NewJob
from service.store.keys import day_of, stored_bytes
from service.store.queue import Lease
from service.store.tables import UsageRow

SHA = "a" * 64
LEASE, RETRY, ATTEMPTS = 30.0, 5.0, 3
RETENTION = 100.0


class Clock:
    """Simulated clock, which only advances when it is set."""

    def __init__(self) -> None:
        self.now = 1_000_000.0

    def __call__(self) -> float:
        return self.now


def store_settings(folder: Path, database: str | None) -> ServiceSettings:
    """Return settings with the durations that this module defines."""
    return ServiceSettings(
        data=folder,
        database=database,
        lease_seconds=LEASE,
        retry_seconds=RETRY,
        max_attempts=ATTEMPTS,
        retention_days=RETENTION / 86_400,
    )


def new_job(owner: str = "local", priority: int = 0) -> NewJob:
    return NewJob(owner, "", priority, {}, [{"role": "scene", "name": "scene.ply", "sha256": SHA, "size": 3}])


def queue(store: Store, owner: str = "local", priority: int = 0) -> str:
    return store.jobs.create(new_job(owner, priority), limit=100)[0].id


def lease(store: Store, dispatcher: str = "one") -> Lease:
    taken = store.leases.take(dispatcher)
    assert taken is not None
    return taken


@dataclass(frozen=True)
class Used:
    """Usage of a key today, and its stored bytes."""

    jobs: int
    gpu_seconds: float
    stored_bytes: int


def usage_of(store: Store, owner: str) -> Used:
    with store.database.reading() as session:
        row = session.get(UsageRow, (owner, day_of(store.database.clock())))
        jobs, seconds = (row.jobs, row.gpu_seconds) if row is not None else (0, 0.0)
        return Used(jobs, seconds, stored_bytes(session, owner))


def at_once(work: Callable[[], object], times: int) -> int:
    """Call `work` concurrently in `times` threads; return the number of calls that were not refused."""
    ready, passed, broken = threading.Barrier(times), [], []

    def one() -> None:
        ready.wait()
        try:
            passed.append(work())
        except ServiceError:
            return
        except BaseException as error:
            broken.append(error)

    threads = [threading.Thread(target=one) for _ in range(times)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert not broken, broken
    return len(passed)
