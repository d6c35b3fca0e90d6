"""Cost model of a job: its seconds and bytes, predicted from measured facts and from the choices of its plan.

The predicted time of a step consists of

- the pixels that pass through the feature network (`Work`), times its measured rate,
- a render and its gradient, and the data of the view that are not cached (`ViewCosts`),
- with several ranks, each rank's portion of both, and the messages between ranks (`IterationWork`).

A view's first visit takes longer, because its data are then computed. `CostModel` adds this up over all steps and
measurements, and predicts the peak memory of a rank.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import replace

from sgsst_core.budget import memory_for
from sgsst_core.loss.scale_weights import ScaleWeights
from sgsst_core.loss.tiling import RENDERING, Tiling
from sgsst_core.parallel.division import Piece, loads
from sgsst_core.planning.facts import Probe
from sgsst_core.planning.measurement_choice import (
    LEVELS,
    LOSS_VIEWS,
    RENDERED,
    Prices,
    choose_level,
    choose_loss_views,
    novel_view_seconds,
)
from sgsst_core.planning.memory import PeakMemory, neighbors_are_searched, reference_activations
from sgsst_core.planning.plan import Plan, Prediction
from sgsst_core.planning.ranks import IterationWork, RanksChoice, choose_ranks
from sgsst_core.planning.view_costs import RENDER, RankPart, ViewCosts
from sgsst_core.planning.work import Work, content_bytes, pairs_of, pieces_of
from sgsst_core.settings import Settings

#: Temporary memory that a pass on a CPU uses if all activations are cached, as a fraction of `Tiling.working`
#: (measured: 0.4 at 512x384, where it is 40 MB, and at most 0.15 at 990x742).
_WORKING_FRACTION = 0.25
#: Number of views that represent all views when the time on several ranks is predicted.
_SAMPLED_VIEWS = 3
#: Time from the last step to the last file written: constant seconds for images and report, and seconds per Gaussian
#: for the neighbor search and for writing (measured with 4 million Gaussians on two cores; an estimate elsewhere).
_ENDING_SECONDS = 1.5
_ENDING_SECONDS_PER_GAUSSIAN = 4e-6
#: Portion of `_ENDING_SECONDS_PER_GAUSSIAN` for the neighbor search. If some Gaussians are unseen, the search is
#: repeated at every measurement.
_NEIGHBORS_SECONDS_PER_GAUSSIAN = 1.5e-6
#: Renders needed to compute the depth of a novel view.
_DEPTH_RENDERS = 2


class CostModel:
    """Predicted seconds and bytes of a job.

    Args:
        plan: Plan under construction: complete except for ranks, measurements, decisions and prediction.
        probe: Measured facts.
        settings: Settings of the job.

    Attributes:
        tiling: Partitioning rules.
        sizes: (height, width) of each view of the job.
        work: Work of an iteration on all scales.
        coarse: Work of an iteration on the coarsest scale.
        views: Data that are computed for the views.
    """

    def __init__(self, plan: Plan, probe: Probe, settings: Settings) -> None:
        self._plan, self._probe, self._settings = plan, probe, settings
        self.tiling = tiling_of(probe, settings)
        self.sizes = [probe.sizes[index] for index in plan.covered]
        self._regions = [probe.survey.regions[index] if plan.weighted else None for index in plan.covered]
        fraction = _WORKING_FRACTION if probe.machine.device == "cpu" else 1.0
        everything = range(len(self.sizes))
        self.work = Work.of(self._pieces(everything), self.tiling, working_fraction=fraction)
        self.coarse = Work.of(self._pieces(everything, coarsest=True), self.tiling)
        content = content_bytes(self.sizes, self.tiling, probe.network.content_bytes)
        self._plan = plan = replace(plan, spare=self.spare())
        self.views = ViewCosts.of(plan, probe, settings, self.work, self.coarse, content)

    def _pieces(self, views: Iterable[int], *, coarsest: bool = False) -> list[tuple[Piece, ...]]:
        """Return the pieces of some views of the job, given by their positions in `sizes`."""
        return [pieces_of(self.sizes[at], self.tiling, self._regions[at], coarsest=coarsest) for at in views]

    def spare(self) -> int:
        """Return the bytes of the budget for activations that the steps of a single rank on a GPU do not need."""
        plan, machine = self._plan, self._probe.machine
        if machine.device == "cpu" or machine.ranks > 1:
            return 0
        budget, once = memory_for("activations", machine.memory), int(self.work.peak * self._probe.network.held_bytes)
        needed = reference_activations(plan, once, budget)
        # A CUDA graph does not share its memory: evaluating the loss without the graph needs the same amount again.
        return max(budget - needed - (once if plan.graphs else 0), 0)

    def on_one_rank(self) -> tuple[Prediction, int]:
        """Return the prediction for the steps on one rank, and the bytes of its activations."""
        network, views, graphs = self._probe.network, self.views, self._plan.graphs
        seconds, seconds_coarse = (
            self._settings.views_per_step
            * (work.seconds(network, graphs=graphs) + views.rasterized() + views.later(coarse=work is self.coarse))
            for work in (self.work, self.coarse)
        )
        return Prediction(seconds, seconds_coarse, 0), int(self.work.peak * network.held_bytes)

    def on_several_ranks(self) -> tuple[RanksChoice, Prediction, int, RankPart]:
        """Choose the number of ranks.

        Returns:
            Choice, prediction for the steps on the chosen ranks, bytes of a rank's activations, and its part of a view;
            both for the rank with most of them.
        """
        available, link = self._probe.machine.ranks, self._probe.link
        coarse, sos = self._sampled(coarsest=True), self._sampled(coarsest=False)
        phases = [(self._plan.steps_coarse, coarse), (self._settings.steps_sos, sos)]
        choice = choose_ranks(phases, self._settings.views_per_step, available, link)
        if not self._settings.rebalance:
            choice = replace(choice, ranks=available)
        return choice, *self._on_ranks(choice.ranks, coarse, sos)

    def _on_ranks(
        self, ranks: int, coarse: list[IterationWork], sos: list[IterationWork]
    ) -> tuple[Prediction, int, RankPart]:
        """Return the prediction for a number of ranks, and a rank's activations in bytes and its part of a view.

        Groups of ranks process views in parallel, one view per group.
        """
        link, network = self._probe.link, self._probe.network
        groups = math.gcd(self._settings.views_per_step, ranks)
        each, turns = ranks // groups, self._settings.views_per_step // groups

        def per_step(seconds: Sequence[float]) -> float:
            return turns * sum(seconds) / len(seconds)

        largest = max(max(loads(work.shards(each), work.halo)) for work in sos)
        parts = [max(work.parts(each, groups), key=lambda part: part.window) for work in sos]
        part = replace(parts[0], window=sum(each.window for each in parts) / len(parts))
        memory = memory_for("activations", self._probe.machine.memory) * part.memory
        activations = int(min(largest * (network.held_bytes + network.working_bytes), memory))
        prediction = Prediction(
            per_step([work.seconds(each, link, groups) for work in sos]),
            per_step([work.seconds(each, link, groups) for work in coarse]),
            0,
            per_step([work.communication(each, link) for work in sos]),
            per_step([work.seconds(1, link) for work in sos]) * groups,
        )
        return prediction, activations, part

    def _sampled(self, *, coarsest: bool) -> list[IterationWork]:
        """Return the work of iterations of a sample of views: of phase 1, or on all scales."""
        network, sharing, plan = self._probe.network, self._probe.machine.sharing, self._plan
        tile = network.fixed.both  # on a GPU, the time to launch its kernels
        fixed, launch = (tile, 0.0) if self._probe.machine.device == "cpu" else (0.0, tile)
        sample = range(0, len(self.sizes), max(1, len(self.sizes) // _SAMPLED_VIEWS))

        def raster(part: RankPart) -> float:
            views = self.views.of_rank(part)
            return views.rasterized() + views.later(coarse=coarsest)

        return [
            IterationWork(
                pieces,
                network.halo,
                network.rate.both,
                raster,
                fixed * len(pieces),
                int(plan.seen.sum()),
                forward=network.rate.features,
                held=self.tiling.held * sharing,
                working=self.tiling.working,
                sharing=sharing,
                shown=plan.survey.shown,
                matching=network.rate.search * sum(map(pairs_of, pieces)),
                largest_tile=network.largest_tile,
                rendered=rendered,
                rendering=self.tiling.rendering,
                launch=launch,
                graphs=plan.graphs,
            )
            for pieces, rendered in zip(self._pieces(sample, coarsest=coarsest), self._pieces(sample), strict=True)
        ]

    def whole_job(self, steps: Prediction, activations: int, part: RankPart) -> tuple[Prediction, int, int]:
        """Extend a prediction of the steps to the whole job, and choose its measurements.

        Args:
            steps: Prediction for the steps.
            activations: Peak size of a rank's activations in an iteration, in bytes.
            part: Part of each view that a rank processes.

        Returns:
            Prediction, level of measurements (see `Plan.measuring`), and number of views for the loss.
        """
        views = self.views.of_rank(part)
        expected = self._with_first_visits(steps, views)
        level, loss_views = self._plan.measuring, min(LOSS_VIEWS[0], len(self._plan.covered))
        if self._plan.measured:
            expected, level, loss_views = self._with_measurements(expected, views, part)
        memory = PeakMemory(
            self.tiling,
            self.sizes,
            views,
            part,
            self._plan,
            self._probe,
            self._settings,
            level,
            loss_views,
            activations,
        )
        process, device = memory.bytes()
        return replace(expected, peak_bytes=process, device_bytes=device), level, loss_views

    def _with_first_visits(self, steps: Prediction, views: ViewCosts) -> Prediction:
        """Add the time of the style and of every view's first visit to a prediction of the steps."""
        expected = replace(
            steps,
            first_visit=views.first(coarse=False),
            first_visit_coarse=views.first(coarse=True),
            style=self._probe.styles * self.work.without_region * self._probe.network.rate.forward,
        )
        return replace(expected, job=self._steps_seconds(expected))

    def _with_measurements(self, expected: Prediction, views: ViewCosts, part: RankPart) -> tuple[Prediction, int, int]:
        """Choose the measurements of a job, and add their time to its prediction.

        Returns what `whole_job` returns.
        """
        plan, settings, count = self._plan, self._settings, len(self._plan.covered)
        evaluation = RENDER * views.rasterized() + views.later(coarse=False)
        evaluation += part.seconds(self.work.evaluation(self._probe.network))
        unvisited = max(1 - settings.steps_sos * settings.views_per_step / count, 0.0)
        before_and_after = evaluation + unvisited * expected.first_visit
        # `target_loss` is relative to the initial loss on these views. Their number must not depend on timings, or
        # timings would determine the step at which the job ends.
        loss_views = (
            min(LOSS_VIEWS[0], count)
            if settings.target_loss
            else choose_loss_views(settings.measure, expected.job, before_and_after, count)
        )
        expected = replace(
            expected,
            evaluation=loss_views * evaluation,
            losses=loss_views * before_and_after,
            ending=_ENDING_SECONDS + _ENDING_SECONDS_PER_GAUSSIAN * self._probe.scene.gaussians,
        )
        prices, total = self._prices(expected), plan.steps_coarse + settings.steps_sos
        level = choose_level(prices, novel_view_seconds(settings.measure, expected), total)
        measuring = expected.losses + prices.of(LEVELS[level], len(LEVELS[level].moments(total)))
        return replace(expected, measuring=measuring, job=expected.job + measuring), level, loss_views

    def _steps_seconds(self, expected: Prediction) -> float:
        """Return the time in seconds of all steps, including first visits and style."""
        phases = (
            (self._plan.steps_coarse, expected.seconds_coarse, expected.first_visit_coarse),
            (self._settings.steps_sos, expected.seconds, expected.first_visit),
        )
        views = len(self._plan.covered)
        steps = expected.style + sum(
            count * seconds + min(count * self._settings.views_per_step, views) * first
            for count, seconds, first in phases
        )
        return min(steps, self._settings.max_seconds or steps)

    def _prices(self, expected: Prediction) -> Prices:
        """Return the expected cost of measuring novel views, assuming that one costs as much as a view of the job."""
        raster, gaussians = self._probe.raster, self._probe.scene.gaussians
        render = RENDER * raster.seconds
        neighbors = (
            _NEIGHBORS_SECONDS_PER_GAUSSIAN * gaussians if neighbors_are_searched(self._plan, self._settings) else 0.0
        )
        return Prices(
            setup=RENDERED * (raster.first_seconds + raster.colors_seconds + _DEPTH_RENDERS * render),
            view=RENDERED * render + self.work.pixels * self._probe.network.rate.forward,
            moment=neighbors + (2 * expected.seconds if self._plan.is_approximated else 0.0),
        )


def tiling_of(probe: Probe, settings: Settings) -> Tiling:
    """Return the partitioning rules of a rank."""
    network = probe.network
    return Tiling(
        network.halo,
        memory_for("activations", probe.machine.memory) / network.held_bytes,
        network.working_bytes / network.held_bytes,
        settings.coarsest_side,
        weights=ScaleWeights(settings.scales),
        largest=network.largest_tile,
        rendering=RENDERING[probe.machine.device],
    )
