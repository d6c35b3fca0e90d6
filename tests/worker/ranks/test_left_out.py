"""Tests that ranks that the plan does not use end immediately and release their resources."""

from __future__ import annotations

import contextlib
import os
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import psutil
import pytest

from sgsst_core.progress import Progress
from tests.worker.ranks.faults import Fault, FaultyRank, fired, small_request
from worker.ranks import cluster
from worker.ranks.attempts import Listener, stylize_on_ranks
from worker.ranks.rank import WorkerOptions

pytestmark = [
    pytest.mark.usefixtures("one_thread", "tiny_installed"),
    pytest.mark.skipif(not sys.platform.startswith("linux"), reason="only Linux ends processes with their parent"),
]

ROOT = Path(__file__).resolve().parents[3]
STEPS = 16


def running_ranks() -> int:
    """Return the number of running ranks among the descendants of this process."""
    count = 0
    for child in psutil.Process().children(recursive=True):
        with contextlib.suppress(psutil.Error):  # a process that has ended since it was listed, or is a zombie
            count += "FaultyRank" in " ".join(child.cmdline())
    return count


@pytest.mark.slow
def test_unneeded_worker_exits_before_the_steps(tmp_path: Path) -> None:
    request = small_request(tmp_path, STEPS, rebalance=True)  # views are too small to be divided between ranks
    ranks_alive: list[int] = []
    listener = Listener(progress=lambda now: ranks_alive.append(running_ranks()))
    ended = stylize_on_ranks(request, 2, listener, options=WorkerOptions(actor=FaultyRank))
    assert ended.step == STEPS
    assert ranks_alive[-1] == 1


@pytest.mark.slow
def test_gpus_of_unneeded_ranks_are_released_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Ray is configured with two GPUs that do not exist. It assigns them, and ranks compute on the CPU."""
    monkeypatch.setenv("RAY_AUTH_MODE", "token")  # Ray reads it at import, which is earlier here than in a job
    monkeypatch.setenv("RAY_AUTH_TOKEN", cluster._SECRET)
    import ray

    start = ray.init

    def with_gpus(**options: Any) -> Any:
        gpus = len(os.environ["CUDA_VISIBLE_DEVICES"].split(","))
        return start(**{**options, "num_gpus": gpus, "num_cpus": gpus})

    monkeypatch.setattr(ray, "init", with_gpus)
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "5,7")
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")]))
    monkeypatch.delenv("RAY_ADDRESS", raising=False)
    request = small_request(tmp_path, STEPS, rebalance=True)  # views are too small to be divided between ranks
    Fault(0, "optimizer", 10, "SIGKILL").write(request)
    given_back: list[str] = []
    happened: list[str] = []
    ranks_alive: list[int] = []

    def left_out(gpus: Sequence[str]) -> None:
        given_back.extend(gpus)

    def progress(now: Progress) -> None:
        if given_back:
            ranks_alive.append(running_ranks())

    options = WorkerOptions(checkpoint_seconds=0.2, actor=FaultyRank)
    listener = Listener(progress=progress, left_out=left_out, happened=happened.append)
    ended = stylize_on_ranks(request, 2, listener, options=options)
    assert fired(request) is not None
    assert [attempt.ranks for attempt in ended.attempts] == [2], happened
    assert "with 1 worker," in happened[-1]
    assert ended.step == STEPS
    assert ranks_alive
    assert max(ranks_alive) == 1
    assert len(given_back) == 1, "reported once: the second attempt has no rank too many"
    assert {*given_back, os.environ["CUDA_VISIBLE_DEVICES"]} == {"5", "7"}


@pytest.mark.slow
@pytest.mark.usefixtures("joined")
def test_unneeded_gpus_return_to_cluster_during_the_job(tmp_path: Path) -> None:
    import ray

    request = small_request(tmp_path, STEPS, rebalance=True)
    free: list[float] = []
    given_back: list[str] = []

    def progress(now: Progress) -> None:
        if given_back:
            free.append(ray.available_resources().get("GPU", 0.0))

    listener = Listener(progress=progress, left_out=given_back.extend)
    ended = stylize_on_ranks(request, 2, listener, options=WorkerOptions(actor=FaultyRank))
    assert ended.step == STEPS
    assert not ended.attempts
    assert len(given_back) == 1
    assert free[-1] == 1.0
