"""Tests of webhooks at submission: URLs that cannot be called are refused with a problem document."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import httpx2
import pytest

from service.settings import ServiceSettings
from service.store import open_store
from tests.api.service import Service, check_documented
from tests.small_scenes import wall, write_files


@pytest.fixture(scope="module")
def service(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Service]:
    data = tmp_path_factory.mktemp("webhooks") / "data"
    with Service(data, alone=True, SGSST_WEBHOOKS="true") as running:
        yield running


def test_uncallable_webhook_urls_are_rejected(service: Service, tmp_path: Path) -> None:
    scene, cameras, style = write_files(tmp_path, wall())
    files = [
        (role, (path.name, path.read_bytes()))
        for role, path in (("scene", scene), ("cameras", cameras), ("style", style))
    ]

    def submit(url: str) -> httpx2.Response:
        return client.post("/v1/jobs", files=files, data={"webhook": url})

    refused = ["http://[::1", "http://℀.com/", "http://a:99999/", "http://user:pw@example.com/", "ftp://example.com"]
    with service.client() as client:
        for url in [*refused, "http://exa mple.com/", "x" * 3000]:
            answer = submit(url)
            assert answer.status_code == 422, f"{url[:80]!r}: {answer.status_code} {answer.text}"
            check_documented(answer)
            problem = answer.json()
            assert (problem["code"], problem["input"]) == ("invalid-webhook", "webhook")
        assert submit("https://example.com/hook").status_code == 202
    store = open_store(ServiceSettings(data=service.data))
    assert [job.row.webhook for job in store.jobs.page(None, limit=10)] == ["https://example.com/hook"]
    store.close()
