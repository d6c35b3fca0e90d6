"""Quotas and rates as a client meets them: 429, when to come back, and what of."""

from __future__ import annotations

import socket
from collections.abc import Iterator
from pathlib import Path

import httpx
import pytest

from api.http.rates import Rates
from service.errors import RateLimitError
from service.settings import ServiceSettings
from service.store import open_store
from service.store.quotas import Quotas
from tests.api.http.test_api import TUS, form, refused
from tests.api.service import Service, wait_for
from tests.small_scenes import wall, write_files


class Clock:
    now = 0.0

    def __call__(self) -> float:
        return self.now


def test_a_rate_is_kept_on_average() -> None:
    clock = Clock()
    rates = Rates(clock)
    for _ in range(20):
        rates.take("alice", 2.0)
    with pytest.raises(RateLimitError) as caught:
        rates.take("alice", 2.0)
    assert caught.value.extra == {"limit": 2.0, "retry_after": 1}
    rates.take("bob", 2.0)
    clock.now += 0.4
    with pytest.raises(RateLimitError):
        rates.take("alice", 2.0)
    clock.now += 0.11
    rates.take("alice", 2.0)
    for _ in range(50):
        rates.take("carol", None)


@pytest.mark.parametrize("a_second", [0.01, 0.5, 3.0])
def test_who_comes_back_when_told_is_let_in(a_second: float) -> None:
    clock = Clock()
    rates = Rates(clock)
    for _ in range(200):
        try:
            rates.take("alice", a_second)
        except RateLimitError as error:
            clock.now += float(str(error.extra["retry_after"]))
            rates.take("alice", a_second)


def test_measures_of_those_who_are_gone_are_forgotten() -> None:
    rates = Rates(Clock())
    for number in range(20_000):
        rates.take(f"key_{number}", 1.0)
    assert len(rates._left) == 10_000
    assert "key_19999" in rates._left


@pytest.fixture(scope="module")
def service(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Service]:
    data = tmp_path_factory.mktemp("quotas") / "data"
    limits = {"SGSST_REQUIRE_KEYS": "true", "SGSST_MAX_JOBS_A_DAY_PER_KEY": "1", "SGSST_MAX_CONNECTIONS": "5"}
    with Service(data, alone=True, **limits) as running:
        yield running


def key(service: Service, quotas: Quotas) -> str:
    store = open_store(ServiceSettings(data=service.data))
    text = store.keys.create("someone", quotas=quotas)[1]
    store.close()
    return text


def test_jobs_bytes_and_requests(service: Service, tmp_path: Path) -> None:
    ply, cameras, style = write_files(tmp_path, wall())
    files = {"scene": ply.read_bytes(), "cameras": cameras.read_bytes(), "style": style.read_bytes()}
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


def test_connections_are_bounded(service: Service) -> None:
    host, port = service.url.removeprefix("http://").split(":")
    held = [socket.create_connection((host, int(port))) for _ in range(6)]
    try:
        held[-1].settimeout(30)
        said = b"".join(iter(lambda: held[-1].recv(4096), b""))
        assert said.startswith(b"HTTP/1.1 503 ")
        assert b"retry-after: 5" in said.lower()
        assert b'"too-many-connections"' in said
    finally:
        for each in held:
            each.close()
    wait_for(lambda: httpx.get(f"{service.url}/livez").status_code == 200, "room for a connection", service.said)
