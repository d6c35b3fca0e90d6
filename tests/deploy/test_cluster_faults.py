"""Machines that fail while a cluster works: a few of `benchmarks.cluster_faults`."""

from __future__ import annotations

import shutil
import subprocess
import tempfile
from collections.abc import Iterator
from pathlib import Path

import pytest

from benchmarks import cluster_faults, cluster_hosts
from sgsst_core.features.network_weights import BackboneWeights
from tests.deploy.test_three_hosts import missing

pytestmark = pytest.mark.slow


@pytest.fixture
def folder() -> Iterator[Path]:
    """With a name so short that Ray's sockets can lie below it."""
    path = Path(tempfile.mkdtemp(prefix="sgsst-c-", dir="/tmp"))
    yield path
    shutil.rmtree(path, ignore_errors=True)


def test_no_fault_of_a_machine_loses_a_job(folder: Path, vgg16_weights: BackboneWeights) -> None:
    for module in ("moto.server", "psycopg", "s3fs"):
        pytest.importorskip(module, reason=f"{module} is not installed: see the extra [dev]")
    if reason := cluster_hosts.missing() or missing():
        pytest.skip(reason)
    kinds = ("kill-node", "cut-dispatcher", "restart-database")
    found = cluster_faults.measure(folder, kinds, len(kinds))
    assert found["faults"] == len(kinds)
    assert found["jobs_accepted"] >= len(kinds)
    assert (found["lost"], found["not_succeeded"]) == (0, [])
    assert (found["published_twice"], found["different"]) == (0, 0)
    assert not any(found["left_on_hosts"].values())
    assert found["left_in_store"] == []
    devices = subprocess.run(["ip", "-o", "link"], capture_output=True, text=True, check=True).stdout
    devices += subprocess.run(["ip", "netns", "list"], capture_output=True, text=True, check=True).stdout
    assert "sgsst4" not in devices
