"""Tests of quotas and rate limits as a client sees them: 429 with the reason and the time to retry."""

import json
import os
import stat
from collections.abc import Iterator
from pathlib import Path

import httpx2
import pytest

from api.http.context import Rates
from service.problems import ServiceError
from service.store.keys import NO_QUOTAS, Quotas
from tests.api.conftest import Sgsst
from tests.api.http.sending import TUS, begin, closed, connect, form, lines, refused, send
from tests.api.service import PATIENCE, Service, wait_for
from tests.service.store.helpers import Clock, usage_of


@pytest.mark.parametrize("a_second", [0.01, 0.5, 3.0])
def test_request_after_retry_after_is_allowed(a_second: float) -> None:
    clock = Clock()
    rates = Rates(clock)
    refusals = 0
    for _ in range(200):
        try:
            rates.take("alice", a_second)
        except ServiceError as error:
            refusals += 1
            clock.now += error.retry_after or 0
            rates.take("alice", a_second)
            rates.take(f"another {refusals}", a_second)
    assert refusals > 50


@pytest.fixture(scope="module")
def service(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Service]:
    data = tmp_path_factory.mktemp("quotas") / "data"
    limits = {"SGSST_REQUIRE_KEYS": "true", "SGSST_MAX_JOBS_A_DAY_PER_KEY": "1", "SGSST_MAX_CONNECTIONS": "5"}
    with Service(data, alone=True, **limits) as running:
        yield running


def key(service: Service, quotas: Quotas) -> str:
    return owner_and_key(service, quotas)[1]


def owner_and_key(service: Service, quotas: Quotas) -> tuple[str, str]:
    with service.store() as store:
        row, text = store.keys.create("someone", quotas=quotas)
        return row.id, text


def on_disk(service: Service) -> int:
    """Return the total bytes of stored inputs and unfinished uploads of all owners."""
    folders = [service.data / name for name in ("blobs", "incoming", "uploads", "inspections")]
    files = {path: status for path, status in service.stored().items() if stat.S_ISREG(status.st_mode)}
    mine = [status for path, status in files.items() if any(folder in path.parents for folder in folders)]
    return sum({status.st_ino: status.st_size for status in mine}.values())


def test_quotas_of_jobs_bytes_and_requests(service: Service, files: dict[str, bytes]) -> None:
    with service.client(key(service, Quotas(stored_bytes=1_000_000))) as client:
        assert client.post("/v1/jobs", files=form(files)).status_code == 202
        answer = client.post("/v1/jobs", files=form(files))
        assert refused(answer, 429, "quota-exceeded")["quota"] == "jobs-a-day"
        assert 0 < int(answer.headers["retry-after"]) <= 86_400
        answer = client.post("/v1/uploads", headers=TUS | {"Upload-Length": "2000000"})
        assert refused(answer, 429, "quota-exceeded")["quota"] == "stored-bytes"
        assert answer.headers["retry-after"]
        assert client.get("/v1/jobs").status_code == 200
    with service.client(key(service, Quotas(requests_a_second=0.1))) as client:
        assert client.get("/v1/jobs").status_code == 200
        answer = client.get("/v1/jobs")
        refused(answer, 429, "rate-limited")
        assert 1 <= int(answer.headers["retry-after"]) <= 10


def test_usage_of_own_key_and_of_all_keys(
    service: Service, files: dict[str, bytes], monkeypatch: pytest.MonkeyPatch, sgsst: Sgsst
) -> None:
    used = {}
    for _ in range(2):
        owner, text = owner_and_key(service, Quotas())
        with service.client(text) as client:
            inputs = client.post("/v1/jobs", files=form(files)).json()["inputs"]
            used[owner] = {"key": owner, "name": "someone", "jobs": 1, "gpu_seconds": 0.0, "cpu_seconds": 0.0}
            used[owner]["bytes"] = sum(entry["size"] for entry in inputs)
            (row,) = client.get("/v1/usage").json()["usage"]
            assert row == {"day": row["day"], **used[owner]}
            assert client.get(f"/v1/usage?since={row['day']}&until={row['day']}").json()["usage"] == [row]
            for days in ("since=2026-02-30", "since=20260201", "since=1", "until=tomorrow", "until="):
                refused(client.get(f"/v1/usage?{days}"), 422, "invalid-request")
            for days in ("since=2026-01-01&until=2025-12-31", "since=2026-01-01&until=2026-04-03", "since=0001-01-01"):
                problem = refused(client.get(f"/v1/usage?{days}"), 422, "invalid-request")
                assert "must be between 1 and 92 days" in problem["detail"]
            assert client.get("/v1/usage?since=2026-01-01&until=2026-04-02").json() == {"usage": []}
    with service.client() as client:
        refused(client.get("/v1/usage"), 401, "unauthorized")
    for name in ("SGSST_DATA", "SGSST_KEY", "SGSST_URL"):
        monkeypatch.setenv(name, "")
    operators = sgsst(["keys", "create", "operator", "--operator", "--data", str(service.data)]).strip()
    for command in (["--data", str(service.data)], ["--url", service.url, "--key", operators]):
        rows = json.loads(sgsst(["usage", "--json", *command]))
        assert {row["key"]: row for row in rows}.items() >= {
            owner: {"day": rows[-1]["day"], **row} for owner, row in used.items()
        }.items()
        assert next(iter(used)) in sgsst(["usage", *command])
        assert "'monday' does not match the formats '%Y-%m-%d'" in sgsst(["usage", "--since", "monday", *command], 2)
    period = ["--since", "2026-01-01", "--until", "2026-11-30"]
    error = json.loads(sgsst(["usage", "--data", str(service.data), *period, "--json"], 2))
    assert (error["code"], "334 days" in error["detail"]) == ("invalid-request", True)


def test_connections_are_limited(service: Service) -> None:
    held = [connect(service) for _ in range(6)]
    try:
        said = closed(held[-1])
        assert said.startswith(b"HTTP/1.1 503 ")
        assert b"retry-after: 5" in said.lower()
        assert b'"too-many-connections"' in said
    finally:
        for each in held:
            each.close()
    wait_for(lambda: httpx2.get(f"{service.url}/livez").status_code == 200, "room for a connection", service.said)


# --- bytes without a charge ----------------------------------------------------------------------------------------

MB = 1_000_000


def body_of(scene: int) -> tuple[bytes, dict[str, str]]:
    """Return a multipart body with a unique scene of `scene` bytes, and the request headers."""
    content = b"ply\n" + os.urandom(32) + bytes(scene)
    request = httpx2.Request("POST", "http://x", files={"scene": ("scene.ply", content)})
    return request.read(), {"Content-Type": request.headers["content-type"]}


def test_rejected_requests_release_quota(service: Service, files: dict[str, bytes]) -> None:
    """Each request fits into the quota, but their sum is ten times as large."""
    before = on_disk(service)
    with service.client(key(service, Quotas(stored_bytes=5 * MB))) as client:
        for number in range(12):
            broken = os.urandom(4 * MB)
            answer = client.post("/v1/jobs", files=form({**files, "style": broken}))
            refused(answer, 422, "invalid-image")
            assert on_disk(service) <= before, f"request {number} has left its files"


@pytest.mark.slow
def test_dry_runs_and_full_queues_release_quota(tmp_path: Path, files: dict[str, bytes]) -> None:
    quick = {"parameters": json.dumps({"preset": "preview", "backbone": "vgg16", "resolution": 128})}
    with (
        Service(tmp_path / "data", alone=True, SGSST_REQUIRE_KEYS="true", SGSST_MAX_JOBS_PER_KEY="1") as service,
        service.client(key(service, NO_QUOTAS)) as client,
    ):
        for accept in ("*/*", "text/event-stream"):
            answer = client.post(
                "/v1/jobs?dry_run=true", files=form(files), data=quick, headers={"Accept": accept}, timeout=PATIENCE
            )
            assert answer.status_code == 200
            assert "estimated_seconds" in answer.text
            assert on_disk(service) == 0, accept
        assert client.post("/v1/jobs", files=form(files)).status_code == 202
        before = on_disk(service)
        assert before == sum(len(content) for content in files.values())
        refused(client.post("/v1/jobs", files=form(files)), 429, "queue-full")
        assert on_disk(service) == before, "the job still needs the same files"
        other = {**files, "cameras": files["cameras"] + b"\n"}
        refused(client.post("/v1/jobs", files=form(other)), 429, "queue-full")
        assert on_disk(service) == before
        job_id = client.get("/v1/jobs").json()["jobs"][0]["id"]
        client.post(f"/v1/jobs/{job_id}/cancel")
        assert client.delete(f"/v1/jobs/{job_id}").status_code == 204
        assert on_disk(service) == 0


def test_declared_bytes_over_quota_are_rejected_early(service: Service) -> None:
    before = on_disk(service)
    owner, text = owner_and_key(service, Quotas(stored_bytes=5 * MB))
    head = f"POST /v1/jobs HTTP/1.1\nAuthorization: Bearer {text}\nContent-Length: {6 * MB}\n"
    with connect(service) as connection:
        connection.sendall(lines(head + "Content-Type: multipart/form-data; boundary=x"))
        assert connection.recv(4096).startswith(b"HTTP/1.1 429 "), "no byte of the body was sent"
    assert on_disk(service) == before
    with service.store() as store:
        assert usage_of(store, owner).stored_bytes == 0


def test_undeclared_bytes_are_charged_on_arrival(service: Service) -> None:
    before, most = on_disk(service), 0
    body, headers = body_of(20 * MB)

    def pieces() -> Iterator[bytes]:
        nonlocal most
        for start in range(0, len(body), MB // 4):
            yield body[start : start + MB // 4]
            most = max(most, on_disk(service))

    with service.client(key(service, Quotas(stored_bytes=5 * MB))) as client:
        refused(client.post("/v1/jobs", content=pieces(), headers=headers), 429, "quota-exceeded")
    assert most - before <= 5 * MB
    assert on_disk(service) == before


def test_deleted_uploads_release_quota(service: Service) -> None:
    before = on_disk(service)
    with service.client(key(service, Quotas(stored_bytes=5 * MB))) as client:
        for _ in range(3):
            content = os.urandom(4 * MB)
            where = begin(client, len(content))
            assert send(client, where, 0, content).status_code == 204
            assert client.delete(where, headers=TUS).status_code == 204
            assert on_disk(service) == before
