"""Tests of the service behind nginx, at the root of a host and at a subpath."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.parse import urljoin

import httpx2
import pytest

from tests.api.service import Service
from tests.nginx import Nginx
from tests.small_scenes import wall, write_files

TUS = {"Tus-Resumable": "1.0.0"}
FORWARDED = ("proxy_set_header X-Forwarded-Prefix /tools/paint;",)


@dataclass
class Proxy:
    """Service behind a proxy."""

    url: str
    subpath: str


@pytest.fixture(scope="module")
def configured(tmp_path_factory: pytest.TempPathFactory, tiny_installed: Path) -> Iterator[Service]:
    """Yield a service that knows its subpath from a setting."""
    data = tmp_path_factory.mktemp("configured") / "data"
    with Service(data, alone=True, SGSST_ROOT_PATH="/sgsst/", SGSST_TRUSTED_PROXIES="127.0.0.1") as running:
        yield running


@pytest.fixture(scope="module")
def trusting(tmp_path_factory: pytest.TempPathFactory, tiny_installed: Path) -> Iterator[Service]:
    """Yield a service that trusts a proxy on this machine."""
    data = tmp_path_factory.mktemp("trusting") / "data"
    with Service(data, alone=True, SGSST_TRUSTED_PROXIES="127.0.0.0/8", SGSST_REQUIRE_KEYS="false") as running:
        yield running


@pytest.fixture(params=["stripped", "passed", "forwarded", "root"])
def proxy(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Proxy]:
    subpath = {"forwarded": "/tools/paint", "root": ""}.get(request.param, "/sgsst")
    service = request.getfixturevalue("configured" if subpath == "/sgsst" else "trusting")
    directives = FORWARDED if request.param == "forwarded" else ()
    strip = request.param != "passed"
    with Nginx(tmp_path / "nginx", port_of(service), subpath, strip=strip, directives=directives) as nginx:
        yield Proxy(nginx.url, subpath)


def port_of(service: Service) -> int:
    return int(service.url.rpartition(":")[2])


def job_form(folder: Path) -> dict[str, Any]:
    paths = dict(zip(("scene", "cameras", "style"), write_files(folder, wall()), strict=True))
    parameters = {"preset": "preview", "resolution": 48, "steps_coarse": 1, "steps_sos": 1}
    return {
        "files": {role: (path.name, path.read_bytes()) for role, path in paths.items()},
        "data": {"parameters": json.dumps(parameters)},
    }


def test_pages_and_their_files_are_found(proxy: Proxy) -> None:
    for page in ("/", "/docs", "/shared"):
        answer = httpx2.get(proxy.url + page)
        assert answer.status_code == 200
        named = re.findall(r'(?:src|href)="([^"]+)"', answer.text)
        assert named
        for name in named:
            if not name.startswith("data:"):
                assert httpx2.get(urljoin(str(answer.url), name)).status_code == 200, name
    unchanged = httpx2.get(f"{proxy.url}/", headers={"If-None-Match": httpx2.get(f"{proxy.url}/").headers["etag"]})
    assert unchanged.status_code == 304  # nginx has made the tag a weak one
    servers = httpx2.get(f"{proxy.url}/openapi.json").json().get("servers", [])
    assert servers == ([{"url": proxy.subpath}] if proxy.subpath else [])


def test_addresses_lead_through_the_proxy(proxy: Proxy, tmp_path: Path) -> None:
    created = httpx2.post(f"{proxy.url}/v1/uploads", headers={**TUS, "Upload-Length": "10"})
    where = urljoin(proxy.url, created.headers["location"])
    assert where.startswith(f"{proxy.url}/v1/uploads/")
    assert httpx2.head(where, headers=TUS).headers["upload-offset"] == "0"
    answer = httpx2.post(f"{proxy.url}/v1/jobs", **job_form(tmp_path), timeout=60)
    job = answer.json()
    assert answer.headers["location"] == job["links"]["self"]
    assert httpx2.get(urljoin(proxy.url, job["links"]["self"])).json()["id"] == job["id"]
    with httpx2.stream("GET", urljoin(proxy.url, job["links"]["events"])) as events:
        assert next(line for line in events.iter_lines() if line.startswith("event:")) == "event: status"
    (scene, *_) = httpx2.get(f"{job_url(proxy, job)}/inputs").json()["inputs"]
    assert httpx2.get(urljoin(proxy.url, scene["url"])).headers["etag"] == f'"{scene["sha256"]}"'
    assert httpx2.get(urljoin(proxy.url, scene["url"])).headers["cache-control"] == "private, no-cache, no-transform"
    names = {"scene": scene["url"], "style": job["id"], "cameras": [f"/v1/jobs/{job['id']}/inputs/cameras"]}
    refused = httpx2.post(f"{proxy.url}/v1/jobs", json=names).json()
    assert refused["input"] == "style", "the scene, named by its address, is found"
    slash = httpx2.get(f"{proxy.url}/v1/jobs/").headers["location"]
    assert slash == f"{proxy.url}/v1/jobs"
    httpx2.post(f"{job_url(proxy, job)}/cancel").raise_for_status()


def job_url(proxy: Proxy, job: dict[str, Any]) -> str:
    return f"{proxy.url}/v1/jobs/{job['id']}"


def test_session_cookie_is_limited_to_the_subpath(proxy: Proxy) -> None:
    cookie = httpx2.delete(f"{proxy.url}/v1/session").headers["set-cookie"]
    assert f"; Path={proxy.subpath or '/'};" in cookie


@pytest.mark.parametrize("prefix", ["//evil.example", "/a/../b", "/a b", "a", "/" + "a" * 300])
def test_unusable_prefixes_are_ignored(trusting: Service, prefix: str) -> None:
    headers = {**TUS, "Upload-Length": "10", "X-Forwarded-Prefix": prefix}
    answer = httpx2.post(f"{trusting.url}/v1/uploads", headers=headers)
    assert answer.headers["location"].startswith("/v1/uploads/")


def test_setting_takes_precedence_over_header(configured: Service) -> None:
    headers = {**TUS, "Upload-Length": "10", "X-Forwarded-Prefix": "/other"}
    answer = httpx2.post(f"{configured.url}/v1/uploads", headers=headers)
    assert answer.headers["location"].startswith("/sgsst/v1/uploads/")
    assert httpx2.get(f"{configured.url}/sgsst").headers["location"].endswith("/sgsst/")
