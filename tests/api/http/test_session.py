"""Tests of browser sessions: the key is sent once, then a cookie, which pages of other sites cannot use."""

import asyncio
import sqlite3
from collections.abc import Iterator
from http.cookies import Morsel, SimpleCookie
from pathlib import Path

import httpx2
import pytest

from api.http.access import MOST_FAILURES, SECONDS_A_TRY
from api.http.context import Rates
from service import problems
from service.scheduling.capacity import Machine
from service.settings import ServiceSettings
from service.store import Store, open_store
from service.store.keys import MOST_SESSIONS
from tests.api.conftest import KEYED, Services
from tests.api.http.sending import refused
from tests.api.service import Service
from tests.raised import raises_problem
from tests.service.store.helpers import SHA, queue

COOKIE = "sgsst_session"


@pytest.fixture(scope="module")
def service(services: Services) -> Service:
    """Return an API process that requires keys, without a dispatcher."""
    return services(**KEYED)


@pytest.fixture
def browser(service: Service) -> Iterator[httpx2.Client]:
    """Return a client that stores cookies and sends `Origin`, as browsers do."""
    with service.client() as opened:
        opened.headers["Origin"] = service.url
        yield opened


@pytest.fixture
def key(store: Store) -> str:
    return store.keys.create("alice")[1]


def budget() -> int:
    """Return the time budget that the page proposes on this machine."""
    return 60 if Machine.find(ServiceSettings()).gpus else 600


def sign_in(browser: httpx2.Client, key: str, **headers: str) -> httpx2.Response:
    return browser.post("/v1/session", json={"key": key}, headers=headers)


def cookie_of(answer: httpx2.Response) -> Morsel[str]:
    cookies: SimpleCookie = SimpleCookie(answer.headers["set-cookie"])
    return cookies[COOKIE]


def job_of(store: Store, owner: str) -> str:
    """Create a job whose scene was never uploaded, so that it never runs."""
    store.inputs.add_blob(SHA, "aa/blob", 3)
    return queue(store, owner)


def test_key_is_exchanged_for_cookie(browser: httpx2.Client, store: Store) -> None:
    row, key = store.keys.create("alice")
    job_id = job_of(store, row.id)
    refused(browser.get("/v1/jobs"), 401, "unauthorized")
    assert browser.get("/v1/session").json() == {"keys_needed": True, "signed_in": False, "within": budget()}
    answer = sign_in(browser, key)
    assert (answer.status_code, answer.content) == (204, b"")
    cookie = cookie_of(answer)
    assert cookie["httponly"]
    assert cookie["samesite"].lower() == "strict"
    assert cookie["path"] == "/"
    assert not cookie["domain"]
    assert not cookie["secure"], "this is http"
    assert int(cookie["max-age"]) == 7 * 86_400
    assert key not in cookie.value
    assert browser.get("/v1/session").json() == {"keys_needed": True, "signed_in": True, "within": budget()}
    assert [job["id"] for job in browser.get("/v1/jobs").json()["jobs"]] == [job_id]


def test_cookie_is_secure_on_https_pages(service: Service, key: str) -> None:
    # Behind a proxy that terminates TLS, the request itself arrives by HTTP.
    with service.client() as browser:
        host = service.url.removeprefix("http://")
        assert cookie_of(sign_in(browser, key, Origin=f"https://{host}"))["secure"]


def test_stored_session_digest_is_no_cookie(browser: httpx2.Client, service: Service, key: str) -> None:
    text = cookie_of(sign_in(browser, key)).value
    with sqlite3.connect(service.data / "sgsst.db") as connection:
        (stored,) = connection.execute("SELECT group_concat(sha256) FROM sessions").fetchone()
        everything = "\n".join(connection.iterdump())
    assert text not in everything
    assert key not in everything
    with service.client() as thief:
        for digest in stored.split(","):
            refused(thief.get("/v1/jobs", headers={"Cookie": f"{COOKIE}={digest}"}), 401, "unauthorized")
        assert thief.get("/v1/jobs", headers={"Cookie": f"{COOKIE}={text}"}).status_code == 200


def test_signing_out_ends_session(browser: httpx2.Client, service: Service, key: str) -> None:
    text = cookie_of(sign_in(browser, key)).value
    answer = browser.delete("/v1/session")
    assert answer.status_code == 204
    assert cookie_of(answer)["max-age"] == "0"
    assert browser.get("/v1/session").json()["signed_in"] is False
    with service.client() as thief:
        refused(thief.get("/v1/jobs", headers={"Cookie": f"{COOKIE}={text}"}), 401, "unauthorized")
    assert browser.delete("/v1/session").status_code == 204, "again"


def test_signing_in_again_ends_previous_session(browser: httpx2.Client, service: Service, key: str) -> None:
    first = cookie_of(sign_in(browser, key)).value
    second = cookie_of(sign_in(browser, key)).value
    assert first != second
    with service.client() as thief:
        refused(thief.get("/v1/jobs", headers={"Cookie": f"{COOKIE}={first}"}), 401, "unauthorized")
        assert thief.get("/v1/jobs", headers={"Cookie": f"{COOKIE}={second}"}).status_code == 200


def test_revoking_key_ends_its_sessions(browser: httpx2.Client, store: Store) -> None:
    row, key = store.keys.create("bob")
    sign_in(browser, key)
    assert browser.get("/v1/jobs").status_code == 200
    store.keys.revoke(row.id)
    refused(browser.get("/v1/jobs"), 401, "unauthorized")
    refused(browser.get("/v1/jobs", headers={"Authorization": f"Bearer {key}"}), 401, "unauthorized")
    assert browser.get("/v1/session").json() == {"keys_needed": True, "signed_in": False, "within": budget()}


def test_api_processes_share_sessions(browser: httpx2.Client, service: Service, key: str) -> None:
    text = cookie_of(sign_in(browser, key)).value
    with Service(service.data, alone=True, SGSST_REQUIRE_KEYS="true") as other, other.client() as client:
        assert client.get("/v1/jobs", headers={"Cookie": f"{COOKIE}={text}"}).status_code == 200
    assert browser.get("/v1/jobs").status_code == 200


def test_request_key_overrides_session(browser: httpx2.Client, store: Store, key: str) -> None:
    other, text = store.keys.create("carol")
    job_id = job_of(store, other.id)
    sign_in(browser, key)
    asked = browser.get("/v1/jobs", headers={"Authorization": f"Bearer {text}"})
    assert [job["id"] for job in asked.json()["jobs"]] == [job_id]
    refused(browser.get("/v1/jobs", headers={"Authorization": "Bearer wrong"}), 401, "unauthorized")
    # A key needs no page: no browser adds it to another site's request.
    del browser.headers["Origin"]
    canceled = browser.post(f"/v1/jobs/{job_id}/cancel", headers={"Authorization": f"Bearer {text}"})
    assert canceled.status_code == 200


# --- other sites ---------------------------------------------------------------------------------------------------

#: Headers of browsers for requests from another site's page, or from an unknown page.
ELSEWHERE: list[dict[str, str]] = [
    {"Origin": "https://evil.example"},
    {"Origin": "https://evil.example", "Sec-Fetch-Site": "cross-site"},
    {"Origin": "null"},
    {"Origin": ""},
    {"Origin": "http://["},
    {"Origin": "http://127.0.0.1"},  # another port of this machine
    {"Origin": "SELF.evil.example"},
    {"Origin": "http://evil@SELF"},
    {"Sec-Fetch-Site": "cross-site"},
    {"Sec-Fetch-Site": "same-site"},
    {"Sec-Fetch-Site": "none"},
    {"Origin": "SELF", "Sec-Fetch-Site": "cross-site"},
    {"Origin": "https://evil.example", "Sec-Fetch-Site": "same-origin"},
    {},
]


@pytest.mark.parametrize("headers", ELSEWHERE, ids=str)
def test_cross_origin_changes_are_rejected(
    service: Service, store: Store, headers: dict[str, str], browser: httpx2.Client
) -> None:
    row, key = store.keys.create("fred")
    job_id = job_of(store, row.id)
    sign_in(browser, key)
    del browser.headers["Origin"]
    sent = {name: value.replace("SELF", service.url) for name, value in headers.items()}
    upload = {"Tus-Resumable": "1.0.0", "Upload-Length": "5"}
    simple = {"Content-Type": "text/plain"}  # a form can send this without a preflight request
    for method, path, more, body in (
        ("POST", "/v1/jobs", simple, b"{}"),
        ("POST", f"/v1/jobs/{job_id}/cancel", {}, b""),
        ("POST", f"/v1/jobs/{job_id}/retry", {}, b""),
        ("DELETE", f"/v1/jobs/{job_id}", {}, b""),
        ("POST", "/v1/uploads", upload, b""),
        ("DELETE", "/v1/session", {}, b""),
    ):
        answer = browser.request(method, path, headers={**sent, **more}, content=body)
        refused(answer, 403, "cross-origin")
        assert "set-cookie" not in answer.headers
    assert store.jobs.get(job_id, row.id).status == "queued"
    store.inputs.create_upload(row.id, 1, "x", "", 1000, most=1)  # fails if there is an upload
    assert browser.get("/v1/session").json()["signed_in"] is True


@pytest.mark.parametrize("headers", [{"Origin": "SELF"}, {"Sec-Fetch-Site": "same-origin"}], ids=str)
def test_same_origin_changes_are_accepted(
    service: Service, store: Store, headers: dict[str, str], browser: httpx2.Client
) -> None:
    row, key = store.keys.create("gina")
    job_id = job_of(store, row.id)
    sign_in(browser, key)
    del browser.headers["Origin"]
    sent = {name: value.replace("SELF", service.url) for name, value in headers.items()}
    assert browser.post(f"/v1/jobs/{job_id}/cancel", headers=sent).json()["status"] == "canceled"


def test_reads_are_accepted_from_any_origin(browser: httpx2.Client, store: Store) -> None:
    """A link or an image of another site can make a browser GET anything (without the cookie, by SameSite)."""
    row, key = store.keys.create("hans")
    job_id = job_of(store, row.id)
    sign_in(browser, key)
    del browser.headers["Origin"]
    for path in (f"/v1/jobs/{job_id}/cancel", f"/v1/jobs/{job_id}/retry"):
        refused_method = browser.get(path)
        assert (refused_method.status_code, refused_method.json()["code"]) == (405, "method-not-allowed")
    for path in ("/v1/jobs", f"/v1/jobs/{job_id}", f"/v1/jobs/{job_id}/progress", "/v1/session"):
        answer = browser.get(path)
        assert answer.status_code == 200
        assert "set-cookie" not in answer.headers
        assert not [name for name in answer.headers if name.startswith("access-control")]
    assert store.jobs.get(job_id, row.id).status == "queued"
    assert "set-cookie" not in browser.get("/v1/session?key=" + key).headers


def test_cross_origin_sign_in_is_rejected(service: Service, key: str) -> None:
    """Otherwise, another site could sign users in with the attacker's key."""
    with service.client() as browser:
        for headers in ELSEWHERE[:-1]:
            sent = {name: value.replace("SELF", service.url) for name, value in headers.items()}
            answer = sign_in(browser, key, **sent)
            refused(answer, 403, "cross-origin")
            assert "set-cookie" not in answer.headers


# --- what is wrong, and too often ----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("body", "kind", "status", "code"),
    [
        (b"{}", "application/json", 422, "invalid-request"),
        (b'{"key": ""}', "application/json", 422, "invalid-request"),
        (b'{"key": 5}', "application/json", 422, "invalid-request"),
        (b'{"key": "x", "more": 1}', "application/json", 422, "invalid-request"),
        (b"[]", "application/json", 422, "invalid-request"),
        (b"[" * 4000, "application/json", 422, "invalid-request"),
        (b"key=x", "application/json", 422, "invalid-request"),
        (b"\xff", "application/json", 400, "malformed-body"),
        (b'{"key": "x"}', "text/plain", 415, "unsupported-media-type"),
        (b'{"key": "' + b"x" * 5000 + b'"}', "application/json", 413, "too-large"),
    ],
)
def test_malformed_sign_ins_are_rejected(
    browser: httpx2.Client, body: bytes, kind: str, status: int, code: str
) -> None:
    answer = browser.post("/v1/session", content=body, headers={"Content-Type": kind})
    refused(answer, status, code)
    assert answer.json()["detail"][0] not in ": "
    assert "set-cookie" not in answer.headers


def test_failed_sign_ins_are_limited_temporarily(service: Service, store: Store) -> None:
    """The client has an address of its own. If it could invent one for each attempt, there would be no limit."""
    transport = httpx2.HTTPTransport(local_address="127.0.0.2", verify=False)
    with httpx2.Client(base_url=service.url, transport=transport, timeout=60) as browser:
        key = store.keys.create("ida")[1]
        for number in range(MOST_FAILURES):
            answer = sign_in(browser, "sgsst_wrong", **{"X-Forwarded-For": f"192.0.2.{number}"})
            refused(answer, 401, "unauthorized")
        answer = sign_in(browser, key)
        refused(answer, 429, "too-many-tries")
        assert 0 < int(answer.headers["retry-after"]) <= SECONDS_A_TRY
        # The limit does not block a valid key from the same address.
        assert browser.get("/v1/jobs", headers={"Authorization": f"Bearer {key}"}).status_code == 200


def test_parallel_sign_ins_cannot_pass_the_limit(service: Service) -> None:
    async def guess() -> list[int]:
        transport = httpx2.AsyncHTTPTransport(local_address="127.0.0.3", verify=False)
        async with httpx2.AsyncClient(base_url=service.url, transport=transport, timeout=60) as browser:
            guesses = [browser.post("/v1/session", json={"key": f"sgsst_{each}"}) for each in range(60)]
            return [answer.status_code for answer in await asyncio.gather(*guesses)]

    statuses = asyncio.run(guess())
    assert (statuses.count(401), statuses.count(429)) == (MOST_FAILURES, 60 - MOST_FAILURES)


@pytest.mark.parametrize("trusted", ["10.0.0.0/8", pytest.param("127.0.0.1", marks=pytest.mark.slow)])
def test_only_trusted_proxy_sets_client_address(tmp_path: Path, trusted: str) -> None:
    """If any local client were trusted, it could invent an address for each attempt."""
    proxies = {"SGSST_REQUIRE_KEYS": "true", "SGSST_TRUSTED_PROXIES": trusted}
    with Service(tmp_path / "data", alone=True, **proxies) as service, service.client() as browser:
        for number in range(MOST_FAILURES + 1):
            answer = sign_in(browser, "sgsst_wrong", **{"X-Forwarded-For": f"192.0.2.{number}"})
        if trusted == "127.0.0.1":
            refused(answer, 401, "unauthorized")
        else:
            refused(answer, 429, "too-many-tries")


def test_sign_in_failures_expire() -> None:
    now = 0.0
    tries = Rates(lambda: now)

    def attempt(address: str) -> None:
        tries.take(address, 1 / SECONDS_A_TRY, MOST_FAILURES)

    for _ in range(MOST_FAILURES):
        attempt("a")
    with raises_problem(problems.RATE_LIMITED):
        attempt("a")
    attempt("b")
    now = SECONDS_A_TRY + 1
    attempt("a")
    tries.give_back("a")
    attempt("a")
    with raises_problem(problems.RATE_LIMITED):
        attempt("a")


def test_session_expires(tmp_path: Path) -> None:
    now = 1000.0
    store = open_store(ServiceSettings(data=tmp_path, session_days=1), lambda: now)
    row, _ = store.keys.create("jan")
    text = store.sessions.create(row.id)
    now += 86_399
    session = store.sessions.find(text)
    assert session is not None
    assert session.id == row.id
    now += 1
    assert store.sessions.find(text) is None
    store.sessions.create(row.id)
    with sqlite3.connect(tmp_path / "sgsst.db") as connection:
        assert connection.execute("SELECT count(*) FROM sessions").fetchone() == (1,), "the old one is forgotten"
    store.close()


def test_sessions_per_key_are_limited(tmp_path: Path) -> None:
    now = 1000.0
    store = open_store(ServiceSettings(data=tmp_path), lambda: now)
    row, _ = store.keys.create("kim")
    texts = []
    for _ in range(MOST_SESSIONS + 3):
        now += 1
        texts.append(store.sessions.create(row.id))
    alive = [store.sessions.find(text) is not None for text in texts]
    assert alive == [False] * 3 + [True] * MOST_SESSIONS
    store.close()


def test_invalid_cookie_is_ignored_without_keys(services: Services) -> None:
    with services().client() as browser:
        browser.cookies.set(COOKIE, "old")
        assert browser.get("/v1/session").json() == {"keys_needed": False, "signed_in": False, "within": budget()}
        assert browser.get("/v1/jobs").status_code == 200
        refused(browser.get("/v1/jobs", headers={"Origin": "https://evil.example"}), 403, "foreign-site")


def test_cookie_authorizes_streams_and_files(browser: httpx2.Client, store: Store) -> None:
    """`EventSource`, images and downloads cannot send a key."""
    row, key = store.keys.create("lea")
    job_id = job_of(store, row.id)
    sign_in(browser, key)
    del browser.headers["Origin"]
    with browser.stream("GET", f"/v1/jobs/{job_id}/events") as answer:
        assert answer.status_code == 200
        assert any("queued" in line for line in answer.iter_lines())
    assert browser.get(f"/v1/jobs/{job_id}/artifacts").json() == {"artifacts": [], "next_cursor": None}
