"""Helpers for tests of the store: a simulated clock, and jobs."""

from __future__ import annotations

from pathlib import Path

from service.settings import ServiceSettings
from service.store import Store
from service.store.jobs import NewJob
from service.store.leases import Lease

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
