"""Timing of a view's loss with kernels launched one by one, and as a CUDA graph."""

from __future__ import annotations

from collections.abc import Callable

from sgsst_core.loss.graphs import LossGraphs, has_graphs
from sgsst_core.loss.sos import SosLoss, SosResult
from sgsst_core.parallel.division import Size
from sgsst_core.planning.cost import LaunchCost
from sgsst_core.planning.pictures import soft_picture
from sgsst_core.timing import Timer

#: Number of runs. The fastest counts, because other activity on the machine can only slow launches down.
RUNS = 3


def launch_cost(loss: SosLoss, size: Size) -> LaunchCost:
    """Time the loss of a synthetic view of size (height, width), with its gradient, with and without a graph."""
    if not has_graphs(loss.network.device):
        return LaunchCost(problem="only NVIDIA GPUs are known to replay them")
    picture = soft_picture(max(size))[: size[0], : size[1]].contiguous().to(loss.network.device)
    style, view = loss.style_targets(picture.flip(0), size), loss.view_target(picture)
    scales = loss.scales(*size)
    graphs = LossGraphs(loss)

    def evaluate() -> SosResult:
        return graphs.evaluate(picture, style, view, scales)

    evaluate()  # eager first run: warms up the kernels
    seconds = min(_seconds(loss, lambda: loss.evaluate(picture, style, view, scales)) for _ in range(RUNS))
    first = _seconds(loss, evaluate)
    if graphs.problem is not None:
        return LaunchCost(problem=graphs.problem)
    if not graphs.captured:
        return LaunchCost(problem="a view's activations do not fit the memory twice")
    replayed = min(_seconds(loss, evaluate) for _ in range(RUNS))
    return LaunchCost(seconds, replayed, max(first - replayed, 0.0))


def _seconds(loss: SosLoss, evaluate: Callable[[], SosResult]) -> float:
    timer = Timer(loss.network.device)
    with timer("evaluation"):
        evaluate()
    return timer.read()["evaluation"]
