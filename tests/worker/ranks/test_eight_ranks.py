"""Tests of whole jobs on eight ranks: by the command, and with one of them killed in each part of a job."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.worker.ranks.faults import Fault, FaultyRank, fired, small_request
from worker.execute import execute
from worker.prepare import prepare
from worker.ranks.cluster import Cluster
from worker.ranks.driver import stylize_on_ranks
from worker.ranks.rank import WorkerOptions
from worker.run import Listener

pytestmark = [
    pytest.mark.slow,
    pytest.mark.usefixtures("one_thread", "tiny_installed"),
    pytest.mark.skipif(not sys.platform.startswith("linux"), reason="only Linux ends processes with their parent"),
]

ROOT = Path(__file__).resolve().parents[3]
STEPS, VIEWS = 4, 4


@pytest.fixture(scope="module")
def alone(tmp_path_factory: pytest.TempPathFactory) -> dict[int, float]:
    """Return the final loss on one rank by the number of views per step."""
    losses = {}
    for views in (1, VIEWS):
        request = small_request(tmp_path_factory.mktemp("alone"), STEPS, views_per_step=views)
        losses[views] = execute(prepare(request), Listener()).loss_after or 0.0
    return losses


@pytest.mark.parametrize("views", [1, VIEWS])
def test_command_matches_one_rank(views: int, alone: dict[int, float], tmp_path: Path) -> None:
    request = small_request(tmp_path, STEPS)
    source = ["stylize", str(request.source.scene), "--cameras", str(request.source.cameras), "--backbone", "vgg16"]
    files = ["--style", str(request.styles[0].path), "--out", str(request.out)]
    options = ["--steps-sos", str(STEPS), "--no-early-stop", "--views-per-step", str(views)]
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "PYTHONPATH": str(ROOT)}
    environment.pop("RAY_ADDRESS", None)
    command = [sys.executable, "-m", "api.cli", *source, *files, *options, "--workers", "8"]
    subprocess.run(command, env=environment, check=True, timeout=900)
    report = json.loads(request.out.with_name("s.report.json").read_text())
    assert report["workers"]["used"] == 8
    assert report["loss"]["after"]["total"] == pytest.approx(alone[views], rel=1e-3)


@pytest.fixture(scope="module")
def cluster() -> Iterator[Cluster]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("PYTHONPATH", str(ROOT))
        patch.delenv("RAY_ADDRESS", raising=False)
        with Cluster(8) as opened:
            yield opened


@pytest.mark.parametrize(
    "fault",
    [
        Fault(3, "split_group", 1, "SIGKILL"),
        Fault(7, "optimizer", 1, "SIGKILL"),
        Fault(2, "all_reduce", 6, "SIGKILL"),
        Fault(5, "finish", 1, "SIGKILL"),
    ],
    ids=["planning", "first-step", "later-step", "end"],
)
def test_one_of_eight_may_be_killed(fault: Fault, alone: dict[int, float], cluster: Cluster, tmp_path: Path) -> None:
    request = small_request(tmp_path, STEPS, views_per_step=VIEWS)
    fault.write(request)
    options = WorkerOptions(rank_timeout=60.0, checkpoint_seconds=0.0, actor=FaultyRank)
    ended = stylize_on_ranks(request, 8, options=options, cluster=cluster)
    assert fired(request) is not None
    assert ["was killed" in attempt.reason for attempt in ended.attempts] == [True]
    assert ended.result is not None
    assert ended.result.loss_after == pytest.approx(alone[VIEWS], rel=1e-3)
