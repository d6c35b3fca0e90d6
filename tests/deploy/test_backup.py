"""Tests of `deploy/backup.py`: a running service is saved, all its data are deleted, and it is restored elsewhere."""

import contextlib
import os
import shutil
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import httpx2
import psutil
import pytest

from tests.api.service import ROOT, Service, undisturbed, wait_for
from tests.api.service import submit as submit_job
from tests.postgres import fresh_database
from tests.service.conftest import postgres, s3_url  # noqa: F401 (fixtures)
from tests.service.files.s3 import environment_of
from tests.small_scenes import input_files

pytestmark = pytest.mark.slow
#: The job has to run for longer than two backups take, even on a busy machine.
PARAMETERS = {
    "steps_sos": 1500,
    "early_stop": False,
    "steps_coarse": 0,
    "backbone": "vgg16",
    "precision": "float32",
    "seed": 3,
}


def bucket(s3: str, name: str) -> dict[str, str]:
    """Create a bucket, and return the environment of a service that stores its files there."""
    assert httpx2.put(f"{s3}/{name}").status_code == 200
    return {**environment_of(s3), "SGSST_ARTIFACTS": f"s3://{name}/service"}


def backup(environment: dict[str, str], *words: str | Path) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, str(ROOT / "deploy" / "backup.py"), *map(str, words)]
    own = {**os.environ, "PYTHONPATH": str(ROOT), **environment}
    return subprocess.run(command, env=own, capture_output=True, text=True)


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    return input_files(tmp_path_factory.mktemp("in"))


@pytest.fixture(scope="module")
def expected(files: dict[str, Path], tiny_installed: Path, tmp_path_factory: pytest.TempPathFactory) -> bytes:
    """Return the result of a job that nothing interrupts."""
    return undisturbed(files, PARAMETERS, tmp_path_factory.mktemp("expected")).read_bytes()


def submit(client: httpx2.Client, files: dict[str, Path], **parameters: Any) -> str:
    return submit_job(client, files, **PARAMETERS | parameters)


def job(client: httpx2.Client, job_id: str) -> dict[str, Any]:
    return dict(client.get(f"/v1/jobs/{job_id}").json())


def lose(service: Service) -> None:
    """Kill all processes of a service at once."""
    for process in service.survivors():
        with contextlib.suppress(psutil.NoSuchProcess):  # it has died with its parent
            process.send_signal(signal.SIGKILL)
    wait_for(lambda: not service.survivors(), "the end of all processes")


@pytest.mark.parametrize("kind", ["local", "servers"])
def test_jobs_continue_after_a_restore(
    kind: str, tmp_path: Path, files: dict[str, Path], expected: bytes, request: pytest.FixtureRequest
) -> None:
    before: dict[str, Any] = {}
    after: dict[str, Any] = {}
    if kind == "servers":
        if shutil.which("pg_dump") is None:
            pytest.skip("pg_dump is missing: apt-get install -y postgresql-client")
        server, s3 = request.getfixturevalue("postgres"), request.getfixturevalue("s3_url")
        before = {**bucket(s3, "old"), "SGSST_DATABASE": fresh_database(server)}
        after = {**bucket(s3, "new"), "SGSST_DATABASE": fresh_database(server)}
    saved = tmp_path / "backup"
    with Service(tmp_path / "before", **before) as service, service.client() as client:
        done = submit(client, files, steps_sos=20)
        service.succeeded(done)
        first = client.get(f"/v1/jobs/{done}/artifacts/stylized.ply").content
        running = submit(client, files)
        waiting = submit(client, files, steps_sos=20)
        wait_for(lambda: (job(client, running)["progress"] or {}).get("step", 0) > 300, "steps", service.said)
        for _ in range(2):  # the second backup adds to the first
            ended = backup({"SGSST_DATA": str(service.data), **before}, "save", saved)
            assert ended.returncode == 0, ended.stderr
        assert job(client, running)["status"] == "running"
        lose(service)
    shutil.rmtree(tmp_path / "before")

    restored = {"SGSST_DATA": str(tmp_path / "after"), **after}
    ended = backup(restored, "restore", saved)
    assert ended.returncode == 0, ended.stderr
    assert "; 0 files are missing" in ended.stdout
    assert "Restore into an empty one" in backup(restored, "restore", saved).stderr
    with Service(tmp_path / "after", **after) as service, service.client() as client:
        assert client.get(f"/v1/jobs/{done}/artifacts/stylized.ply").content == first
        for job_id in (running, waiting):
            service.succeeded(job_id)
        assert client.get(f"/v1/jobs/{running}/artifacts/stylized.ply").content == expected
        assert job(client, running)["attempt"] > 1
        log = client.get(f"/v1/jobs/{running}/artifacts/log.txt").text
        assert "resum" in log.lower() or "goes on" in log.lower(), log


def test_restore_refuses_a_folder_without_a_backup(tmp_path: Path) -> None:
    ended = backup({"SGSST_DATA": str(tmp_path / "data")}, "restore", tmp_path)
    assert ended.returncode == 1
    assert "holds no backup" in ended.stderr
