"""Tests of outages: a database that is stopped, killed or locked, and file stores and folders that hang.

Requests that need them get 503 with Retry-After; others and health checks still work.
"""

import asyncio
import contextlib
import json
import os
import signal
import sqlite3
import threading
from collections.abc import AsyncIterator, Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import AbstractContextManager, ExitStack, contextmanager
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import httpx2
import pytest
import uvicorn
from fastapi import FastAPI, Request
from fastapi.responses import StreamingResponse

from api.http.access import MOST_FAILURES
from api.http.app import Deadlines, create_app
from service import problems
from service.deadlines import FileThreads, suspended
from service.problems import SHARE_ID, SHARE_TOKEN, StoreError
from service.settings import ServiceSettings
from tests.api.http.sending import TUS, form, refused, send
from tests.api.service import PATIENCE, Service, wait_for
from tests.ports import free_port
from tests.postgres import Postgres, controlled_server, fresh_database, is_installed
from tests.service.files.s3 import FaultyS3, environment_of, s3_server

#: Concurrent requests: more than an API process has threads for.
MANY = 60
#: Timeout of a health check on a busy machine in seconds. If it waited for other requests, it would take minutes.
HEALTH_SECONDS = 60.0
#: Operations that need no database.
WITHOUT_DATABASE = {("get", "/livez"), ("get", "/readyz"), ("options", "/v1/uploads")}
CODES = ("database-unavailable", "database-busy")


@dataclass
class Outage:
    """Service whose database can be stopped or killed."""

    service: Service
    key: str
    job_id: str
    upload_id: str
    postgres: Postgres

    def client(self) -> httpx2.Client:
        """Return an HTTP client of the service, with a key."""
        return self.service.client(self.key)

    @contextlib.contextmanager
    def kind(self, name: str) -> Iterator[None]:
        """Make the database unavailable within the block, or read-only as a standby."""
        if name == "standby":
            with self.postgres.standby():
                yield
            return self.back(name)
        self.postgres.signal(signal.SIGSTOP if name == "stopped" else signal.SIGKILL)
        try:
            yield
        finally:
            self.back(name)

    def back(self, name: str) -> None:
        """Restore the database, and wait until the service uses it again."""
        if name == "stopped":
            self.postgres.signal(signal.SIGCONT)
        elif name == "killed":
            self.postgres.start()
        with self.client() as client:
            wait_for(lambda: client.get(f"/v1/jobs/{self.job_id}").status_code == 200, "reads", self.service.said)
            wait_for(lambda: create_upload(client).status_code == 201, "writes", self.service.said)


def create_upload(client: httpx2.Client) -> httpx2.Response:
    return client.post("/v1/uploads", headers={**TUS, "Upload-Length": "100"})


def open_service(data: Path, database: str | None, files: dict[str, bytes]) -> Iterator[tuple[Service, str, str, str]]:
    """Yield a service that requires keys, a key, and the ids of a job and of an upload that belong to the key."""
    settings = {"SGSST_REQUIRE_KEYS": "true", **({"SGSST_DATABASE": database} if database else {})}
    with Service(data, alone=True, **settings) as service:
        key = service.key()
        with service.client(key) as client:
            answer = client.post("/v1/jobs", files=form(files))
            assert answer.status_code == 202, answer.text
            yield service, key, answer.json()["id"], create_upload(client).json()["id"]


@pytest.fixture(scope="module")
def outage(tmp_path_factory: pytest.TempPathFactory, files: dict[str, bytes]) -> Iterator[Outage]:
    if not is_installed():
        pytest.skip("PostgreSQL's server is not installed")
    with controlled_server() as postgres:
        opened = open_service(tmp_path_factory.mktemp("outage") / "data", fresh_database(postgres.url), files)
        for service, key, job_id, upload_id in opened:
            yield Outage(service, key, job_id, upload_id, postgres)


@cache
def operations() -> list[tuple[str, str]]:
    """Return method and path of every operation that needs the database."""
    document = create_app(ServiceSettings()).openapi()
    pairs = [(method, path) for path, methods in document["paths"].items() for method in methods]
    return [each for each in pairs if each not in WITHOUT_DATABASE]


def request(client: httpx2.Client, method: str, path: str, outage: Outage, files: dict[str, bytes]) -> httpx2.Response:
    """Send a request that would succeed, or be refused for the job's state, if the database were available."""
    body: dict[str, Any] = {}
    if (method, path) == ("post", "/v1/jobs"):
        body = {"files": form(files)}
    elif path.startswith("/v1/uploads"):
        body = {"headers": {**TUS, "Upload-Length": "100"}}
    elif path == "/v1/session":
        body = {"headers": {"Cookie": "sgsst_session=x", "Origin": outage.service.url}}
    if path == "/v1/session" and method == "post":
        body["json"] = {"key": outage.key}
    if (method, path) == ("patch", "/v1/jobs/{job_id}"):
        body["json"] = {"name": "renamed"}
    elif method == "patch":
        body["headers"] |= {"Upload-Offset": "0", "Content-Type": "application/offset+octet-stream"}
        body["content"] = b"x" * 10
    values = {"job_id": outage.job_id, "upload_id": outage.upload_id, "role": "scene", "name": "stylized.ply"}
    values |= {"share_id": SHARE_ID, "token": SHARE_TOKEN}
    return client.request(method, path.format(**values), **body)


def check_away(answer: httpx2.Response) -> None:
    """Fail unless the response says that the database is unavailable and when to retry."""
    assert answer.status_code == 503, (answer.request.method, str(answer.request.url), answer.text)
    assert int(answer.headers["retry-after"]) > 0
    if answer.request.method != "HEAD":
        refused(answer, 503, answer.json()["code"])
        assert answer.json()["code"] in CODES


def check_health(service: Service, ready: int) -> None:
    """Fail unless liveness responds with 200 and readiness with the status `ready`."""
    assert httpx2.get(f"{service.url}/livez", timeout=HEALTH_SECONDS).status_code == 200
    answer = httpx2.get(f"{service.url}/readyz", timeout=HEALTH_SECONDS)
    assert answer.status_code == ready, answer.text
    assert (answer.json()["checks"]["database"] == "ok") == (ready == 200)


def at_once(ask: Callable[[], httpx2.Response]) -> contextlib.ExitStack:
    """Start `MANY` concurrent requests; at the end of the block, wait for the responses and check them."""
    stack = contextlib.ExitStack()
    pool = stack.enter_context(ThreadPoolExecutor(MANY))
    answers = [pool.submit(ask) for _ in range(MANY)]

    def check_all() -> None:
        for answer in answers:
            check_away(answer.result())

    stack.callback(check_all)
    return stack


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["killed", "stopped"])
def test_every_operation_reports_unavailable_database(outage: Outage, files: dict[str, bytes], kind: str) -> None:
    with outage.client() as client, outage.kind(kind), ThreadPoolExecutor(len(operations())) as pool:
        for answer in pool.map(lambda each: request(client, each[0], each[1], outage, files), operations()):
            check_away(answer)
        check_health(outage.service, 503)
    check_health(outage.service, 200)
    assert "Traceback" not in outage.service.said()


@pytest.mark.slow
def test_standby_is_read_and_reported_as_unavailable(outage: Outage) -> None:
    with outage.client() as client, outage.kind("standby"):
        wait_for(lambda: client.get(f"/v1/jobs/{outage.job_id}").status_code == 200, "reads", outage.service.said)
        for _ in range(2):
            refused(create_upload(client), 503, "database-unavailable")
            check_away(client.post(f"/v1/jobs/{outage.job_id}/cancel"))
        check_health(outage.service, 503)
    check_health(outage.service, 200)
    assert "Traceback" not in outage.service.said()


@pytest.mark.slow
def test_sign_ins_during_an_outage_do_not_count_as_failed(outage: Outage) -> None:
    with outage.service.client() as browser:
        with outage.kind("killed"):
            for _ in range(MOST_FAILURES + 1):
                check_away(browser.post("/v1/session", json={"key": outage.key}))
        assert browser.post("/v1/session", json={"key": outage.key}).status_code == 204


@pytest.mark.slow
def test_health_checks_answer_while_requests_wait(outage: Outage) -> None:
    with outage.client() as client, outage.kind("stopped"), at_once(lambda: client.get("/v1/jobs")):
        for _ in range(3):
            check_health(outage.service, 503)


@pytest.mark.slow
def test_stream_resumes_when_database_returns(outage: Outage, files: dict[str, bytes]) -> None:
    with outage.client() as client, outage.client() as other:
        job_id = client.post("/v1/jobs", files=form(files)).json()["id"]
        with client.sse(f"/v1/jobs/{job_id}/events") as stream:
            events = (json.loads(sent.data) for sent in stream if sent.data)
            assert next(events) == {"status": "queued", "attempt": 0}
            with outage.kind("killed"):
                check_away(other.get(f"/v1/jobs/{job_id}"))
            assert other.post(f"/v1/jobs/{job_id}/cancel").status_code == 200
            assert [*events][-1]["status"] == "canceled"


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["killed", "stopped"])
def test_interrupted_upload_can_be_resumed(outage: Outage, kind: str) -> None:
    with outage.client() as client, contextlib.ExitStack() as away:
        place = create_upload(client).headers["location"]

        def body() -> Iterator[bytes]:
            yield b"x" * 50
            away.enter_context(outage.kind(kind))
            yield b"y" * 50

        check_away(send(client, place, 0, body()))
        away.close()
        offset = int(client.head(place, headers=TUS).headers["upload-offset"])
        answer = send(client, place, offset, (b"x" * 50 + b"y" * 50)[offset:])
        assert (answer.status_code, answer.headers["upload-offset"]) == (204, "100")


@pytest.mark.slow
def test_locked_database_is_busy_but_readable(tmp_path: Path, files: dict[str, bytes]) -> None:
    for service, key, job_id, _ in open_service(tmp_path / "data", None, files):
        with service.client(key) as client, contextlib.closing(sqlite3.connect(service.data / "sgsst.db")) as other:
            other.isolation_level = None
            other.execute("BEGIN EXCLUSIVE")
            with at_once(lambda: create_upload(client)), ThreadPoolExecutor(2) as pool:
                upload = pool.submit(create_upload, client)
                origin = {"Origin": service.url}
                sign_in = pool.submit(client.post, "/v1/session", json={"key": key}, headers=origin)
                for _ in range(3):
                    check_health(service, 200)
                assert client.get(f"/v1/jobs/{job_id}").status_code == 200
            refused(upload.result(), 503, "database-busy")
            refused(sign_in.result(), 503, "database-busy")
            other.execute("ROLLBACK")
            assert create_upload(client).status_code == 201
            assert client.post(f"/v1/jobs/{job_id}/cancel").status_code == 200


#: Settings of a service whose files can hang, and functions that make them hang and respond again.
Hanging = tuple[dict[str, str], Callable[[], None], Callable[[], None]]


@contextmanager
def hanging_store(folder: Path) -> Iterator[Hanging]:
    """Provide settings with a store that can hang, and functions that make it hang and answer again."""
    with s3_server() as url, FaultyS3(url) as s3:
        assert httpx2.put(f"{url}/results").status_code == 200
        settings = {"SGSST_ARTIFACTS": "s3://results/files", **environment_of(s3.origin)}
        yield settings, lambda: s3.fail("silence", 10**6), s3.heal


@contextmanager
def hanging_folder(folder: Path) -> Iterator[Hanging]:
    """Do the same with a pipe in place of the scene: opening it takes until somebody else writes to it."""
    moved: list[tuple[Path, Path]] = []

    def hang() -> None:
        for path in (folder / "blobs").glob("*/*"):
            moved.append((path, path.rename(path.with_suffix(".away"))))
            os.mkfifo(path)

    def heal() -> None:
        while moved:
            path, away = moved.pop()
            pipe = path.rename(path.with_suffix(".pipe"))
            away.rename(path)
            writers.callback(os.close, os.open(pipe, os.O_RDWR))  # no opening waits any longer

    with ExitStack() as writers:
        yield {}, hang, heal


@pytest.mark.parametrize("kind", [pytest.param(hanging_store, marks=pytest.mark.slow), hanging_folder])
def test_hanging_files_delay_only_requests_that_need_them(
    tmp_path: Path, files: dict[str, bytes], kind: Callable[..., AbstractContextManager[Hanging]]
) -> None:
    """The deadline is longer than the patience of the other key's client."""
    data = tmp_path / "data"
    with ExitStack() as stack:
        settings, hang, heal = stack.enter_context(kind(data))
        settings |= {"SGSST_REQUIRE_KEYS": "true", "SGSST_ANSWER_SECONDS": str(PATIENCE)}
        service = stack.enter_context(Service(data, alone=True, **settings))
        mine, others = (service.client(service.key()) for _ in range(2))
        mine.timeout = httpx2.Timeout(PATIENCE)
        job_id = mine.post("/v1/jobs", files=form(files)).json()["id"]
        hang()
        pool = stack.enter_context(ThreadPoolExecutor(MANY))
        stack.callback(heal)
        downloads = [pool.submit(mine.get, f"/v1/jobs/{job_id}/inputs/scene") for _ in range(MANY)]
        for client in (mine, others):
            assert len(client.get("/v1/jobs").json()["jobs"]) == (client is mine)
            assert client.post(f"/v1/jobs/{job_id}/cancel").status_code == (200 if client is mine else 404)
        assert others.get("/metrics").status_code == 200
        assert not any(download.done() for download in downloads)
        heal()
        answers = [download.result() for download in downloads]
        assert {answer.status_code for answer in answers} <= {200, 500}  # 500: a digest of the pipe's content
        wait_for(lambda: mine.get(f"/v1/jobs/{job_id}/inputs/scene").content == files["scene"], "the file")


def test_owners_take_turns_and_work_is_given_up() -> None:
    """A thread that hangs stays occupied; its owner's further work is given up, and another owner's is done."""
    release = threading.Event()

    async def work() -> None:
        threads = FileThreads(0.5)
        waiting = [asyncio.create_task(threads.run("me", release.wait)) for _ in range(MANY)]
        await asyncio.sleep(0)
        assert await threads.run("other", lambda: "done") == "done"
        results = await asyncio.gather(*waiting, return_exceptions=True)
        assert {type(result) for result in results} == {StoreError}
        with pytest.raises(StoreError):
            await threads.run("me", lambda: "done")
        release.set()
        again = FileThreads(PATIENCE)
        assert await again.run("me", lambda: "done") == "done"
        for each in (threads, again):
            each.close()

    asyncio.run(work())


@pytest.fixture
def server() -> Iterator[str]:
    """Serve an app whose requests hang in different ways, with a deadline of half a second."""
    app = FastAPI()
    app.add_middleware(Deadlines, seconds=0.5)

    @app.get("/hang")
    async def hang() -> None:
        await asyncio.Event().wait()

    @app.get("/works")
    async def works() -> str:
        with suspended():
            await asyncio.sleep(1.0)
        return "done"

    @app.get("/stream")
    async def stream(stall: bool) -> StreamingResponse:
        async def body() -> AsyncIterator[bytes]:
            for _ in range(10):
                yield b"x"
                await asyncio.sleep(0.1)
            if stall:
                await asyncio.Event().wait()

        return StreamingResponse(body())

    @app.post("/body")
    async def body(request: Request) -> int:
        return len(await request.body())

    running = uvicorn.Server(uvicorn.Config(app, port=free_port(), log_config=None))
    thread = threading.Thread(target=running.run)
    thread.start()
    wait_for(lambda: running.started, "the server")
    yield f"http://127.0.0.1:{running.config.port}"
    running.should_exit = True
    thread.join()


@pytest.mark.slow
def test_deadline_is_of_a_request_without_progress(server: str) -> None:
    answer = httpx2.get(f"{server}/hang")
    assert (answer.status_code, answer.json()["code"]) == (503, problems.DEADLINE_EXCEEDED.code)
    assert int(answer.headers["retry-after"]) > 0
    assert httpx2.get(f"{server}/works").json() == "done"
    assert httpx2.get(f"{server}/stream?stall=false").text == "x" * 10
    with pytest.raises(httpx2.RemoteProtocolError):
        httpx2.get(f"{server}/stream?stall=true")

    def slow_body() -> Iterator[bytes]:
        for _ in range(10):
            threading.Event().wait(0.1)
            yield b"x"

    assert httpx2.post(f"{server}/body", content=slow_body()).json() == 10
