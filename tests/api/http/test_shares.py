"""Tests of links to results: what they show, when they end, and that they give access to nothing else."""

import json
import os
import re
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import httpx2
import pytest
from sqlalchemy import update

from service.store import Store
from service.store.jobs import MOST_SHARES
from service.store.tables import ShareRow
from tests.api.conftest import KEYED, Services
from tests.api.http.sending import refused
from tests.api.http.test_outages import MANY
from tests.api.service import Service, check_documented, submit, wait_for

PLY, COLORS, THUMBNAIL = b"ply\nstylized", b"\0\1" * 9, b"\xff\xd8\xff\xe0"


@pytest.fixture(scope="module")
def service(services: Services) -> Service:
    """Return an API process that requires keys and may be embedded, without a dispatcher."""
    return services(**KEYED, SGSST_EMBED_ORIGINS="gallery.example, http://localhost:3000")


@pytest.fixture
def me(service: Service) -> Iterator[httpx2.Client]:
    with service.client(service.key()) as client:
        yield client


@pytest.fixture
def visitor(service: Service) -> Iterator[httpx2.Client]:
    """Yield a client without a key."""
    with service.client() as client:
        yield client


def finished(client: httpx2.Client, service: Service, paths: dict[str, Path]) -> str:
    """Return a finished job, with results in place of those of a dispatcher."""
    job_id = submit(client, paths, background="white", name="my wall", seed=7)
    contents = {"stylized.ply": PLY, "colors.f16": COLORS, "report.json": b"{}", "plan.json": b'{"decisions": []}'}
    service.finish(job_id, {**contents, "previews/thumbnail.jpg": THUMBNAIL})
    return job_id


def share(client: httpx2.Client, job_id: str, **body: Any) -> tuple[dict[str, Any], str]:
    """Share a job; return the share and its token."""
    answer = client.post(f"/v1/jobs/{job_id}/shares", json=body)
    assert answer.status_code == 201, answer.text
    view = answer.json()
    return view, view["url"].partition("/shared#")[2]


def assert_missing(answer: httpx2.Response, code: str = "not-found") -> None:
    refused(answer, 404, code)


def test_link_shows_the_result_and_nothing_else(
    service: Service, me: httpx2.Client, visitor: httpx2.Client, paths: dict[str, Path]
) -> None:
    job_id = finished(me, service, paths)
    view, token = share(me, job_id)
    shown = visitor.get(f"/v1/shared/{token}")
    assert shown.headers["referrer-policy"] == "no-referrer"
    assert shown.headers["cache-control"] == "no-store"
    assert shown.json() == {
        "name": "my wall",
        "expires_at": view["expires_at"],
        "parameters": {"background": [1.0, 1.0, 1.0]},
        "viewpoints": {"start": None, "named": []},
        "cameras": ["cameras.json"],
        "files": ["colors.f16", "stylized.ply", "poster"],
    }
    for name, content in (
        ("scene", paths["scene"].read_bytes()),
        ("cameras:0", paths["cameras"].read_bytes()),
        ("colors.f16", COLORS),
        ("stylized.ply", PLY),
    ):
        answer = visitor.get(f"/v1/shared/{token}/{name}")
        assert answer.content == content
        assert answer.headers["referrer-policy"] == "no-referrer"
        assert answer.headers["content-disposition"].startswith("attachment")
        assert "sandbox" in answer.headers["content-security-policy"]
    part = visitor.get(f"/v1/shared/{token}/stylized.ply", headers={"Range": "bytes=4-7"})
    assert (part.status_code, part.content) == (206, PLY[4:8])
    assert_missing(visitor.get(f"/v1/shared/{token}/cameras:1"), "no-shared-file")
    page = visitor.get("/shared")
    assert page.headers["referrer-policy"] == "no-referrer"
    assert "default-src 'none'" in page.headers["content-security-policy"]
    listed = me.get(f"/v1/jobs/{job_id}/shares").json()["shares"]
    assert [each["id"] for each in listed] == [view["id"]]
    assert token.partition(".")[2] not in json.dumps(listed)


def test_link_with_poster_names_its_image(
    service: Service, me: httpx2.Client, visitor: httpx2.Client, paths: dict[str, Path]
) -> None:
    job_id = finished(me, service, paths)
    assert me.patch(f"/v1/jobs/{job_id}", json={"name": 'my "<wall>"'}).status_code == 200
    view = me.post(f"/v1/jobs/{job_id}/shares", json={"poster": True}).json()
    path, token = view["url"], view["url"].rpartition("/")[2]
    assert path == f"/shared/{token}"
    assert view["embed_url"] == f"{path}?embed=1"
    page = visitor.get(path)
    assert page.headers["referrer-policy"] == "no-referrer"
    assert page.headers["cache-control"] == "no-store"
    assert '<meta property="og:title" content="my &quot;&lt;wall&gt;&quot;">' in page.text
    (image,) = re.findall(r'<meta property="og:image" content="(.*?)">', page.text)
    assert image == f"{service.url}/v1/shared/{token}/poster"
    poster = httpx2.get(image)  # as the server of a social network does
    assert (poster.content, poster.headers["content-type"]) == (THUMBNAIL, "image/jpeg")
    (script,) = re.findall(r'<script type="module" src="(.*?)">', page.text)
    assert visitor.get(f"/shared/{script}").status_code == 200
    proxied = visitor.get(path, headers={"Host": 'x"><script>'})
    assert "<script>" not in proxied.text.partition("og:image")[2].partition("</head>")[0]
    (row,) = me.get(f"/v1/jobs/{job_id}/shares").json()["shares"]
    assert me.delete(f"/v1/jobs/{job_id}/shares/{row['id']}").status_code == 204
    revoked = visitor.get(path)
    assert (revoked.status_code, "og:" in revoked.text, "shared.js" in revoked.text) == (404, False, True)
    assert_missing(visitor.get(f"/v1/shared/{token}/poster"))
    assert token not in service.log.read_text()


def viewpoint(name: str, **changed: Any) -> dict[str, Any]:
    axes = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]
    known = {"position": [0.0, 0.0, 0.5], "axes": axes, "fx": 80.0, "fy": 80.0, "width": 120, "height": 80}
    return {"name": name, **known, **changed}


def test_link_shows_the_named_viewpoints(
    service: Service, me: httpx2.Client, visitor: httpx2.Client, paths: dict[str, Path]
) -> None:
    job_id = finished(me, service, paths)
    _, token = share(me, job_id)
    here, named = f"/v1/jobs/{job_id}", [viewpoint("front"), viewpoint("left", position=[-1.0, 0.0, 0.5])]
    changed = me.patch(here, json={"viewpoints": {"named": named}})
    assert changed.json()["viewpoints"] == {"start": None, "named": named}
    assert changed.json()["name"] == "my wall"
    assert visitor.get(f"/v1/shared/{token}").json()["viewpoints"] == me.get(here).json()["viewpoints"]
    for wrong, reason in (
        ({"named": named * 7}, "at most 12"),
        ({"named": [viewpoint("front"), viewpoint("front", fx=90.0)]}, "each of them once"),
        ({"named": [viewpoint("")]}, "must have names"),
        ({"named": [viewpoint("a", axes=[[1, 0, 0], [0, -1, 0], [0, 0, 1]])]}, "orthogonal unit vectors"),
        ({"named": [viewpoint("a", axes=[[2, 0, 0], [0, 1, 0], [0, 0, 1]])]}, "orthogonal unit vectors"),
        ({"named": [viewpoint("a", fx=0)]}, "greater than 0"),
        ({"named": [viewpoint("a", width=10**9)]}, "65535"),
        ({"named": [viewpoint("a", up=[0, 1, 0])]}, "up"),
        ({"begin": None}, "begin"),
    ):
        assert reason in refused(me.patch(here, json={"viewpoints": wrong}), 422, "invalid-request")["detail"]
    unreadable = me.patch(here, json={"viewpoints": {"start": viewpoint("")}})  # the result is no PLY
    assert unreadable.status_code == 422
    check_documented(unreadable)
    assert "give a name or viewpoints" in refused(me.patch(here, json={}), 422, "invalid-request")["detail"]
    assert me.get(here).json()["viewpoints"] == {"start": None, "named": named}, "nothing else was stored"
    refused(me.patch(f"/v1/jobs/{submit(me, paths)}", json={"viewpoints": {"named": named}}), 409, "conflict")


def test_only_permitted_sites_may_frame_a_link(
    service: Service, services: Services, me: httpx2.Client, paths: dict[str, Path]
) -> None:
    job_id = finished(me, service, paths)
    hidden, posted = (me.post(f"/v1/jobs/{job_id}/shares", json={"poster": poster}).json() for poster in (False, True))
    assert hidden["embed_url"].startswith("/shared?embed=1#shr_")
    for view in (hidden, posted):
        page, frame = (me.get(view[name]).headers["content-security-policy"] for name in ("url", "embed_url"))
        assert page.endswith("; frame-ancestors 'none'")
        assert frame == page.removesuffix("'none'") + "http://localhost:3000 https://gallery.example:443"
    with services(**KEYED).client() as other:  # which permits none
        assert other.get("/shared?embed=1").headers["content-security-policy"].endswith("frame-ancestors 'none'")
    assert me.get("/?embed=1").headers["content-security-policy"].endswith("frame-ancestors 'none'")


@pytest.mark.parametrize(
    "name",
    [
        "report.json",
        "style",
        "style:0",
        "photos:0",
        "cameras:8",
        "log.txt",
        ".checkpoint",
        "..%2f..%2fartifacts%2freport.json",
        "%2e%2e%2fscene",
        "scene%00",
        "scene%0a",
        "scene%2f..%2freport.json",
        "stylized.ply%3fformat=spz",
        "Scene",
    ],
)
def test_token_opens_no_other_file(
    service: Service,
    me: httpx2.Client,
    visitor: httpx2.Client,
    paths: dict[str, Path],
    name: str,
) -> None:
    _, token = share(me, finished(me, service, paths))
    assert visitor.get(f"/v1/shared/{token}/{name}").status_code in (404, 422)


def test_token_is_no_key_and_of_one_job(
    service: Service, me: httpx2.Client, visitor: httpx2.Client, paths: dict[str, Path]
) -> None:
    job_id, other = (finished(me, service, paths) for _ in range(2))
    view, token = share(me, job_id)
    for headers in ({"Authorization": f"Bearer {token}"}, {"Cookie": f"sgsst_session={token}"}):
        for method, path in (
            ("GET", "/v1/jobs"),
            ("GET", f"/v1/jobs/{job_id}"),
            ("GET", f"/v1/jobs/{job_id}/artifacts/stylized.ply"),
            ("GET", f"/v1/jobs/{job_id}/shares"),
            ("GET", f"/v1/jobs/{other}/artifacts/stylized.ply"),
            ("DELETE", f"/v1/jobs/{job_id}/shares/{view['id']}"),
            ("DELETE", f"/v1/jobs/{job_id}"),
        ):
            assert visitor.request(method, path, headers=headers).status_code == 401
    for method in ("POST", "PUT", "PATCH", "DELETE"):
        assert visitor.request(method, f"/v1/shared/{token}").status_code == 405
    for path in (f"/v1/shared/{token}/../{other}", f"/v1/shared/{token}/{other}", f"/v1/shared/{view['id']}"):
        assert visitor.get(path).status_code in (404, 422)
    reference = f"/v1/shared/{token}/scene"
    body = {"scene": reference, "style": reference, "parameters": {"orbit": 1}}
    assert me.post("/v1/jobs", json=body).json()["code"] == "unknown-upload"


def test_wrong_tokens_open_nothing(
    service: Service, me: httpx2.Client, visitor: httpx2.Client, paths: dict[str, Path]
) -> None:
    view, token = share(me, finished(me, service, paths))
    secret = token.partition(".")[2]
    changed = ("A" if secret[0] != "A" else "B") + secret[1:]
    for wrong in (f"{view['id']}.{changed}", view["id"], f"{view['id']}.", f"{token}x", f"x{token}", secret, "x" * 100):
        assert_missing(visitor.get(f"/v1/shared/{wrong}"))
        assert_missing(visitor.get(f"/v1/shared/{wrong}/scene"))
    assert visitor.get(f"/v1/shared/{'x' * 200}").status_code == 422
    assert visitor.get(f"/v1/shared/{token}").status_code == 200


def test_link_ends_when_it_expires_or_is_revoked(
    service: Service, store: Store, me: httpx2.Client, visitor: httpx2.Client, paths: dict[str, Path]
) -> None:
    job_id = finished(me, service, paths)
    (first, one), (second, two), (_, three) = (share(me, job_id) for _ in range(3))
    with store.database.writing() as session:
        session.get_one(ShareRow, first["id"]).expires_at = store.database.clock() - 1
    assert_missing(visitor.get(f"/v1/shared/{one}"))
    assert_missing(visitor.get(f"/v1/shared/{one}/stylized.ply"))
    assert visitor.get(f"/v1/shared/{two}").status_code == 200
    assert me.delete(f"/v1/jobs/{job_id}/shares/{second['id']}").status_code == 204
    assert_missing(visitor.get(f"/v1/shared/{two}"))
    assert_missing(me.delete(f"/v1/jobs/{job_id}/shares/{second['id']}"))
    assert_missing(me.delete(f"/v1/jobs/{job_id}/shares/x"))
    assert visitor.get(f"/v1/shared/{three}").status_code == 200
    assert me.delete(f"/v1/jobs/{job_id}").status_code == 204
    assert_missing(visitor.get(f"/v1/shared/{three}"))


def test_link_ends_with_the_key_of_its_job(
    service: Service, store: Store, visitor: httpx2.Client, paths: dict[str, Path]
) -> None:
    key, text = store.keys.create("leaving")
    with service.client(text) as client:
        _, token = share(client, finished(client, service, paths))
    assert visitor.get(f"/v1/shared/{token}").status_code == 200
    store.keys.revoke(key.id)
    assert_missing(visitor.get(f"/v1/shared/{token}"))


def test_only_results_of_ones_own_can_be_shared(service: Service, me: httpx2.Client, paths: dict[str, Path]) -> None:
    job_id = finished(me, service, paths)
    with service.client(service.key()) as other:
        for method in ("GET", "POST"):
            assert_missing(other.request(method, f"/v1/jobs/{job_id}/shares", json={}))
        view, _ = share(me, job_id)
        assert_missing(other.delete(f"/v1/jobs/{job_id}/shares/{view['id']}"))
    own = finished(me, service, paths)
    assert_missing(me.delete(f"/v1/jobs/{own}/shares/{view['id']}"))
    refused(me.post(f"/v1/jobs/{submit(me, paths)}/shares", json={}), 409, "conflict")
    for days in (0, -1, 91, "x", "7", True, None, 1e400, 1e-300, 0.0006):
        assert (
            me.post(
                f"/v1/jobs/{job_id}/shares",
                content=json.dumps({"days": days}),
                headers={"Content-Type": "application/json"},
            ).status_code
            == 422
        )
    share(me, job_id, days=1 / 1440)
    for _ in range(MOST_SHARES - 2):
        share(me, job_id)
    refused(me.post(f"/v1/jobs/{job_id}/shares", json={}), 409, "too-many-shares")


def test_expired_links_do_not_count_toward_the_limit(
    store: Store, service: Service, me: httpx2.Client, paths: dict[str, Path]
) -> None:
    job_id = finished(me, service, paths)
    for _ in range(MOST_SHARES):
        share(me, job_id)
    now = store.database.clock()
    with store.database.writing() as session:
        session.execute(update(ShareRow).where(ShareRow.job_id == job_id).values(expires_at=now - 5))
    view, _ = share(me, job_id)
    assert [each["id"] for each in me.get(f"/v1/jobs/{job_id}/shares").json()["shares"]] == [view["id"]]


def test_stored_digest_is_no_token_and_logs_contain_none(
    service: Service, store: Store, me: httpx2.Client, visitor: httpx2.Client, paths: dict[str, Path]
) -> None:
    job_id = finished(me, service, paths)
    view, token = share(me, job_id)
    with store.database.reading() as session:
        row = session.get_one(ShareRow, view["id"])
    assert token.partition(".")[2] not in (row.id, row.sha256)
    assert_missing(visitor.get(f"/v1/shared/{row.id}.{row.sha256[:43]}"))
    assert visitor.get(f"/v1/shared/{token}/scene").status_code == 200
    assert visitor.get(f"/v1/shared/{token}/a/b").status_code == 404
    (result,) = (service.data / "artifacts" / job_id).rglob("colors.f16")
    result.unlink()
    result.mkdir()  # which cannot be read as a file
    assert visitor.get(f"/v1/shared/{token}/colors.f16").status_code == 500
    assert "/v1/shared/{token}/{name} failed unexpectedly" in service.log.read_text()
    assert token.partition(".")[2] not in service.log.read_text()


@pytest.mark.slow
def test_requests_of_a_link_are_limited(paths: dict[str, Path], tmp_path: Path) -> None:
    settings = {"SGSST_REQUIRE_KEYS": "true", "SGSST_MAX_REQUESTS_A_SECOND_PER_KEY": "0.5"}
    with Service(tmp_path / "data", alone=True, **settings) as service, service.client() as visitor:
        with service.client(service.key()) as me:
            _, token = share(me, finished(me, service, paths))
        for path in (token, "shr_1.x"):
            answers = [visitor.get(f"/v1/shared/{path}") for _ in range(20)]
            refused(next(answer for answer in answers if answer.status_code == 429), 429, "rate-limited")


def test_link_whose_files_hang_occupies_no_thread_of_others(
    service: Service, store: Store, me: httpx2.Client, visitor: httpx2.Client, paths: dict[str, Path]
) -> None:
    job_id = finished(me, service, paths)
    _, token = share(me, job_id)
    row = store.jobs.artifact(job_id, "plan.json")
    assert row is not None
    path = service.data / "artifacts" / row.location
    away, pipe = path.rename(path.with_suffix(".away")), path.with_suffix(".pipe")
    os.mkfifo(path)  # opening it takes until somebody else writes to it
    with ThreadPoolExecutor(MANY) as pool, service.client(service.key()) as other:
        reads = [pool.submit(visitor.get, f"/v1/shared/{token}") for _ in range(MANY)]
        try:
            for _ in range(3):
                assert other.get("/v1/jobs").json()["jobs"] == []
            assert not any(read.done() for read in reads)
        finally:
            path.rename(pipe)
            away.rename(path)
            writer = os.open(pipe, os.O_RDWR)
        # A connection of its own, because the service may be closing those that have waited.
        link = f"{service.url}/v1/shared/{token}"
        wait_for(lambda: httpx2.get(link).status_code == 200, "the link", service.said)
        os.close(writer)
