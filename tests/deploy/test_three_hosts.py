"""Test of `deploy/three_hosts.sh`: the service on hosts that share only a database and an object store."""

from __future__ import annotations

import os
import re
import shutil
import sys
from pathlib import Path

import pytest

from sgsst_core.features.network_weights import BackboneWeights
from tests.deploy.test_two_hosts import ROOT, assert_removed, problem, run

pytestmark = pytest.mark.slow


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
