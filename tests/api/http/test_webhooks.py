"""Tests of webhooks at submission: URLs that cannot be called are refused with a problem document."""

import httpx2
import pytest

from service.store import Store
from tests.api.conftest import Services
from tests.api.http.sending import form, refused
from tests.api.service import Service


@pytest.fixture(scope="module")
def service(services: Services) -> Service:
    return services(SGSST_TRUSTED_PROXIES="127.0.0.0/8", SGSST_REQUIRE_KEYS="false", SGSST_WEBHOOKS="true")


def test_uncallable_webhook_urls_are_rejected(store: Store, client: httpx2.Client, files: dict[str, bytes]) -> None:
    def submit(url: str, **more: str) -> httpx2.Response:
        return client.post("/v1/jobs", files=form(files), data={"webhook": url, **more})

    wrong = ["http://[::1", "http://℀.com/", "http://a:99999/", "http://user:pw@example.com/", "ftp://example.com"]
    for url in [*wrong, "http://exa mple.com/", "x" * 3000]:
        assert refused(submit(url), 422, "invalid-webhook")["input"] == "webhook"
    assert submit("https://example.com/hook").status_code == 202
    assert submit("https://example.com/hook", webhook_events="started, progress").status_code == 202
    for url, events in (("https://example.com/hook", "ended"), ("", "started")):
        assert "webhook_events" in str(refused(submit(url, webhook_events=events), 422, "invalid-request"))
    chosen, default = (shown.row for shown in store.jobs.page(None, limit=2))
    assert (default.webhook, default.webhook_events) == ("https://example.com/hook", None)
    assert chosen.webhook_events == ["started", "progress"]
