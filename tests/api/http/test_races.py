"""Random interleavings: all pairs of operations on one job, and writes of two API processes to one upload.

Whoever comes second gets an answer, never a 500, and stored files match their digests.
"""

import hashlib
import itertools
import random
import socket
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import httpx2
import pytest
from sqlalchemy import text

from service.files.objects import Artifacts
from service.settings import ServiceSettings
from service.states import JobStatus, Published
from service.store import Store, open_store
from service.store.jobs import NewJob
from tests.api.http.sending import OFFSET_STREAM, begin, closed, connect, lines, send
from tests.api.service import Service, wait_for
from tests.postgres import fresh_database, is_installed, server
from tests.service.store import helpers
from tests.small_scenes import wall, write_files

pytestmark = pytest.mark.slow
#: Requests of each of the two operations that run at the same time.
COPIES = 2


@dataclass(frozen=True)
class Job:
    """Job of one round, with a share, and a client and a store that all operations use."""

    client: httpx2.Client
    store: Store
    id: str
    share: str
    token: str

    def ask(self, method: str, path: str = "", **options: object) -> int:
        """Return the status of a request; bodies are not read to their end, since some streams have none."""
        with self.client.stream(method, f"/v1/jobs/{self.id}{path}", **options) as answer:  # type: ignore[arg-type]
            return answer.status_code

    def read_shared(self, name: str = "") -> int:
        return self.client.get(f"/v1/shared/{self.token}{name}").status_code

    def derive(self) -> int:
        """Publish a file derived from the result, as conversions do; the file itself does not matter here."""
        source = self.store.jobs.artifact(self.id, "stylized.ply")
        if source is not None:
            self.store.jobs.add_derived(source, [Published("stylized.spz", "x", 1, "0" * 64)], "local")
        return 200

    def work(self) -> int:
        """Take a queued job as a dispatcher does, and return it."""
        lease = self.store.leases.take("test")
        if lease is not None:
            self.store.leases.release(lease)
        return 200


OPERATIONS: dict[str, Callable[[Job], int]] = {
    "get": lambda job: job.ask("GET"),
    "list": lambda job: job.client.get("/v1/jobs").status_code,
    "rename": lambda job: job.ask("PATCH", json={"name": "other"}),
    "finish": lambda job: job.ask("POST", "/finish"),
    "cancel": lambda job: job.ask("POST", "/cancel"),
    "retry": lambda job: job.ask("POST", "/retry"),
    "delete": lambda job: job.ask("DELETE"),
    "progress": lambda job: job.ask("GET", "/progress"),
    "events": lambda job: job.ask("GET", "/events"),
    "inputs": lambda job: job.ask("GET", "/inputs"),
    "input": lambda job: job.ask("GET", "/inputs/scene"),
    "artifacts": lambda job: job.ask("GET", "/artifacts"),
    "artifact": lambda job: job.ask("GET", "/artifacts/stylized.ply"),
    "shares": lambda job: job.ask("GET", "/shares"),
    "share": lambda job: job.ask("POST", "/shares", json={"days": 1}),
    "revoke": lambda job: job.ask("DELETE", f"/shares/{job.share}"),
    "shared": lambda job: job.read_shared(),
    "shared file": lambda job: job.read_shared("/stylized.ply"),
    "derive": Job.derive,
    "work": Job.work,
}


@pytest.fixture(scope="module", params=["sqlite", "postgresql"])
def settings(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Iterator[ServiceSettings]:
    folder = tmp_path_factory.mktemp("races") / "data"
    if request.param == "sqlite":
        yield ServiceSettings(data=folder)
        return
    if not is_installed():
        pytest.skip("PostgreSQL's server is not installed")
    with server() as url:
        yield ServiceSettings(data=folder, database=fresh_database(url))


def test_all_pairs_of_operations_on_one_job(settings: ServiceSettings, tmp_path: Path) -> None:
    chosen = random.Random(7)
    options = {
        "SGSST_MAX_JOBS_PER_KEY": "100000",
        **({"SGSST_DATABASE": settings.database} if settings.database else {}),
    }
    ply, cameras, style = write_files(tmp_path, wall())
    result = tmp_path / "stylized.ply"
    result.write_bytes(b"ply")
    results = Artifacts(settings.artifacts_url)
    with Service(settings.folder, alone=True, **options) as service, service.client() as client:
        store = open_store(settings)
        sent = {"scene": ply, "cameras": cameras, "style": style}
        first = client.post("/v1/jobs", files={role: (path.name, path.read_bytes()) for role, path in sent.items()})
        inputs = store.jobs.inputs(first.json()["id"])
        assert client.post(f"/v1/jobs/{first.json()['id']}/cancel").status_code == 200

        def new_job() -> Job:
            row, _ = store.jobs.create(NewJob("local", "job", 0, {}, inputs), limit=10**6)
            lease = helpers.lease(store, "test")
            if chosen.random() < 0.25:  # a job that can be retried has no share, and its token opens nothing
                store.leases.fail(lease, {"code": "internal", "message": "test"}, permanent=True)
                return Job(client, store, row.id, "shr_" + "0" * 31, "shr_" + "0" * 31 + "." + "A" * 43)
            store.leases.start(lease)
            store.leases.succeed(lease, [results.put(row.id, lease.epoch, "stylized.ply", result)], {})
            share, token = store.shares.create(row.id, "local", 1000.0)
            return Job(client, store, row.id, share.id, token)

        with ThreadPoolExecutor(2 * COPIES) as threads:
            for pair in itertools.combinations_with_replacement(OPERATIONS, 2):
                job, barrier = new_job(), threading.Barrier(2 * COPIES)

                def run(name: str, wait: float, job: Job = job, barrier: threading.Barrier = barrier) -> int:
                    barrier.wait()
                    threading.Event().wait(wait)
                    return OPERATIONS[name](job)

                names = [*pair] * COPIES
                statuses = list(threads.map(run, names, [chosen.random() * 0.004 for _ in names]))
                assert max(statuses) < 500, (pair, statuses)
                client.post(f"/v1/jobs/{job.id}/cancel")  # else `work` takes what `retry` has queued
        assert "Traceback" not in service.said()
        with store.database.reading() as session:
            unknown = "holder LIKE 'job:%' AND substr(holder, 5) NOT IN (SELECT id FROM jobs)"
            orphans = f"SELECT count(*) FROM blob_uses WHERE {unknown}"
            assert session.scalar(text(orphans)) == 0
            assert set(session.scalars(text("SELECT status FROM jobs"))) <= set(JobStatus)
            if settings.database:
                idle = "SELECT count(*) FROM pg_stat_activity WHERE state = 'idle in transaction (aborted)'"
                assert session.scalar(text(idle)) == 0
        store.close()


@dataclass
class Pair:
    """Two API processes and their shared database."""

    services: tuple[Service, Service]
    store: Store

    @property
    def data(self) -> Path:
        return self.services[0].data


@pytest.fixture(scope="module")
def pair(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Pair]:
    data = tmp_path_factory.mktemp("pair") / "data"
    with Service(data, alone=True) as one, Service(data, alone=True) as two:
        store = open_store(ServiceSettings(data=data))
        yield Pair((one, two), store)
        store.close()


class Patch:
    """PATCH request that is sent a few bytes at a time."""

    def __init__(self, service: Service, where: str, offset: int, content: bytes, *, expect: bool = False) -> None:
        self.content, self.sent = content, 0
        self.socket = connect(service)
        self.socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        head = f"PATCH {where} HTTP/1.1\nTus-Resumable: 1.0.0\nUpload-Offset: {offset}\nContent-Type: {OFFSET_STREAM}\n"
        head += f"Content-Length: {len(content)}\nConnection: close" + "\nExpect: 100-continue" * expect
        self.socket.sendall(lines(head))
        if expect:
            assert b" 100 " in self.socket.recv(100), "it is this one's turn"

    @property
    def done(self) -> bool:
        return self.sent == len(self.content)

    def send(self, count: int) -> None:
        """Send more bytes, ignoring a closed connection, because the service may have refused the request."""
        part = self.content[self.sent : self.sent + count]
        try:
            self.socket.sendall(part)
        except OSError:
            self.sent = len(self.content)
            return
        self.sent += len(part)

    def status(self) -> int:
        """Return the status of the response; 0 if the connection was closed without a response."""
        answer = closed(self.socket)
        self.socket.close()
        return int(answer.split(b" ", 2)[1]) if answer else 0


def interleave(pair: Pair, clients: tuple[httpx2.Client, httpx2.Client], order: random.Random) -> set[int]:
    """Write to one upload by concurrent requests to both processes, and return the response statuses."""
    length = order.choice([1, 7, 64, 1000, 300_000])
    where = begin(clients[0], length)
    statuses: set[int] = set()
    for turn in range(4):
        shown = clients[turn % 2].get(where).json()
        if shown["complete"]:
            break
        statuses |= write_at_once(pair, where, shown["offset"], length, turn, order)

    def finished() -> dict[str, Any] | None:
        """Return the upload if it is complete; otherwise, try to send its rest."""
        shown = clients[0].get(where).json()
        if not shown["complete"]:
            rest = b"z" * (length - shown["offset"])
            statuses.add(send(clients[1], where, shown["offset"], rest).status_code)
        return shown if shown["complete"] else None

    shown = wait_for(finished, "the upload to be finished", every=0.01)
    check_digest(pair, shown["sha256"], length)
    return statuses


def write_at_once(pair: Pair, where: str, offset: int, length: int, turn: int, order: random.Random) -> set[int]:
    """Send the rest of an upload in two or three interleaved requests, some of which are cut off."""
    writers = [
        Patch(pair.services[order.randrange(2)], where, offset, bytes([65 + 4 * turn + number]) * (length - offset))
        for number in range(order.choice([2, 2, 3]))
    ]
    cut = {writer for writer in writers if order.random() < 0.3}
    while waiting := [writer for writer in writers if not writer.done and not (writer in cut and writer.sent)]:
        order.choice(waiting).send(order.choice([1, 13, length]))
    for writer in cut:
        writer.socket.close()
    return {writer.status() for writer in writers if writer not in cut}


def check_digest(pair: Pair, sha256: str, length: int) -> None:
    """Check that a stored file has the digest that it is named after."""
    row = pair.store.inputs.blobs([sha256])[sha256]
    content = (pair.data / "blobs" / row.location).read_bytes()
    assert (hashlib.sha256(content).hexdigest(), len(content)) == (sha256, length)


def run(pair: Pair, count: int, seed: int) -> None:
    order, statuses = random.Random(seed), set[int]()
    with pair.services[0].client() as one, pair.services[1].client() as two:
        for _ in range(count):
            statuses |= interleave(pair, (one, two), order)
    assert statuses <= {0, 204, 404, 409, 423}, statuses
    for path in (pair.data / "blobs").glob("*/*"):
        assert path.name.partition("-")[0] == hashlib.sha256(path.read_bytes()).hexdigest()


def test_upload_is_locked_across_processes(pair: Pair) -> None:
    """The second of two writers is refused. Otherwise, a file could be named by the digest of other content."""
    with pair.services[0].client() as client:
        where = begin(client, 1000)
        first = Patch(pair.services[0], where, 0, b"x" * 1000, expect=True)
        first.send(500)
        second = Patch(pair.services[1], where, 0, b"y" * 1000)
        second.send(1000)
        statuses = {second.status()}
        first.send(500)
        statuses.add(first.status())
        shown = client.get(where).json()
    assert shown["complete"]
    check_digest(pair, shown["sha256"], 1000)
    assert len(statuses & {409, 423}) == 1, statuses


def test_interleaved_patches_from_two_processes(pair: Pair) -> None:
    run(pair, 400, seed=1)
