"""Tests of the page's static files: addresses, caching and policy."""

import gzip
import hashlib
import json
import re
from pathlib import Path

import httpx2
import pytest

from api.http.sending import DOCS_POLICY, POLICY, StaticFiles, static_files
from api.static_files import FOLDER, exported_viewer
from sgsst_core.files.formats import DOWNLOADS, FORMATS
from sgsst_core.files.scene_file import read_scene
from tests.api.conftest import KEYED, Services
from tests.api.service import Service

BUNDLE = "vendor/swagger-ui/swagger-ui-bundle.js"


@pytest.fixture(scope="module")
def service(services: Services) -> Service:
    """Return an API process that requires keys, which pages and their files do not need."""
    return services(**KEYED)


@pytest.fixture(scope="module")
def files() -> StaticFiles:
    return static_files()


@pytest.mark.parametrize(("path", "policy"), [("/", POLICY), ("/docs", DOCS_POLICY)])
def test_pages_reference_existing_files(client: httpx2.Client, path: str, policy: str) -> None:
    answer = client.get(path)
    assert answer.status_code == 200
    wanted = {"content-type": "text/html; charset=utf-8", "content-security-policy": policy}
    wanted |= {"x-content-type-options": "nosniff", "cache-control": "no-cache"}
    assert wanted.items() <= dict(answer.headers).items()
    assert "{{" not in answer.text
    named = re.findall(r'(?:src|href)="([^"]+)"', answer.text)
    assert not [name for name in named if re.match("(https?:)?//", name)], "something of another site"
    for name in named:
        if name.startswith("/"):
            assert client.get(name).status_code == 200, name


def test_policies_forbid_inline_scripts() -> None:
    for policy in (POLICY, DOCS_POLICY):
        assert "unsafe" not in policy
        assert "media-src 'self';" in policy
        assert "http" not in policy
        assert policy.startswith("default-src 'none'; script-src 'self';")


@pytest.mark.parametrize("script", ["page", "worker"])
def test_exported_scripts_need_no_modules(script: str) -> None:
    code = exported_viewer()[script]
    assert not re.search(r"^(import|export) |import\.meta", code, re.MULTILINE)


def test_example_is_a_scene_with_cameras(client: httpx2.Client, files: StaticFiles, tmp_path: Path) -> None:
    scene = tmp_path / "motorcycle.sog"
    answer = client.get(f"/static/{files.digest}/example/{scene.name}")
    assert (answer.status_code, answer.headers["content-security-policy"]) == (200, POLICY)
    scene.write_bytes(answer.content)
    assert len(read_scene(scene).scene) > 200_000
    assert len(client.get(f"/static/{files.digest}/example/cameras.json").json()) > 5
    assert client.get(f"/static/{files.digest}/example/..%2F..%2Fapp.py").status_code == 404
    assert client.get(f"/static/{files.digest}/example/none").status_code == 404
    assert client.get("/static/0/example/cameras.json").status_code == 404


def test_files_are_cached_by_digest(client: httpx2.Client, files: StaticFiles) -> None:
    for name in files.files:
        path = f"/static/{files.digest}/{name}"
        plain = client.get(path, headers={"Accept-Encoding": "identity"})
        if name not in ("tables.js", "options.js"):  # filled in by the server
            assert plain.content == Path(FOLDER, name).read_bytes()
        assert "max-age=31536000" in plain.headers["cache-control"]
        assert "immutable" in plain.headers["cache-control"]
        assert plain.headers["content-security-policy"] == POLICY
        known = client.get(path, headers={"Accept-Encoding": "identity", "If-None-Match": plain.headers["etag"]})
        assert (known.status_code, known.content) == (304, b"")


def test_page_knows_the_registered_scene_formats(client: httpx2.Client, files: StaticFiles) -> None:
    module = client.get(f"/static/{files.digest}/tables.js").text
    match = re.search(r"sceneFormats = .*\((\[.*\])\);", module)
    assert match
    assert [entry["suffix"] for entry in json.loads(match[1])] == [format.suffix for format in FORMATS]
    offered = re.search(r"downloads = .*\((\[.*\])\);", module)
    assert offered
    parameters = client.get("/openapi.json").json()["paths"]["/v1/jobs/{job_id}/artifacts/{name}"]["get"]["parameters"]
    (choices,) = [each["schema"]["anyOf"][0]["enum"] for each in parameters if each["name"] == "format"]
    assert [entry["name"] for entry in json.loads(offered[1])] == choices == [*DOWNLOADS]


def test_large_files_are_compressed_once(client: httpx2.Client, files: StaticFiles) -> None:
    path = f"/static/{files.digest}/{BUNDLE}"
    with client.stream("GET", path, headers={"Accept-Encoding": "br, gzip;q=0.5"}) as answer:
        assert answer.headers["content-encoding"] == "gzip"
        assert answer.headers["vary"] == "Accept-Encoding"
        packed, tag = b"".join(answer.iter_raw()), answer.headers["etag"]
    assert gzip.decompress(packed) == Path(FOLDER, BUNDLE).read_bytes()
    assert len(packed) < Path(FOLDER, BUNDLE).stat().st_size / 3
    refused = client.get(path, headers={"Accept-Encoding": "gzip;q=0, identity"})
    assert "content-encoding" not in refused.headers
    assert refused.headers["etag"] != tag


@pytest.mark.parametrize(
    "name", ["0123456789abcdef/index.html", "{digest}/nothing.js", "{digest}/%2e%2e/%2e%2e/http/app.py", "{digest}/"]
)
def test_other_static_paths_are_not_found(client: httpx2.Client, files: StaticFiles, name: str) -> None:
    answer = client.get(f"/static/{name.replace('{digest}', files.digest)}")
    assert answer.status_code == 404
    assert answer.headers["content-type"] == "application/problem+json"
    assert "immutable" not in answer.headers.get("cache-control", "")


def test_changed_file_changes_digest(tmp_path: Path) -> None:
    for version, text in enumerate(("let a = 1;", "let a = 2;")):
        folder = tmp_path / str(version)
        folder.mkdir()
        for page in ("index.html", "shared.html", "docs.html"):
            (folder / page).write_text('<script src="{{static}}/page.js"></script>')
        (folder / "page.js").write_text(text)
    first, second = (static_files(tmp_path / name) for name in "01")
    assert first.digest != second.digest
    assert first.pages["index.html"].digest != second.pages["index.html"].digest


@pytest.mark.parametrize("library", ["swagger-ui", "fzstd"])
def test_vendored_libraries_match_published_digests(library: str) -> None:
    folder = FOLDER / "vendor" / library
    lines = (folder / "SHA256SUMS").read_text().splitlines()
    sums = {name: digest for digest, name in (line.split() for line in lines)}
    assert {path.name for path in folder.iterdir()} == {*sums, "README.md", "SHA256SUMS"}
    for name, digest in sums.items():
        assert hashlib.sha256((folder / name).read_bytes()).hexdigest() == digest, name
