"""Tests of the access log and the metrics of requests: every response is in both, those to unexpected errors too."""

import asyncio
import logging
import re
from collections.abc import AsyncIterator
from pathlib import Path

import httpx2
import pytest
from fastapi.responses import StreamingResponse
from starlette.responses import Response
from starlette.types import ASGIApp, Receive, Scope, Send

from api.http.app import create_app
from service.settings import ServiceSettings
from tests.api.service import Service
from tests.service.store.helpers import SHA, queue


class FaultError(Exception):
    """Error that no code expects."""


async def fail() -> None:
    """Raise before the response has started."""
    raise FaultError


async def break_off() -> StreamingResponse:
    """Raise while the response is being sent."""

    async def body() -> AsyncIterator[bytes]:
        yield b"x"
        raise FaultError

    return StreamingResponse(body())


class Refusing:
    """Middleware that responds to some requests itself."""

    def __init__(self, app: ASGIApp) -> None:
        self._app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        await (Response(status_code=418) if scope["path"] == "/refused" else self._app)(scope, receive, send)


async def request_all(folder: Path) -> tuple[dict[str, httpx2.Response], str]:
    """Send requests to the app with a few routes that fail, and return the responses by path and the metrics."""
    app = create_app(ServiceSettings(data=folder, min_free_bytes=0))
    app.add_middleware(Refusing)
    reached = asyncio.Event()

    async def hang() -> None:
        reached.set()
        await asyncio.Event().wait()

    for route in (fail, break_off, hang):
        app.add_api_route(f"/{route.__name__}", route)
    async with app.router.lifespan_context(app):
        transport = httpx2.ASGITransport(app, raise_app_exceptions=False)
        async with httpx2.AsyncClient(transport=transport, base_url="http://127.0.0.1") as client:
            answers = {path: await client.get(path) for path in ("/livez", "/fail", "/break_off", "/refused", "/x")}
            hanging = asyncio.create_task(client.get("/hang"))
            await reached.wait()
            hanging.cancel()  # as the server does when it stops
            answers["/hang"] = await hanging
            return answers, (await client.get("/metrics")).text


def test_every_response_is_logged_and_counted(
    tmp_path: Path, tiny_installed: Path, caplog: pytest.LogCaptureFixture
) -> None:
    with caplog.at_level(logging.INFO):
        answers, metrics = asyncio.run(request_all(tmp_path / "data"))
    counted = {
        (match[1], match[2]): float(match[3])
        for match in re.finditer(r'sgsst_requests_total\{method="GET",route="(.+)",status="(\d+)"\} (\S+)', metrics)
    }
    assert counted == {
        ("/livez", "200"): 1,
        ("/fail", "500"): 1,
        ("/break_off", "200"): 1,
        ("/break_off", "500"): 1,
        ("(none)", "418"): 1,
        ("(none)", "404"): 1,
        ("/hang", "503"): 1,
    }
    lines = [vars(record) for record in caplog.records if record.name == "api.access"]
    for path, answer in answers.items():
        request_id = answer.headers["x-request-id"]
        line = next(line for line in lines if line["request_id"] == request_id)
        assert (line["path"], line["status"]) == (path, answer.status_code)
    assert len({line["request_id"] for line in lines}) == len(answers) + 1
    broken = answers["/fail"]
    problem = broken.json()
    assert broken.headers["content-type"] == "application/problem+json"
    assert (problem["status"], problem["code"]) == (500, "internal")
    assert problem["request_id"] == broken.headers["x-request-id"]
    (error, _) = (vars(record) for record in caplog.records if record.name == "api.http.problems")
    assert error["request_id"] == problem["request_id"]
    assert error["exc_info"]


def test_streams_that_end_with_the_service_are_no_errors(tmp_path: Path) -> None:
    with Service(tmp_path / "data", alone=True) as service, service.client() as client:
        with service.store() as store:
            store.inputs.add_blob(SHA, "aa/blob", 3)
            job_id = queue(store)
        with client.sse(f"/v1/jobs/{job_id}/events") as stream:
            events = (sent.event for sent in stream if sent.data)
            assert next(events) == "status"
            service.stop()
            assert list(events) == []
        log = service.log.read_text()
        assert not [words for words in ("Traceback", "status=500", "graceful shutdown exceeded") if words in log], log
