"""Tests of webhooks at submission: URLs that cannot be called are refused with a problem document."""

from __future__ import annotations

from pathlib import Path

import httpx2
import pytest

from service.settings import ServiceSettings
from service.store import open_store
from tests.api.conftest import Services
from tests.api.service import Service, check_documented
from tests.small_scenes import wall, write_files


@pytest.fixture(scope="module")
def service(services: Services) -> Service:
    return services(SGSST_TRUSTED_PROXIES="127.0.0.0/8", SGSST_REQUIRE_KEYS="false", SGSST_WEBHOOKS="true")


def test_uncallable_webhook_urls_are_rejected(service: Service, tmp_path: Path) -> None:
    scene, cameras, style = write_files(tmp_path, wall())
    files = [
        (role, (path.name, path.read_bytes()))
        for role, path in (("scene", scene), ("cameras", cameras), ("style", style))
    ]

    def submit(url: str, **more: str) -> httpx2.Response:
        return client.post("/v1/jobs", files=files, data={"webhook": url, **more})

    refused = ["http://[::1", "http://℀.com/", "http://a:99999/", "http://user:pw@example.com/", "ftp://example.com"]
    with service.client() as client:
        for url in [*refused, "http://exa mple.com/", "x" * 3000]:
            answer = submit(url)
            assert answer.status_code == 422, f"{url[:80]!r}: {answer.status_code} {answer.text}"
            check_documented(answer)
            problem = answer.json()
            assert (problem["code"], problem["input"]) == ("invalid-webhook", "webhook")
        assert submit("https://example.com/hook").status_code == 202
        assert submit("https://example.com/hook", webhook_events="started, progress").status_code == 202
        for url, events in (("https://example.com/hook", "ended"), ("", "started")):
            answer = submit(url, webhook_events=events)
            check_documented(answer)
            assert (answer.status_code, answer.json()["code"]) == (422, "invalid-request")
            assert "webhook_events" in answer.text
    store = open_store(ServiceSettings(data=service.data))
    chosen, default = (shown.row for shown in store.jobs.page(None, limit=2))
    store.close()
    assert (default.webhook, default.webhook_events) == ("https://example.com/hook", None)
    assert chosen.webhook_events == ["started", "progress"]
