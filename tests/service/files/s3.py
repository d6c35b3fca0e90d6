"""S3 server for tests (moto's), and a proxy that injects faults."""

import socket
import struct
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler
from typing import Literal

import httpx2
import pytest

from tests.http_servers import LocalServer

#: "slow-down": 503, S3's response to too many requests. "reset": the connection is closed before the response.
#: "cut-off": it is closed in the middle of the response. "silence": there is no response until `heal`.
Fault = Literal["slow-down", "reset", "cut-off", "silence"]

_SLOW_DOWN = (
    b"<?xml version='1.0'?><Error><Code>SlowDown</Code><Message>Please reduce your request rate.</Message></Error>"
)


@contextmanager
def s3_server() -> Iterator[str]:
    """Run a server without buckets, and yield its URL."""
    server_module = pytest.importorskip("moto.server", reason="moto's server is not installed: see the extra [dev]")
    pytest.importorskip("s3fs", reason="s3fs is not installed: see the extra [s3]")
    server = server_module.ThreadedMotoServer(ip_address="127.0.0.1", port=0, verbose=False)
    server.start()
    host, port = server.get_host_and_port()
    yield f"http://{host}:{port}"
    server.stop()


def environment_of(endpoint: str) -> dict[str, str]:
    """Return the environment variables with the server's address and credentials for S3 clients."""
    return {
        "AWS_ENDPOINT_URL": endpoint,
        "AWS_ACCESS_KEY_ID": "key",
        "AWS_SECRET_ACCESS_KEY": "secret",
        "AWS_DEFAULT_REGION": "us-east-1",
    }


class FaultyS3(LocalServer):
    """Proxy that forwards requests to an S3 server, except for those that should fail.

    Attributes:
        asked: Method and path of every request.
    """

    def __init__(self, behind: str) -> None:
        self.asked: list[tuple[str, str]] = []
        self._faults: list[tuple[Fault, Callable[[str, str], bool]]] = []
        self._lock = threading.Lock()
        self._healed = threading.Event()
        self._client = httpx2.Client(base_url=behind, timeout=60)
        super().__init__(self._answer, "HTTP/1.1")

    def fail(self, fault: Fault, times: int, which: Callable[[str, str], bool] = lambda method, path: True) -> None:
        """Inject a fault into the next `times` requests for which `which(method, path)` is true."""
        with self._lock:
            self._faults = [(fault, which)] * times
            self._healed = threading.Event()

    def heal(self) -> None:
        """Forward all requests from now on."""
        with self._lock:
            self._faults = []
            self._healed.set()

    def __exit__(self, *ignored: object) -> None:
        self.heal()
        super().__exit__(*ignored)

    def _fault(self, method: str, path: str) -> Fault | None:
        with self._lock:
            self.asked.append((method, path))
            if self._faults and self._faults[0][1](method, path):
                return self._faults.pop(0)[0]
        return None

    def _answer(self, handler: BaseHTTPRequestHandler) -> None:
        body = handler.rfile.read(int(handler.headers.get("Content-Length", 0)))
        fault = self._fault(handler.command, handler.path)
        if fault == "slow-down":
            self._send(handler, 503, {"Content-Type": "application/xml"}, _SLOW_DOWN)
        elif fault == "reset":
            self._reset(handler)
        elif fault == "silence":
            self._healed.wait()
            handler.close_connection = True
        else:
            headers = {name: value for name, value in handler.headers.items() if name.lower() != "connection"}
            request = self._client.build_request(handler.command, handler.path, headers=headers, content=body)
            answer = self._client.send(request)
            self._send(handler, answer.status_code, dict(answer.headers), answer.content, cut=fault == "cut-off")

    def _send(
        self,
        handler: BaseHTTPRequestHandler,
        status: int,
        headers: dict[str, str],
        body: bytes,
        *,
        cut: bool = False,
    ) -> None:
        handler.send_response_only(status)
        dropped = {"content-length", "connection", "transfer-encoding", "content-encoding"}
        for name, value in headers.items():
            if name.lower() not in dropped:
                handler.send_header(name, value)
        head = handler.command == "HEAD"
        length = next((value for name, value in headers.items() if name.lower() == "content-length"), "0")
        handler.send_header("Content-Length", length if head else str(len(body)))
        handler.end_headers()
        if head:
            return
        handler.wfile.write(body[: len(body) // 2] if cut else body)
        if cut:
            self._reset(handler)

    @staticmethod
    def _reset(handler: BaseHTTPRequestHandler) -> None:
        handler.connection.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
        handler.connection.close()
        handler.close_connection = True
