"""Tests of videos of finished jobs, rendered by a request that reports its progress."""

import io
import json
from pathlib import Path
from typing import Any

import av
import httpx2
import pytest

from api.client import Client
from api.client.transport import RequestError
from tests.api.service import Service, submit, wait_for

PARAMETERS = {"preset": "preview", "backbone": "vgg16", "steps_coarse": 1, "steps_sos": 1, "measure": False}
pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def service(whole_service: Service) -> Service:
    return whole_service


@pytest.fixture(scope="module")
def job(service: Service, paths: dict[str, Path]) -> str:
    """Return the id of a finished job."""
    with service.client() as client:
        job_id = submit(client, paths, **PARAMETERS)
    return str(service.succeeded(job_id)["id"])


def frames(client: httpx2.Client, job_id: str) -> list[Any]:
    """Return the decoded frames of a job's video."""
    answer = client.get(f"/v1/jobs/{job_id}/artifacts/video.mp4")
    assert answer.status_code == 200
    assert answer.headers["content-type"] == "video/mp4"
    assert answer.headers["content-disposition"].startswith("inline")
    with av.open(io.BytesIO(answer.content), "r") as container:
        return [frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)]


def events(client: httpx2.Client, job_id: str, **options: Any) -> list[httpx2.ServerSentEvent]:
    with client.sse(f"/v1/jobs/{job_id}/video", method="POST", json=options) as source:
        assert source.response.status_code == 200, source.response.read()
        return [sent for sent in source if sent.data]


def names(client: httpx2.Client, job_id: str) -> list[str]:
    return [entry["name"] for entry in client.get(f"/v1/jobs/{job_id}/artifacts").json()["artifacts"]]


@pytest.mark.parametrize("path", ["orbit", "cameras"])
def test_finished_job_makes_another_video_with_progress(client: httpx2.Client, job: str, path: str) -> None:
    *rendering, last = events(client, job, path=path, fps=4, seconds=2, resolution=100)
    assert {sent.event for sent in rendering} == {"rendering"}
    assert [json.loads(sent.data)["total"] for sent in rendering] == [8] * len(rendering)
    assert json.loads(rendering[-1].data)["fraction"] == 1
    assert last.event == "video", last.data
    assert json.loads(last.data)["name"] == "video.mp4"
    images = frames(client, job)
    assert len(images) == 8
    assert max(images[0].shape) == 100
    assert names(client, job).count("video.mp4") == 1
    ranged = client.get(f"/v1/jobs/{job}/artifacts/video.mp4", headers={"Range": "bytes=4-7"})
    assert (ranged.status_code, ranged.content) == (206, b"ftyp")
    again = client.post(f"/v1/jobs/{job}/video", json={"seconds": 0.1})
    assert (again.status_code, again.json()["media_type"]) == (200, "video/mp4")


def test_client_makes_a_video(service: Service, job: str) -> None:
    reported: list[tuple[int, int]] = []
    with Client(service.url) as client:
        name = client.video(job, lambda *rendered: reported.append(rendered), path="orbit", fps=3, seconds=1)
        assert name == "video.mp4"
        with pytest.raises(RequestError, match="less than or equal to 30"):
            client.video(job, seconds=31)
    assert reported[-1] == (3, 3)
    with service.client() as client:
        assert len(frames(client, job)) == 3


def test_video_that_nobody_waits_for_is_completed(client: httpx2.Client, job: str) -> None:
    before = client.get(f"/v1/jobs/{job}/artifacts").json()
    options = {"fps": 10, "seconds": 6, "resolution": 200}
    with client.sse(f"/v1/jobs/{job}/video", method="POST", json=options) as source:
        next(iter(source))
        other = client.post(f"/v1/jobs/{job}/video", json={"seconds": 1})
        assert (other.status_code, other.json()["code"]) == (503, "busy")
    wait_for(lambda: client.get(f"/v1/jobs/{job}/artifacts").json() != before, "the video to be published")
    assert len(frames(client, job)) == 60


@pytest.mark.parametrize(
    ("options", "status", "message"),
    [
        ({"seconds": 31}, 422, "less than or equal to 30"),
        ({"fps": 61}, 422, "less than or equal to 60"),
        ({"resolution": 4000}, 422, "less than or equal to 1920"),
        ({"path": "spiral"}, 422, "path"),
        ({"codec": "av1"}, 422, "codec"),
    ],
)
def test_options_beyond_the_limits_are_refused(
    client: httpx2.Client, job: str, options: dict[str, Any], status: int, message: str
) -> None:
    answer = client.post(f"/v1/jobs/{job}/video", json=options)
    assert answer.status_code == status
    assert message in answer.text


def test_jobs_without_a_result_have_no_video(client: httpx2.Client, job: str) -> None:
    assert client.post(f"/v1/jobs/{'job_' + 31 * '0'}/video", json={}).status_code == 404
    broken = client.post(f"/v1/jobs/{job}/video", content=b"{", headers={"Content-Type": "application/json"})
    assert broken.status_code in (400, 422)
