"""Tests of `deploy/Dockerfile`, `deploy/compose.yaml` and scripts: linters, and services that start and survive."""

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import httpx2
import pytest

from tests.api.service import wait_for
from tests.deploy.containers import COMPOSE, ROOT, STAND_INS, Containers, compose_program, containers
from tests.ports import free_port
from tests.small_scenes import wall, write_files

pytestmark = pytest.mark.slow
IMAGE = "docker.io/library/sgsst:cpu"
PROJECT = "sgsst-test"
#: Time limit of waits in seconds.
PATIENCE = 900.0
OPTIONS = {"steps_coarse": 0, "backbone": "vgg16", "seed": 1}


@pytest.fixture(scope="module")
def podman() -> Iterator[Containers]:
    with containers() as started:
        yield started


class Composed:
    """Services of the compose file, with a separate project name and port."""

    def __init__(self, podman: Containers, weights: Path) -> None:
        self.podman = podman
        port = free_port()
        self.url = f"http://127.0.0.1:{port}"
        self.variables = {
            "SGSST_ADDRESS": f"127.0.0.1:{port}",
            "SGSST_WEIGHTS": str(weights),
            "SGSST_MIN_FREE_BYTES": "0",
            "SGSST_CHECKPOINT_SECONDS": "1",
            "SGSST_LEASE_SECONDS": "10",
        }
        self.key = ""

    def compose(self, *words: str) -> str:
        """Run `podman-compose` with the compose file and return its output."""
        command: list[str | Path] = [compose_program(), "--in-pod=0", "-p", PROJECT, "-f", COMPOSE, *words]
        return self.podman.run(*command, variables=self.variables)

    def name(self, service: str) -> str:
        """Return the name of a service's container."""
        return f"{PROJECT}_{service}_1"

    def kill(self, service: str) -> None:
        """Kill the main process of a service's container directly, like a crash, so that podman restarts it."""
        pid = int(self.podman.run("podman", "inspect", "--format", "{{.State.Pid}}", self.name(service)))
        os.kill(pid, signal.SIGKILL)

    def said(self) -> str:
        """Return the last lines of all services' logs."""
        names = self.podman.run("podman", "ps", "--all", "--format", "{{.Names}} {{.Status}}")
        logs = [
            subprocess.run(
                ["podman", "logs", "--tail", "12", self.name(service)],
                env=self.podman.environment,
                stdout=subprocess.PIPE,
                stderr=subprocess.STDOUT,
                text=True,
            ).stdout
            for service in ("setup", "api", "dispatcher", "database", "store")
        ]
        return "\n---\n".join([names, *logs])

    def health(self) -> dict[str, Any]:
        """Return the response of `/readyz`; an empty dictionary if there is none."""
        try:
            return dict(httpx2.get(f"{self.url}/readyz", timeout=5).json())
        except (httpx2.TransportError, ValueError):
            return {}

    def client(self) -> httpx2.Client:
        """Return an HTTP client with the API key."""
        return httpx2.Client(base_url=self.url, headers={"Authorization": f"Bearer {self.key}"}, timeout=60)

    def job(self, job_id: str) -> dict[str, Any]:
        """Return a job from the API; an empty dictionary if the API does not respond."""
        try:
            with self.client() as client:
                return dict(client.get(f"/v1/jobs/{job_id}").json())
        except (httpx2.TransportError, ValueError):
            return {}


@pytest.fixture(scope="module")
def composed(podman: Containers, tiny_cache: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Composed]:
    weights = tmp_path_factory.mktemp("weights")
    shutil.copytree(tiny_cache, weights, dirs_exist_ok=True)
    weights.chmod(0o777)  # compiled kernels are cached there too
    started = Composed(podman, weights)
    started.compose("down", "--volumes")
    try:
        started.compose("up", "--detach", "--no-build", "api", "dispatcher", "setup")
        time.sleep(3)  # the services that they need do not run yet
        started.compose("up", "--detach", "--no-build")
        wait_for(lambda: started.health().get("status") == "ok", "the composed service", started.said)
        started.key = podman.run("podman", "exec", started.name("api"), "sgsst", "keys", "create", "alice").strip()
        yield started
    finally:
        started.compose("down", "--volumes")
    assert PROJECT not in podman.run("podman", "ps", "--all", "--format", "{{.Names}}")
    assert PROJECT not in podman.run("podman", "volume", "ls", "--format", "{{.Name}}")
    assert PROJECT not in podman.run("podman", "network", "ls", "--format", "{{.Name}}")


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path, Path]:
    return write_files(tmp_path_factory.mktemp("files"), wall())


def expected(files: tuple[Path, Path, Path], steps: int, cache: Path, out: Path) -> bytes:
    """Return the result of `sgsst stylize` on this machine."""
    ply, cameras, style = files
    command = [sys.executable, "-m", "api.cli", "stylize", ply, "--cameras", cameras, "--style", style, "--out", out]
    command += ["--steps-sos", str(steps), "--steps-coarse", "0", "--backbone", "vgg16"]
    command += ["--seed", "1"]
    # with as many threads as in the container: another number would add in another order
    own = {name: value for name, value in os.environ.items() if not name.endswith("_NUM_THREADS")}
    environment = {**own, "SGSST_CACHE": str(cache), "PYTHONPATH": str(COMPOSE.parents[1])}
    ended = subprocess.run(list(map(str, command)), env=environment, capture_output=True, text=True)
    assert ended.returncode == 0, ended.stderr
    return out.read_bytes()


def test_image_is_small_and_unprivileged(podman: Containers) -> None:
    (image,) = json.loads(podman.run("podman", "image", "inspect", IMAGE))
    assert image["Size"] < 1_600_000_000
    assert image["Config"]["User"] == "10001:10001"
    assert image["Labels"]["org.opencontainers.image.licenses"] == "GPL-3.0-or-later"
    inside = ["podman", "run", "--rm", "--read-only", "--cap-drop=all", "--network=none", IMAGE, "sh", "-c"]
    for compiler in ("cc", "gcc", "clang", "make"):
        assert podman.run(*inside, f"command -v {compiler} || true") == ""
    assert podman.run(*inside, "python -m pip --version").startswith("pip")  # with which VGG16 is fetched
    assert podman.run(*inside, "touch /opt/here 2> /dev/null || id -u").strip() == "10001"
    # bytecode is compiled in advance, because it could not be stored at run time
    assert podman.run(*inside, "ls /opt/sgsst/lib/python3*/site-packages/api/http/__pycache__ | grep -c server").strip()


def test_submit_to_container_equals_stylize(
    composed: Composed, files: tuple[Path, Path, Path], tiny_cache: Path, tmp_path: Path
) -> None:
    ply, cameras, style = files
    out = tmp_path / "stylized.ply"
    command = [sys.executable, "-m", "api.cli", "submit", ply, "--cameras", cameras, "--style", style, "--out", out]
    command += ["--url", composed.url, "--key", composed.key]
    command += ["--steps-sos", "6", "--steps-coarse", "0", "--backbone", "vgg16", "--seed", "1"]
    ended = subprocess.run(list(map(str, command)), cwd=COMPOSE.parents[1], capture_output=True, text=True)
    assert ended.returncode == 0, f"{ended.stdout}\n{ended.stderr}\n{composed.said()}"
    assert out.read_bytes() == expected(files, 6, tiny_cache, tmp_path / "expected.ply")


def test_container_requires_a_key(composed: Composed) -> None:
    assert httpx2.get(f"{composed.url}/v1/jobs").status_code == 401


def test_container_health_follows_its_process(composed: Composed) -> None:
    for service in ("api", "dispatcher"):
        inspected = composed.podman.run("podman", "inspect", composed.name(service))
        # run directly: `podman healthcheck run` uses the file's timeout, which may be too short on a busy machine
        test = json.loads(inspected)[0]["Config"]["Healthcheck"]["Test"]
        assert test == ["CMD", "python", "-m", "service.health", service]
        assert composed.podman.succeeds("podman", "exec", composed.name(service), *test[1:]), composed.said()
    inside = ["podman", "run", "--rm", "--network=none", IMAGE, "python", "-m", "service.health", "api"]
    assert not composed.podman.succeeds(*inside)


def curl(composed: Composed, files: tuple[Path, Path, Path], parameters: dict[str, Any]) -> dict[str, Any]:
    """Submit a job with curl, and return the response."""
    ply, cameras, style = files
    command = ["curl", "-sS", "-H", f"Authorization: Bearer {composed.key}", f"{composed.url}/v1/jobs"]
    command += ["-F", f"scene=@{ply}", "-F", f"cameras=@{cameras}", "-F", f"style=@{style}"]
    command += ["-F", f"parameters={json.dumps(parameters)}"]
    return dict(json.loads(subprocess.run(command, check=True, capture_output=True, text=True).stdout))


def seen(look: Callable[[], bool], composed: Composed, what: str) -> None:
    """Wait for a condition, for minutes if necessary, because each new container compiles kernels again."""
    until = time.monotonic() + PATIENCE
    while not look():
        assert time.monotonic() < until, f"waited in vain for {what}\n{composed.said()}"
        time.sleep(0.5)


@pytest.mark.parametrize("victims", [("dispatcher", "api"), ("database", "store")])
def test_job_survives_restarts_of_its_containers(
    composed: Composed, victims: tuple[str, ...], files: tuple[Path, Path, Path], tiny_cache: Path, tmp_path: Path
) -> None:
    if "store" in victims and "moto" in composed.podman.run("podman", "exec", composed.name("store"), "ls", "/opt"):
        victims = ("database",)  # moto stores everything in memory, unlike a real store
    submitted = curl(composed, files, {**OPTIONS, "steps_sos": 300})
    assert "id" in submitted, submitted
    job_id = submitted["id"]

    def step() -> int:
        progress = composed.job(job_id).get("progress") or {}
        return int(progress.get("step") or 0) if progress.get("loss") else 0

    seen(lambda: step() >= 20, composed, "the job's first steps")
    for victim in victims:
        composed.kill(victim)
    assert step() < 300
    seen(lambda: composed.job(job_id).get("status") in ("succeeded", "failed"), composed, "the job's end")
    job = composed.job(job_id)
    assert job["status"] == "succeeded", f"{job}\n{composed.said()}"
    if "dispatcher" in victims:
        assert job["attempt"] > 1
    with composed.client() as client:
        result = client.get(f"/v1/jobs/{job_id}/artifacts/stylized.ply").content
    assert result == expected(files, 300, tiny_cache, tmp_path / "expected.ply")


def lint(tool: str, *words: str | Path) -> None:
    """Run a linter that is installed in this Python environment, and fail if it reports anything."""
    program = Path(sys.executable).parent / tool
    if not program.exists():
        pytest.skip(f"{tool} is missing: see the extra [dev]")
    ended = subprocess.run([program, *words], cwd=ROOT, capture_output=True, text=True)
    assert ended.returncode == 0, ended.stdout + ended.stderr


def test_dockerfiles() -> None:
    lint("hadolint", "deploy/Dockerfile")
    lint("hadolint", "--ignore=DL3008", "--ignore=DL3066", STAND_INS / "Dockerfile")


def test_scripts() -> None:
    hosts = ["deploy/free_network.sh", "deploy/two_hosts.sh", "deploy/three_hosts.sh"]
    lint("shellcheck", "--shell=sh", "--severity=warning", "deploy/remove_unused.sh", f"{STAND_INS}/postgres.sh")
    lint("shellcheck", "--severity=error", *hosts)
