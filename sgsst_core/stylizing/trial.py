"""Trial: warm visits of a job's first views before its first step, from which its time and memory are predicted.

A visit does everything that a step does, on a copy of the colors. It fills the caches in the order of the steps and
changes nothing else, so the steps that follow are the same.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from itertools import islice
from statistics import mean

import psutil
import torch

from sgsst_core.budget import device_peak
from sgsst_core.loss.graphs import LossGraphs, graphs_problem
from sgsst_core.planning.facts import LaunchCost, NetworkPixels
from sgsst_core.stylizing.job import StylizationJob, with_second_attempt
from sgsst_core.stylizing.optimizer import ColorOptimizer
from sgsst_core.stylizing.schedule import Phase, drawn_views
from sgsst_core.stylizing.training_background import drawn_color
from sgsst_core.timing import Timer

#: A visit is repeated until the repetitions take so many seconds, but at most so many times; the fastest one counts.
_ENOUGH_SECONDS, _REPETITIONS = 0.3, 3
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


def run_trial(job: StylizationJob) -> Trial:
    """Visit one or two views of a job in both phases. All ranks of the job must call this, and get the same result."""
    own = _Visitor(job).run()
    trials = job.collectives.all_gather(own)
    slowest = max(trials, key=lambda trial: trial.sos.seconds)
    largest = max(trials, key=lambda trial: (trial.device or 0, trial.process + trial.growth))
    return replace(slowest, **{name: getattr(largest, name) for name in ("process", "device", "passing", "growth")})


class _Visitor:
    """Visitor of the views that a rank's first steps visit."""

    def __init__(self, job: StylizationJob) -> None:
        self._job = job
        self._colors = job.views.scene.sh_dc.clone().to(job.views.rasterizer.device)
        self._optimizer = ColorOptimizer(self._colors, job.network.unit, bounded=job.settings.bounded)
        self._visited: list[int] = []

    def run(self) -> Trial:
        job, device = self._job, self._job.network.device
        groups, (coarse, sos) = job.team.groups, job.schedule
        # Every group visits as many views as the others, because their ranks communicate; and none that no step visits.
        different = min(len(job.views.covered), job.total_steps * job.settings.views_per_step)
        visits = 2 if 2 * groups <= different else 1
        order = list(islice(drawn_views(job.views.covered, job.settings.seed), visits * groups))
        costs: list[tuple[StepCost, StepCost]] = []
        with _peak_of_process() as process:
            for index in order[job.team.own_group :: groups]:
                self._visited.append(index)
                costs.append((self._cost(index, coarse), self._cost(index, sos)))
                if job.collectives.broadcast(lambda: costs[0][1].seconds > _SLOW):
                    break
            camera = job.views.cameras[self._visited[0]]
            render = job.views.rasterizer.uncached.step_seconds(camera, 2)[1]
        on_device = device_peak(device)
        peak, now = (process[0], _resident()) if on_device is None else (on_device, torch.cuda.memory_allocated(device))
        growth, novel, free = self._memory_to_come()
        sizes = {(job.views.cameras[index].height, job.views.cameras[index].width) for index in self._visited}
        prepare = [mean(own) for name in ("intersections", "colors") if (own := self._seconds_of(name))]
        in_coarse, in_sos = (_mean([cost[at] for cost in costs]) for at in (0, 1))
        if not job.plan.steps_coarse:
            in_sos = replace(in_sos, first=in_coarse.first + in_sos.first)
        return Trial(
            coarse=in_coarse,
            sos=self._scaled(in_sos),
            views=len(self._visited) * groups,
            style=job.style_targets.seconds / len(sizes),
            render=render,
            prepare=sum(prepare),
            process=process[0],
            device=on_device,
            passing=max(peak - now, 0),
            growth=growth,
            novel=novel,
            free=free,
        )

    def _cost(self, index: int, phase: Phase) -> StepCost:
        """Visit a view, repeatedly if that is fast. The first phase warms up the kernels, so it is always repeated."""
        job, before = self._job, {name: len(cache.costs) for name, cache in self._job.caches.items()}
        first = self._visit(index, phase)
        fresh = {
            name: sum(seconds for key, (_, seconds) in list(cache.costs.items())[before[name] :] if key in cache)
            for name, cache in job.caches.items()
        }
        prepared, later, repeated = sum(fresh.values()), first, 0.0
        for repetition in range(_REPETITIONS):
            slow = later["total"] - (0.0 if repetition else prepared) > _SLOW
            wanted = (repeated < _ENOUGH_SECONDS and not slow) or (phase.scale is not None and not repetition)
            if not job.collectives.all_gather(wanted)[0]:
                break
            again = self._visit(index, phase)
            later = min(later, again, key=lambda visit: visit["total"]) if repetition else again
            repeated += again["total"]
        on_gpu = job.network.device.type == "cuda"
        if later is first:
            later = {**first, "total": first["total"] - prepared, "prepare": max(first["prepare"] - prepared, 0.0)}
        elif on_gpu:
            prepared = max(first["total"] - later["total"], 0.0)
        cached = {name: fraction for name, (fraction, _) in self._forecast().items()}
        always = sum((1 - cached[name]) * seconds for name, seconds in fresh.items()) / (sum(fresh.values()) or 1.0)
        turns = job.settings.views_per_step // job.team.groups
        total = later.pop("total")
        once = later.get("optimizer", 0.0)
        return StepCost(turns * (total - once + always * prepared) + once, (1 - always) * prepared, later)

    def _visit(self, index: int, phase: Phase) -> dict[str, float]:
        """Make a step on one view, and return its seconds by activity, and as "total"."""
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
        regions, tiling = job.plan.survey.regions if job.plan.weighted else None, job.loss.tiling
        every = {
            index: (
                (job.views.cameras[index].height, job.views.cameras[index].width),
                regions[index] if regions else None,
            )
            for index in job.views.covered
        }
        pixels = NetworkPixels.of([every[index] for index in self._visited], tiling).all
        factor = NetworkPixels.of([*every.values()], tiling).all / pixels
        more = (factor - 1) * cost.of(*NETWORK) * (job.settings.views_per_step // job.team.groups)
        return replace(cost, seconds=cost.seconds + more, first=cost.first * factor)

    def _forecast(self) -> dict[str, tuple[float, int]]:
        """Return the fraction of the views whose data will be cached, and the final size in bytes, by cache."""
        job, result = self._job, dict[str, tuple[float, int]]()
        visits = (job.total_steps * job.settings.views_per_step) + (job.plan.loss_views if job.plan.measured else 0)
        views = min(visits, len(job.views.covered))
        weights = 0.0
        for name, cache in job.caches.items():  # weights come before tile intersections, whose budget they share
            needed, capacity = self._bytes_of_a_view(name) * views, cache.capacity
            if name == "intersections" and "weights" in job.caches:
                needed, capacity = needed * (1 - weights), job.intersection_budget(result["weights"][1])
            fraction = 1.0 if capacity is None or needed <= capacity else capacity / needed
            weights = fraction if name == "weights" else weights
            result[name] = fraction, int(needed * fraction)
        return result

    def _bytes_of_a_view(self, name: str) -> float:
        """Return the mean size in bytes of the data of a view in a cache. The survey has computed its intersections."""
        costs = self._job.caches[name].costs
        sizes = sum(size for size, _ in costs.values())
        return sizes / max(len(costs) if name == "intersections" else len(self._visited), 1)

    def _seconds_of(self, name: str) -> list[float]:
        cache = self._job.caches.get(name)
        return [seconds for _, seconds in cache.costs.values()] if cache else []

    def _memory_to_come(self) -> tuple[int, int, int]:
        """Return `growth`, `novel` and `free` of a trial."""
        caches, forecast = self._job.caches, self._forecast()
        growth = sum(final - caches[name].used for name, (_, final) in forecast.items())
        if "intersections" not in caches:
            return max(growth, 0), 0, 0
        final, budget = forecast["intersections"][1], self._job.intersection_budget(forecast.get("weights", (0, 0))[1])
        return max(growth, 0), int(self._bytes_of_a_view("intersections")), max(budget - final, 0)


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


def launch_cost(job: StylizationJob) -> LaunchCost:
    """Time the loss of a job's first view on a GPU, with its gradient, with and without a graph."""
    problem = graphs_problem(job.network.device)
    if problem is not None:
        return LaunchCost(problem=problem)
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
        eager = min(seconds(job.loss.evaluate) for _ in range(_REPETITIONS))
        first = seconds(graphs.evaluate)
        if graphs.problem is not None:
            return LaunchCost(problem=graphs.problem)
        if not graphs.captured:
            return LaunchCost(problem="a view's activations do not fit the memory twice")
        replayed = min(seconds(graphs.evaluate) for _ in range(_REPETITIONS))
    except torch.OutOfMemoryError:
        return LaunchCost(problem="the GPU's memory was not enough to evaluate the first view")
    finally:
        graphs.clear()
    return LaunchCost(eager, replayed, max(first - replayed, 0.0))
