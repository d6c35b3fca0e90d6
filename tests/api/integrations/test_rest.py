"""Tests of the client that all packages contain."""

import hashlib
import tempfile
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from api.integrations import sgsst_rest
from tests.api.conftest import KEYED, Services
from tests.api.service import Service
from tests.http_servers import LocalServer, send
from tests.small_scenes import wall


def splat() -> dict[str, Any]:
    """Return a wall as arrays by the property of a PLY."""
    scene = wall()
    values = np.hstack([scene.means, scene.sh_dc, scene.opacities[:, None], scene.scales, scene.quats])
    return dict(zip(("x", "y", "z", *sgsst_rest.REQUIRED), values.T, strict=True))


def answer_oddly(handler: BaseHTTPRequestHandler) -> None:
    """Truncate a file, send another one whole, and refuse all else: this is no service of sgsst."""
    if not handler.path.endswith(("truncated", "whole")):
        handler.send_error(404)
        return
    tag = f'"{hashlib.sha256(b"content").hexdigest()}"'
    send(handler, b"cont" if handler.path.endswith("truncated") else b"content", ETag=tag, Content_Length="7")


@pytest.fixture
def odd() -> Iterator[sgsst_rest.Service]:
    with LocalServer(answer_oddly) as server:
        yield sgsst_rest.Service(server.origin)


def test_key_is_for_one_origin(monkeypatch: pytest.MonkeyPatch) -> None:
    sent = []

    def redirect(handler: BaseHTTPRequestHandler) -> None:
        sent.append(handler.headers["Authorization"])
        send(handler, status=302, Location=f"{other}/")

    with LocalServer(redirect) as server:
        own, other = (f"http://{host}:{server.server_port}" for host in ("127.0.0.1", "localhost"))
        monkeypatch.setenv("SGSST_URL", own)
        monkeypatch.setenv("SGSST_KEY", "secret")
        given = [(None, None), (f"{own}/below", None), (other, None), (f"{own}@localhost", None), (other, "own")]
        for url, key in given:
            with pytest.raises(sgsst_rest.ServiceError):
                sgsst_rest.Service(url, key).json("GET", "/v1/jobs")
        with pytest.raises(sgsst_rest.ServiceError, match=rf"\(HTTP 302 {other}/\)\. Correct the address"):
            sgsst_rest.Service().json("GET", "/v1/jobs")
    assert sent == ["Bearer secret", "Bearer secret", None, "Bearer own", "Bearer secret"]


def test_truncated_download_is_no_result(odd: sgsst_rest.Service, tmp_path: Path) -> None:
    with pytest.raises(sgsst_rest.ServiceError, match="truncated or damaged"):
        odd.download("job", "truncated", tmp_path / "out.ply")
    assert list(tmp_path.iterdir()) == []
    (tmp_path / "out.ply.part").write_bytes(b"mine")
    odd.download("job", "whole", tmp_path / "out.ply")
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == {
        "out.ply": b"content",
        "out.ply.part": b"mine",
    }


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


@pytest.mark.parametrize(
    ("length", "advice"), [("6", "is no service of sgsst"), ("100", "The connection to http://127.0.0.1:")]
)
def test_job_that_cannot_be_submitted_has_an_error(length: str, advice: str, tmp_path: Path) -> None:
    """Programs that show a job in the background take one without an error for a success."""
    style = tmp_path / "style.png"
    style.write_bytes(b"image")
    with LocalServer(lambda handler: send(handler, b"<html>", Content_Length=length)) as server:
        job = sgsst_rest.BackgroundJob(sgsst_rest.Service(server.origin), splat(), style)
        job.run()
    assert job.error is not None
    assert job.error.startswith((advice, f"{server.origin} {advice}"))


def test_files_of_a_job_end_with_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    (tmp_path / "style.png").write_bytes(b"image")
    job = sgsst_rest.BackgroundJob(sgsst_rest.Service(), splat(), tmp_path / "style.png")
    assert [path.name for path in job.out.parent.iterdir()] == ["splat.ply"]
    with pytest.warns(ResourceWarning):
        del job
    assert [path.name for path in tmp_path.iterdir()] == ["style.png"]


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
    job = sgsst_rest.BackgroundJob(client, splat(), style, live=True, orbit=4, preset="preview", up="-y")
    job.run()
    assert (job.error, job.fraction) == (None, 1)
    assert job.colors is None or len(job.colors) == 6 * 28 * 22
    assert sgsst_rest.read_colors(job.out).shape == (28 * 22, 3)
