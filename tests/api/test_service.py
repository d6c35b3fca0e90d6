"""End-to-end tests of the service: real processes of `sgsst serve`, jobs over HTTP, and killed processes."""

import hashlib
import io
import json
import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from datetime import datetime
from pathlib import Path
from typing import Any

import httpx2
import numpy as np
import pytest
import torch
from plyfile import PlyData

from sgsst_core import container
from sgsst_core.files.formats import EXTRA_FORMATS, by_name
from sgsst_core.files.formats.spz import SPZ
from sgsst_core.files.scene_file import SceneFile, read_scene, write_scene
from tests.api.service import ROOT, Service, undisturbed, wait_for
from tests.api.service import submit as submit_job
from tests.small_scenes import input_files, wall

#: Enough steps to be killed during a job, and enough to see a job run.
STEPS, FEW_STEPS = 600, 150
PARAMETERS = {"preset": "standard", "steps_sos": STEPS, "backbone": "vgg16", "early_stop": False, "seed": 3}


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    return input_files(tmp_path_factory.mktemp("inputs"), wall(sh_degree=1))


@pytest.fixture(scope="module")
def service(tmp_path_factory: pytest.TempPathFactory, tiny_installed: Path) -> Iterator[Service]:
    with Service(tmp_path_factory.mktemp("service") / "data") as running:
        yield running


@pytest.fixture(scope="module")
def expected(files: dict[str, Path], service: Service, tmp_path_factory: pytest.TempPathFactory) -> bytes:
    """Return the result of `sgsst stylize` for the same files and settings."""
    return undisturbed(files, PARAMETERS, tmp_path_factory.mktemp("cli")).read_bytes()


def submit(client: httpx2.Client, files: dict[str, Path], **parameters: Any) -> str:
    return submit_job(client, files, **PARAMETERS | parameters)


def job(client: httpx2.Client, job_id: str) -> dict[str, Any]:
    content: dict[str, Any] = client.get(f"/v1/jobs/{job_id}").json()
    return content


def wait_until(service: Service, client: httpx2.Client, job_id: str, *statuses: str) -> dict[str, Any]:
    def there() -> dict[str, Any] | None:
        current = job(client, job_id)
        return current if current["status"] in statuses else None

    reached: dict[str, Any] = wait_for(there, f"{job_id} to be {statuses}", service.said)
    return reached


def wait_for_step(service: Service, client: httpx2.Client, job_id: str, step: int, attempt: int = 1) -> None:
    def there() -> bool:
        progress = job(client, job_id)["progress"] or {}
        stepping = progress.get("stage") not in ("planning", "starting")
        return stepping and progress.get("attempt") == attempt and progress.get("step", 0) >= step

    wait_for(there, f"step {step}", service.said)


def events(client: httpx2.Client, job_id: str, after: int = 0) -> list[tuple[int, str, dict[str, Any]]]:
    """Return all events until the service closes the stream."""
    headers = {"Last-Event-ID": str(after)} if after else {}
    with client.sse(f"/v1/jobs/{job_id}/events", headers=headers) as stream:
        if stream.response.status_code == 204:
            return []
        return [(int(sent.id), sent.event, json.loads(sent.data)) for sent in stream if sent.data]


def result(client: httpx2.Client, job_id: str) -> bytes:
    return client.get(f"/v1/jobs/{job_id}/artifacts/stylized.ply").content


def check_colors(client: httpx2.Client, job_id: str, scene: Path) -> None:
    """Check that the file of stylized colors contains those of the PLY, rounded to float16."""
    colors = np.frombuffer(client.get(f"/v1/jobs/{job_id}/artifacts/colors.f16").content, "<f2").reshape(-1, 3)
    stylized = PlyData.read(io.BytesIO(result(client, job_id)))["vertex"]
    exact = np.stack([stylized[f"f_dc_{channel}"] for channel in range(3)], 1).astype(np.float64)
    assert np.abs(colors - exact).max() <= max(2.0**-11 * np.abs(exact).max(), 2.0**-25)
    assert len(colors) == len(read_scene(scene).scene), "each belongs to a row of what was sent"


def check_course(client: httpx2.Client, job_id: str, steps: list[int]) -> None:
    """Check the loss history of the whole job, from the first reported step to the last."""
    points = client.get(f"/v1/jobs/{job_id}/progress").json()["points"]
    assert {point["step"] for point in points} <= set(steps)
    assert points[0]["step"] == next(step for step in steps if step > 0)
    assert points[-1]["step"] == steps[-1]
    assert points[-1]["loss"] <= points[0]["loss"]  # a fast machine may report the last step alone
    for point in points:
        seen = [loss for loss in point["scales"] if loss is not None]
        assert np.isclose(np.mean(seen), point["loss"]), "all scales count alike"


def test_job_from_submission_to_ply(
    service: Service, client: httpx2.Client, files: dict[str, Path], tmp_path: Path
) -> None:
    job_id = submit(client, files, name="my wall", steps_sos=FEW_STEPS)
    seen = events(client, job_id)  # returns when the job has ended
    kinds = [(kind, data.get("status") or data.get("name")) for _, kind, data in seen]
    statuses = [what for kind, what in kinds if kind == "status"]
    assert statuses == ["queued", "starting", "running", "succeeded"]
    assert kinds.index(("artifact", "plan.json")) < kinds.index(("status", "succeeded"))
    assert any(kind == "artifact" and str(what).startswith("previews/") for kind, what in kinds)
    last_step = max(number for number, (kind, _) in enumerate(kinds) if kind == "progress")
    assert kinds.index(("artifact", "log.txt")) < last_step, "the log can be read while the job runs"
    progress = [data for _, kind, data in seen if kind == "progress"]
    steps = [data["step"] for data in progress if data["stage"] != "planning"]  # steps of planning are views
    assert all(0 <= data["step"] <= data["total"] == 3 for data in progress if data["stage"] == "planning")
    assert all(datetime.fromisoformat(data["updated_at"]).tzinfo for _, kind, data in seen if kind == "progress")
    assert steps == sorted(steps)
    assert steps[-1] == FEW_STEPS
    middle = seen[len(seen) // 2][0]
    assert events(client, job_id, after=middle) == [event for event in seen if event[0] > middle]
    assert events(client, job_id, after=seen[-1][0]) == []

    first = client.get(f"/v1/jobs/{job_id}")
    shown_job = first.json()
    assert (shown_job["status"], shown_job["name"], shown_job["attempt"]) == ("succeeded", "my wall", 1)
    assert shown_job["progress"]["fraction"] == 1
    assert shown_job["result"]["loss_after"] < shown_job["result"]["loss_before"]
    assert shown_job["result"]["steps"] == shown_job["result"]["total"] == FEW_STEPS
    same = client.get(f"/v1/jobs/{job_id}", headers={"If-None-Match": first.headers["etag"]})
    assert (same.status_code, same.content) == (304, b"")
    listed = client.get(f"/v1/jobs/{job_id}/artifacts").json()["artifacts"]
    names = {entry["name"] for entry in listed}
    assert {"stylized.ply", "plan.json", "report.json", "report.html", "log.txt"} <= names
    assert not any(name.startswith(".") for name in names)
    assert shown_job["preview"] == max(name for name in names if name.startswith("previews/"))
    check_colors(client, job_id, files["scene"])
    check_course(client, job_id, steps)
    for entry in listed:
        content = client.get(entry["url"])
        assert hashlib.sha256(content.content).hexdigest() == entry["sha256"] == content.headers["etag"].strip('"')
        assert content.headers["content-type"] == entry["media_type"]
        assert str(service.data).encode() not in content.content, f"{entry['name']} tells where the service's data is"
    assert result(client, job_id) == undisturbed(files, PARAMETERS | {"steps_sos": FEW_STEPS}, tmp_path).read_bytes()


@pytest.mark.slow
def test_compressed_scene_and_results_in_other_formats(
    service: Service, client: httpx2.Client, files: dict[str, Path], tmp_path: Path
) -> None:
    scene, gaussians = tmp_path / "wall.ply", wall(sh_degree=1)
    gaussians.means[:, 2] += torch.linspace(0, 0.3, 616)  # at equal depths, the image would depend on their order
    write_scene(scene, gaussians, SPZ)
    job_id = submit(client, files | {"scene": scene}, steps_sos=5)
    where = f"/v1/jobs/{job_id}/artifacts/stylized.ply"
    assert client.get(where, params={"format": "spz"}).status_code == 404
    wait_until(service, client, job_id, "succeeded")
    ply = read(tmp_path, client.get(where).content)
    assert ply.format == "ply"
    assert torch.equal(ply.scene.means, read_scene(scene).scene.means)
    for form in (each.name for each in EXTRA_FORMATS):
        first = client.get(where, params={"format": form})
        assert first.status_code == 200, first.text
        suggested = f'attachment; filename="{scene.stem}_style-stylized.{form}"'
        assert first.headers["content-disposition"].startswith(suggested)
        assert first.headers["content-type"] == by_name(form).media_type
        result = read(tmp_path, first.content)
        assert (result.format, len(result.scene)) == (form, len(ply.scene))
        again = client.get(where, params={"format": form}, headers={"If-None-Match": first.headers["etag"]})
        assert again.status_code == 304, "it is kept"
        assert client.get(f"/v1/jobs/{job_id}/artifacts/stylized.{form}").content == first.content
        loss = client.get(f"/v1/jobs/{job_id}/artifacts/stylized.{form}.json").json()
        assert (loss["name"], loss["format"], loss["bytes"]) == (f"stylized.{form}", form, len(first.content))
        assert loss["psnr_db"] is None or loss["psnr_db"] > 35
        assert loss["views"] == ["view_0", "view_1", "view_2"]
    names = {entry["name"] for entry in client.get(f"/v1/jobs/{job_id}/artifacts").json()["artifacts"]}
    assert {"stylized.spz", "stylized.spz.json", "stylized.compressed.ply"} <= names
    assert client.get(where, params={"format": "ply"}).content == client.get(where).content
    assert client.get(where, params={"format": "splat"}).json()["code"] == "invalid-request"
    page = client.get(where, params={"format": "html"})
    suggested = f'attachment; filename="{scene.stem}_style-stylized.html"'
    assert page.headers["content-disposition"].startswith(suggested)
    assert page.headers["content-type"] == "text/html; charset=utf-8"
    assert '<script type="text/plain" id="colors"></script>' not in page.text, "the scene's colors are there too"
    assert client.get(f"/v1/jobs/{job_id}/artifacts/stylized.html").content == page.content
    other = client.get(f"/v1/jobs/{job_id}/artifacts/report.json", params={"format": "spz"})
    assert (other.status_code, other.json()["code"]) == (422, "invalid-request")
    assert list((service.data / "packing").iterdir()) == []
    command = [sys.executable, "-m", "api.cli", "download", job_id, "--url", service.url]
    command += ["--out", str(tmp_path / "other.compressed.ply")]
    subprocess.run(command, check=True, env=service.environment, cwd=ROOT)
    assert read_scene(tmp_path / "other.compressed.ply").format == "compressed.ply"
    assert client.delete(f"/v1/jobs/{job_id}").status_code == 204
    assert client.get(where, params={"format": "spz"}).status_code == 404
    assert not (service.data / "artifacts" / job_id).exists()


def read(folder: Path, data: bytes) -> SceneFile:
    path = folder / hashlib.sha256(data).hexdigest()
    path.write_bytes(data)
    return read_scene(path)


@pytest.mark.slow
def test_stopped_job_is_continued(
    service: Service, client: httpx2.Client, files: dict[str, Path], expected: bytes
) -> None:
    """The result stays until the new one, which is that of a job that was never stopped; its derived files do not."""
    job_id = submit(client, files)
    wait_for_step(service, client, job_id, 10)
    assert client.post(f"/v1/jobs/{job_id}/finish").status_code == 200
    ended = wait_until(service, client, job_id, "succeeded")
    stopped = ended["result"]
    assert (stopped["stopped"], stopped["steps"] < stopped["total"]) == ("on-request", True)
    assert (ended["progress"]["eta_s"], client.post(f"/v1/jobs/{job_id}/finish").status_code) == (None, 409)
    report = client.get(f"/v1/jobs/{job_id}/artifacts/report.json").json()
    assert (report["stopped"], sum(each["done"] for each in report["steps"].values())) == (
        "on-request",
        stopped["steps"],
    )
    assert "stopped on request" in client.get(f"/v1/jobs/{job_id}/artifacts/report.html").text
    derived = f"/v1/jobs/{job_id}/artifacts/stylized.ply?format=spz"
    first = client.get(derived).content
    assert client.post(f"/v1/jobs/{job_id}/retry").json()["result"] is None
    assert "stylized.spz" not in client.get(f"/v1/jobs/{job_id}/artifacts").text
    final = wait_until(service, client, job_id, "succeeded")
    assert (final["result"]["stopped"], final["attempt"]) == ("finished", 2)
    steps = [data["step"] for _, kind, data in events(client, job_id) if kind == "progress" and data["attempt"] == 2]
    assert min(step for step in steps if step) >= stopped["steps"], "it started over"
    assert result(client, job_id) == expected
    assert client.get(derived).content != first
    assert client.post(f"/v1/jobs/{job_id}/retry").status_code == 409


@pytest.mark.slow
def test_request_to_finish_outlives_its_attempt(
    service: Service, client: httpx2.Client, files: dict[str, Path]
) -> None:
    """The next attempt resumes, makes a step and writes its result."""
    job_id = submit(client, files, steps_sos=1_000_000)
    wait_for_step(service, client, job_id, 5)
    running = service.process("service.scheduling.attempt_process")
    assert running is not None
    running.suspend()
    client.post(f"/v1/jobs/{job_id}/finish")
    running.kill()
    final = wait_until(service, client, job_id, "succeeded", "failed")
    assert [attempt["outcome"] for attempt in final["attempts"]] == ["failed", "succeeded"]
    assert final["result"]["stopped"] == "on-request"


def test_queued_job_is_canceled_immediately(service: Service, client: httpx2.Client, files: dict[str, Path]) -> None:
    first, second = (submit(client, files, steps_sos=1_000_000) for _ in range(2))
    assert client.post(f"/v1/jobs/{second}/cancel").json()["status"] == "canceled"
    client.post(f"/v1/jobs/{first}/cancel")
    wait_until(service, client, first, "canceled")
    page = client.get("/v1/jobs", params={"limit": 1, "status": "canceled"}).json()
    assert [entry["id"] for entry in page["jobs"]] == [second]
    following = client.get("/v1/jobs", params={"limit": 1, "status": "canceled", "cursor": page["next_cursor"]})
    assert [entry["id"] for entry in following.json()["jobs"]] == [first]


@pytest.mark.slow
def test_restart_resumes_running_jobs(files: dict[str, Path], expected: bytes, tmp_path: Path) -> None:
    with Service(tmp_path / "data") as service, service.client() as client:
        job_id = submit(client, files)
        wait_for_step(service, client, job_id, 10)
        wait_for(lambda: service.process("api.cli"), "the process", service.said).send_signal(signal.SIGINT)
        wait_for(lambda: "running jobs save their state" in service.said(), "the announcement", service.said)
        service.stop(signal.SIGHUP)  # the terminal is closed before the end
        service.start()
        ended = wait_until(service, client, job_id, "succeeded")
        assert [attempt["outcome"] for attempt in ended["attempts"]] == ["released", "succeeded"]
        assert result(client, job_id) == expected
    assert service.process("service.scheduling.dispatcher") is None
    assert not any((tmp_path / "data" / "work").iterdir())


@pytest.mark.slow
def test_concurrent_jobs_share_cores_and_memory(files: dict[str, Path], tmp_path: Path) -> None:
    with Service(tmp_path / "data", SGSST_PARALLEL_JOBS="2") as service, service.client() as client:
        jobs = [submit(client, files, name=name, steps_sos=1_000_000) for name in ("one", "two", "three")]
        for job_id in jobs[:2]:
            wait_for_step(service, client, job_id, 1)
        assert [job(client, job_id)["status"] for job_id in jobs] == ["running", "running", "queued"]
        tasks = [json.loads(path.read_text()) for path in service.data.glob("work/*/*/task.json")]
        limits = [task["spec"]["settings"]["memory_limit"] for task in tasks]
        assert len(limits) == 2
        assert 0 < sum(limits) <= 0.8 * container.memory().total
        threads = [
            process.environ()["MKL_NUM_THREADS"] for process in service.processes("service.scheduling.attempt_process")
        ]
        assert set(threads) == {str(max(1, container.cores() // 2))}
        wait_for(lambda: "sgsst_slots_free 0.0" in client.get("/metrics").text, "no place to be free", service.said)
        ready = client.get("/readyz").json()
        assert (ready["status"], ready["checks"]["dispatchers"]) == ("ok", "1")
        for job_id in jobs:
            client.post(f"/v1/jobs/{job_id}/cancel")
        for job_id in jobs:
            wait_until(service, client, job_id, "canceled")


def test_logs_contain_no_errors(service: Service) -> None:
    """This test runs last, and checks that the log of the shared service contains no traceback."""
    assert "Traceback" not in service.said()
    assert os.listdir(service.data / "incoming") == []
