"""Tests that ranks that the plan does not use end immediately and release their resources."""

from __future__ import annotations

import contextlib
import sys
from pathlib import Path

import psutil
import pytest

from sgsst_core.progress import Progress
from tests.worker.ranks.faults import FaultyRank, small_request
from worker.ranks.attempts import stylize_on_ranks
from worker.ranks.rank import WorkerOptions
from worker.run import Listener

pytestmark = [
    pytest.mark.usefixtures("one_thread", "tiny_installed"),
    pytest.mark.skipif(not sys.platform.startswith("linux"), reason="only Linux ends processes with their parent"),
]

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
