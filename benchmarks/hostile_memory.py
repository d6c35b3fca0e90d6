"""Peak memory growth of the API during each of several attacks with hostile requests.

    python -m benchmarks.hostile_memory

Each attack runs against a separate API process on loopback, which requires no key. Growth is the difference between the
peak that the kernel reports (`VmHWM`) and the memory after a few ordinary requests. An attack is stopped once the API
has grown by 1 GB. The target is a growth of at most 64 MB for each attack.
"""

import argparse
import contextlib
import re
import socket
import tempfile
import threading
import time
from collections import Counter
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

from benchmarks.common import parse, write_result
from tests.api.service import Service, wait_for

MB = 1_000_000
#: Largest allowed growth, and growth at which an attack is stopped.
ALLOWED, TOO_MUCH = 64 * MB, 1000 * MB
_PIECE = b"X-Trailer: y\r\n" * (MB // 14)


class Target:
    """API process under attack.

    Attributes:
        answers: Number of responses by status; "none" for connections that were closed without a response.
    """

    def __init__(self, service: Service) -> None:
        api = service.process("api.http.server")
        assert api is not None
        parts = urlsplit(service.url)
        self._address = (str(parts.hostname), parts.port or 0)
        self._status = Path(f"/proc/{api.pid}/status")
        self._lock = threading.Lock()
        self.answers: Counter[str] = Counter()
        Path(f"/proc/{api.pid}/clear_refs").write_text("5")  # reset the peak that the kernel reports
        self._before = self._memory("VmRSS")

    def growth(self) -> int:
        """Return the peak growth of the process in bytes."""
        return self._memory("VmHWM") - self._before

    def connect(self) -> socket.socket:
        """Open a connection."""
        return socket.create_connection(self._address, timeout=60)

    def ask(self, request: bytes, connection: socket.socket | None = None) -> None:
        """Send a request, and count its response."""
        with contextlib.ExitStack() as stack:
            connection = connection or stack.enter_context(self.connect())
            with contextlib.suppress(OSError):
                connection.sendall(request)
            self.count(connection)

    def count(self, connection: socket.socket) -> None:
        """Read the start of a response, and count its status."""
        answer = b""
        with contextlib.suppress(OSError):
            answer = connection.recv(65536)
        with self._lock:
            self.answers[answer[9:12].decode() or "none"] += 1

    def _memory(self, field: str) -> int:
        match = re.search(rf"{field}:\s+(\d+) kB", self._status.read_text())
        assert match
        return 1024 * int(match[1])


def _request(first: str, kind: str, body: bytes) -> bytes:
    head = f"{first} HTTP/1.1\r\nHost: localhost\r\nContent-Type: {kind}\r\nContent-Length: {len(body)}\r\n\r\n"
    return head.encode() + body


def trailers(target: Target) -> None:
    """Send 1 GB of trailers to `/livez`; reconnect whenever the connection is closed."""
    start = b"POST /livez HTTP/1.1\r\nHost: localhost\r\nTransfer-Encoding: chunked\r\n\r\n0\r\n"
    sent = 0
    while sent < 1000 * MB and target.growth() < TOO_MUCH:
        with target.connect() as connection, contextlib.suppress(OSError):
            connection.sendall(start)
            while sent < 1000 * MB and target.growth() < TOO_MUCH:
                sent += connection.send(_PIECE)
            connection.sendall(b"\r\n")


def _bodies(target: Target, request: bytes, count: int = 1000) -> None:
    with ThreadPoolExecutor(200) as pool:
        list(pool.map(target.ask, [request] * count))


def sign_in(target: Target) -> None:
    """Sign in 1,000 times, on 200 connections at a time, with bodies of 256 kB."""
    _bodies(target, _request("POST /v1/session", "application/json", b'{"key": "' + b"x" * 256_000 + b'"}'))


def json_text(target: Target) -> None:
    """Submit 1,000 jobs, on 200 connections at a time, as JSON that contains one string of 1 MB."""
    _bodies(target, _request("POST /v1/jobs", "application/json", b'{"scene": "' + b"x" * (MB - 20) + b'"}'))


def json_lists(target: Target) -> None:
    """Submit 100 jobs, each on a separate connection, as 1 MB of JSON that contains as many lists as possible."""
    _bodies(target, _request("POST /v1/jobs", "application/json", b'{"photos": [' + b"[]," * 333_000 + b"[]]}"), 100)


def unfinished(target: Target) -> None:
    """Send 200 bodies of 1 MB except for their last bytes, and keep the connections open."""
    request = _request("POST /v1/jobs", "application/json", b'{"scene": "' + b"x" * (MB - 20) + b'"}')
    with contextlib.ExitStack() as stack, ThreadPoolExecutor(200) as pool:
        held = [stack.enter_context(target.connect()) for _ in range(200)]

        def hold(connection: socket.socket) -> None:
            with contextlib.suppress(OSError):
                connection.sendall(request[:-1])

        list(pool.map(hold, held))
        time.sleep(2)  # until the data in the kernel's buffers has arrived


def pipelined(target: Target) -> None:
    """Send 1,000,000 requests without reading a response; reconnect whenever the connection is closed."""
    piece = b"GET /livez HTTP/1.1\r\nHost: localhost\r\n\r\n" * 1000
    sent = 0
    while sent < 1000 and target.growth() < TOO_MUCH:
        with target.connect() as connection, contextlib.suppress(OSError):
            connection.settimeout(10)  # the service may stop reading
            while sent < 1000 and target.growth() < TOO_MUCH:
                sent += 1
                connection.sendall(piece)


def _held(target: Target, sent: bytes) -> None:
    with contextlib.ExitStack() as stack:
        held = [stack.enter_context(target.connect()) for _ in range(10_000)]
        if sent:
            for connection in held:
                target.ask(sent, connection)
        time.sleep(2)


def idle(target: Target) -> None:
    """Keep 10,000 connections open without sending anything."""
    _held(target, b"")


def kept_alive(target: Target) -> None:
    """Send one request on each of 10,000 connections, and keep them open."""
    _held(target, b"GET /livez HTTP/1.1\r\nHost: localhost\r\n\r\n")


ATTACKS = (trailers, sign_in, json_text, json_lists, unfinished, pipelined, idle, kept_alive)


def measure(attack: Callable[[Target], None]) -> dict[str, Any]:
    """Run one attack against a new API process."""
    with (
        tempfile.TemporaryDirectory(prefix="sgsst-hostile-") as folder,
        Service(Path(folder) / "data", alone=True) as service,
        service.client() as client,
    ):
        for _ in range(20):  # warm-up: what is loaded once does not count as growth
            client.get("/v1/jobs")
            client.post("/v1/jobs", json={"scene": "x", "style": "x"})
        target = Target(service)
        started = time.perf_counter()
        attack(target)
        seconds = time.perf_counter() - started
        growth = target.growth()
        wait_for(service.ready, "the service to answer afterwards", service.said)
    figures = {"growth_mb": round(growth / MB, 1), "allowed": growth <= ALLOWED, "seconds": round(seconds, 1)}
    return figures | {"answers": dict(target.answers)}


def main() -> None:
    """Run the attacks, then print and store the figures."""
    parse(argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter))
    results = {}
    for attack in ATTACKS:
        results[attack.__name__] = measure(attack)
        print(attack.__name__, results[attack.__name__], flush=True)
    print(write_result("hostile_memory", {"allowed_mb": ALLOWED / MB, "attacks": results}))


if __name__ == "__main__":
    main()
