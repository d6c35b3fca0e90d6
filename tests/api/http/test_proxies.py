"""Tests of the service behind nginx, at the root of a host and at a subpath."""

import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.parse import urljoin

import httpx2
import pytest

from tests.api.conftest import Services
from tests.api.http.sending import TUS, form
from tests.api.service import Service
from tests.nginx import Nginx

#: Client without certificates, which take time to load.
PLAIN = httpx2.Client(verify=False, timeout=60)
FORWARDED = ("proxy_set_header X-Forwarded-Prefix /tools/paint;",)


@dataclass
class Proxy:
    """Service behind a proxy."""

    url: str
    subpath: str


@pytest.fixture(scope="module")
def configured(services: Services) -> Service:
    """Return a service that knows its subpath from a setting."""
    return services(SGSST_ROOT_PATH="/sgsst/", SGSST_TRUSTED_PROXIES="127.0.0.1")


@pytest.fixture(scope="module")
def trusting(services: Services) -> Service:
    """Return a service that trusts a proxy on this machine."""
    return services(SGSST_TRUSTED_PROXIES="127.0.0.0/8", SGSST_REQUIRE_KEYS="false", SGSST_WEBHOOKS="true")


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


def test_pages_and_their_files_are_found(proxy: Proxy) -> None:
    for page in ("/", "/docs", "/shared"):
        answer = PLAIN.get(proxy.url + page)
        assert answer.status_code == 200
        named = re.findall(r'(?:src|href)="([^"]+)"', answer.text)
        assert named
        for name in named:
            if not name.startswith("data:"):
                assert PLAIN.get(urljoin(str(answer.url), name)).status_code == 200, name
    unchanged = PLAIN.get(f"{proxy.url}/", headers={"If-None-Match": PLAIN.get(f"{proxy.url}/").headers["etag"]})
    assert unchanged.status_code == 304  # nginx has made the tag a weak one
    servers = PLAIN.get(f"{proxy.url}/openapi.json").json().get("servers", [])
    assert servers == ([{"url": proxy.subpath}] if proxy.subpath else [])


def test_addresses_lead_through_the_proxy(proxy: Proxy, files: dict[str, bytes]) -> None:
    created = PLAIN.post(f"{proxy.url}/v1/uploads", headers={**TUS, "Upload-Length": "10"})
    where = urljoin(proxy.url, created.headers["location"])
    assert where.startswith(f"{proxy.url}/v1/uploads/")
    assert PLAIN.head(where, headers=TUS).headers["upload-offset"] == "0"
    answer = PLAIN.post(f"{proxy.url}/v1/jobs", files=form(files), timeout=60)
    job = answer.json()
    assert answer.headers["location"] == job["links"]["self"]
    assert PLAIN.get(urljoin(proxy.url, job["links"]["self"])).json()["id"] == job["id"]
    with PLAIN.stream("GET", urljoin(proxy.url, job["links"]["events"])) as events:
        assert next(line for line in events.iter_lines() if line.startswith("event:")) == "event: status"
    (scene, *_) = PLAIN.get(f"{job_url(proxy, job)}/inputs").json()["inputs"]
    assert PLAIN.get(urljoin(proxy.url, scene["url"])).headers["etag"] == f'"{scene["sha256"]}"'
    assert PLAIN.get(urljoin(proxy.url, scene["url"])).headers["cache-control"] == "private, no-cache, no-transform"
    names = {"scene": scene["url"], "style": job["id"], "cameras": [f"/v1/jobs/{job['id']}/inputs/cameras"]}
    refused = PLAIN.post(f"{proxy.url}/v1/jobs", json=names).json()
    assert refused["input"] == "style", "the scene, named by its address, is found"
    slash = PLAIN.get(f"{proxy.url}/v1/jobs/").headers["location"]
    assert slash == f"{proxy.url}/v1/jobs"
    PLAIN.post(f"{job_url(proxy, job)}/cancel").raise_for_status()


def job_url(proxy: Proxy, job: dict[str, Any]) -> str:
    return f"{proxy.url}/v1/jobs/{job['id']}"


def test_session_cookie_is_limited_to_the_subpath(proxy: Proxy) -> None:
    cookie = PLAIN.delete(f"{proxy.url}/v1/session").headers["set-cookie"]
    assert f"; Path={proxy.subpath or '/'};" in cookie


@pytest.mark.parametrize("prefix", ["//evil.example", "/a/../b", "/a b", "a", "/" + "a" * 300])
def test_unusable_prefixes_are_ignored(trusting: Service, prefix: str) -> None:
    headers = {**TUS, "Upload-Length": "10", "X-Forwarded-Prefix": prefix}
    answer = PLAIN.post(f"{trusting.url}/v1/uploads", headers=headers)
    assert answer.headers["location"].startswith("/v1/uploads/")


def test_setting_takes_precedence_over_header(configured: Service) -> None:
    headers = {**TUS, "Upload-Length": "10", "X-Forwarded-Prefix": "/other"}
    answer = PLAIN.post(f"{configured.url}/v1/uploads", headers=headers)
    assert answer.headers["location"].startswith("/sgsst/v1/uploads/")
    assert PLAIN.get(f"{configured.url}/sgsst").headers["location"].endswith("/sgsst/")
