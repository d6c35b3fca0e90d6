"""Tests of inputs by URL: allowed hosts and addresses, limits of size and time, and what a refusal leaves."""

import asyncio
import hashlib
import ipaddress
import json
import socket
import threading
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from http.server import BaseHTTPRequestHandler
from pathlib import Path
from typing import Any

import httpx2
import pytest

from api.http.receiving import Fetcher, Receipt, Receipts, file_name
from service import outgoing, problems
from service.deadlines import FileThreads
from service.files.blobs import Blobs, open_blobs
from service.files.objects import Artifacts
from service.problems import ServiceError
from service.settings import ServiceSettings
from service.store import Store, open_store
from service.store.keys import Quotas
from tests.api.conftest import Sgsst
from tests.api.http.sending import refused
from tests.api.service import Service
from tests.http_servers import Answer, LocalServer, repeating, send
from tests.raised import raises_problem
from tests.service.store.helpers import usage_of
from tests.small_scenes import wall, write_files

#: Time limit of a test's waits in seconds.
PATIENCE = 60.0
FILE = b"a file\n" * 1000
PUBLIC = "8.8.8.8"
METADATA = "169.254.169.254"


class FileServer(LocalServer):
    """Server whose paths have their own answers; all requests are recorded."""

    def __init__(self) -> None:
        self.answers: dict[str, Answer] = {}
        self.requests: list[tuple[str, str]] = []
        super().__init__(self._answer)

    def _answer(self, handler: BaseHTTPRequestHandler) -> None:
        self.requests.append((handler.headers["host"], handler.path))
        self.answers[handler.path](handler)

    def url(self, path: str, answer: Answer) -> str:
        """Set the answer of a path, and return its URL."""
        self.answers[path] = answer
        return self.origin + path


def sends(body: bytes, status: int = 200, **headers: str) -> Answer:
    """Return an answer with a body."""
    return lambda handler: send(handler, body, status, **headers)


def redirects(target: str) -> Answer:
    return sends(b"moved", 302, Location=target)


@pytest.fixture
def files() -> Iterator[FileServer]:
    with FileServer() as server:
        yield server


@pytest.fixture
def names(monkeypatch: pytest.MonkeyPatch) -> dict[str, list[str]]:
    """Return the addresses of host names, which tests change. Other names and addresses cannot be looked up."""
    known: dict[str, list[str]] = {"127.0.0.1": ["127.0.0.1"]}
    getaddrinfo = socket.getaddrinfo

    def look_up(host: Any, *arguments: Any, **named: Any) -> Any:
        host = host.decode() if isinstance(host, bytes) else host
        if host not in known:
            raise socket.gaierror(f"{host} was looked up")
        return [entry for address in known[host] for entry in getaddrinfo(address, *arguments, **named)]

    monkeypatch.setattr(socket, "getaddrinfo", look_up)
    return known


@pytest.fixture
def public_loopback(monkeypatch: pytest.MonkeyPatch) -> None:
    """Treat 127.0.0.1 as a public address, so that a server of the test can be the first hop of a redirect."""
    loopback, is_public = ipaddress.ip_address("127.0.0.1"), outgoing.is_public
    monkeypatch.setattr(outgoing, "is_public", lambda address: address == loopback or is_public(address))


@dataclass
class Stored:
    """Content store, which is empty between tests, and the database."""

    folder: Path
    store: Store
    blobs: Blobs


@pytest.fixture(scope="module")
def stored(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Stored]:
    folder = tmp_path_factory.mktemp("stored")
    settings = ServiceSettings(data=folder, min_free_bytes=0)
    store = open_store(settings)
    yield Stored(folder, store, open_blobs(settings, store.inputs, Artifacts(settings.artifacts_url)))
    store.close()


def fetch(stored: Stored, *urls: str, requests: int = 1, bytes_quota: int | None = None, **values: Any) -> list[str]:
    """Fetch files as inputs of one request, or of several at once, and return the SHA-256 of each file.

    Checks that the request leaves neither a file nor a charge, as no job takes over its files.
    """
    settings = ServiceSettings(**{"url_private_addresses": True, **values})
    quotas = Quotas(stored_bytes=bytes_quota)

    async def request(fetcher: Fetcher) -> list[str]:
        receipts = Receipts(stored.store.inputs, stored.blobs, fetcher.threads)
        async with Receipt(receipts, "me", quotas) as receipt:
            checked = fetcher.urls([(index, "style", url) for index, url in enumerate(urls)])
            digests = await fetcher.fetch(checked, receipt)
            for sha256 in digests.values():
                path = next(iter((stored.folder / "blobs").glob(f"*/{sha256}*")))
                assert hashlib.sha256(path.read_bytes()).hexdigest() == sha256
            return [digests[url] for url in urls]

    async def all_requests() -> list[list[str]]:
        fetcher = Fetcher(settings, stored.blobs, FileThreads(PATIENCE))
        return await asyncio.gather(*(request(fetcher) for _ in range(requests)))

    try:
        return asyncio.run(all_requests())[0]
    finally:
        assert list((stored.folder / "incoming").iterdir()) == []
        assert list((stored.folder / "blobs").glob("*/*")) == []
        assert usage_of(stored.store, "me").stored_bytes == 0


# --- allowed hosts --------------------------------------------------------------------------------------------------


def test_nothing_is_fetched_by_default(stored: Stored, files: FileServer) -> None:
    with raises_problem(problems.URLS_OFF):
        fetch(stored, files.url("/a", sends(FILE)))
    assert files.requests == []


@pytest.mark.parametrize(
    "url",
    [
        *(
            "https://allowed.example.evil.test/",
            "https://evil.test/allowed.example",
            "https://evil.test#allowed.example",
        ),
        *("https://evil.test?allowed.example", "https://evil-allowed.example/", "https://sub.allowed.example/"),
        *("https://allowed.example@evil.test/", "https://user:pw@allowed.example/"),
        *("https://allowed.example:444/", "http://allowed.example/", "http://allowed.example:443/"),
        *("https://allowed.example./", "https://allowed.example..evil.test/", "https://allowed%2eexample/"),
        *("https://allowed.example\\@evil.test/", "https://evil.test\\.allowed.example/", "https:///allowed.example/"),
        *("https://\u0430llowed.example/", "https://allowed\u3002evil.test/", "https://allowed.example\0.evil.test/"),
        *("https://127.0.0.1/", "https://2130706433/", "https://0x7f.1/", f"http://{METADATA}/", "https://[::1]/"),
        *("https://", "https://[::1", "https://allowed.example:99999/", "https://allowed.example/" + "a" * 2000),
    ],
)
def test_only_allowed_hosts_are_contacted(url: str, stored: Stored, names: dict[str, list[str]]) -> None:
    """Names are compared as the client will look them up; `names` fails the test's lookup of any of them."""
    with raises_problem(problems.INVALID_URL) as caught:
        fetch(stored, url, url_hosts="allowed.example, other.example")
    assert (caught.value.code, caught.value.extra["input"]) == ("invalid-url", "style")
    assert len(str(caught.value)) < 800


@pytest.mark.parametrize(
    "url", ["https://ALLOWED.example/a", "https://allowed.example:443/a", "HTTPS://allowed.example"]
)
def test_spellings_of_an_allowed_host(url: str, stored: Stored, names: dict[str, list[str]]) -> None:
    with raises_problem(problems.URL_NOT_FETCHED, match=r"allowed\.example was looked up"):
        fetch(stored, url, url_hosts=" allowed.example ,")


@pytest.mark.parametrize(
    "entry", ["*", "*.example", "files.example/folder", "ftp://a", "a b", "a?", "a:x", "u@a", "[::1"]
)
def test_lists_of_hosts_are_checked_at_the_start(entry: str) -> None:
    with pytest.raises(ValueError, match="is not a host"):
        ServiceSettings(url_hosts=f"files.example, {entry}")


@pytest.mark.parametrize(
    ("url", "name"),
    [
        ("https://a/b/scene.ply?token=x#y", "scene.ply"),
        ("https://a/b%20c.ply", "b c.ply"),
        ("https://a/b%2F..%2Fc.ply", "c.ply"),
        ("https://a", ""),
    ],
)
def test_name_is_the_last_part_of_the_path(url: str, name: str) -> None:
    assert file_name(url) == name


# --- addresses ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "addresses",
    [
        *(["127.0.0.1"], ["10.0.0.1"], ["192.168.1.1"], [METADATA], ["100.64.0.1"], ["0.0.0.0"], ["192.0.0.192"]),
        *(["::1"], ["fe80::1"], ["fc00::1"], ["::ffff:127.0.0.1"], [f"64:ff9b::{METADATA}"], ["2002:7f00:1::"]),
        *([PUBLIC, "127.0.0.1"], ["2606:4700::1111", "::1"]),
    ],
)
def test_names_with_private_addresses_are_refused(
    addresses: list[str], stored: Stored, names: dict[str, list[str]]
) -> None:
    names["allowed.example"] = addresses
    with raises_problem(problems.INVALID_URL, match="not public") as caught:
        fetch(stored, "http://allowed.example/", url_hosts="http://allowed.example", url_private_addresses=False)
    assert not any(address in str(caught.value) for address in addresses)


def test_connection_uses_the_checked_address(
    stored: Stored, files: FileServer, names: dict[str, list[str]], public_loopback: None
) -> None:
    """A second lookup of the name would return another address, so there must not be one."""
    names["allowed.example"] = ["127.0.0.1"]
    host = f"allowed.example:{files.server_port}"

    def answer(handler: BaseHTTPRequestHandler) -> None:
        names["allowed.example"] = ["127.0.0.2"]
        sends(FILE)(handler)

    files.answers["/a"] = answer
    fetch(stored, f"http://{host}/a", url_hosts=f"http://{host}", url_private_addresses=False)
    assert files.requests == [(host, "/a")]


# --- redirects ------------------------------------------------------------------------------------------------------


def test_redirects_among_allowed_hosts_are_followed(
    stored: Stored, files: FileServer, names: dict[str, list[str]], public_loopback: None
) -> None:
    names["allowed.example"] = ["127.0.0.1"]
    other = f"http://allowed.example:{files.server_port}"
    url = files.url("/a/b", redirects("../c?d=e"))
    files.answers |= {"/c?d=e": redirects(f"{other}/f"), "/f": sends(FILE)}
    hosts = f"{files.origin}, {other}"
    digests = fetch(stored, url, url_hosts=hosts, url_private_addresses=False)
    assert digests == [hashlib.sha256(FILE).hexdigest()]
    hops = [(host.partition(":")[0], path) for host, path in files.requests]
    assert hops == [("127.0.0.1", "/a/b"), ("127.0.0.1", "/c?d=e"), ("allowed.example", "/f")]


@pytest.mark.parametrize(
    "target",
    [
        *(f"http://{METADATA}/latest/meta-data/", f"http://[::ffff:{METADATA}]/", "http://2852039166/"),
        *("http://allowed.example.evil.test/", "//evil.test/", "http://127.0.0.1:1/", "http://localhost/"),
        *(
            "file:///etc/passwd",
            "gopher://127.0.0.1/",
            "ftp://127.0.0.1/",
            "http://user@127.0.0.1/",
        ),
        *("http://metadata.allowed/", "http://rebound.allowed/"),
    ],
)
def test_redirects_are_checked_like_urls(
    target: str, stored: Stored, files: FileServer, names: dict[str, list[str]], public_loopback: None
) -> None:
    """Some targets are not allowed. Others are allowed names, but lead to addresses that are not public."""
    names["metadata.allowed"], names["rebound.allowed"] = [METADATA], [PUBLIC, "10.0.0.1"]
    url = files.url("/a", redirects(target))
    hosts = f"{files.origin}, http://metadata.allowed, http://rebound.allowed"
    with raises_problem(problems.INVALID_URL) as caught:
        fetch(stored, url, url_hosts=hosts, url_private_addresses=False)
    assert str(caught.value).startswith(repr(url))
    assert len(files.requests) == 1


# --- bodies ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("answer", "message"),
    [
        *((redirects(each), None) for each in ("http://[::1", "http://a:99999999/", "/\x7f", "data:text/plain,x")),
        (redirects("/a"), "redirects more than 5 times"),
        (sends(b"", Content_Length="1001"), "more than 1,000 bytes"),
        (sends(FILE[:500], Content_Length="900"), None),
        *((sends(FILE[:500], Content_Length=each), None) for each in ("-1", "x", "1_0", "7, 8", "9" * 5000, "")),
        *((sends(b"", each, Content_Length="0"), f"answered {each}") for each in (204, 206, 304, 401, 404, 500)),
        (sends(FILE[:500], Content_Encoding="gzip"), "compresses"),
        (sends(b""), "a: is empty"),
    ],
)
def test_unusable_answers_are_refused(answer: Answer, message: str | None, stored: Stored, files: FileServer) -> None:
    with pytest.raises(ServiceError, match=message):
        fetch(stored, files.url("/a", answer), url_hosts=files.origin, url_bytes=1000)
    assert len(files.requests) == (6 if message and "redirects" in message else 1)


@pytest.mark.parametrize("chunked", [False, True])
def test_undeclared_size_is_limited(chunked: bool, stored: Stored, files: FileServer) -> None:
    head = b"HTTP/1.1 200 OK\r\n" + b"Transfer-Encoding: chunked\r\n" * chunked + b"\r\n"
    block = b"10000\r\n" + bytes(1 << 16) + b"\r\n" if chunked else bytes(1 << 16)
    endless = repeating(head, block, cut_off := threading.Event())
    with raises_problem(problems.TOO_LARGE):
        fetch(stored, files.url("/a", endless), url_hosts=files.origin, url_bytes=1_000_000)
    assert cut_off.wait(PATIENCE), "everything was read"


def test_size_limit_counts_all_files_of_a_request(stored: Stored, files: FileServer) -> None:
    urls = [files.url(f"/{index}", sends(FILE)) for index in range(3)]
    assert len(fetch(stored, *urls, url_hosts=files.origin, url_bytes=3 * len(FILE))) == 3
    with raises_problem(problems.TOO_LARGE):
        fetch(stored, *urls, url_hosts=files.origin, url_bytes=3 * len(FILE) - 1)


def test_bytes_count_toward_the_quota(stored: Stored, files: FileServer) -> None:
    """The second file exceeds the quota, with and without a declared size."""
    urls = [files.url("/a", sends(FILE, Content_Length=str(len(FILE)))), files.url("/b", sends(FILE + b"b"))]
    for order in (urls, urls[::-1]):
        with raises_problem(problems.QUOTA_EXCEEDED):
            fetch(stored, *order, url_hosts=files.origin, bytes_quota=2 * len(FILE))


def test_bytes_beyond_the_declared_size_are_ignored(stored: Stored, files: FileServer) -> None:
    url = files.url("/a", sends(FILE, Content_Length="7"))
    assert fetch(stored, url, url_hosts=files.origin) == [hashlib.sha256(FILE[:7]).hexdigest()]


def test_unreachable_servers_are_reported(stored: Stored, names: dict[str, list[str]]) -> None:
    with socket.socket() as closed:
        closed.bind(("127.0.0.1", 0))
        origin = f"http://127.0.0.1:{closed.getsockname()[1]}"
        with raises_problem(problems.URL_NOT_FETCHED):
            fetch(stored, f"{origin}/a", url_hosts=origin)


# --- time -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("head", [b"HTTP/1.1 200 OK\r\nX: ", b"HTTP/1.1 200 OK\r\nContent-Length: 99999\r\n\r\n"])
def test_slow_answers_are_cut_off_at_the_deadline(head: bytes, stored: Stored, files: FileServer) -> None:
    """No single read takes long, but one deadline covers the whole request."""
    drip = repeating(head, b"x", cut_off := threading.Event(), 0.02)
    with raises_problem(
        problems.URL_NOT_FETCHED, match="within 2 s"
    ):  # long enough to send the request on a busy machine
        fetch(stored, files.url("/a", drip), url_hosts=files.origin, url_seconds=2)
    assert cut_off.wait(PATIENCE)


def test_deadline_covers_all_files_and_redirects(stored: Stored, files: FileServer) -> None:
    """Each of the endlessly many hops is fast, but their requests are served slowly together."""

    def answer(handler: BaseHTTPRequestHandler) -> None:
        time.sleep(0.2)
        sends(FILE)(handler)

    urls = [files.url(f"/{index}", answer) for index in range(50)]
    with raises_problem(problems.URL_NOT_FETCHED, match="within 1 s"):
        fetch(stored, *urls, url_hosts=files.origin, url_seconds=1)
    assert len(files.requests) < 50


def test_deadline_covers_lookups(stored: Stored, monkeypatch: pytest.MonkeyPatch) -> None:
    release = threading.Event()
    monkeypatch.setattr(socket, "getaddrinfo", lambda *arguments, **named: release.wait(PATIENCE) and [])
    with raises_problem(problems.URL_NOT_FETCHED, match="within"):
        fetch(stored, "https://allowed.example/", url_hosts="allowed.example", url_seconds=0.5)
    release.set()


# --- requests -------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def shared_files() -> Iterator[FileServer]:
    with FileServer() as server:
        yield server


@pytest.fixture(scope="module")
def service(tmp_path_factory: pytest.TempPathFactory, shared_files: FileServer) -> Iterator[Service]:
    settings = {"SGSST_URL_HOSTS": shared_files.origin, "SGSST_URL_PRIVATE_ADDRESSES": "true"}
    with Service(tmp_path_factory.mktemp("urls") / "data", alone=True, **settings) as running:
        yield running


@pytest.fixture(scope="module")
def urls(tmp_path_factory: pytest.TempPathFactory, shared_files: FileServer) -> dict[str, str]:
    paths = write_files(tmp_path_factory.mktemp("files"), wall())
    return {
        role: shared_files.url(f"/{path.name}", sends(path.read_bytes()))
        for role, path in zip(("scene", "cameras", "style"), paths, strict=True)
    }


def test_job_from_urls(client: httpx2.Client, shared_files: FileServer, urls: dict[str, str]) -> None:
    """JSON and forms may name URLs. The inputs have the names and the digests of the files."""
    named = {"scene": urls["scene"], "style": urls["style"], "cameras": [urls["cameras"]]}
    by_json = client.post("/v1/jobs", json=named)
    by_form = client.post("/v1/jobs", data=urls, files=[("webhook", (None, ""))])
    for answer in (by_json, by_form):
        assert answer.status_code == 202, answer.text
        job = answer.json()
        assert {entry["role"]: entry["name"] for entry in job["inputs"]} == {
            role: url.rsplit("/", 1)[1] for role, url in urls.items()
        }
        for entry in job["inputs"]:
            role = entry["role"]
            content = client.get(f"/v1/jobs/{job['id']}/inputs/{role}").content
            assert content == httpx2.get(urls[role]).content
            assert hashlib.sha256(content).hexdigest() == entry["sha256"]


def test_submit_command_accepts_urls(service: Service, urls: dict[str, str], tmp_path: Path, sgsst: Sgsst) -> None:
    style = tmp_path / "local.png"
    style.write_bytes(httpx2.get(urls["style"]).content)
    command = ["submit", urls["scene"], "--cameras", urls["cameras"], "--url", service.url, "--json"]
    command += ["--style", f"{urls['style']}:2", "--style", str(style), "--region", "half:half-space=1,0,0,0"]
    job = json.loads(sgsst([*command, "--region-style", f"half={style}"]))
    assert job["parameters"]["style_weights"] == [2, 1]
    assert job["parameters"]["regions"][0]["style"] == ["2_local.png:1.0"]
    names = {role: [entry["name"] for entry in job["inputs"] if entry["role"] == role] for role in urls}
    styles = ["style.png", "local.png", "2_local.png"]
    assert names == {"scene": ["scene.ply"], "cameras": ["cameras.json"], "style": styles}
    assert "not a file. Check the path." in sgsst([*command, "--region-style", f"half={urls['style']}"], 2)
    assert "not among the hosts" in sgsst(
        ["submit", "http://evil.test/scene.ply", "--style", str(style), "--orbit=3", "--url", service.url], 2
    )


def test_requests_are_checked_before_anything_is_fetched(
    client: httpx2.Client, shared_files: FileServer, urls: dict[str, str]
) -> None:
    wrong: list[tuple[str, dict[str, Any]]] = [
        ("invalid-cameras", {"scene": urls["scene"], "style": urls["style"], "photos": [urls["style"]]}),
        ("unknown-upload", {"scene": urls["scene"], "style": "x", "cameras": [urls["cameras"]]}),
        ("invalid-url", {"scene": urls["scene"], "style": "http://evil.test/", "cameras": [urls["cameras"]]}),
        ("webhooks-off", {**urls, "cameras": [urls["cameras"]], "webhook": "https://example.com/"}),
        ("invalid-request", {**urls, "cameras": [urls["cameras"]], "parameters": {"seed": -1}}),
    ]
    before = len(shared_files.requests)
    for code, body in wrong:
        refused(client.post("/v1/jobs", json=body), 422, code)
    assert len(shared_files.requests) == before


def test_failures_are_problem_documents(
    service: Service, client: httpx2.Client, shared_files: FileServer, urls: dict[str, str]
) -> None:
    """The style is missing, no image, or no file that may be fetched; nothing stays of the fetched scene."""
    bad = {
        "url-not-fetched": sends(b"", 404),
        "invalid-url": redirects(f"http://{METADATA}/"),
        "invalid-image": sends(b"no image"),
    }
    stored = sorted((service.data / "blobs").glob("*/*"))
    scene = shared_files.url("/other.ply", sends(httpx2.get(urls["scene"]).content + b"\n"))
    for code, answer in bad.items():
        body = {"scene": scene, "style": shared_files.url("/bad", answer), "cameras": [urls["cameras"]]}
        refused(client.post("/v1/jobs", json=body), 422, code)
    assert list((service.data / "incoming").iterdir()) == []
    assert sorted((service.data / "blobs").glob("*/*")) == stored


def test_other_requests_do_not_wait(service: Service, shared_files: FileServer, urls: dict[str, str]) -> None:
    """While servers keep fetching requests waiting, the service answers others."""
    release = threading.Event()
    slow = shared_files.url("/slow", lambda handler: release.wait(PATIENCE))
    body = {"scene": slow, "style": slow, "cameras": [urls["cameras"]]}
    with service.client() as client, ThreadPoolExecutor(4) as pool:
        before = len(shared_files.requests)
        waiting = [pool.submit(client.post, "/v1/jobs", json=body) for _ in range(4)]
        deadline = time.monotonic() + PATIENCE
        while len(shared_files.requests) < before + 4 and time.monotonic() < deadline:
            time.sleep(0.05)
        assert client.post("/v1/jobs", json=body).json()["code"] == "busy"
        assert client.get("/v1/jobs").status_code == 200
        release.set()
        assert {each.result().json()["code"] for each in waiting} == {"url-not-fetched"}
