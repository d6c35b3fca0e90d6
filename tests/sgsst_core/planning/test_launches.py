"""Tests of measuring the cost of kernel launches, on a simulated GPU."""

from __future__ import annotations

import os
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from torch.torch_version import TorchVersion

if torch.cuda.is_available():
    pytest.skip("there is a GPU, which does not pretend", allow_module_level=True)

from sgsst_core.features.network_weights import BackboneWeights
from sgsst_core.loss.sos import SosLoss
from sgsst_core.planning.choices import LEAST_GRAPH_VISITS, LEAST_TRIED_VISITS
from sgsst_core.planning.context import Saving
from sgsst_core.settings import make_settings
from sgsst_core.style import Style
from sgsst_core.stylizing.job import StylizationJob
from sgsst_core.stylizing.planner import plan_job
from sgsst_core.stylizing.stylizer import Stylizer
from sgsst_core.stylizing.trial import launch_cost
from tests.pretend_cuda.counts import Counts
from tests.pretend_cuda.interpreter import leave_out_kernels
from tests.pretend_cuda.runtime import pretend_cuda
from tests.small_scenes import cameras, style, wall

pytest.importorskip("triton")
pytestmark = pytest.mark.usefixtures("one_thread")


@pytest.fixture
def counts(monkeypatch: pytest.MonkeyPatch) -> Iterator[Counts]:
    """Yield the counters of a simulated GPU, with Triton's kernels disabled, so that no interpreter is needed."""
    with pretend_cuda() as counts:
        leave_out_kernels(monkeypatch)
        monkeypatch.setattr(torch, "__version__", TorchVersion("2.13.0"))  # earlier versions use no graphs
        yield counts


def job(weights: BackboneWeights, **values: Any) -> StylizationJob:
    settings = make_settings(steps_coarse=0, steps_sos=2, coarsest_side=16, **values)
    return plan_job(wall(10, 8), cameras(1, 48, 32), Style.of(style()), settings, weights=weights, rasterizer="cpu")


def test_launches_are_timed_with_and_without_a_graph(counts: Counts, tiny_weights: BackboneWeights) -> None:
    planned = job(tiny_weights)
    counts.clear()
    cost = launch_cost(planned)
    assert cost.problem is None
    assert cost.without > 0
    assert cost.seconds > 0
    assert cost.once >= 0
    replays = [count for line, count in counts.launches.items() if "loss/graphs.py" in line]
    assert max(replays) > 1  # including the run after the capture


def test_launch_cost_without_graph_states_the_problem(
    counts: Counts, tiny_weights: BackboneWeights, monkeypatch: pytest.MonkeyPatch
) -> None:
    planned = job(tiny_weights)
    little = SosLoss(planned.network, memory=int(1.5 * 48 * 32 * planned.network.held_bytes_per_pixel()), coarsest=16)
    assert launch_cost(replace(planned, loss=little)).problem == "a view's activations do not fit the memory twice"

    def broken(*_: object, **__: object) -> None:
        raise RuntimeError("not here")

    with monkeypatch.context() as patch:
        patch.setattr(torch.cuda, "graph", broken)
        assert launch_cost(planned).problem == "RuntimeError: not here"
    monkeypatch.setattr(torch, "__version__", TorchVersion("2.12.1"))
    assert "a trial in a child process ended with status 1: " in str(launch_cost(planned).problem)  # no GPU there


@pytest.mark.slow
def test_capture_is_tried_in_a_child_process_if_a_failure_is_fatal(
    counts: Counts, tiny_weights: BackboneWeights, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The child process has the simulated GPU too, on which capturing works, or fails where the host waits for it."""
    planned = job(tiny_weights)
    monkeypatch.setattr(torch, "__version__", TorchVersion("2.12.1"))
    monkeypatch.setenv("PYTHONPATH", f"{tmp_path}{os.pathsep}{Path(__file__).parents[3]}")
    start = (
        "import os; os.environ['TRITON_INTERPRET'] = '1'\n"
        "import pytest; from tests.pretend_cuda.interpreter import leave_out_kernels\n"
        "from tests.pretend_cuda.runtime import pretend_cuda\n"
        "device = pretend_cuda(); device.__enter__(); leave_out_kernels(pytest.MonkeyPatch())\n"
    )
    wait = (
        "from sgsst_core.features.vgg import FeatureNetwork\n"
        "convolve = FeatureNetwork._convolve\n"
        "FeatureNetwork._convolve = lambda self, x, step: float(x.amax()) and convolve(self, x, step)\n"
    )
    (tmp_path / "sitecustomize.py").write_text(start)
    cost = launch_cost(planned)
    assert cost.problem is None
    assert cost.seconds > 0
    (tmp_path / "sitecustomize.py").write_text(start + wait)
    assert "operation not permitted when stream is capturing" in str(launch_cost(planned).problem)
    assert planned.loss.timer.read() is not None  # this process still uses the device


@pytest.mark.slow
@pytest.mark.parametrize(("capability", "chosen"), [((7, 5), "float32"), ((8, 0), "bfloat16")])
def test_bfloat16_is_not_used_if_it_is_emulated(
    counts: Counts,
    tiny_weights: BackboneWeights,
    monkeypatch: pytest.MonkeyPatch,
    capability: tuple[int, int],
    chosen: str,
) -> None:
    """The emulation may even be faster in the timed convolution, but Triton does not compile it."""
    monkeypatch.setattr(torch.cuda, "get_device_capability", lambda *_: capability)
    monkeypatch.setattr("sgsst_core.planning.context.convolution_ratio", lambda *_: 1.5)
    settings = make_settings(steps_coarse=0, steps_sos=2, coarsest_side=16, precision="bfloat16")
    stylizer = Stylizer.planned(
        wall(10, 8), cameras(1, 48, 32), style(), settings, weights=tiny_weights, rasterizer="cpu"
    )
    assert stylizer.job.plan.precision == chosen


@pytest.mark.slow
def test_launches_are_measured_if_views_are_visited_often(
    counts: Counts, tiny_weights: BackboneWeights, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Visits must also save the time of a child process if one tries the capture."""
    for version, steps, considered in (
        ("2.13.0", LEAST_GRAPH_VISITS, True),
        ("2.13.0", LEAST_GRAPH_VISITS - 1, False),
        ("2.12.1", LEAST_TRIED_VISITS - 1, False),
    ):
        monkeypatch.setattr(torch, "__version__", TorchVersion(version))
        settings = make_settings(steps_coarse=0, steps_sos=steps, coarsest_side=16, position_weights="off")
        stylizer = Stylizer.planned(
            wall(10, 8), cameras(2, 48, 32), style(), settings, weights=tiny_weights, rasterizer="cpu"
        )
        decision = next(line for line in stylizer.job.plan.decisions if line.item == "launches")
        measured = "measured per view" in decision.reason
        assert measured is considered
        assert (stylizer.job.graphs is not None) is stylizer.job.plan.graphs


def test_graphs_reduce_the_spare_memory(
    counts: Counts, tiny_weights: BackboneWeights, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A graph's activations are separate memory, which data of the views must not use too."""
    spare = {}
    for seconds in (1.0, 0.5):
        monkeypatch.setattr("sgsst_core.stylizing.planner.launch_cost", lambda job, s=seconds: Saving(s, 0.5))
        settings = make_settings(steps_coarse=0, steps_sos=2 * LEAST_GRAPH_VISITS, coarsest_side=16)
        inputs = wall(10, 8), cameras(1, 48, 32), Style.of(style())
        planned = plan_job(*inputs, settings, weights=tiny_weights, rasterizer="cpu")
        spare[planned.plan.graphs] = planned.plan.spare
        assert (planned.graphs is not None) is planned.plan.graphs
        used = [cache.used for cache in planned.view_targets.caches.values()]
        assert sum(used) > 0  # by the trial, whose job is continued
    assert 0 < spare[True] < spare[False]
