"""Tests of a host with a wrong clock: no file is deleted, and no lease of a live dispatcher is taken over."""

from __future__ import annotations

import os
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from sqlalchemy import select

from service.files.artifacts import Artifacts
from service.scheduling.clock_watch import ClockWatch
from service.settings import ServiceSettings
from service.store import Store, open_store
from service.store.clocks import CATCH_UP
from service.store.jobs import NewJob
from service.store.leases import Lease
from service.store.tables import DispatcherRow
from tests.api.service import ROOT, SETTINGS, wait_for
from tests.service.scheduling.conftest import new_lease
from tests.service.store.helpers import Clock
from tests.stores import migrated_database

SHA = "a" * 64
DAY = 86_400.0
LEASE = 6.0


@pytest.fixture(params=["sqlite", pytest.param("postgresql", marks=pytest.mark.slow)])
def settings(request: pytest.FixtureRequest, tmp_path: Path) -> ServiceSettings:
    """Return the settings of a service with a new database and short leases."""
    database = None if request.param == "sqlite" else migrated_database(request.getfixturevalue("postgres"))
    return ServiceSettings(data=tmp_path / "data", database=database, poll_seconds=0.05, lease_seconds=LEASE)


@pytest.fixture
def store(settings: ServiceSettings) -> Iterator[Store]:
    opened = open_store(settings)
    opened.inputs.add_blob(SHA, "aa/blob", 3)
    yield opened
    opened.close()


def heartbeats(store: Store) -> dict[str, float]:
    """Return the newest heartbeat of each dispatcher, including implausible ones."""
    with store.database.reading() as session:
        return {row.name: row.seen_at for row in session.scalars(select(DispatcherRow))}


@contextmanager
def healthy(store: Store, held: Lease) -> Iterator[list[object]]:
    """Renew a lease and send heartbeats, like a dispatcher with a correct clock; yield the list of lease statuses."""
    stop, problems = threading.Event(), list[object]()

    def work() -> None:
        while not stop.wait(0.2):
            store.operations.record_heartbeat(held.dispatcher, 1, 0)
            problems.append(store.leases.renew([held])[held.job_id])

    thread = threading.Thread(target=work)
    thread.start()
    try:
        yield problems
    finally:
        stop.set()
        thread.join()


@contextmanager
def wrong_dispatcher(settings: ServiceSettings, seconds: float) -> Iterator[subprocess.Popen[bytes]]:
    """Run a real dispatcher process whose clock is wrong by `seconds`."""
    environment = {
        **os.environ,
        **SETTINGS,
        "PYTHONPATH": str(ROOT),
        "SGSST_DATA": str(settings.data),
        "SGSST_DATABASE": settings.database_url,
        "SGSST_LEASE_SECONDS": str(settings.lease_seconds),
        "SGSST_POLL_SECONDS": "0.05",
        "SGSST_PARALLEL_JOBS": "2",
    }
    command = [sys.executable, "-m", "tests.shifted_clock", str(seconds), "service.scheduling.dispatcher"]
    process = subprocess.Popen(command, env=environment, cwd=ROOT)
    try:
        yield process
    finally:
        process.kill()
        process.wait()


@pytest.mark.parametrize("seconds", [31 * DAY, -31 * DAY], ids=["ahead", "behind"])
def test_dispatcher_with_a_wrong_clock_deletes_nothing(
    settings: ServiceSettings, store: Store, tmp_path: Path, seconds: float
) -> None:
    artifacts = Artifacts(settings.artifacts_url)
    source = tmp_path / "stylized.ply"
    source.write_bytes(b"ply")
    ended = []
    for _ in range(3):
        done = new_lease(store, "healthy-00000000-1-1")
        result = artifacts.put(done.job_id, done.epoch, "stylized.ply", source)
        store.leases.succeed(done, [result], {})
        ended.append((done.job_id, result))
    incoming = settings.folder / "incoming" / "arrives.part"
    incoming.parent.mkdir(parents=True, exist_ok=True)
    incoming.write_bytes(b"on its way")
    held = new_lease(store, "healthy-00000000-1-1")
    # the wrong heartbeat precedes the first housekeeping, which the process does in its own thread
    with store_with_clock(settings, seconds) as (wrong, _, _):
        wrong.operations.record_heartbeat("wrong-00000000-1-1", 1, 1)
    with healthy(store, held) as statuses, wrong_dispatcher(settings, seconds) as process:
        wait_for(lambda: store.retention.unswept(10) == [] or process.poll(), "the first housekeeping")
        wait_for(
            lambda: heartbeats(store).keys() - {"healthy-00000000-1-1", "wrong-00000000-1-1"} or process.poll(),
            "the wrong dispatcher's heartbeat",
        )
        assert process.poll() is None
    assert set(statuses) == {"starting"}, "the lease was never lost"
    assert [store.jobs.get(job_id, None).status for job_id, _ in ended] == ["succeeded"] * 3
    for job_id, result in ended:
        assert [row.name for row in store.jobs.artifacts(job_id)] == ["stylized.ply"]
        assert b"".join(artifacts.objects.read(result.location, 0, 3)) == b"ply"
    assert incoming.exists()
    assert store.inputs.blobs([SHA])


@pytest.mark.slow
def test_dispatcher_with_a_fast_clock_takes_no_live_lease(settings: ServiceSettings, store: Store) -> None:
    held = new_lease(store, "healthy-00000000-1-1")
    with healthy(store, held) as statuses, wrong_dispatcher(settings, 120.0) as process:
        beats = set[float]()

        def beaten() -> bool:
            beats.update(at for name, at in heartbeats(store).items() if name != held.dispatcher)
            return len(beats) > 8

        wait_for(lambda: beaten() or process.poll(), "several leases' time of the wrong dispatcher")
        assert process.poll() is None
    assert set(statuses) == {"starting"}, "the lease was never lost"
    assert [row.outcome for row in store.jobs.detail(held.job_id, None)[1]] == [None]
    assert time.time() - store.database.clock() == pytest.approx(0.0, abs=30.0)


# --- with simulated clocks ----------------------------------------------------------------------------------------


@contextmanager
def store_with_clock(settings: ServiceSettings, wrong_by: float) -> Iterator[tuple[Store, ClockWatch, Clock]]:
    """Open the database with a clock that is wrong by `wrong_by` seconds, and yield it with a clock watch."""
    store, monotonic = open_store(settings, lambda: time.time() + wrong_by), Clock()
    try:
        yield store, ClockWatch(store, LEASE, monotonic), monotonic
    finally:
        store.close()


def test_lease_is_lost_after_a_lease_duration_without_renewal(tmp_path: Path) -> None:
    settings = ServiceSettings(data=tmp_path, lease_seconds=LEASE)
    with store_with_clock(settings, 0.0) as (store, _, _), store_with_clock(settings, 120.0) as (ahead, watch, clock):
        store.inputs.add_blob(SHA, "aa/blob", 3)
        held = new_lease(store, "healthy")
        for _ in range(5):
            assert ahead.leases.take("wrong", is_lost=watch.is_lost) is None
            clock.now += 0.9 * LEASE
            store.leases.renew([held])
        assert ahead.leases.take("wrong", is_lost=watch.is_lost) is None
        clock.now += LEASE
        assert ahead.leases.take("wrong", is_lost=watch.is_lost) is not None


def test_lease_of_a_dead_local_dispatcher_is_lost_at_once(tmp_path: Path) -> None:
    with store_with_clock(ServiceSettings(data=tmp_path, lease_seconds=LEASE), 0.0) as (store, watch, _):
        store.inputs.add_blob(SHA, "aa/blob", 3)
        new_lease(store, "dead")
        assert store.leases.take("new", is_lost=watch.is_lost) is None
        store.leases.expire("dead")
        assert store.leases.take("new", is_lost=watch.is_lost) is not None


def test_times_written_by_a_fast_clock_delay_nothing(settings: ServiceSettings, store: Store) -> None:
    """Neither the lease of its dead dispatcher nor a job queued by it has to wait."""
    with (
        store_with_clock(settings, 31 * DAY) as (ahead, _, _),
        store_with_clock(settings, 0.0) as (right, watch, clock),
    ):
        lost = new_lease(ahead, "ahead")
        assert right.leases.take("right", is_lost=watch.is_lost) is None
        clock.now += LEASE
        again = right.leases.take("right", is_lost=watch.is_lost)
        assert again is not None
        assert again.job_id == lost.job_id
        scene = {"role": "scene", "name": "scene.ply", "sha256": SHA, "size": 3}
        queued, _ = ahead.jobs.create(NewJob("local", "", 0, {}, [scene]), limit=100)
        lease = right.leases.take("right", is_lost=watch.is_lost)
        assert lease is not None
        assert lease.job_id == queued.id


def test_overdue_data_are_deleted_gradually(settings: ServiceSettings) -> None:
    """A machine that was off for 40 days cannot be distinguished from one whose clock is ahead."""
    clock = Clock()
    store = open_store(settings, clock)
    store.inputs.add_blob(SHA, "aa/blob", 3)
    done = new_lease(store, "one")
    store.leases.succeed(done, [], {})
    store.retention.advance(0.0)
    clock.now += 40 * DAY
    store.retention.advance(60.0)
    assert store.retention.expire() == []
    assert store.inputs.collect() == []
    store.close()
    store = open_store(settings, clock)  # the next process continues from there
    store.retention.advance(29 * DAY / CATCH_UP)
    assert store.retention.expire() == []
    store.retention.advance(2 * DAY / CATCH_UP)
    assert store.retention.expire() == [done.job_id]
    store.retention.advance(1000 * DAY)
    assert store.database.expiry() == clock.now, "it is never ahead of the clock"
    store.close()


def test_slow_clock_does_not_shorten_retention(settings: ServiceSettings, store: Store) -> None:
    store.retention.advance(0.0)
    held = new_lease(store, "behind")
    with store_with_clock(settings, -31 * DAY) as (behind, _, _):
        behind.leases.succeed(held, [], {})
    expires = store.jobs.get(held.job_id, None).expires_at
    assert expires is not None
    assert expires > store.database.clock() + settings.retention_seconds - 600


@pytest.mark.parametrize("wrong_by", [120.0, -120.0, 31 * DAY])
def test_nothing_is_deleted_while_live_clocks_disagree(
    settings: ServiceSettings, store: Store, wrong_by: float
) -> None:
    with store_with_clock(settings, wrong_by) as (wrong, watch, clock):
        monotonic = Clock()
        store.retention.advance(0.0)
        right_watch = ClockWatch(store, LEASE, monotonic)
        # the first call has nothing to compare with and does not advance the expiry time
        for passing in (True, False, False):
            store.operations.record_heartbeat("healthy", 1, 1)
            wrong.operations.record_heartbeat("wrong", 1, 1)
            before = wrong.database.expiry()
            assert watch.confirm() == passing
            assert right_watch.confirm() == passing, "nobody knows who is right"
            assert wrong.database.expiry() <= max(before, store.database.clock())
            clock.now, monotonic.now = clock.now + 1.0, monotonic.now + 1.0
        # only its own heartbeats are left, which it can compare
        wrong.operations.record_heartbeat("wrong", 1, 1)
        assert watch.confirm()
