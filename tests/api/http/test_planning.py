"""Tests of dry runs that report their progress."""

from __future__ import annotations

import asyncio
import json
from collections.abc import Iterator
from typing import Any

import httpx
import pytest
from httpx_sse import ServerSentEvent, connect_sse

from tests.api.service import PATIENCE, Service, wait_for
from tests.small_scenes import wall, write_files

#: Region that freezes every Gaussian in view, but not those at the corners of the wall.
IN_VIEW = {"name": "middle", "select": "sphere=0,0,3,2.5", "freeze": True}
PARAMETERS = {"preset": "preview", "backbone": "vgg16", "resolution": 128}


@pytest.fixture(scope="module")
def service(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Service]:
    with Service(tmp_path_factory.mktemp("planning") / "data", alone=True) as running:
        yield running


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    scene, cameras, style = write_files(tmp_path_factory.mktemp("inputs"), wall())
    return {"scene": scene.read_bytes(), "cameras": cameras.read_bytes(), "style": style.read_bytes()}


def request(files: dict[str, bytes], **parameters: Any) -> dict[str, Any]:
    names = {"scene": "scene.ply", "cameras": "cameras.json", "style": "style.png"}
    return {
        "params": {"dry_run": True},
        "files": [(role, (names[role], content)) for role, content in files.items()],
        "data": {"parameters": json.dumps(PARAMETERS | parameters)},
    }


def events(client: httpx.Client, files: dict[str, bytes], **parameters: Any) -> list[ServerSentEvent]:
    with connect_sse(client, "POST", "/v1/jobs", **request(files, **parameters)) as source:
        assert source.response.status_code == 200, source.response.read()
        return [sent for sent in source.iter_sse() if sent.data]


def test_views_are_told_and_the_plan_is_the_one_without_events(service: Service, files: dict[str, bytes]) -> None:
    with service.client() as client:
        *planning, last = events(client, files)
        assert {sent.event for sent in planning} == {"planning"}
        now = [sent.json() for sent in planning]
        assert [entry["total"] for entry in now] == [3] * len(now)
        assert [entry["step"] for entry in now] == sorted(entry["step"] for entry in now)
        assert (now[-1]["step"], now[-1]["fraction"]) == (3, 1.0)
        assert last.event == "plan"
        plain = client.post("/v1/jobs", **request(files))
        assert plain.headers["content-type"] == "application/json"
        assert plain.json() == last.json()
        assert client.get("/v1/jobs").json()["jobs"] == []


def test_what_cannot_be_used_is_refused_before_the_first_event(service: Service, files: dict[str, bytes]) -> None:
    with service.client() as client:
        headers = {"Accept": "text/event-stream"}
        answer = client.post("/v1/jobs", headers=headers, **request({**files, "scene": b"none"}))
        assert (answer.status_code, answer.json()["code"]) == (422, "invalid-scene")


def test_what_only_the_plan_finds_is_an_event(service: Service, files: dict[str, bytes]) -> None:
    with service.client() as client:
        last = events(client, files, regions=[IN_VIEW])[-1]
        assert (last.event, last.json()["status"], last.json()["code"]) == ("problem", 422, "invalid-settings")
        plain = client.post("/v1/jobs", **request(files, regions=[IN_VIEW]))
        assert (plain.status_code, plain.json()) == (422, last.json())


def test_nobody_plans_for_who_has_left(service: Service, files: dict[str, bytes]) -> None:
    with service.client() as client:
        events(client, files)
        both = len(service.processes("service.inspection.process"))
        begin_and_leave(service, client, files, both, resolution=1024, seed=1)
        assert events(client, files, resolution=96)[-1].event == "plan"


def test_nor_for_who_has_left_without_events(service: Service, files: dict[str, bytes]) -> None:
    with service.client() as client:
        events(client, files)
        both = len(service.processes("service.inspection.process"))
        begin_and_leave(service, client, files, both, resolution=1024, seed=2)  # validated by now, and not planned

    async def leave() -> None:
        async with httpx.AsyncClient(base_url=service.url, headers=client.headers, timeout=PATIENCE) as waiting:
            answer = asyncio.create_task(waiting.post("/v1/jobs", **request(files, resolution=1024, seed=2)))
            await asyncio.to_thread(
                wait_for, lambda: len(service.processes("service.inspection.process")) >= both, "the planning to begin"
            )
            assert not answer.done()
            answer.cancel()

    asyncio.run(leave())
    wait_for(lambda: len(service.processes("service.inspection.process")) < both, "the planning process to end")
    with service.client() as client:
        assert client.post("/v1/jobs", **request(files, resolution=96)).status_code == 200


def begin_and_leave(
    service: Service, client: httpx.Client, files: dict[str, bytes], both: int, **parameters: Any
) -> None:
    """Start a dry run, disconnect at the first event, and wait until fewer than `both` inspecting processes run."""
    with connect_sse(client, "POST", "/v1/jobs", **request(files, **parameters)) as source:
        next(source.iter_sse())
    wait_for(lambda: len(service.processes("service.inspection.process")) < both, "the planning process to end")
