"""Fixture of a Ray cluster for tests that join one."""

import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.ports import free_port
from worker.processes import sweep
from worker.ranks import cluster

ROOT = Path(__file__).resolve().parents[3]


@pytest.fixture
def joined(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Run a Ray cluster of one node that pretends to have two GPUs and 10 GB of memory."""
    monkeypatch.setenv("RAY_AUTH_MODE", "token")
    monkeypatch.setenv("RAY_AUTH_TOKEN", cluster._SECRET)
    monkeypatch.setenv("RAY_USAGE_STATS_ENABLED", "0")
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "0,1")  # without it, Ray finds no GPUs
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")]))
    folder = tempfile.mkdtemp(prefix="sgsst-head-", dir="/tmp")
    import ray

    here, port = ray.util.get_node_ip_address(), free_port()  # Ray replaces 127.0.0.1 by this one
    command = [sys.executable, "-m", "ray.scripts.scripts", "start", "--head", "--block", f"--port={port}"]
    command += [f"--node-ip-address={here}", "--num-cpus=2", "--num-gpus=2", "--memory=10000000000"]
    command += [
        "--include-dashboard=false",
        "--object-store-memory=100000000",
        f"--temp-dir={folder}",
        "--disable-usage-stats",
    ]
    head = subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, start_new_session=True
    )
    assert head.stdout is not None
    monkeypatch.setenv("RAY_ADDRESS", f"{here}:{port}")
    try:
        assert any("Ray runtime started" in line for line in head.stdout), "Ray's head has not come up"
        yield
    finally:
        head.terminate()
        head.wait(120)
        sweep(Path(folder))
