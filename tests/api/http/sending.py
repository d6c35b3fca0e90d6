"""Requests of tests, parts of them, and the check of refusals."""

import base64
import io
import re
import socket
from collections.abc import Callable, Iterator
from typing import Any
from urllib.parse import urlsplit

import httpx2
from PIL import Image

from service.store import Store
from tests.api.service import Service, check_documented

MB = 1_000_000
TUS = {"Tus-Resumable": "1.0.0"}
OFFSET_STREAM = "application/offset+octet-stream"
Files = dict[str, bytes]
Make = Callable[[Files], bytes]


def form(files: Files, **changed: bytes | tuple[str, bytes] | None) -> list[tuple[str, Any]]:
    """Return multipart fields. `changed` has new contents, or pairs (file name, content); None omits a field."""
    names = {"scene": "scene.ply", "cameras": "cameras.json", "style": "style.png"}
    parts: list[tuple[str, Any]] = []
    for role in {**files, **changed}:
        content = changed.get(role, files.get(role))
        if content is not None:
            parts.append((role, content if isinstance(content, tuple) else (names.get(role, role), content)))
    return parts


def refused(answer: httpx2.Response, status: int, *codes: str) -> dict[str, Any]:
    """Check that a response is a problem document with this status and one of the codes, and return the document."""
    assert answer.status_code == status, f"{answer.status_code} {answer.text[:500]}"
    assert answer.headers["content-type"] == "application/problem+json"
    check_documented(answer)
    problem: dict[str, Any] = answer.json()
    assert problem["status"] == status
    assert problem["code"] in codes, problem
    assert problem["title"]
    assert problem["detail"]
    assert len(answer.content) < 20_000, "it repeats what was sent"
    assert not re.search(r"/tmp|/work|Errno|Traceback|\.part\b", problem["detail"]), problem["detail"]
    return problem


def count_jobs(store: Store) -> int:
    return len(store.jobs.page(None, limit=100_000))


def image_bytes(format_: str, width: int, height: int) -> bytes:
    file = io.BytesIO()
    Image.new("L", (width, height)).save(file, format_)
    return file.getvalue()


BOUNDARY = "b0undary"


def post(client: httpx2.Client, body: bytes | Iterator[bytes], kind: str = "", **headers: str) -> httpx2.Response:
    kind = kind or f"multipart/form-data; boundary={BOUNDARY}"
    return client.post("/v1/jobs", content=body, headers={"content-type": kind, **headers})


def part(head: str, body: bytes = b"x") -> bytes:
    return f"--{BOUNDARY}\r\n{head}\r\n\r\n".encode("latin-1") + body + b"\r\n"


END = f"--{BOUNDARY}--\r\n".encode()
FILE = 'Content-Disposition: form-data; name="{}"; filename="x"'


def begin(client: httpx2.Client, size: int, name: str = "scene.ply") -> str:
    metadata = f"filename {base64.b64encode(name.encode()).decode()}"
    answer = client.post("/v1/uploads", headers={**TUS, "Upload-Length": str(size), "Upload-Metadata": metadata})
    assert answer.status_code == 201, answer.text
    assert answer.headers["upload-expires"].endswith("GMT")
    return str(answer.headers["location"])


def send(client: httpx2.Client, where: str, offset: object, data: Any, **headers: Any) -> httpx2.Response:
    fixed = {**TUS, "Upload-Offset": str(offset), "Content-Type": OFFSET_STREAM}
    return client.patch(where, content=data, headers={**fixed, **headers})


#: Texts that Python's `int` accepts.
NO_DIGITS: list[Any] = ["1_0", "+10", "10.0", "1 0", "\u0661\u0660".encode(), "\uff11\uff10".encode()]


def connect(service: Service) -> socket.socket:
    parts = urlsplit(service.url)
    return socket.create_connection((str(parts.hostname), parts.port or 0), timeout=60)


def lines(head: str) -> bytes:
    if "Host:" not in head:
        first, _, rest = head.partition("\n")
        head = f"{first}\nHost: 127.0.0.1\n{rest}"
    return head.rstrip("\n").replace("\n", "\r\n").encode("latin-1") + b"\r\n\r\n"


def exchange(service: Service, head: str, body: bytes = b"") -> tuple[bytes, bytes]:
    """Send exactly these bytes, read until the connection is closed, and return head and body of the response."""
    with connect(service) as connection:
        connection.sendall(lines(head) + body)
        answer = b""
        while more := connection.recv(65536):
            answer += more
    headers, _, rest = answer.partition(b"\r\n\r\n")
    return headers, rest


def answer_on(connection: socket.socket) -> tuple[bytes, bytes]:
    """Return head and body of the next response, which must have a Content-Length. The connection stays open."""
    connection.settimeout(60)
    answer = connection.recv(65536)
    while not (match := re.search(rb"content-length: ([0-9]+)\r\n.*?\r\n\r\n", answer, re.DOTALL | re.IGNORECASE)) or (
        len(answer) < match.end() + int(match[1])
    ):
        more = connection.recv(65536)
        assert more, answer
        answer += more
    return answer[: match.end()], answer[match.end() :]


def closed(connection: socket.socket) -> bytes:
    """Return all bytes until the service closes the connection; fail if it does not."""
    connection.settimeout(60)
    answer = b""
    try:
        while more := connection.recv(65536):
            answer += more
    except ConnectionResetError:
        pass
    return answer


#: Hostile file names.
NAMES = [
    "../../../../etc/cron.d/x",
    "/etc/passwd",
    "..\\..\\..\\windows\\system32\\x",
    "C:\\x.ply",
    "\\\\server\\share\\x.ply",
    "a\x00b.ply",
    "a\nb\r\nX-Injected: 1.ply",
    "....//....//x.ply",
    "%2e%2e%2f%2e%2e%2fx.ply",
    "..%c0%af..%c0%afx.ply",
    ".",
    "..",
    "...",
    "/",
    "",
    " ",
    ".bashrc",
    "-rf",
    "~root/.ssh/id",
    "$(id).ply",
    "CON",
    "aux.ply",
    "x.ply:stream",
    "a" * 5000 + ".ply",
    "a/" * 3000 + "x.ply",
    "界" * 200 + ".ply",
    "é" * 255,
    "\u202egpj.ply",
    "\ufeffx.ply",
    "👩‍👩‍👧‍👦" * 50,
]
