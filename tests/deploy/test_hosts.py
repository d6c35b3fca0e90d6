"""Tests on simulated hosts, which are namespaces of this machine: one job, the service, and failures of hosts."""

import os
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from benchmarks import cluster_faults
from sgsst_core.features.network_weights import BackboneWeights

pytestmark = pytest.mark.slow
ROOT = Path(__file__).resolve().parents[2]
PROBE = f"sgsst-p{os.getpid()}"


def problem() -> str | None:
    """Return why this machine cannot simulate two hosts, or None if it can."""
    if sys.platform != "linux" or os.geteuid() != 0:
        return "network namespaces are made by root, on Linux"
    for tool in ("ip", "unshare", "nsenter", "setpriv"):
        if shutil.which(tool) is None:
            return f"{tool} is missing: apt-get install -y iproute2 util-linux"
    commands = [
        ["ip", "netns", "add", PROBE],
        ["ip", "link", "add", PROBE, "type", "bridge"],
        ["unshare", "--uts", "--pid", "--mount", "--fork", "--mount-proc", "true"],
    ]
    try:
        for command in commands:
            ended = subprocess.run(command, capture_output=True, text=True)
            if ended.returncode:
                return f"{' '.join(command)}: {ended.stderr.strip()}"
    finally:
        subprocess.run(["ip", "link", "delete", PROBE], capture_output=True)
        subprocess.run(["ip", "netns", "delete", PROBE], capture_output=True)
    return None


def run(command: list[str], environment: dict[str, str]) -> subprocess.CompletedProcess[str]:
    """Run a script of `deploy/`, and wait for its end. It gets no settings of a local Ray of this process.

    If the tests are interrupted, the script receives SIGTERM instead of SIGKILL, so that it can remove its hosts.
    """
    environment = {name: value for name, value in environment.items() if not name.startswith("RAY_")}
    held = ["setpriv", "--pdeathsig", "TERM", *command]
    pipes: Any = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    with subprocess.Popen(held, env=environment, cwd=ROOT, **pipes) as process:
        try:
            out, err = process.communicate()
        except BaseException:
            process.terminate()
            process.wait()
            raise
    return subprocess.CompletedProcess(held, process.returncode, out, err)


def assert_removed(network: re.Match[str] | None) -> None:
    """Assert that the network whose number a script has printed no longer exists, nor do its hosts."""
    assert network is not None
    left = subprocess.run(["ip", "-o", "link"], capture_output=True, text=True, check=True).stdout
    left += subprocess.run(["ip", "netns", "list"], capture_output=True, text=True, check=True).stdout
    assert f"sgsst-{network[1]}" not in left


def test_job_runs_on_two_hosts_with_cold_caches(tmp_path: Path, vgg16_weights: BackboneWeights) -> None:
    if reason := problem():
        pytest.skip(reason)
    kernels, out = tmp_path / "kernels", tmp_path / "out" / "stylized.ply"
    environment = {
        **os.environ,
        "BIN": str(Path(sys.executable).parent),
        "NUMBA_CACHE_DIR": str(kernels),  # used in place of the __pycache__ folders
    }
    ended = run([str(ROOT / "deploy" / "two_hosts.sh"), str(out)], environment)
    assert ended.returncode == 0, f"{ended.stdout}\n{ended.stderr}"
    assert re.search(r"^ranks: host-a \(cpu, \d+ threads\), host-b \(cpu, \d+ threads\)$", ended.stdout, flags=re.M)
    sent = re.search(r"^sent by host-b over the bridge: ([\d.]+) MB in 20 steps$", ended.stdout, flags=re.M)
    assert sent is not None, ended.stdout
    assert float(sent[1]) >= 20
    assert out.is_file()
    assert list(kernels.rglob("*.nbi")), "the kernels were not compiled here"
    assert_removed(re.search(r"^Two hosts: 10\.77\.(\d+)\.2 and 10\.77\.\1\.3$", ended.stdout, flags=re.M))


def missing() -> str | None:
    """Return which required program this machine lacks, or None if it has all."""
    for tool in ("curl", "setpriv", "initdb"):
        if shutil.which(tool) is None and not list(Path("/usr/lib/postgresql").glob(f"*/bin/{tool}")):
            return f"{tool} is missing: apt-get install -y curl util-linux postgresql"
    return None


def test_cluster_job_needs_no_shared_folder(tmp_path: Path, vgg16_weights: BackboneWeights) -> None:
    for module in ("moto.server", "psycopg", "s3fs"):
        pytest.importorskip(module, reason=f"{module} is not installed: see the extra [dev]")
    if reason := problem() or missing():
        pytest.skip(reason)
    environment = {**os.environ, "BIN": str(Path(sys.executable).parent)}
    command = [str(ROOT / "deploy" / "three_hosts.sh"), str(tmp_path / "out"), "kill"]
    ended = run(command, environment)
    assert ended.returncode == 0, f"{ended.stdout}\n{ended.stderr}"
    assert "computed on: host-node" in ended.stdout
    assert "the result is that of sgsst stylize, byte for byte" in ended.stdout
    assert re.findall(r"^left on host-(\w+): 0 files beside the cache, 0 of jobs$", ended.stdout, flags=re.M) == [
        "api",
        "head",
        "node",
    ]
    assert "the node was killed with its disk at step" in ended.stdout
    assert_removed(re.search(r"^Three hosts of 10\.77\.(\d+): ", ended.stdout, flags=re.M))


@pytest.fixture
def folder() -> Iterator[Path]:
    """Provide a folder with a path short enough for Ray's sockets."""
    path = Path(tempfile.mkdtemp(prefix="sgsst-c-", dir="/tmp"))
    yield path
    shutil.rmtree(path, ignore_errors=True)


def networks() -> set[str]:
    """Return the network devices and namespaces that `benchmarks.cluster_faults` has created on this machine."""
    commands = (["ip", "-o", "link"], ["ip", "netns", "list"])
    said = (subprocess.run(command, capture_output=True, text=True, check=True).stdout for command in commands)
    return {name for text in said for name in re.findall(r"sgsst\d[\w-]*", text)}


def test_host_faults_lose_no_job(folder: Path, vgg16_weights: BackboneWeights) -> None:
    for module in ("moto.server", "psycopg", "s3fs"):
        pytest.importorskip(module, reason=f"{module} is not installed: see the extra [dev]")
    if reason := cluster_faults.missing() or missing():
        pytest.skip(reason)
    before = networks()
    kinds = ("kill-node", "cut-dispatcher", "restart-database")
    result = cluster_faults.measure(folder, kinds, len(kinds))
    assert result["faults"] == len(kinds)
    assert result["jobs_accepted"] >= len(kinds)
    assert (result["lost"], result["not_succeeded"]) == (0, [])
    assert (result["published_twice"], result["different"]) == (0, 0)
    assert not any(result["left_on_hosts"].values())
    assert result["left_in_store"] == []
    assert networks() == before
