"""Trial: warm visits of a job's first views before its first step, from which its time and memory are predicted.

A visit does everything that a step does, on a copy of the colors. It fills the caches in the order of the steps and
changes nothing else, so the steps that follow are the same.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace
from itertools import islice
from statistics import mean, median

import psutil
import torch

from sgsst_core.budget import device_peak, memory_for
from sgsst_core.loss.graphs import LossGraphs, failure_is_fatal, graphs_problem
from sgsst_core.planning.context import NetworkPixels, Saving
from sgsst_core.rasterizer import RASTERIZERS
from sgsst_core.rasterizer.cached import CachedRasterizer
from sgsst_core.stylizing.capture_trial import CaptureTrial
from sgsst_core.stylizing.job import StylizationJob, view_memory, with_second_attempt
from sgsst_core.stylizing.optimizer import ColorOptimizer
from sgsst_core.stylizing.schedule import Phase, drawn_views
from sgsst_core.stylizing.training_background import drawn_color
from sgsst_core.timing import Timer

#: A visit that takes fewer seconds is repeated so many times, of which the fastest counts; others are repeated once.
_FAST, _REPETITIONS = 0.15, 3
#: Seconds of a visit above which it is not repeated, and no second view is visited.
_SLOW = 1.0
#: Activities whose time is in proportion to the pixels through the network.
NETWORK = ("vgg_forward", "vgg_backward", "statistics")
#: Seconds between two readings of the memory of the process.
_READING_SECONDS = 0.005


@dataclass(frozen=True)
class StepCost:
    """Cost of a step, mean over views.

    Attributes:
        seconds: Seconds if the views of the step were visited before.
        first: Additional seconds of each view's first visit.
        parts: Seconds for each view by activity, at a later visit.
    """

    seconds: float
    first: float
    parts: dict[str, float]

    def of(self, *names: str) -> float:
        """Return the seconds of some activities."""
        return sum(self.parts.get(name, 0.0) for name in names)


@dataclass(frozen=True)
class Trial:
    """Measured cost of a job: time of the slowest rank, and memory of the rank that takes most.

    Attributes:
        coarse: Cost of a step of phase 1.
        sos: Cost of a step on all scales.
        views: Number of views that were visited.
        style: Seconds of the style's targets for views of one size.
        render: Seconds of a view's render and gradient without cached weights.
        prepare: Seconds of a view's tile intersections and SH colors.
        process: Peak memory of the process in bytes.
        device: Peak memory of the GPU in bytes; None on a CPU.
        passing: Portion of the peak that is freed after a visit, in bytes.
        growth: Bytes of the data of all other views that will be cached.
        novel: Bytes of the tile intersections of a novel view.
        free: Bytes that will be left for tile intersections of novel views.
        spare: Bytes of `Plan.spare` that data of the views will leave for tile intersections.
    """

    coarse: StepCost
    sos: StepCost
    views: int
    style: float
    render: float
    prepare: float
    process: int
    device: int | None
    passing: int
    growth: int
    novel: int
    free: int
    spare: int


def run_trial(job: StylizationJob, show: Callable[[int, int], None] = lambda done, total: None) -> Trial:
    """Visit one or two views of a job in both phases. All ranks of the job must call this, and get the same result.

    Args:
        job: Job, before its first step.
        show: Callback that receives the number of visited and of all views, where each phase counts.
    """
    trials = job.collectives.all_gather(_Visitor(job, show).run())
    slowest = max(trials, key=lambda trial: trial.sos.seconds)
    largest = max(trials, key=lambda trial: (trial.device or 0, trial.process + trial.growth))
    return replace(slowest, **{name: getattr(largest, name) for name in ("process", "device", "passing", "growth")})


class _Visitor:
    """Visitor of the views that a rank's first steps visit."""

    def __init__(self, job: StylizationJob, show: Callable[[int, int], None]) -> None:
        self._job, self._show = job, show
        self._colors = job.views.scene.sh_dc.clone().to(job.views.rasterizer.device)
        self._optimizer = ColorOptimizer(self._colors, job.network.unit, bounded=job.settings.bounded)
        self._visited: list[int] = []

    def run(self) -> Trial:
        job, device = self._job, self._job.network.device
        groups, rasterizer = job.team.groups, job.views.rasterizer
        # Every group visits as many views as the others, because their ranks communicate; and none that no step visits.
        different = min(len(job.views.covered), job.total_steps * job.settings.views_per_step)
        visits = 2 if 2 * groups <= different else 1
        order = list(islice(drawn_views(job.views.covered, job.settings.seed), visits * groups))
        # A view with one scale is visited in one phase, because both evaluate the same.
        alike = all(len(job.scales(index)) == 1 for index in job.views.covered)
        phases = job.schedule[:1] if alike else job.schedule
        costs: list[list[StepCost]] = [[] for _ in phases]
        with _peak_of_process() as process:
            for index in order[job.team.own_group :: groups]:
                self._visited.append(index)
                for own, phase in zip(costs, phases, strict=True):
                    self._show(sum(map(len, costs)), visits * len(costs))
                    own.append(self._cost(index, phase))
                if job.collectives.broadcast(lambda: costs[-1][0].seconds > _SLOW):
                    break
            camera = job.views.cameras[self._visited[0]]
            render = with_second_attempt(job, lambda: rasterizer.uncached.step_seconds(camera, 2)[1])
        coarse, *later = map(_mean, costs)
        sos = later[0] if later else replace(coarse, first=0.0)
        if not job.plan.steps_coarse:
            sos = replace(sos, first=coarse.first + sos.first)
        on_device = device_peak(device)
        peak, now = (process[0], _resident()) if on_device is None else (on_device, torch.cuda.memory_allocated(device))
        forecast, budget = self._forecast(), 0
        if "intersections" in forecast:
            budget = self._intersection_budget(forecast) - forecast["intersections"][1]
        # The median, because the first view of the survey includes the start of libraries.
        prepared = [job.caches[name].costs.values() for name in ("intersections", "colors") if name in job.caches]
        return Trial(
            coarse=coarse,
            sos=self._scaled(sos),
            views=len(self._visited) * groups,
            style=job.style_targets.seconds / len({self._size(index) for index in self._visited}),
            render=render,
            prepare=sum(median(seconds for _, seconds in own) for own in prepared if own),
            process=process[0],
            device=on_device,
            passing=max(peak - now, 0),
            growth=max(sum(final - job.caches[name].used for name, (_, final) in forecast.items()), 0),
            novel=int(self._bytes_of_a_view("intersections")),
            free=max(budget, 0),
            spare=self._spare(forecast),
        )

    def _cost(self, index: int, phase: Phase) -> StepCost:
        """Visit a view, and again if that is fast. The first visit warms up the kernels, so it is always repeated."""
        job, before = self._job, {name: len(cache.costs) for name, cache in self._job.caches.items()}
        first = self._visit(index, phase)
        fresh = {
            name: sum(seconds for key, (_, seconds) in list(cache.costs.items())[before[name] :] if key in cache)
            for name, cache in job.caches.items()
        }
        prepared, forecast = sum(fresh.values()), self._forecast()
        later = {**first, "total": first["total"] - prepared, "prepare": max(first["prepare"] - prepared, 0.0)}
        fast, warms_up = later["total"] <= _SLOW, phase.scale is not None and len(self._visited) == 1
        repetitions = _REPETITIONS if later["total"] < _FAST else int(fast or warms_up)
        again = [self._visit(index, phase) for _ in range(job.collectives.broadcast(lambda: repetitions))]
        if again:
            later = min(again, key=lambda visit: visit["total"])
            if job.network.device.type == "cuda":
                prepared = max(first["total"] - later["total"], 0.0)
        uncached = sum((1 - forecast[name][0]) * seconds for name, seconds in fresh.items())
        always = prepared * uncached / (sum(fresh.values()) or 1.0)
        total, once = later.pop("total"), later.get("optimizer", 0.0)
        turns = job.settings.views_per_step // job.team.groups
        return StepCost(turns * (total - once + always) + once, prepared - always, later)

    def _visit(self, index: int, phase: Phase) -> dict[str, float]:
        """Make a step on one view, and return its seconds by activity, and as "total", without those for the style."""
        job, styled = self._job, self._job.style_targets.seconds
        job.timer.clear()
        clock = Timer()
        with clock("total"):
            with_second_attempt(job, lambda: self._step(index, phase))
            parts = dict(job.timer.read())
        styled = job.style_targets.seconds - styled
        job.timer.clear()
        return {**parts, "prepare": max(parts["prepare"] - styled, 0.0), "total": clock.seconds["total"] - styled}

    def _step(self, index: int, phase: Phase) -> None:
        job, scales = self._job, phase.scales(self._job.scales(index))
        background = drawn_color(job.plan.training_background, job.settings.seed, 0, index, job.style)
        with job.timer("prepare", whole=True):
            job.views.cache_weights(index)
            target = job.view_targets.target(index, scales, background)
            style = job.style_targets(job.views.cameras[index])
        gradient, result = job.gradient(index, self._colors.detach(), style, target, scales, background)
        if job.team.groups > 1:
            with job.timer("communication"):
                gradient = job.collectives.all_reduce(gradient / job.group.size)
        with job.timer("optimizer"):
            self._optimizer.update(gradient, job.settings.learning_rate)
        result.values.cpu()

    def _scaled(self, cost: StepCost) -> StepCost:
        """Scale the time of the network from the visited views to the mean view."""
        job = self._job
        sizes = [self._size(index) for index in range(len(job.views))]
        every, visited = (
            NetworkPixels.of(job.plan, sizes, job.loss.tiling, views).all for views in (job.plan.covered, self._visited)
        )
        more = (every / visited - 1) * cost.of(*NETWORK) * (job.settings.views_per_step // job.team.groups)
        return replace(cost, seconds=cost.seconds + more, first=cost.first * every / visited)

    def _size(self, index: int) -> tuple[int, int]:
        return self._job.views.cameras[index].height, self._job.views.cameras[index].width

    def _forecast(self) -> dict[str, tuple[float, int]]:
        """Return the fraction of the views whose data will be cached, and the final size in bytes, by cache."""
        job, result = self._job, dict[str, tuple[float, int]]()
        visits = job.total_steps * job.settings.views_per_step + (job.plan.loss_views if job.plan.measured else 0)
        views = min(visits, len(job.views.covered))
        # Tile intersections come last, because they use what others leave of their budgets.
        for name, cache in sorted(job.caches.items(), key=lambda item: item[0] == "intersections"):
            needed, capacity = self._bytes_of_a_view(name) * views, cache.capacity
            if name == "intersections":
                needed *= 1 - result.get("weights", (0.0, 0))[0]
                capacity = self._intersection_budget(result)
            fraction = 1.0 if capacity is None or needed <= capacity else capacity / needed
            result[name] = fraction, int(needed * fraction)
        return result

    def _intersection_budget(self, forecast: Mapping[str, tuple[float, int]]) -> int:
        """Return the budget in bytes for tile intersections beside the cached blend weights of a forecast."""
        rasterizer, memory = self._job.views.rasterizer, memory_for("rasterizer", self._job.memory)
        weights = forecast.get("weights", (0.0, 0))[1]
        budget = rasterizer.intersection_budget(weights) if isinstance(rasterizer, CachedRasterizer) else None
        return memory + self._spare(forecast) if budget is None else budget

    def _spare(self, forecast: Mapping[str, tuple[float, int]]) -> int:
        """Return the bytes of `Plan.spare` that data of the views, by a forecast, leave for tile intersections.

        With cached weights, it is 0: then a different number of cached views would change rounding.
        """
        job = self._job
        if job.plan.cached_weights != "none" or not RASTERIZERS[job.plan.uncached].on_gpu:
            return 0
        of_views = sum(final for name, (_, final) in forecast.items() if name != "intersections")
        return min(max(view_memory(job.plan, job.memory) - of_views, 0), job.plan.spare)

    def _bytes_of_a_view(self, name: str) -> float:
        """Return the mean size in bytes of the data of a view in a cache. The survey has computed its intersections."""
        costs = self._job.caches[name].costs if name in self._job.caches else {}
        sizes = sum(size for size, _ in costs.values())
        return sizes / max(len(costs) if name == "intersections" else len(self._visited), 1)


def _mean(costs: list[StepCost]) -> StepCost:
    """Return the mean cost; the last first visit counts, because earlier ones include the start of libraries."""
    names = {name for cost in costs for name in cost.parts}
    parts = {name: mean(cost.of(name) for cost in costs) for name in names}
    return StepCost(mean(cost.seconds for cost in costs), costs[-1].first, parts)


@contextmanager
def _peak_of_process() -> Iterator[list[int]]:
    """Record the largest memory of the process in bytes during a `with` block, as the only item of the result."""
    peak, ended = [_resident()], threading.Event()

    def read() -> None:
        while not ended.wait(_READING_SECONDS):
            peak[0] = max(peak[0], _resident())

    reader = threading.Thread(target=read, daemon=True)
    reader.start()
    try:
        yield peak
    finally:
        ended.set()
        reader.join()


def _resident() -> int:
    return int(psutil.Process().memory_info().rss)


def launch_cost(job: StylizationJob) -> Saving:
    """Time the loss of a job's first view on a GPU, with its gradient, with and without a graph."""
    problem = graphs_problem(job.network.device)
    if problem is not None:
        return Saving(problem=problem)
    index, graphs = job.views.covered[0], LossGraphs(job.loss)
    scales, style = job.scales(index), job.style_targets(job.views.cameras[index])
    target, image = job.view_targets.target(index, scales), job.views.unstylized(index)

    def seconds(evaluate: Callable[..., object]) -> float:
        timer = Timer(job.network.device)
        with timer("evaluation"):
            evaluate(image, style, target, scales)
        return timer.read()["evaluation"]

    try:
        seconds(graphs.evaluate)  # eager first run: warms up the kernels
        if not graphs.visited:
            return Saving(problem="a view's activations do not fit the memory twice")
        eager = min(seconds(job.loss.evaluate) for _ in range(_REPETITIONS))
        if failure_is_fatal() and (problem := CaptureTrial.of(job, (image.shape[0], image.shape[1])).run_in_child()):
            return Saving(problem=problem)
        first = seconds(graphs.evaluate)
        if graphs.problem is not None:
            return Saving(problem=graphs.problem)
        replayed = min(seconds(graphs.evaluate) for _ in range(_REPETITIONS))
    except torch.OutOfMemoryError:
        return Saving(problem="the GPU's memory was not enough to evaluate the first view")
    finally:
        graphs.clear()
    return Saving(eager, replayed, max(first - replayed, 0.0))
