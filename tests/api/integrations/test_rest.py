"""Tests of the client that all packages contain."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import pytest

from api.integrations import sgsst_rest
from tests.api.conftest import KEYED, Services
from tests.api.service import Service
from tests.http_servers import serve


class Odd(BaseHTTPRequestHandler):
    """Server that truncates some files and is no service of sgsst."""

    def do_GET(self) -> None:
        if not self.path.endswith(("truncated", "whole")):
            self.send_error(404)
            return
        self.send_response(200)
        self.send_header("ETag", f'"{hashlib.sha256(b"content").hexdigest()}"')
        self.send_header("Content-Length", "7")
        self.end_headers()
        self.wfile.write(b"cont" if self.path.endswith("truncated") else b"content")

    def log_message(self, *arguments: Any) -> None:
        pass


@pytest.fixture
def odd() -> Iterator[sgsst_rest.Service]:
    with ThreadingHTTPServer(("127.0.0.1", 0), Odd) as server:
        serve(server)
        yield sgsst_rest.Service(f"http://127.0.0.1:{server.server_port}")
        server.shutdown()


def test_truncated_download_is_no_result(odd: sgsst_rest.Service, tmp_path: Path) -> None:
    with pytest.raises(sgsst_rest.ServiceError, match="truncated or damaged"):
        odd.download("job", "truncated", tmp_path / "out.ply")
    assert list(tmp_path.iterdir()) == []
    odd.download("job", "whole", tmp_path / "out.ply")
    assert (tmp_path / "out.ply").read_bytes() == b"content"


def test_each_failure_says_what_to_do(odd: sgsst_rest.Service, services: Services) -> None:
    cases = {
        "http://127.0.0.1:9": "sgsst serve",
        "nonsense": "Write it as",
        odd.url: "is no service of sgsst, or one of another version",
        services(**KEYED).url: "sgsst keys create",
    }
    for url, advice in cases.items():
        with pytest.raises(sgsst_rest.ServiceError, match=advice):
            list(sgsst_rest.Service(url).watch("job_1"))


@pytest.mark.slow
def test_stylize_returns_the_service_s_result(
    whole_service: Service, files: tuple[Path, Path, Path], tmp_path: Path
) -> None:
    scene, cameras, style = files
    client, out = sgsst_rest.Service(whole_service.url), tmp_path / "out.ply"
    job_id = client.stylize(scene, style, out, [cameras], preset="preview")
    assert out.read_bytes() == client.request("GET", f"/v1/jobs/{job_id}/artifacts/stylized.ply").read()
    with pytest.raises(sgsst_rest.ServiceError, match="Both 'cameras'"):
        client.stylize(scene, style, tmp_path / "b.ply", [cameras], orbit=3)
    job = sgsst_rest.BackgroundJob(client, (scene, style, tmp_path / "c.ply"), live=True, orbit=4, preset="preview")
    job.run()
    assert (job.error, job.fraction) == (None, 1)
    assert job.colors is None or len(job.colors) == 6 * 28 * 22
    assert (tmp_path / "c.ply").exists()
