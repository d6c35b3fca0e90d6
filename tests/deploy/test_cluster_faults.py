"""Tests of machine failures in a cluster at work: a short run of `benchmarks.cluster_faults`."""

from __future__ import annotations

import re
import shutil
import subprocess
import tempfile
from collections.abc import Iterator
from pathlib import Path

import pytest

from benchmarks import cluster_faults
from sgsst_core.features.network_weights import BackboneWeights
from tests.deploy.test_three_hosts import missing

pytestmark = pytest.mark.slow


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
