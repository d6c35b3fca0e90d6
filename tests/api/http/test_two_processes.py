"""Tests of two API processes that share a data folder: for any order of writes, stored files match their digests."""

import hashlib
import random
import socket
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import httpx2
import pytest

from service.settings import ServiceSettings
from service.store import Store, open_store
from tests.api.http.sending import OFFSET_STREAM, TUS, begin
from tests.api.service import Service, wait_for


@dataclass
class Pair:
    """Two API processes and their shared database."""

    services: tuple[Service, Service]
    store: Store

    @property
    def data(self) -> Path:
        return self.services[0].data


@pytest.fixture(scope="module")
def pair(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Pair]:
    data = tmp_path_factory.mktemp("pair") / "data"
    with Service(data, alone=True) as one, Service(data, alone=True) as two:
        store = open_store(ServiceSettings(data=data))
        yield Pair((one, two), store)
        store.close()


class Patch:
    """PATCH request that is sent a few bytes at a time."""

    def __init__(self, service: Service, where: str, offset: int, content: bytes, *, expect: bool = False) -> None:
        self.content, self.sent = content, 0
        address = urlsplit(service.url)
        self.socket = socket.create_connection((address.hostname, address.port), timeout=60)
        self.socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        head = [
            f"PATCH {where} HTTP/1.1",
            f"Host: {address.netloc}",
            "Tus-Resumable: 1.0.0",
            f"Upload-Offset: {offset}",
            f"Content-Type: {OFFSET_STREAM}",
            f"Content-Length: {len(content)}",
            "Connection: close",
            *(["Expect: 100-continue"] if expect else []),
        ]
        self.socket.sendall("\r\n".join([*head, "", ""]).encode())
        if expect:
            assert b" 100 " in self.socket.recv(100), "it is this one's turn"

    @property
    def done(self) -> bool:
        return self.sent == len(self.content)

    def send(self, count: int) -> None:
        """Send more bytes, ignoring a closed connection, because the service may have refused the request."""
        part = self.content[self.sent : self.sent + count]
        try:
            self.socket.sendall(part)
        except OSError:
            self.sent = len(self.content)
            return
        self.sent += len(part)

    def status(self) -> int:
        """Return the status of the response; 0 if the connection was closed without a response."""
        answer = b""
        try:
            while part := self.socket.recv(4096):
                answer += part
        except OSError:
            pass
        self.socket.close()
        return int(answer.split(b" ", 2)[1]) if answer else 0

    def cut_off(self) -> None:
        self.socket.close()


def interleave(pair: Pair, clients: tuple[httpx2.Client, httpx2.Client], order: random.Random) -> set[int]:
    """Write to one upload by concurrent requests to both processes, and return the response statuses."""
    length = order.choice([1, 7, 64, 1000, 300_000])
    where = begin(clients[0], length)
    statuses: set[int] = set()
    for turn in range(4):
        shown = clients[turn % 2].get(where).json()
        if shown["complete"]:
            break
        statuses |= write_at_once(pair, where, shown["offset"], length, turn, order)

    def finished() -> dict[str, Any] | None:
        """Return the upload if it is complete; otherwise, try to send its rest."""
        shown = clients[0].get(where).json()
        if not shown["complete"]:
            rest = b"z" * (length - shown["offset"])
            headers = {**TUS, "Upload-Offset": str(shown["offset"]), "Content-Type": OFFSET_STREAM}
            statuses.add(clients[1].patch(where, content=rest, headers=headers).status_code)
        return shown if shown["complete"] else None

    shown = wait_for(finished, "the upload to be finished", every=0.01)
    check_digest(pair, shown["sha256"], length)
    return statuses


def write_at_once(pair: Pair, where: str, offset: int, length: int, turn: int, order: random.Random) -> set[int]:
    """Send the rest of an upload in two or three interleaved requests, some of which are cut off."""
    writers = [
        Patch(pair.services[order.randrange(2)], where, offset, bytes([65 + 4 * turn + number]) * (length - offset))
        for number in range(order.choice([2, 2, 3]))
    ]
    cut = {writer for writer in writers if order.random() < 0.3}
    while waiting := [writer for writer in writers if not writer.done and not (writer in cut and writer.sent)]:
        order.choice(waiting).send(order.choice([1, 13, length]))
    for writer in cut:
        writer.cut_off()
    return {writer.status() for writer in writers if writer not in cut}


def check_digest(pair: Pair, sha256: str, length: int) -> None:
    """Check that a stored file has the digest that it is named after."""
    row = pair.store.inputs.blobs([sha256])[sha256]
    content = (pair.data / "blobs" / row.location).read_bytes()
    assert (hashlib.sha256(content).hexdigest(), len(content)) == (sha256, length)


def run(pair: Pair, count: int, seed: int) -> None:
    order, statuses = random.Random(seed), set[int]()
    with pair.services[0].client() as one, pair.services[1].client() as two:
        for _ in range(count):
            statuses |= interleave(pair, (one, two), order)
    assert statuses <= {0, 204, 404, 409, 423}, statuses
    for path in (pair.data / "blobs").glob("*/*"):
        assert path.name.partition("-")[0] == hashlib.sha256(path.read_bytes()).hexdigest()


@pytest.mark.slow
def test_upload_is_locked_across_processes(pair: Pair) -> None:
    """The second of two writers is refused. Otherwise, a file could be named by the digest of other content."""
    with pair.services[0].client() as client:
        where = begin(client, 1000)
        first = Patch(pair.services[0], where, 0, b"x" * 1000, expect=True)
        first.send(500)
        second = Patch(pair.services[1], where, 0, b"y" * 1000)
        second.send(1000)
        statuses = {second.status()}
        first.send(500)
        statuses.add(first.status())
        shown = client.get(where).json()
    assert shown["complete"]
    check_digest(pair, shown["sha256"], 1000)
    assert len(statuses & {409, 423}) == 1, statuses


@pytest.mark.slow
def test_interleaved_patches_from_two_processes(pair: Pair) -> None:
    run(pair, 400, seed=1)
