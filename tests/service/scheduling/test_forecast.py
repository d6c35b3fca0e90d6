"""Tests of the forecast of when queued jobs start."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
from sqlalchemy import event

from service.scheduling.forecast import expected_starts
from service.scheduling.packing import estimated_seconds
from service.store import Store
from sgsst_core.progress import Progress
from tests.service.store.helpers import SHA, Clock, lease, queue, store_settings
from tests.stores import new_store

STEP = Progress(stage="sos", step=1, total=9, loss=1.0, eta_s=90.0)


@pytest.fixture
def clock() -> Clock:
    return Clock()


@pytest.fixture
def store(tmp_path: Path, clock: Clock) -> Iterator[Store]:
    opened = new_store(store_settings(tmp_path, None), clock)
    opened.inputs.add_blob(SHA, "aa/b", 3)
    yield opened
    opened.close()


def queue_later(store: Store, clock: Clock, priority: int = 0) -> str:
    """Queue a job a second after the one before."""
    clock.now += 1
    return queue(store, priority=priority)


def test_starts_follow_from_running_jobs_and_jobs_ahead(store: Store, clock: Clock) -> None:
    running, *waiting = (queue_later(store, clock) for _ in range(4))
    assert expected_starts(store, waiting) == {}, "there is no dispatcher"
    store.operations.record_heartbeat("one", 1, 0)
    taken = lease(store)
    store.leases.start(taken)
    assert expected_starts(store, waiting) == {}, "nothing is reported yet"
    store.leases.report_progress(taken, Progress(stage="planning", step=1, total=9, eta_s=1.0))
    assert expected_starts(store, waiting) == {}, "the time of the steps is unknown"
    started = clock.now
    clock.now += 10
    store.leases.report_progress(taken, STEP)
    clock.now += 5  # it changes nothing: times derive from reports
    assert taken.job_id == running
    assert expected_starts(store, waiting) == pytest.approx(
        {job_id: started + 100 * number for number, job_id in enumerate(waiting, 1)}
    ), "all jobs are alike, so each takes the 100 s of the first"
    assert estimated_seconds(taken.job) != 100, "the pace is measured"
    assert expected_starts(store, [running, "job_0"]) == {}


def test_free_capacity_and_priority_count(store: Store, clock: Clock) -> None:
    store.operations.record_heartbeat("one", 2, 1)
    queue_later(store, clock)
    taken = lease(store)
    store.leases.start(taken)
    store.leases.report_progress(taken, STEP)
    reported_at = clock.now
    low, high = queue_later(store, clock), queue_later(store, clock, priority=5)
    queued_at = clock.now
    assert expected_starts(store, [low, high]) == pytest.approx({high: queued_at, low: reported_at + 90})
    clock.now += 1000
    assert expected_starts(store, [low]) == {}, "the dispatcher is dead"


def test_parameters_of_jobs_ahead_are_read_once(store: Store, clock: Clock) -> None:
    """They may take 64 kB each, and belong to other keys."""
    store.operations.record_heartbeat("one", 2, 1)
    waiting = [queue_later(store, clock) for _ in range(3)]
    read: list[str] = []
    event.listen(store.database.engine, "before_cursor_execute", lambda *each: read.append(each[2]))
    first = expected_starts(store, waiting[-1:])
    assert sum("parameters" in statement for statement in read) == 3
    read.clear()
    assert expected_starts(store, waiting[-1:]) == first
    assert read
    assert not any("parameters" in statement or "inputs" in statement for statement in read)
