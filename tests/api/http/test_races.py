"""Random interleavings of all pairs of operations on one job: whoever comes second gets an answer, never a 500."""

import itertools
import random
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import httpx2
import pytest
from sqlalchemy import text

from service.files.objects import Artifacts
from service.settings import ServiceSettings
from service.states import JobStatus, Published
from service.store import Store, open_store
from service.store.jobs import NewJob
from tests.api.service import Service
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
            self.store.jobs.add_derived(source, [Published("stylized.spz", "x", 1, "0" * 64)], "local", replace=True)
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
