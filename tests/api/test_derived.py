"""End-to-end tests of blends and videos of finished jobs over HTTP, compared with those that commands compute."""

import io
import json
from pathlib import Path
from typing import Any

import av
import httpx2
import pytest
import torch

from api.client import Client
from api.client.transport import RequestError
from sgsst_core.files.library import save
from sgsst_core.files.scene_file import blend_scenes, read_scene, write_scene
from tests.api.page.actions import done, submit
from tests.api.service import Service, wait_for
from tests.small_scenes import input_files, wall

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    files = input_files(tmp_path_factory.mktemp("inputs"), wall(sh_degree=1))
    scene = files["scene"].read_bytes()
    files["scene"].write_bytes(scene.replace(b"\nelement", b"\ncomment made by hand\nelement", 1))
    return files


@pytest.fixture(scope="module")
def service(whole_service: Service) -> Service:
    return whole_service


@pytest.fixture(scope="module")
def jobs(service: Service, files: dict[str, Path]) -> list[str]:
    """Return the ids of three finished jobs of one scene; the second one attenuates its harmonics."""
    ids = [
        submit(service, files, steps_sos=5, **each)
        for each in ({"seed": 1}, {"sh_attenuation": 0.5}, {"content_weight": 9})
    ]
    return [done(service, each) for each in ids]


def post(service: Service, job_id: str, **body: object) -> httpx2.Response:
    return httpx2.post(f"{service.url}/v1/jobs/{job_id}/blends", json=body, timeout=120)


def test_blend_is_that_of_the_command(
    service: Service, files: dict[str, Path], jobs: list[str], tmp_path: Path
) -> None:
    with Client(service.url) as client:
        paths = [client.download(job_id, tmp_path / f"{job_id}.ply") for job_id in jobs]
        results, scene = [read_scene(path) for path in paths], read_scene(files["scene"])
        for weight, others in ((0.7, {}), (1.5, {}), (0.4, {jobs[2]: 0.6}), (0.25, {jobs[1]: 0.5, jobs[2]: 0.25})):
            name = client.blend(jobs[0], weight, others)
            client.download(jobs[0], tmp_path / "found.ply", name)
            weights = [weight, *others.values()]
            chosen = [results[0], *(results[jobs.index(other)] for other in others)]
            if sum(weights) != 1:
                chosen, weights = [*chosen, scene], [*weights, 1 - sum(weights)]
            expected = blend_scenes(chosen, weights)
            save(tmp_path / "expected.ply", expected)
            assert (tmp_path / "found.ply").read_bytes() == (tmp_path / "expected.ply").read_bytes()
        spz = client.blend(jobs[0], 0.7, format="spz")
        client.download(jobs[0], tmp_path / "found.spz", spz)
        assert read_scene(tmp_path / "found.spz").format == "spz"
        assert {name, spz} <= {entry["name"] for entry in client.artifacts(jobs[0])}
    assert b"made by hand" in paths[0].read_bytes()
    assert list((service.data / "packing").iterdir()) == []


def test_same_blend_is_stored_once(service: Service, jobs: list[str]) -> None:
    first, second = post(service, jobs[2], weight=0.25), post(service, jobs[2], weight=0.2500001)
    assert first.status_code == second.status_code == 201
    assert first.json() == second.json()
    assert first.json()["name"] == "blends/stylized_0.25.ply"
    assert first.headers["location"] == first.json()["url"]
    download = httpx2.get(service.url + first.headers["location"])
    assert download.headers["content-disposition"] == 'attachment; filename="scene_style-stylized_0.25.ply"'


def test_unusable_blends_are_refused(service: Service, files: dict[str, Path], jobs: list[str], tmp_path: Path) -> None:
    write_scene(tmp_path / "other.ply", wall(sh_degree=1).subset(torch.arange(500)))
    other = done(service, submit(service, files | {"scene": tmp_path / "other.ply"}, steps_sos=5))
    unfinished = submit(service, files, steps_sos=1_000_000)
    missing = f"job_{'0' * 31}"
    for body, status, message in (
        ({"weight": 0.5, "others": [{"job_id": other, "weight": 0.5}]}, 422, "has 500 Gaussians"),
        ({"weight": 0.5, "others": [{"job_id": jobs[0], "weight": 0.5}]}, 422, "named twice"),
        ({"weight": 0.5, "others": [{"job_id": missing, "weight": 0.5}]}, 404, "There is no job"),
        ({"weight": 0.5, "others": [{"job_id": unfinished, "weight": 0.5}]}, 404, "has no file"),
        ({"weight": 0.5, "format": "splat"}, 422, "format"),
        ({"weight": 99}, 422, "weight"),
        ({}, 422, "weight"),
        ({"weight": 0.5, "color": 1}, 422, "color"),
    ):
        answer = post(service, jobs[0], **body)
        assert (answer.status_code, message in answer.text) == (status, True), answer.text
    assert post(service, unfinished, weight=0.5).status_code == 404
    assert post(service, missing, weight=0.5).status_code == 404
    httpx2.post(f"{service.url}/v1/jobs/{unfinished}/cancel")
    listed = httpx2.get(f"{service.url}/v1/jobs/{other}/artifacts").json()["artifacts"]
    assert not any(entry["name"].startswith("blends/") for entry in listed)


@pytest.fixture(scope="module")
def job(jobs: list[str]) -> str:
    return jobs[0]


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
