"""One wrong clock beside a right one: nothing is deleted, and no lease of a live dispatcher is taken."""

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
from service.settings import ServiceSettings
from service.store import Store, open_store
from service.store.jobs import NewJob
from service.store.leases import Lease
from service.store.tables import DispatcherRow
from tests.api.service import ROOT, SETTINGS, wait_for
from tests.postgres import fresh_database, is_installed, server

SHA = "a" * 64
DAY = 86_400.0
LEASE = 3.0


@pytest.fixture(scope="module")
def postgres() -> Iterator[str]:
    """A PostgreSQL server of our own; skipped where none is installed."""
    if not is_installed():
        pytest.skip("PostgreSQL's server is not installed")
    with server() as url:
        yield url


@pytest.fixture(params=["sqlite", "postgresql"])
def settings(request: pytest.FixtureRequest, tmp_path: Path) -> ServiceSettings:
    """Settings of a service with an empty database and short leases."""
    database = None if request.param == "sqlite" else fresh_database(request.getfixturevalue("postgres"))
    return ServiceSettings(data=tmp_path / "data", database=database, poll_seconds=0.05, lease_seconds=LEASE)


@pytest.fixture
def store(settings: ServiceSettings) -> Iterator[Store]:
    made = open_store(settings)
    made.inputs.add_blob(SHA, "aa/blob", 3)
    yield made
    made.close()


def leased(store: Store, dispatcher: str) -> Lease:
    """Return the lease of a new job."""
    scene = {"role": "scene", "name": "scene.ply", "sha256": SHA, "size": 3}
    store.jobs.create(NewJob("local", "", 0, {}, [scene]), limit=100)
    found = store.leases.take(dispatcher)
    assert found is not None
    return found


def heartbeats(store: Store) -> dict[str, float]:
    """Return the newest heartbeat of each dispatcher, plausible or not."""
    with store.database.reading() as session:
        return {row.name: row.seen_at for row in session.scalars(select(DispatcherRow))}


@contextmanager
def healthy(store: Store, held: Lease) -> Iterator[list[object]]:
    """Renew a lease and beat, as a dispatcher with the right clock does; yields the statuses of the lease."""
    stop, found = threading.Event(), list[object]()

    def work() -> None:
        while not stop.wait(0.2):
            store.operations.beat(held.dispatcher, 1, 0)
            found.append(store.leases.renew([held])[held.job_id])

    thread = threading.Thread(target=work)
    thread.start()
    try:
        yield found
    finally:
        stop.set()
        thread.join()


@contextmanager
def wrong_dispatcher(settings: ServiceSettings, seconds: float) -> Iterator[subprocess.Popen[bytes]]:
    """Run the dispatcher's own process with a clock that is wrong by so much."""
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
def test_a_dispatcher_a_month_off_deletes_nothing(
    settings: ServiceSettings, store: Store, tmp_path: Path, seconds: float
) -> None:
    artifacts = Artifacts(settings.artifacts_url)
    source = tmp_path / "stylized.ply"
    source.write_bytes(b"ply")
    ended = []
    for _ in range(3):
        done = leased(store, "healthy-00000000-1-1")
        result = artifacts.put(done.job_id, done.epoch, "stylized.ply", source)
        store.leases.succeed(done, [result], {})
        ended.append((done.job_id, result))
    incoming = settings.folder / "incoming" / "arrives.part"
    incoming.parent.mkdir(parents=True, exist_ok=True)
    incoming.write_bytes(b"on its way")
    held = leased(store, "healthy-00000000-1-1")
    with healthy(store, held) as statuses, wrong_dispatcher(settings, seconds) as process:
        wait_for(lambda: store.retention.unswept(10) == [] or process.poll(), "the first housekeeping")
        wait_for(lambda: len(heartbeats(store)) == 2 or process.poll(), "the wrong dispatcher's heartbeat")
        assert process.poll() is None
    assert set(statuses) == {"starting"}, "the lease was never lost"
    assert [store.jobs.get(job_id, None).status for job_id, _ in ended] == ["succeeded"] * 3
    for job_id, result in ended:
        assert [row.name for row in store.jobs.artifacts(job_id)] == ["stylized.ply"]
        assert b"".join(artifacts.read(result.location, 0, 3)) == b"ply"
    assert incoming.exists()
    assert store.inputs.blobs([SHA])


def test_a_dispatcher_two_minutes_ahead_takes_no_healthy_lease(settings: ServiceSettings, store: Store) -> None:
    held = leased(store, "healthy-00000000-1-1")
    with healthy(store, held) as statuses, wrong_dispatcher(settings, 120.0) as process:
        beats = set[float]()

        def beaten() -> bool:
            beats.update(at for name, at in heartbeats(store).items() if name != held.dispatcher)
            return len(beats) > 8

        wait_for(lambda: beaten() or process.poll(), "several leases' time of the wrong dispatcher")
        assert process.poll() is None
    assert set(statuses) == {"starting"}, "the lease was never lost"
    assert [row.outcome for row in store.jobs.detail(held.job_id, None)[2]] == [None]
    assert time.time() - store.database.clock() == pytest.approx(0.0, abs=30.0)
