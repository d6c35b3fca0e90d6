"""HTTP servers that tests run in a thread."""

import threading
from collections.abc import Callable
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from socketserver import BaseServer
from typing import Self

#: Interval at which a server looks whether it should stop; with the default, every `shutdown` takes half a second.
_POLL_SECONDS = 0.02

Answer = Callable[[BaseHTTPRequestHandler], object]


def serve(server: BaseServer) -> None:
    """Answer requests in a separate thread until the server is shut down."""
    threading.Thread(target=server.serve_forever, args=(_POLL_SECONDS,), daemon=True).start()


def send(handler: BaseHTTPRequestHandler, body: bytes = b"", status: int = 200, **headers: str) -> None:
    """Send a response; hyphens in names of headers are given as underscores.

    Without `Content_Length`, the body ends with the connection.
    """
    handler.send_response(status)
    for name, value in headers.items():
        handler.send_header(name.replace("_", "-"), value)
    handler.end_headers()
    handler.wfile.write(body)


def repeating(head: bytes, block: bytes, cut_off: threading.Event, pause: float = 0.0, most: int = 64 << 20) -> Answer:
    """Return an answer that sends a head, and then the same bytes until the client closes the connection.

    Args:
        cut_off: Event to set then.
        pause: Seconds between blocks.
        most: Number of bytes after which the answer ends.
    """

    def answer(handler: BaseHTTPRequestHandler) -> None:
        handler.wfile.write(head)
        try:
            for _ in range(most // len(block)):
                if cut_off.wait(pause):
                    return
                handler.wfile.write(block)
        except OSError:
            cut_off.set()

    return answer


class LocalServer(ThreadingHTTPServer):
    """Server on a free port of this machine that answers requests within a `with` block.

    Args:
        answer: Function that answers a request of any method.
        version: Version of HTTP; connections stay open from 1.1 on.
    """

    daemon_threads = True
    block_on_close = False
    request_queue_size = 100

    def __init__(self, answer: Answer, version: str = "HTTP/1.0") -> None:
        class Handler(BaseHTTPRequestHandler):
            protocol_version = version

            def do_GET(self) -> None:
                answer(self)

            do_POST = do_PUT = do_DELETE = do_HEAD = do_GET  # noqa: N815 (http.server's names)

            def log_message(self, *ignored: object) -> None:
                return

        super().__init__(("127.0.0.1", 0), Handler)
        self.origin = f"http://127.0.0.1:{self.server_port}"

    def handle_error(self, *ignored: object) -> None:
        """Ignore clients that leave early or do not complete TLS."""

    def __enter__(self) -> Self:
        serve(self)
        return self

    def __exit__(self, *ignored: object) -> None:
        self.shutdown()
        self.server_close()
