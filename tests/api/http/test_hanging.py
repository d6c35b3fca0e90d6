"""Tests with a file store or a folder that hangs: other requests are answered, and those that need it get 503."""

import asyncio
import os
import threading
from collections.abc import AsyncIterator, Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import AbstractContextManager, ExitStack, contextmanager
from pathlib import Path

import httpx2
import pytest
import uvicorn
from fastapi import FastAPI, Request
from fastapi.responses import StreamingResponse

from api.http.app import Deadlines
from service import problems
from service.deadlines import FileThreads, suspended
from service.problems import StoreError
from tests.api.http.sending import form
from tests.api.service import PATIENCE, Service, wait_for
from tests.ports import free_port
from tests.service.files.s3 import FaultyS3, environment_of, s3_server

#: Concurrent downloads of one key: more than the API has threads for.
MANY = 60

#: Settings of a service whose files can hang, and functions that make them hang and respond again.
Hanging = tuple[dict[str, str], Callable[[], None], Callable[[], None]]


@contextmanager
def hanging_store(folder: Path) -> Iterator[Hanging]:
    """Provide settings with a store that can hang, and functions that make it hang and answer again."""
    with s3_server() as url:
        s3 = FaultyS3(url)
        assert httpx2.put(f"{url}/results").status_code == 200
        settings = {"SGSST_ARTIFACTS": "s3://results/files", **environment_of(s3.url)}
        yield settings, lambda: s3.fail("silence", 10**6), s3.heal
        s3.close()


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
