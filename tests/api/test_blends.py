"""End-to-end tests of blends over HTTP: real jobs, and the same blends computed from the downloaded files."""

from pathlib import Path

import httpx2
import pytest
import torch

from api.client import Client
from sgsst_core.files.library import save
from sgsst_core.files.scene_file import read_scene, write_scene
from sgsst_core.files.stylized_ply import blend_scenes
from tests.api.page.actions import done, submit
from tests.api.service import Service
from tests.small_scenes import wall, write_files

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    ply, cameras, style = write_files(tmp_path_factory.mktemp("inputs"), wall(sh_degree=1))
    ply.write_bytes(ply.read_bytes().replace(b"\nelement", b"\ncomment made by hand\nelement", 1))
    return {"scene": ply, "cameras": cameras, "style": style}


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
