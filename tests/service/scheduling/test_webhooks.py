"""Webhooks: signed, tried again, and never to private addresses unless allowed."""

from __future__ import annotations

import base64
import hashlib
import hmac
import json
import threading
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, HTTPServer
from pathlib import Path

import pytest

from service.errors import RefusedInputError
from service.scheduling.webhooks import Deliverer, check_url, public_address
from service.settings import ServiceSettings
from service.store import Store, open_store
from service.store.jobs import NewJob


class Listener:
    """A server that remembers what it was told, and answers with `status`."""

    def __init__(self) -> None:
        self.status = 200
        self.heard: list[tuple[dict[str, str], bytes]] = []
        listener = self

        class Handler(BaseHTTPRequestHandler):
            def do_POST(self) -> None:
                body = self.rfile.read(int(self.headers["content-length"]))
                listener.heard.append(({name.lower(): value for name, value in self.headers.items()}, body))
                self.send_response(listener.status)
                self.send_header("Location", listener.url)
                self.end_headers()

            def log_message(self, *ignored: object) -> None:
                return

        self.server = HTTPServer(("127.0.0.1", 0), Handler)
        self.url = f"http://127.0.0.1:{self.server.server_port}/hook"
        threading.Thread(target=self.server.serve_forever, daemon=True).start()


@pytest.fixture
def listener() -> Iterator[Listener]:
    made = Listener()
    yield made
    made.server.shutdown()


def _store(folder: Path, **values: object) -> tuple[ServiceSettings, Store]:
    settings = ServiceSettings(data=folder, webhooks=True, **values)  # type: ignore[arg-type]
    return settings, open_store(settings)


def _ended_job(store: Store, url: str) -> str:
    store.inputs.add_blob("a" * 64, "aa/b", 1)
    inputs = [{"role": "scene", "name": "s", "sha256": "a" * 64, "size": 1}]
    job, _ = store.jobs.create(NewJob("local", "wall", 0, {}, inputs, url), limit=9)
    store.jobs.cancel(job.id, "local")
    return job.id


def test_a_message_is_signed_by_the_convention(tmp_path: Path, listener: Listener) -> None:
    settings, store = _store(tmp_path, webhook_private_addresses=True)
    job_id = _ended_job(store, listener.url)
    Deliverer(settings, store).deliver_due()
    ((headers, body),) = listener.heard
    assert json.loads(body)["type"] == "job.canceled"
    assert json.loads(body)["data"]["id"] == job_id
    key = base64.b64decode(store.operations.webhook_secret().removeprefix("whsec_"))
    signed = f"{headers['webhook-id']}.{headers['webhook-timestamp']}.".encode() + body
    expected = base64.b64encode(hmac.new(key, signed, hashlib.sha256).digest()).decode()
    assert headers["webhook-signature"] == f"v1,{expected}"
    Deliverer(settings, store).deliver_due()
    assert len(listener.heard) == 1


def test_a_message_that_is_refused_is_kept(tmp_path: Path, listener: Listener) -> None:
    settings, store = _store(tmp_path, webhook_private_addresses=True)
    _ended_job(store, listener.url)
    listener.status = 500
    Deliverer(settings, store).deliver_due()
    assert store.operations.due_deliveries(1.0) == []  # later
    with store.database.reading() as session:
        left = session.connection().exec_driver_sql("SELECT tries FROM deliveries").scalars().all()
    assert left == [1]


def test_redirects_are_not_followed(tmp_path: Path, listener: Listener) -> None:
    settings, store = _store(tmp_path, webhook_private_addresses=True)
    _ended_job(store, listener.url)
    listener.status = 307
    Deliverer(settings, store).deliver_due()
    assert len(listener.heard) == 1


def test_private_addresses_are_not_called(tmp_path: Path, listener: Listener) -> None:
    settings, store = _store(tmp_path)
    _ended_job(store, listener.url)
    Deliverer(settings, store).deliver_due()
    assert listener.heard == []


@pytest.mark.parametrize(
    "host", ["127.0.0.1", "localhost", "10.1.2.3", "169.254.169.254", "::1", "::ffff:127.0.0.1", "0.0.0.0", "224.0.0.1"]
)
def test_what_counts_as_private(host: str) -> None:
    with pytest.raises(PermissionError):
        public_address(host, 80, private_allowed=False)


def test_urls_that_are_refused(tmp_path: Path) -> None:
    on = ServiceSettings(data=tmp_path, webhooks=True)
    for url in ("ftp://example.com", "file:///etc/passwd", "http://", "http://user:pw@example.com", "x" * 3000):
        with pytest.raises(RefusedInputError):
            check_url(url, on)
    assert check_url("https://example.com/hook", on)
    with pytest.raises(RefusedInputError, match="switched off"):
        check_url("https://example.com/hook", ServiceSettings(data=tmp_path))
