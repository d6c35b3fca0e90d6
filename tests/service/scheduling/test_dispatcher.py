"""Tests of a dispatcher's other tasks: heartbeats and health, housekeeping, taking over jobs of dead dispatchers."""

import os
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import pytest
from sqlalchemy import text

from service.files.blobs import BlobFolder
from service.files.objects import Artifacts
from service.health import dispatcher_is_healthy
from service.prepare import main as prepare
from service.scheduling.capacity import Grant, Machine, is_dead, own_name
from service.scheduling.dispatcher import Dispatcher
from service.scheduling.housekeeping import orphans
from service.settings import ServiceSettings
from service.states import Published
from service.store import Store, open_store
from service.store.jobs import NewJob
from service.store.queue import Lease
from tests.api.service import wait_for
from tests.service.scheduling.conftest import new_lease
from tests.service.store import helpers
from tests.service.store.helpers import SHA, new_job, queue
from tests.stores import new_store


@contextmanager
def at_work(settings: ServiceSettings, store: Store) -> Iterator[Dispatcher]:
    """Run a dispatcher in a thread within the block."""
    dispatcher = Dispatcher(settings, store, Machine(("0", "1"), 2, 10**10))
    thread = threading.Thread(target=dispatcher.run)
    thread.start()
    try:
        yield dispatcher
    finally:
        dispatcher.stop()
        thread.join()


def test_running_dispatcher_is_registered(settings: ServiceSettings, store: Store) -> None:
    with at_work(settings, store) as dispatcher:
        dispatchers = wait_for(store.operations.dispatchers, "the dispatcher to be known")
        assert [(row.name, row.slots, row.free) for row in dispatchers] == [(dispatcher.name, 2, 2)]
    assert store.operations.dispatchers() == []


def test_dispatcher_survives_an_unexpected_error(
    settings: ServiceSettings, store: Store, caplog: pytest.LogCaptureFixture
) -> None:
    """A missing table is no outage: its error is that of a bug."""

    def rename(old: str, new: str) -> None:
        with store.database.writing() as session:
            session.execute(text(f"ALTER TABLE {old} RENAME TO {new}"))

    rename("dispatchers", "lost")
    with at_work(settings, store):
        wait_for(lambda: "no such table" in caplog.text, "an error")
        rename("lost", "dispatchers")
        wait_for(store.operations.dispatchers, "the dispatcher to be known")


def test_attempt_whose_files_hang_ends_by_the_store(
    settings: ServiceSettings, store: Store, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The input is a pipe, which cannot be opened before somebody writes to it."""
    monkeypatch.setattr("service.scheduling.attempts._FILE_SECONDS", 0.3)
    monkeypatch.setattr("service.scheduling.attempts._CANCEL_SECONDS", 0.1)
    pipe = settings.folder / "blobs" / "aa" / "blob"
    pipe.parent.mkdir(parents=True)
    os.mkfifo(pipe)
    job_id = queue(store)

    def error() -> dict[str, str] | None:
        attempts = store.jobs.detail(job_id, None)[1]
        return attempts[0].error if attempts else None

    with at_work(settings, store):
        recorded = wait_for(error, "the attempt to end")
        os.close(os.open(pipe, os.O_RDWR))  # the thread that hangs reads the end, so the dispatcher need not wait
    assert (recorded["code"], recorded["cause"]) == ("infrastructure", "store")
    ended = store.jobs.get(job_id, None)
    assert (ended.status, ended.failures) == ("queued", 0)


def test_job_with_unsupported_stored_parameters_fails_with_a_message(settings: ServiceSettings, store: Store) -> None:
    parameters = {"sharpness": 3, "workers": "many", "memory_limit": "all"}
    job, _ = store.jobs.create(replace(new_job(), parameters=parameters), limit=10)
    with at_work(settings, store):
        wait_for(lambda: store.jobs.get(job.id, None).status == "failed", "the job to fail")
    ended = store.jobs.get(job.id, None)
    assert ended.attempt == 1, "it would fail again"
    assert (ended.error or {})["code"] == "invalid-settings"
    assert "stored by an earlier version" in (ended.error or {})["message"]


def test_jobs_of_a_dead_dispatcher_are_taken_over_at_once(settings: ServiceSettings, store: Store) -> None:
    script = "from service.scheduling.capacity import own_name; print(own_name())"
    dead = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True).stdout.strip()
    assert is_dead(dead)
    assert not is_dead(own_name())
    held = new_lease(store, dead)
    store.jobs.cancel(held.job_id, None)
    store.operations.record_heartbeat(dead, 8, 0)
    with at_work(settings, store) as dispatcher:
        wait_for(lambda: store.jobs.get(held.job_id, None).status == "canceled", "the lost job to be settled")
        wait_for(
            lambda: [row.name for row in store.operations.dispatchers()] == [dispatcher.name],
            "the dead to be forgotten",
        )


def test_attempt_is_abandoned_before_an_unrenewed_lease_expires(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The database does not respond: the thread that renews leases waits for it, and others will take over the job."""
    settings = ServiceSettings(data=tmp_path / "data", poll_seconds=0.05, lease_seconds=8)
    store = new_store(settings)
    store.inputs.add_blob(SHA, "aa/blob", 3)
    released = threading.Event()
    abandoned_at: list[float] = []

    def renew(leases: list[Lease]) -> dict[str, None]:
        released.wait(60)
        return {}

    class Attempt:
        """Attempt that runs forever."""

        def __init__(self, lease: Lease, grant: Grant, *others: object) -> None:
            self.lease, self.grant, self.alive, self.abandoned = lease, grant, True, False

        def obey(self, status: str) -> None:
            """Ignore requests."""

        def abandon(self) -> None:
            abandoned_at.append(store.database.clock())
            self.abandoned = True

        def release(self) -> None:
            self.alive = False

    monkeypatch.setattr("service.scheduling.dispatcher.RunningAttempt", Attempt)
    with at_work(settings, store):
        monkeypatch.setattr(store.leases, "renew", renew)
        job_id = queue(store)
        wait_for(lambda: store.jobs.get(job_id, None).status == "starting", "the job to be taken")
        wait_for(lambda: abandoned_at, "the attempt to be abandoned")
        expires = store.jobs.get(job_id, None).lease_expires_at
        assert expires is not None
        assert abandoned_at[0] < expires, "nobody else can have the job yet"
        released.set()
    store.close()


def test_leftovers_of_a_killed_dispatcher_are_swept(settings: ServiceSettings, store: Store, tmp_path: Path) -> None:
    """The dispatcher died after its job had succeeded, so nobody else would handle the job again."""
    artifacts = Artifacts(settings.artifacts_url)
    source = tmp_path / "stylized.ply"
    source.write_bytes(b"ply")
    held = new_lease(store, "elsewhere")
    artifacts.put(held.job_id, held.epoch, "previews/cut_off.jpg", source)
    result = artifacts.put(held.job_id, held.epoch, "stylized.ply", source)
    store.leases.succeed(held, [result], {})
    running = new_lease(store, "elsewhere")
    published_next = artifacts.put(running.job_id, running.epoch, "stylized.ply", source)
    with at_work(settings, store):
        wait_for(lambda: store.jobs.unswept(10) == [], "the job to be swept")
    left = {path.name for path in (settings.folder / "artifacts" / held.job_id).rglob("*.*")}
    assert left == {"stylized.ply"}
    assert b"".join(artifacts.objects.read(result.location, 0, 3)) == b"ply"
    assert b"".join(artifacts.objects.read(published_next.location, 0, 3)) == b"ply", "of a job that has not ended"


@pytest.mark.parametrize(("damage", "code"), [("lost", "file-lost"), ("flipped", "file-damaged")])
def test_job_with_a_lost_or_damaged_input_fails(tmp_path: Path, damage: str, code: str) -> None:
    """The job is retried as often as any other job without progress, and not forever."""
    settings = ServiceSettings(data=tmp_path / "data", poll_seconds=0.05, retry_seconds=0.01, max_attempts=2)
    store = new_store(settings)
    blobs = BlobFolder(settings.folder, store.inputs, 0)
    (tmp_path / "scene").write_bytes(b"scene")
    sha256 = blobs.add(tmp_path / "scene")
    path = settings.folder / "blobs" / store.inputs.blobs([sha256])[sha256].location
    path.unlink()
    if damage == "flipped":
        path.write_bytes(b"sceme")
    scene = {"role": "scene", "name": "scene.ply", "sha256": sha256, "size": 5}
    job, _ = store.jobs.create(NewJob("local", "", 0, {}, [scene]), limit=10)
    with at_work(settings, store):
        wait_for(lambda: store.jobs.get(job.id, None).status == "failed", "the job to fail")
    ended = store.jobs.get(job.id, None)
    assert ((ended.error or {})["code"], ended.attempt) == (code, 2)
    assert sha256 in (ended.error or {})["message"]
    store.close()


def test_dispatcher_is_healthy_while_it_sends_heartbeats(tmp_path: Path) -> None:
    now = 1000.0
    store = open_store(ServiceSettings(data=tmp_path, lease_seconds=30), lambda: now)
    assert not dispatcher_is_healthy(store)
    store.operations.record_heartbeat("elsewhere-01234567-1-1", 1, 1)
    assert not dispatcher_is_healthy(store), "that is another machine's"
    store.operations.record_heartbeat(own_name(), 1, 1)
    assert dispatcher_is_healthy(store)
    now += 31
    assert not dispatcher_is_healthy(store)
    store.close()


def test_dispatcher_is_healthy_during_a_database_outage() -> None:
    url = "postgresql+psycopg://nobody@127.0.0.1:1/none"
    pytest.importorskip("psycopg", reason="psycopg is not installed: see the extra [postgresql]")
    assert dispatcher_is_healthy(Store(ServiceSettings(database=url)))


def test_prepare_creates_the_tables_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SGSST_DATA", str(tmp_path))
    assert prepare() == prepare() == 0
    store = Store(ServiceSettings())
    assert store.database.is_up_to_date()
    store.close()
    monkeypatch.setenv("SGSST_DATABASE", "postgresql+psycopg://nobody@127.0.0.1:1/none")
    monkeypatch.setenv("SGSST_START_SECONDS", "0")
    assert prepare() == 1


def test_orphaned_results_are_found(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    settings = ServiceSettings(data=tmp_path / "data")
    store, artifacts = open_store(settings), Artifacts(settings.artifacts_url)
    blobs = BlobFolder(settings.folder, store.inputs, 0)
    store.inputs.add_blob(SHA, "aa/blob", 3)
    source = tmp_path / "file"
    source.write_bytes(b"x")

    def put(job_id: str, epoch: int) -> Published:
        return artifacts.put(job_id, epoch, "plan.json", source)

    done, running = new_lease(store), new_lease(store)
    referenced = put(done.job_id, 1)
    store.leases.succeed(done, [referenced], {})
    late, unknown = put(done.job_id, 1), put("job_0123456789", 1)
    lost = put(done.job_id, 9)  # its row was in a newer copy of the database
    store.leases.release(running)
    assert helpers.lease(store, "two").epoch == 2
    before, own = put(running.job_id, 1), put(running.job_id, 2)
    everything = {file.location for file in (referenced, late, unknown, lost, before, own)}
    assert set(artifacts.objects.below("")) == everything
    assert list(orphans(store, artifacts, blobs)) == [], "rows may still be on their way"
    monkeypatch.setattr("service.files.objects.ORPHAN_SECONDS", -60.0)
    for objects, what, name in orphans(store, artifacts, blobs):
        assert what == "result"
        objects.remove(name)
    assert set(artifacts.objects.below("")) == {referenced.location, own.location}
    store.close()
