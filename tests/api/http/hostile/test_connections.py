"""Tests of hostile connections: the API ends them, serves others meanwhile, and keeps no memory afterwards."""

import contextlib
import json
import re
import select
import socket
import time
from pathlib import Path
from urllib.parse import quote

import httpx2
import pytest

from api.http.context import SESSION_COOKIE
from api.http.server import MAX_HEAD_BYTES, MAX_HEADERS
from service.settings import ServiceSettings
from tests.api.http.hostile.conftest import LARGE, api_of
from tests.api.http.sending import (
    BOUNDARY,
    FILE,
    MB,
    OFFSET_STREAM,
    Files,
    answer_on,
    begin,
    closed,
    connect,
    exchange,
    form,
    lines,
    part,
    post,
    refused,
)
from tests.api.service import Service, wait_for


def test_slow_clients_are_disconnected_without_blocking_others(
    service: Service, client: httpx2.Client, files: Files
) -> None:
    """Connections that send nothing, half a head or half a body all end, and others are served meanwhile."""
    body = f"POST /v1/jobs HTTP/1.1\nContent-Type: multipart/form-data; boundary={BOUNDARY}\nContent-Length: 100000"
    starts = [b"", b"GET /v1/jobs HTTP/1.1\r\nHost: 127.0", lines(body), lines(body) + part(FILE.format("scene"))[:60]]
    slow = [connect(service) for _ in range(200)]
    for number, connection in enumerate(slow):
        connection.sendall(starts[number % len(starts)])
    assert client.get("/v1/jobs").status_code == 200
    assert client.post("/v1/jobs", files=form(files)).status_code == 202
    for number, connection in enumerate(slow):
        answer = closed(connection)
        connection.close()
        if number % len(starts) >= 2:
            assert b" 408 " in answer.splitlines()[0]
            assert b'"code":"too-slow"' in answer


def drip(connection: socket.socket, more: bytes) -> bytes:
    """Send bytes at intervals until the service closes the connection; return its answer."""
    connection.settimeout(0.3)
    deadline, answered = time.monotonic() + 60, b""
    while True:
        assert time.monotonic() < deadline, "it is still listened to"
        try:
            connection.sendall(more)
            piece = connection.recv(65536)
            answered += piece
            if not piece:
                return answered
        except TimeoutError:
            continue
        except OSError:
            return answered


def test_dripping_clients_are_disconnected(service: Service) -> None:
    """A client that sends single bytes at intervals does not stall, but is far below the minimum rate."""
    head = lines(
        f"POST /v1/jobs HTTP/1.1\nContent-Type: multipart/form-data; boundary={BOUNDARY}\nContent-Length: 100000"
    )
    rest = {0: b"GET /v1/jobs HTTP/1.1\r\nX: ", 1: head + part(FILE.format("scene"))[:70]}
    for start in rest.values():
        with connect(service) as connection:
            connection.sendall(start)
            drip(connection, b"x")


def test_endless_head_is_disconnected(service: Service) -> None:
    for start, more in ((b"GET /", b"x"), (b"GET / HTTP/1.1\r\nX: ", b"x"), (b"GET / HTTP/1.1\r\n", b"X: y\r\n")):
        with connect(service) as connection:
            sent = 0
            try:
                connection.sendall(start)
                while sent < 60 * MB:
                    connection.sendall(more * (MB // len(more)))
                    sent += MB
            except OSError:
                pass
            assert sent < 60 * MB, "it was all taken in"


HEADS: list[tuple[str, bytes]] = [
    ("no HTTP", b"hello\r\n\r\n"),
    ("zero bytes", b"\0" * 1000),
    ("TLS", b"\x16\x03\x01\x02\x00\x01\x00\x01\xfc\x03\x03" + bytes(500)),
    ("HTTP/2", b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n"),
    ("two lengths", b"POST /v1/jobs HTTP/1.1\r\nHost: a\r\nContent-Length: 5\r\nContent-Length: 6\r\n\r\nxxxxx"),
    (
        "length and chunks",
        b"POST /v1/jobs HTTP/1.1\r\nHost: a\r\nContent-Length: 5\r\nTransfer-Encoding: chunked\r\n\r\n0\r\n\r\n",
    ),
    ("negative length", b"POST /v1/jobs HTTP/1.1\r\nHost: a\r\nContent-Length: -5\r\n\r\n"),
    ("length 2^70", b"POST /v1/jobs HTTP/1.1\r\nHost: a\r\nContent-Length: 1180591620717411303424\r\n\r\n"),
    ("chunk of 2^70", b"POST /v1/jobs HTTP/1.1\r\nHost: a\r\nTransfer-Encoding: chunked\r\n\r\nffffffffffffffffff\r\n"),
    (
        "no chunk size",
        b"POST /v1/jobs HTTP/1.1\r\nHost: a\r\nTransfer-Encoding: chunked\r\n\r\nzz\r\n",
    ),
    ("folded header", b"GET / HTTP/1.1\r\nHost: a\r\n folded\r\n\r\n"),
    ("zero byte in a header", b"GET / HTTP/1.1\r\nHost: a\r\nX: a\0b\r\n\r\n"),
    ("line end in a header", b"GET / HTTP/1.1\r\nHost: a\r\nX: a\rb\r\n\r\n"),
    ("no path", b"GET HTTP/1.1\r\n\r\n"),
    ("CONNECT", b"CONNECT example.com:80 HTTP/1.1\r\nHost: a\r\n\r\n"),
    ("another site's path", b"GET http://example.com HTTP/1.1\r\nHost: a\r\n\r\n"),
    ("TRACE", b"TRACE / HTTP/1.1\r\nHost: a\r\nConnection: close\r\n\r\n"),
]


@pytest.mark.parametrize("data", [case[1] for case in HEADS], ids=[case[0] for case in HEADS])
def test_malformed_heads_are_rejected(service: Service, client: httpx2.Client, data: bytes) -> None:
    """Malformed heads are refused below the app. The connection is closed, so no remainder is read as a request."""
    with connect(service) as connection:
        connection.sendall(data)
        connection.shutdown(socket.SHUT_WR)
        answer = closed(connection)
    if answer:  # half a request ends with its connection
        head, _, body = answer.partition(b"\r\n\r\n")
        problem = json.loads(body)
        assert b"content-type: application/problem+json" in head.lower()
        assert int(head.split()[1]) == problem["status"]
        assert (problem["status"], problem["code"]) in (
            (400, "malformed-request"),
            (403, "foreign-site"),
            (405, "method-not-allowed"),
        )
    assert client.get("/livez").status_code == 200


def test_malformed_chunk_is_rejected(service: Service) -> None:
    """A malformed chunk gets one response, and subsequent bytes are not interpreted as a request."""
    start = f"POST /v1/jobs HTTP/1.1\nContent-Type: multipart/form-data; boundary={BOUNDARY}"
    with connect(service) as connection:
        connection.sendall(lines(start + "\nTransfer-Encoding: chunked\nExpect: 100-continue"))
        assert b" 100 " in connection.recv(100)  # the app is reading
        connection.sendall(b"5\r\n--b0u\r\nnonsense\r\n" + lines("GET /livez HTTP/1.1"))
        answer = closed(connection)
    assert answer.count(b"HTTP/1.1") == 1
    assert answer.startswith(b"HTTP/1.1 400 Bad Request\r\n")
    assert json.loads(answer.partition(b"\r\n\r\n")[2])["code"] == "malformed-request"


def test_too_large_head_is_rejected(service: Service) -> None:
    # Not a byte more than the service reads: a reset would discard its answer.
    for headers in (b"X: " + b"y" * MAX_HEAD_BYTES, b"X: y\r\n" * (MAX_HEADERS + 1)):
        with connect(service) as connection:
            connection.sendall(lines("GET /v1/jobs HTTP/1.1")[:-2] + headers)
            answer = closed(connection)
        assert answer.startswith(b"HTTP/1.1 431 Request Header Fields Too Large\r\n")
        assert json.loads(answer.partition(b"\r\n\r\n")[2])["code"] == "head-too-large"


def send_on(connection: socket.socket, more: bytes, most: int = 60 * MB) -> int:
    """Send the same bytes repeatedly until the service closes or `most` bytes are sent; return the number of bytes."""
    sent = 0
    with contextlib.suppress(OSError):
        while sent < most:
            connection.sendall(more)
            sent += len(more)
    return sent


TRAILERS = {
    "many": (b"0\r\n", b"X: y\r\n" * 100_000),
    "one": (b"0\r\nX: ", b"y" * 600_000),
    "of a chunk": (b"1;x=", b"y" * 600_000),
}


@pytest.mark.parametrize(("start", "more"), TRAILERS.values(), ids=TRAILERS)
@pytest.mark.parametrize("path", ["/livez", "/v1/session"])
def test_endless_trailers_are_rejected(service: Service, path: str, start: bytes, more: bytes) -> None:
    head = lines(f"POST {path} HTTP/1.1\nContent-Type: application/json\nTransfer-Encoding: chunked")
    with connect(service) as connection:
        connection.sendall(head + start)
        assert send_on(connection, more) < 60 * MB, "it was all taken in"


def test_trailers_are_not_headers(service: Service, client: httpx2.Client) -> None:
    """Trailers do not become headers, not even of the next request on the connection."""
    where = begin(client, 5)
    head = f"PATCH {where} HTTP/1.1\nTus-Resumable: 1.0.0\nUpload-Offset: 0\nContent-Type: {OFFSET_STREAM}"
    with connect(service) as connection:
        body = b"5\r\n12345\r\n0\r\nUpload-Checksum: sha256 AAAA\r\nHost: evil.example\r\n\r\n"
        connection.sendall(lines(head + "\nTransfer-Encoding: chunked") + body)
        assert connection.recv(65536).startswith(b"HTTP/1.1 204 ")
        connection.sendall(lines("GET /v1/jobs HTTP/1.1\nConnection: close"))
        assert closed(connection).startswith(b"HTTP/1.1 200 ")
    assert client.get(where).json()["complete"]


def test_pipelined_requests_are_bounded(service: Service) -> None:
    with connect(service) as connection:
        assert send_on(connection, lines("GET /livez HTTP/1.1") * 10_000) < 60 * MB, "it was all taken in"
    with connect(service) as connection:
        connection.sendall(lines("GET /livez HTTP/1.1") * 2 + lines("GET /livez HTTP/1.1\nConnection: close"))
        assert closed(connection).count(b"HTTP/1.1 200 OK") == 3


def test_unread_body_must_end(service: Service) -> None:
    """The response is sent before the body arrives. Single bytes at intervals do not keep the connection open."""
    for rest in (b"", b"x"):
        with connect(service) as connection:
            connection.sendall(lines("POST /livez HTTP/1.1\nContent-Length: 1000000"))
            answered = drip(connection, rest)
            assert answered.startswith(b"HTTP/1.1 405 ")
            assert answered.count(b"HTTP/1.1") == 1, "it is answered twice"


def test_unread_responses_take_little_memory_and_end(service: Service, done: str) -> None:
    """Clients that request a large file and read nothing are disconnected; `unharmed` limits the memory."""
    with contextlib.ExitStack() as stack:
        unread = [stack.enter_context(connect(service)) for _ in range(60)]
        for connection in unread:
            connection.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
            connection.sendall(lines(f"GET /v1/jobs/{done}/artifacts/colors.f16 HTTP/1.1"))
        process = api_of(service)
        for connection in unread:
            with contextlib.suppress(ConnectionResetError):  # the first ones may be closed already
                connection.recv(1)
        wait_for(lambda: len(process.net_connections("tcp")) < 10, "unread connections to be closed")
        assert len(closed(unread[0])) < LARGE


def test_quoted_cookies_take_linear_time(service: Service) -> None:
    """Python's parser of quoted cookies takes quadratic time: about half a minute for 110 kB."""
    with connect(service) as connection:
        for name in ("other", SESSION_COOKIE):
            connection.sendall(b'GET /v1/session HTTP/1.1\r\nHost: 127.0.0.1\r\nCookie: %s="' % name.encode())
            connection.sendall(b'\\"' * 55_000 + b'"\r\n\r\n')
            assert select.select([connection], [], [], 15)[0]
            assert answer_on(connection)[0].startswith(b"HTTP/1.1 200 ")


def test_session_cookie_is_found_among_others(service: Service, client: httpx2.Client) -> None:
    cookies = 'theme=dark; sgsst_session=unknown; quoted="a\\073b"'
    answer = client.delete("/v1/session", headers={"Cookie": cookies, "Origin": "https://example.com"})
    assert (answer.status_code, answer.json()["code"]) == (403, "cross-origin"), "it counts as a session"
    assert client.delete("/v1/session", headers={"Cookie": "theme=dark"}).status_code == 204


def test_late_end_of_body_preserves_connection(service: Service) -> None:
    with connect(service) as connection:
        connection.sendall(lines("POST /livez HTTP/1.1\nContent-Length: 5"))
        head, _ = answer_on(connection)
        assert head.startswith(b"HTTP/1.1 405 ")
        connection.sendall(b"12345" + lines("GET /livez HTTP/1.1\nConnection: close"))
        assert closed(connection).startswith(b"HTTP/1.1 200 OK")


def test_too_long_json_is_rejected_immediately(service: Service) -> None:
    """A JSON body with too large a declared length is not read at all; an undeclared one is read up to the limit."""
    kind = "Content-Type: application/json"
    for path, size in (("/v1/session", 256_000), ("/v1/session", 4097), ("/v1/jobs", 2 * MB)):
        with connect(service) as connection:
            connection.sendall(lines(f"POST {path} HTTP/1.1\n{kind}\nContent-Length: {size}"))
            answer = connection.recv(65536)
        assert answer.startswith(b"HTTP/1.1 413 ")
    with connect(service) as connection:
        connection.sendall(lines(f"POST /v1/session HTTP/1.1\n{kind}\nTransfer-Encoding: chunked"))
        connection.sendall(b"2000\r\n" + b"x" * 0x2000)  # 8 kB of an unfinished chunk
        assert connection.recv(65536).startswith(b"HTTP/1.1 413 ")


def is_busy(connection: socket.socket) -> bool:
    """Return whether the response on a connection starts with status 503; it is not taken from the connection."""
    connection.setblocking(False)
    try:
        return connection.recv(12, socket.MSG_PEEK) == b"HTTP/1.1 503"
    except OSError:
        return False


def test_concurrent_bodies_share_memory_budget(service: Service, client: httpx2.Client) -> None:
    """Large bodies are refused while too many are arriving; small ones are accepted."""
    large = json.dumps({"scene": "x" * (MB - 1000), "style": "x"}).encode()
    head = lines(f"POST /v1/jobs HTTP/1.1\nContent-Type: application/json\nContent-Length: {len(large)}")
    with contextlib.ExitStack() as stack:
        held = [stack.enter_context(connect(service)) for _ in range(80)]
        for connection in held:
            connection.setblocking(False)
            with contextlib.suppress(OSError):
                connection.send(head)
        left = dict.fromkeys(held, large[:-1])  # no body is complete
        while left:
            _, ready, _ = select.select([], list(left), [], 1.0)
            if not ready:
                break
            for connection in ready:
                try:
                    left[connection] = left[connection][connection.send(left[connection]) :]
                except OSError:
                    left[connection] = b""
                if not left[connection]:
                    del left[connection]
        head, answer = answer_on(wait_for(lambda: next(filter(is_busy, held), None), "a large body to be refused"))
        refused(post(client, b'{"scene": "x", "style": "x"}', "application/json"), 422, "unknown-upload")
    assert head.startswith(b"HTTP/1.1 503 ")
    assert b"retry-after: 5" in head.lower()
    assert json.loads(answer)["code"] == "busy"
    wait_for(lambda: post(client, large, "application/json").status_code == 422, "room for a large body")


def test_connections_beyond_system_limit_are_rejected(tmp_path: Path) -> None:
    """Connections beyond the limit are answered with 503 or closed, and existing ones keep working."""
    running = Service(tmp_path / "data", alone=True)
    running._command = ["sh", "-c", 'ulimit -n 200 && exec "$@"', "sh", *running._command]
    limits = httpx2.Limits(keepalive_expiry=None)
    with running, httpx2.Client(base_url=running.url, timeout=60, limits=limits) as client:
        assert client.get("/livez").status_code == 200
        with contextlib.ExitStack() as stack:
            held = [stack.enter_context(connect(running)) for _ in range(400)]
            wait_for(lambda: len(select.select(held, [], [], 0)[0]) >= 250, "the others to be answered", running.said)
            assert client.get("/v1/jobs").status_code == 200
            answers = []
            for connection in select.select(held, [], [], 0)[0]:
                with contextlib.suppress(ConnectionResetError):
                    answers.append(connection.recv(65536))
            assert any(answer.startswith(b"HTTP/1.1 503 ") for answer in answers)
            assert all(answer.startswith(b"HTTP/1.1 503 ") or not answer for answer in answers)
        wait_for(running.ready, "room for a connection", running.said)
        assert "Traceback" not in running.log.read_text()


def test_open_files_beyond_system_limit_are_reported(tmp_path: Path) -> None:
    """Concurrent uploads for which no file descriptor is left get 503 with Retry-After."""
    running = Service(tmp_path / "data", alone=True)
    running._command = ["sh", "-c", 'ulimit -n 200 && exec "$@"', "sh", *running._command]
    head = f"POST /v1/jobs HTTP/1.1\nContent-Type: multipart/form-data; boundary={BOUNDARY}\nContent-Length: 1000000"
    body = part(FILE.format("style"), bytes(200_000))
    with running, contextlib.ExitStack() as stack:
        held = [stack.enter_context(connect(running)) for _ in range(140)]
        wait_for(running.ready, "a later connection, so that all of these are accepted")
        for connection in held:
            connection.sendall(lines(head) + body[:-2])
        answered = wait_for(lambda: select.select(held, [], [], 0)[0], "an upload to be refused", running.said)
        answer, rest = answer_on(answered[0])
        assert answer.startswith(b"HTTP/1.1 503 ")
        assert b"retry-after" in answer.lower()
        assert json.loads(rest)["code"] == "too-many-connections"
        stack.close()
        wait_for(running.ready, "room for a connection", running.said)


@pytest.mark.parametrize("second", ["127.0.0.1", "evil.example"])
def test_two_host_headers_are_rejected(service: Service, second: str) -> None:
    for hosts in (f"Host: 127.0.0.1\nHost: {second}", f"Host: {second}\nhost: 127.0.0.1"):
        head, body = exchange(service, f"GET /v1/jobs HTTP/1.1\n{hosts}\nConnection: close")
        assert head.startswith(b"HTTP/1.1 400 ")
        assert json.loads(body)["code"] == "malformed-request"


#: Names that a page's author can point at this machine, and texts that are not a host.
FOREIGN = [
    "127.evil.example",
    "127.0.0.1.evil.example",
    "127.0.0.1.nip.io",
    "localhost.evil.example",
    "evil.example",
    "127",
    "127.1",
    "127.0.0.1.",
    "localhost.",
    "127.0.0.1@evil.example",
    "evil.example@127.0.0.1",
    "127.0.0.1:80@evil.example",
    "127.0.0.1/evil.example",
    "[::1].evil.example",
    "[::1]evil",
    "[::2]",
    "::1",
    "[evil.example]",
    "128.0.0.1",
    "0.0.0.0",
    "127.0.0.256",
    "127.0.0.01",
    "0x7f.0.0.1",
]


OWN = [
    "127.0.0.1",
    "127.0.0.1:9",
    "127.8.9.10",
    "localhost",
    "LocalHost:80",
    "[::1]",
    "[::1]:8000",
    "[0:0:0:0:0:0:0:1]",
]


def test_foreign_host_headers_are_rejected(client: httpx2.Client) -> None:
    for host in [*FOREIGN, ""]:
        refused(client.get("/v1/jobs", headers={"Host": host}), 403, "foreign-site")
    for host in OWN:
        assert client.get("/v1/jobs", headers={"Host": host}).status_code == 200, host


def test_service_on_address_like_name_requires_keys() -> None:
    for host in ("127.evil.example", "127.0.0.1.evil.example", "0.0.0.0", "::", "localhost.evil.example"):
        assert ServiceSettings(host=host).keys_required
    for host in ("127.0.0.1", "127.8.9.10", "::1", "localhost"):
        assert not ServiceSettings(host=host).keys_required


def test_paths_cannot_inject_log_lines(service: Service, client: httpx2.Client) -> None:
    before = service.log.stat().st_size
    for text in ("\n12:00:00 error   forged", "\r\nforged", "\u2028forged", "\x1b[2Jforged", "a status=200 forged"):
        assert client.get(f"/v1/{quote(text, safe='')}").status_code == 404

    def logged() -> list[str]:
        return [line for line in service.log.read_bytes()[before:].decode().split("\n") if "forged" in line]

    lines = wait_for(lambda: logged() if len(logged()) == 5 else None, "the requests in the log")
    for line in lines:
        assert line.isprintable()
        pattern = r'\S+ info {4}request  method=GET path="/v1/[^"]*forged" status=404 seconds=\S+ request_id=\S+'
        assert re.fullmatch(pattern, line)
