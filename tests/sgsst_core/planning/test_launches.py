"""Tests of measuring the cost of kernel launches, on a simulated GPU."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any

import pytest
import torch
from torch import Tensor
from torch.torch_version import TorchVersion

if torch.cuda.is_available():
    pytest.skip("there is a GPU, which does not pretend", allow_module_level=True)

from sgsst_core.features.network_weights import BackboneWeights
from sgsst_core.features.vgg import ALIGNMENT, FeatureNetwork
from sgsst_core.loss.sos import SosLoss
from sgsst_core.parallel.collectives import ALONE
from sgsst_core.planning.context import equip
from sgsst_core.planning.facts import Link
from sgsst_core.planning.probe import LAUNCH_RUNS, LEAST_GRAPH_VISITS, launch_cost, measure, soft_image
from sgsst_core.planning.survey import survey_views
from sgsst_core.settings import make_settings
from sgsst_core.style import Style
from sgsst_core.stylizing.stylizer import Stylizer
from tests.pretend_cuda.counts import Counts
from tests.pretend_cuda.interpreter import leave_out_kernels
from tests.pretend_cuda.runtime import pretend_cuda
from tests.small_scenes import cameras, style, wall

pytest.importorskip("triton")
pytestmark = pytest.mark.usefixtures("one_thread")

SIZE = 32, 48


@pytest.fixture
def counts(monkeypatch: pytest.MonkeyPatch) -> Iterator[Counts]:
    """Yield the counters of a simulated GPU, with Triton's kernels disabled, so that no interpreter is needed."""
    with pretend_cuda() as counts:
        leave_out_kernels(monkeypatch)
        monkeypatch.setattr(torch, "__version__", TorchVersion("2.13.0"))  # earlier versions use no graphs
        yield counts


def test_launches_are_timed_with_and_without_a_graph(counts: Counts, tiny_weights: BackboneWeights) -> None:
    loss = SosLoss(FeatureNetwork(tiny_weights, device="cuda"), coarsest=16)
    counts.clear()
    cost = launch_cost(loss, SIZE)
    assert cost.problem is None
    assert cost.seconds > 0
    assert cost.replayed > 0
    assert cost.capture >= 0
    replays = [count for line, count in counts.launches.items() if "loss/graphs.py" in line]
    assert LAUNCH_RUNS + 1 in replays  # including the run after the capture


def test_launches_of_a_tile_are_timed_and_do_not_depend_on_its_size(
    counts: Counts, tiny_weights: BackboneWeights
) -> None:
    scene, views = wall(10, 8), cameras(1, 48, 32)
    loss = SosLoss(FeatureNetwork(tiny_weights, device="cuda"))
    launches = []
    for side in (ALIGNMENT, 4 * ALIGNMENT):
        image = soft_image(side).to("cuda")
        style, view = loss.targets.of_style(Style.of(image.flip(0)), (side, side)), loss.targets.of_view(image)
        counts.clear()
        loss.evaluate(image, style, view, [0])
        launches.append(counts.launches.total())
    assert launches[0] == pytest.approx(launches[1], rel=0.02)
    context = equip(scene, views, make_settings(), tiny_weights, ALONE, rasterizer="cpu")
    fixed = measure(context, survey_views(scene, views, context.rasterizer), Link(math.inf, 0.0)).network.fixed
    assert min(fixed.features, fixed.forward, fixed.both) > 0


def test_launch_cost_without_graph_states_the_problem(
    counts: Counts, tiny_weights: BackboneWeights, monkeypatch: pytest.MonkeyPatch
) -> None:
    network = FeatureNetwork(tiny_weights, device="cuda")
    little = int(1.5 * SIZE[0] * SIZE[1] * (network.held_bytes_per_pixel() + network.working_bytes_per_pixel()))
    assert launch_cost(SosLoss(network, memory=little), SIZE).problem == (
        "a view's activations do not fit the memory twice"
    )
    on_cpu = SosLoss(FeatureNetwork(tiny_weights, device="cpu"))
    assert launch_cost(on_cpu, SIZE).problem == "only NVIDIA GPUs are known to replay them"

    def broken(*_: object, **__: object) -> None:
        raise RuntimeError("not here")

    with monkeypatch.context() as patch:
        patch.setattr(torch.cuda, "graph", broken)
        assert launch_cost(SosLoss(network), SIZE).problem == "RuntimeError: not here"


@pytest.mark.parametrize(
    ("version", "problem"), [("2.12.1", "PyTorch 2.13 or later is needed"), ("2.13.0", "not here")]
)
def test_failed_capture_does_not_break_the_process(
    counts: Counts, tiny_weights: BackboneWeights, monkeypatch: pytest.MonkeyPatch, version: str, problem: str
) -> None:
    network = FeatureNetwork(tiny_weights, device="cuda")
    convolve = FeatureNetwork._convolve

    def cannot_be_captured(network: FeatureNetwork, x: Tensor, step: Any) -> Tensor:
        if torch.cuda.is_current_stream_capturing():
            raise RuntimeError("not here")
        return convolve(network, x, step)

    monkeypatch.setattr(torch, "__version__", TorchVersion(version))
    monkeypatch.setattr(FeatureNetwork, "_convolve", cannot_be_captured)
    cost = launch_cost(SosLoss(network, coarsest=16), SIZE).problem
    assert cost is not None
    assert problem in cost
    torch.cuda.synchronize()


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


def test_launches_are_measured_if_views_are_visited_often(counts: Counts, tiny_weights: BackboneWeights) -> None:
    for steps in (LEAST_GRAPH_VISITS, LEAST_GRAPH_VISITS - 1):
        settings = make_settings(steps_coarse=0, steps_sos=steps, coarsest_side=16)
        stylizer = Stylizer.planned(
            wall(10, 8), cameras(2, 48, 32), style(), settings, weights=tiny_weights, rasterizer="cpu"
        )
        decision = next(line for line in stylizer.job.plan.decisions if line.item == "launches")
        measured = "measured per view" in decision.reason
        assert measured is (steps == LEAST_GRAPH_VISITS)
        assert (stylizer.job.graphs is not None) is stylizer.job.plan.graphs
