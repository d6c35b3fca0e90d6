"""Tests of webhooks: signatures, retries, validation of addresses, and isolation of receivers from slow ones."""

import base64
import contextlib
import datetime
import hashlib
import hmac
import ipaddress
import json
import logging
import socket
import ssl
import threading
from collections.abc import Callable, Iterator
from http.server import BaseHTTPRequestHandler
from pathlib import Path
from typing import Any

import pytest
from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from sqlalchemy import select

from service.outgoing import is_public
from service.problems import ServiceError
from service.scheduling import webhooks
from service.scheduling.webhooks import Deliverer, check_url
from service.settings import ServiceSettings
from service.states import WebhookEvent
from service.store import Store, open_store
from service.store.jobs import NewJob
from service.store.tables import DeliveryRow
from sgsst_core.progress import Progress
from tests.http_servers import Answer, LocalServer, repeating, send
from tests.service.store import helpers
from tests.service.store.helpers import Clock
from tests.stores import migrated_database, new_store

#: Time limit of a test's waits in seconds.
PATIENCE = 60.0


class Receiver(LocalServer):
    """Server that records the messages it receives.

    Args:
        behave: Handling of a connection after its message is read; by default the response is `status`.
        certificate: Certificate and key for TLS.
    """

    def __init__(self, behave: Answer | None = None, certificate: Path | None = None) -> None:
        self.status = 200
        self.received: list[tuple[dict[str, str], bytes]] = []
        self.names: list[str | None] = []
        self._behave = behave or (lambda handler: send(handler, status=self.status, Location=self.url))
        super().__init__(self._receive)
        if certificate is not None:
            context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
            context.load_cert_chain(certificate)
            context.sni_callback = lambda connection, name, context: self.names.append(name)
            self.socket = context.wrap_socket(self.socket, server_side=True)
        self.url = f"{'https' if certificate else 'http'}://127.0.0.1:{self.server_port}/hook"

    def _receive(self, handler: BaseHTTPRequestHandler) -> None:
        body = handler.rfile.read(int(handler.headers["content-length"]))
        self.received.append(({name.lower(): value for name, value in handler.headers.items()}, body))
        self._behave(handler)


Start = Callable[..., Receiver]


@pytest.fixture
def start() -> Iterator[Start]:
    """Yield a function that starts receivers, which are stopped after the test."""
    with contextlib.ExitStack() as started:
        yield lambda *arguments, **named: started.enter_context(Receiver(*arguments, **named))


@pytest.fixture
def receiver(start: Start) -> Receiver:
    return start()


@pytest.fixture
def clock() -> Clock:
    return Clock()


@pytest.fixture
def store(tmp_path: Path, clock: Clock) -> Iterator[Store]:
    opened = new_store(_settings(tmp_path), clock)
    yield opened
    opened.close()


def _settings(folder: Path, **values: Any) -> ServiceSettings:
    return ServiceSettings(data=folder, webhooks=True, **{"webhook_private_addresses": True, **values})


def _deliver(store: Store, folder: Path, **values: Any) -> None:
    Deliverer(_settings(folder, **values), store).deliver_due()


def _new_job(store: Store, url: str, owner: str = "local", events: list[WebhookEvent] | None = None) -> str:
    """Create a job with the webhook `url`, bypassing the validation at submission."""
    store.inputs.add_blob("a" * 64, "aa/b", 1)
    inputs = [{"role": "scene", "name": "s", "sha256": "a" * 64, "size": 1}]
    return store.jobs.create(NewJob(owner, "wall", 0, {}, inputs, url, events), limit=1000)[0].id


def _end_job(store: Store, url: str, owner: str = "local") -> str:
    return store.jobs.cancel(_new_job(store, url, owner), owner).id


def _tries(store: Store) -> list[int]:
    """Return the number of attempts of each pending message."""
    with store.database.reading() as session:
        return list(session.scalars(select(DeliveryRow.tries)))


# --- messages -----------------------------------------------------------------------------------------------------


def test_message_is_signed_as_in_standard_webhooks(tmp_path: Path, store: Store, receiver: Receiver) -> None:
    job_id = _end_job(store, receiver.url)
    _deliver(store, tmp_path)
    ((headers, body),) = receiver.received
    assert json.loads(body)["type"] == "job.canceled"
    assert json.loads(body)["data"]["id"] == job_id
    assert headers["host"] == f"127.0.0.1:{receiver.server_port}"
    key = base64.b64decode(store.operations.webhook_secret().removeprefix("whsec_"))
    signed = f"{headers['webhook-id']}.{headers['webhook-timestamp']}.".encode() + body
    expected = base64.b64encode(hmac.new(key, signed, hashlib.sha256).digest()).decode()
    assert headers["webhook-signature"] == f"v1,{expected}"
    _deliver(store, tmp_path)
    assert len(receiver.received) == 1


def test_rejected_message_is_retried(tmp_path: Path, store: Store, receiver: Receiver, clock: Clock) -> None:
    _end_job(store, receiver.url)
    receiver.status = 500
    _deliver(store, tmp_path)
    assert _tries(store) == [1]
    _deliver(store, tmp_path)
    assert len(receiver.received) == 1  # not due yet
    receiver.status = 204
    clock.now += 5
    _deliver(store, tmp_path)
    assert len(receiver.received) == 2
    assert _tries(store) == []


def test_chosen_events_are_sent_and_progress_does_not_queue_up(
    tmp_path: Path, store: Store, receiver: Receiver, clock: Clock
) -> None:
    def sent() -> list[str]:
        return [json.loads(body)["type"] for _, body in receiver.received]

    choices: tuple[list[WebhookEvent] | None, ...] = (["started", "progress", "completed"], ["started"], None)
    for events in choices:
        _new_job(store, receiver.url, events=events)
        lease = helpers.lease(store)
        store.leases.start(lease)
        for step in (1, 2, 3):
            progress = Progress(stage="sos", step=step, total=9)
            store.leases.report_progress(lease, progress, notify=bool(events and "progress" in events))
        _deliver(store, tmp_path)
        if events is not None and "progress" in events:
            assert sorted(sent()) == ["job.progress", "job.started"]
            messages = {message["type"]: message["data"] for message in (json.loads(b) for _, b in receiver.received)}
            assert messages["job.progress"]["progress"]["step"] == 3
            assert messages["job.started"] == {
                "id": lease.job_id,
                "name": "wall",
                "status": "running",
                "error": None,
                "attempt": 1,
            }
            receiver.status = 500
            store.leases.report_progress(lease, progress, notify=True)
            _deliver(store, tmp_path)
            assert _tries(store) == [], "it is not tried again"
            receiver.status = 200
            store.leases.report_progress(lease, progress, notify=True)
            receiver.received.clear()
        store.leases.fail(lease, {"code": "x", "message": "x"}, permanent=True)
        _deliver(store, tmp_path)
    assert sent() == ["job.failed", "job.started", "job.failed"]


def test_redirects_are_not_followed(tmp_path: Path, store: Store, receiver: Receiver) -> None:
    _end_job(store, receiver.url)
    receiver.status = 307
    _deliver(store, tmp_path)
    assert len(receiver.received) == 1
    assert _tries(store) == [1]


# --- harmful receivers and rows -----------------------------------------------------------------------------------

UNUSABLE = ["http://127.0.0.1:99999/", "http://[::1", "http://℀.com/", "http://[v1.x]/", "\ud800", ""]


def test_invalid_rows_do_not_block_other_messages(tmp_path: Path, store: Store, receiver: Receiver) -> None:
    """An older version without validation may have stored such rows. The newest message must still be sent."""
    for url in UNUSABLE[:4]:
        _end_job(store, url)
    _end_job(store, receiver.url)
    _deliver(store, tmp_path)
    assert len(receiver.received) == 1
    assert _tries(store) == [1] * 4


def test_message_that_always_fails_is_given_up(
    tmp_path: Path, store: Store, clock: Clock, caplog: pytest.LogCaptureFixture
) -> None:
    job_id = _end_job(store, "http://127.0.0.1:99999/")
    with caplog.at_level(logging.WARNING):
        for attempt in range(1, 8):
            assert _tries(store) == [attempt - 1]
            _deliver(store, tmp_path)
            clock.now += 86_400
    assert _tries(store) == []
    last = caplog.records[-1]
    assert last.__dict__["job"] == job_id
    assert "given up" in last.getMessage()
    assert "port" in last.getMessage()


@pytest.mark.parametrize(
    ("head", "tries"),
    [(b"HTTP/1.1 200 OK\r\nContent-Type: text/plain\r\n\r\n", []), (b"HTTP/1.1 200 OK\r\nX: ", [1])],
    ids=["body", "head"],
)
def test_only_the_head_of_a_response_is_read(
    tmp_path: Path, store: Store, start: Start, head: bytes, tries: list[int]
) -> None:
    """Only the head of a response is read, and at most some of an endless one."""
    endless = repeating(head, b"x" * (1 << 16), cut_off := threading.Event())
    _end_job(store, start(endless).url)
    _deliver(store, tmp_path)
    assert cut_off.wait(PATIENCE), "everything was read"
    assert _tries(store) == tries


@pytest.mark.parametrize("head", [b"", b"HTTP/1.1 200 OK\r\nX: "], ids=["100-continue", "head"])
def test_slow_receiver_is_cut_off_at_the_deadline(
    head: bytes, tmp_path: Path, store: Store, start: Start, monkeypatch: pytest.MonkeyPatch
) -> None:
    """No single read takes long, but the deadline covers the whole delivery."""
    monkeypatch.setattr(webhooks, "_DEADLINE", 2.0)  # long enough to send the message on a busy machine
    block = b"x" if head else b"HTTP/1.1 100 Continue\r\n\r\n"
    receiver = start(repeating(head, block, cut_off := threading.Event(), 0.02))
    _end_job(store, receiver.url)
    _deliver(store, tmp_path)
    assert cut_off.wait(PATIENCE)
    assert len(receiver.received) == 1
    assert _tries(store) == [1]


def test_deadline_includes_lookup_and_tls(
    tmp_path: Path, store: Store, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """The receivers are a host name whose lookup hangs, and a server that accepts connections, but never responds."""
    release, getaddrinfo = threading.Event(), socket.getaddrinfo

    def slow(host: Any, *arguments: Any, **named: Any) -> Any:
        if host == "receiver.example":
            release.wait(PATIENCE)
            host = "127.0.0.1"
        return getaddrinfo(host, *arguments, **named)

    monkeypatch.setattr(socket, "getaddrinfo", slow)
    monkeypatch.setattr(webhooks, "_DEADLINE", 0.5)
    with socket.create_server(("127.0.0.1", 0)) as silent, caplog.at_level(logging.WARNING):
        _end_job(store, f"http://receiver.example:{silent.getsockname()[1]}/")
        _end_job(store, f"https://127.0.0.1:{silent.getsockname()[1]}/")
        _deliver(store, tmp_path)
        release.set()
    assert _tries(store) == [1, 1]
    assert [record.getMessage().count("no answer within") for record in caplog.records] == [1, 1]


def test_slow_receivers_do_not_delay_other_messages(tmp_path: Path, store: Store, start: Start) -> None:
    """One owner has many messages to one unresponsive receiver, another one to many such receivers."""
    release = threading.Event()
    slow = start(lambda handler: release.wait(PATIENCE))
    received = threading.Semaphore(0)

    def answer(handler: Any) -> None:
        send(handler)
        received.release()

    quick = start(answer)
    for index in range(20):
        _end_job(store, slow.url, owner="patient")
        _end_job(store, f"{slow.url}/{index}", owner="greedy")
    _end_job(store, f"{quick.url}/own", owner="patient")
    _end_job(store, quick.url, owner="other")
    deliverer = Deliverer(_settings(tmp_path), store)
    thread = threading.Thread(target=deliverer.deliver_due, daemon=True)
    thread.start()
    try:
        assert received.acquire(timeout=PATIENCE)
        assert received.acquire(timeout=PATIENCE)
        assert len(slow.received) <= webhooks._MAX_PER_URL + webhooks._MAX_PER_OWNER
    finally:
        release.set()
        thread.join(PATIENCE)


@pytest.mark.parametrize("backend", ["sqlite", "postgresql"])
def test_messages_are_claimed_fairly_and_once(
    backend: str, request: pytest.FixtureRequest, tmp_path: Path, clock: Clock
) -> None:
    if backend == "sqlite":
        _check_turns(new_store(_settings(tmp_path), clock))
        return
    database = migrated_database(request.getfixturevalue("postgres"))
    _check_turns(open_store(_settings(tmp_path, database=database), clock))


def _check_turns(store: Store) -> None:
    limits = {"total": 6, "per_owner": 4, "per_url": 2}
    for index in range(10):
        _end_job(store, f"http://a/{index // 5}", owner="a")
    _end_job(store, "http://a/3", owner="a")
    for _ in range(3):
        _end_job(store, "http://b/", owner="b")
    first = store.operations.due_deliveries(60, [], **limits)
    assert sorted(each.url for each, owner in first if owner == "a") == ["http://a/0"] * 2 + ["http://a/1"] * 2
    assert [each.url for each, owner in first if owner == "b"] == ["http://b/"] * 2
    assert store.operations.due_deliveries(60, first, **limits) == []
    going = [claimed for claimed in first if claimed[0].url == "http://a/0"]
    second = store.operations.due_deliveries(60, going, **limits)
    assert sorted(each.url for each, _ in second) == ["http://a/1"] * 2 + ["http://b/"]
    taken = [each.id for each, _ in [*first, *second]]
    assert len(set(taken)) == len(taken)
    store.close()


# --- addresses ----------------------------------------------------------------------------------------------------


def test_private_addresses_are_refused(tmp_path: Path, store: Store, receiver: Receiver) -> None:
    _end_job(store, receiver.url)
    _end_job(store, f"http://localhost:{receiver.server_port}/")
    _end_job(store, f"http://2130706433:{receiver.server_port}/")  # 127.0.0.1 to the system's resolver
    _deliver(store, tmp_path, webhook_private_addresses=False)
    assert receiver.received == []
    assert _tries(store) == [1] * 3


@pytest.mark.parametrize(
    "address",
    [
        *(
            "127.0.0.1",
            "10.1.2.3",
            "169.254.169.254",
            "0.0.0.0",
            "224.0.0.1",
            "100.64.0.1",
            "192.0.0.192",
            "255.255.255.255",
        ),
        *("::1", "::", "fe80::1", "fc00::1", "ff02::1", "2001:db8::1", "4000::1"),
        *("::ffff:127.0.0.1", "::ffff:0:127.0.0.1", "::127.0.0.1", "::169.254.169.254"),
        *("64:ff9b::127.0.0.1", "64:ff9b::169.254.169.254", "64:ff9b:1::7f00:1", "64:ff9b:1::8.8.8.8"),
        *("2002:7f00:1::", "2002:a9fe:a9fe::1", "2002:a01:203::1"),
        *("2001:0:7f00:1::", "2001:0:4136:e378:8000:63bf:80ff:fffe"),
    ],
)
def test_private_addresses(address: str) -> None:
    assert not is_public(ipaddress.ip_address(address))


@pytest.mark.parametrize("address", ["8.8.8.8", "2606:4700::1111", "64:ff9b::808:808", "::ffff:8.8.8.8"])
def test_public_addresses(address: str) -> None:
    assert is_public(ipaddress.ip_address(address))


@pytest.mark.parametrize(
    ("name", "known", "delivered"),
    [("localhost", True, True), ("other.example", True, False), ("localhost", False, False)],
)
def test_certificate_is_verified_for_the_host_name(
    name: str, known: bool, delivered: bool, tmp_path: Path, store: Store, start: Start
) -> None:
    """The connection goes to an address; SNI, certificate and `Host` use the name. Its authority must be known."""
    receiver = start(certificate=_certificate(tmp_path, name))
    tls = ssl.create_default_context(cafile=str(tmp_path / "certificate.pem")) if known else None
    _end_job(store, f"https://localhost:{receiver.server_port}/hook")
    Deliverer(_settings(tmp_path), store, tls).deliver_due()
    assert receiver.names == ["localhost"]
    assert [headers["host"] for headers, _ in receiver.received] == [f"localhost:{receiver.server_port}"] * delivered
    assert _tries(store) == [1] * (not delivered)


def _certificate(folder: Path, name: str) -> Path:
    """Write a self-signed certificate for a host name, with its key."""
    key = ec.generate_private_key(ec.SECP256R1())
    subject = x509.Name([x509.NameAttribute(x509.NameOID.COMMON_NAME, name)])
    now = datetime.datetime.now(datetime.UTC)
    certificate = (
        x509.CertificateBuilder(subject, subject, key.public_key(), x509.random_serial_number())
        .not_valid_before(now - datetime.timedelta(days=1))
        .not_valid_after(now + datetime.timedelta(days=1))
        .add_extension(x509.SubjectAlternativeName([x509.DNSName(name)]), critical=False)
        .sign(key, hashes.SHA256())
    )
    plain = serialization.NoEncryption()
    path = folder / "certificate.pem"
    path.write_bytes(
        certificate.public_bytes(serialization.Encoding.PEM)
        + key.private_bytes(serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, plain)
    )
    return path


# --- submission ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "url",
    [
        *UNUSABLE,
        *("ftp://example.com", "file:///etc/passwd", "http://", "http:example.com", "//example.com", "x" * 3000),
        *("http://user:pw@example.com", "http://user@example.com", "http://:pw@example.com"),
        *("http://example.com:0/", "http://example.com:-1/", "http://example.com:65536/", "http://example.com:x/"),
        *(
            "http://exa mple.com/",
            "http://exa%6dple.com/",
            "http://a\\b/",
            "http://a..b/",
            "http://" + "a" * 64 + ".com",
        ),
        *("http://exam\nple.com/", "http://example.com/\0", "http://[fe80::1%25eth0]/"),
        "http://" + "a." * 130 + "com",
        "https://example.com/" + "a" * 2000,
    ],
)
def test_invalid_urls_are_refused(url: str, tmp_path: Path) -> None:
    with pytest.raises(ServiceError) as caught:
        check_url(url, _settings(tmp_path))
    assert caught.value.code == "invalid-webhook"
    assert len(str(caught.value)) < 800


@pytest.mark.parametrize(
    "url",
    [
        *("https://example.com/hook", "http://example.com:65535/?a=b", "HTTPS://EXAMPLE.com", "http://bücher.example/"),
        *("http://localhost:8080/", "http://my_host/", "http://[2606:4700::1111]:8080/hook", "http://example.com./"),
    ],
)
def test_valid_urls_are_accepted(url: str, tmp_path: Path) -> None:
    check_url(url, _settings(tmp_path))
    with pytest.raises(ServiceError, match="switched off"):
        check_url(url, ServiceSettings(data=tmp_path))
