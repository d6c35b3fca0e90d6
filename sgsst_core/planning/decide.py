"""All decisions before the first iteration, as a pure function of probe and settings.

It neither renders nor measures anything: the same probe and settings give the same plan.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import replace

from sgsst_core.budget import memory_for
from sgsst_core.decision import Decision
from sgsst_core.features.partition import Rectangle
from sgsst_core.loss.scale_weights import ScaleWeights
from sgsst_core.loss.tiling import Tiling
from sgsst_core.parallel.division import divide, loads
from sgsst_core.planning import decisions
from sgsst_core.planning.choices import (
    GPU_RASTERIZERS,
    LEAST_VISITS,
    is_scan,
    optimized_gaussians,
    precision_of,
    rendered_gaussians,
    starts_warm,
    training_background_of,
)
from sgsst_core.planning.cost import (
    WORKING_SHARE,
    Work,
    content_bytes,
    nearest_bytes,
    pairs_of,
    pieces_of,
)
from sgsst_core.planning.job import of_measuring, whole_job
from sgsst_core.planning.memory import PeakMemory
from sgsst_core.planning.plan import Plan, Prediction
from sgsst_core.planning.probe import SAMPLED_VIEWS, Probe
from sgsst_core.planning.ranks_model import IterationWork, RanksChoice, choose_ranks
from sgsst_core.planning.visits import Visits
from sgsst_core.settings import CachedWeights, Settings

#: Fraction of uncovered pixels above which statistics are weighted by coverage, unless the settings say otherwise.
UNCOVERED_SHARE = 0.01
#: Minimum passes per image size for which benchmarking cuDNN's algorithms pays off. It takes as long as about ten
#: passes, and makes later passes a few percent faster.
LEAST_PASSES = 200


def decide(probe: Probe, settings: Settings, *, measured: bool = False) -> Plan:
    """Plan a job.

    Args:
        probe: Measured facts.
        settings: Settings of the job.
        measured: Whether quality is measured between steps and a report is written, as in `sgsst stylize`.

    Raises:
        SettingsError: If pruning would leave no Gaussian.
    """
    return _Deciding(probe, settings, measured=measured).plan()


class _Deciding:
    """Derivation of a plan from a probe and settings, step by step."""

    def __init__(self, probe: Probe, settings: Settings, *, measured: bool) -> None:
        self.probe = probe
        self.settings = settings
        self.measured = measured
        memory = probe.machine.memory
        network = probe.network
        self.activations = memory_for("activations", memory)
        self.budget = memory_for("rasterizer", memory)
        self.tiling = Tiling(
            network.halo,
            self.activations / network.held_bytes,
            network.working_bytes / network.held_bytes,
            settings.coarsest_side,
            keep_activations="activations" not in settings.keep,
            weights=ScaleWeights(settings.scales),
        )
        self.base = self._without_decisions()
        self.sizes = [probe.sizes[index] for index in self.base.covered]
        leave_out = self.base.weighted and "uncovered" not in settings.keep
        self.regions: list[Rectangle] | None = None
        if leave_out:
            self.regions = [probe.survey.regions[index] for index in self.base.covered]
        share = WORKING_SHARE if probe.machine.device == "cpu" else 1.0
        self.work = Work.of(self.sizes, self.tiling, self.regions, working_share=share)
        self.coarse = Work.of(self.sizes, self.tiling, self.regions, coarsest=True)
        content = self._content_bytes(self.base.covered)
        self.visits = Visits.of(self.base, probe, settings, self.work, self.coarse, content)

    def plan(self) -> Plan:
        """Return the plan with decisions and prediction."""
        expected, activations, ranks, line = (
            self._one_rank() if self.probe.machine.ranks == 1 else self._several_ranks()
        )
        expected, measured = whole_job(
            expected, self.base, self.probe, self.settings, work=self.work, visits=self.visits
        )
        level = measured.level if self.measured else None
        memory = PeakMemory(
            self.base,
            self.probe,
            self.settings,
            self.visits,
            level,
            measured.loss_views,
            activations,
            self._nearest_bytes(),
        ).bytes()
        expected = replace(expected, peak_bytes=memory[0], device_bytes=memory[1])
        plan = replace(
            self.base,
            ranks=ranks,
            measuring=measured.level,
            loss_views=measured.loss_views,
            prediction=expected,
        )
        lines = [of_measuring(plan, expected, self.settings)] if self.measured else []
        return replace(plan, decisions=(*self._decisions(line), *lines))

    def _without_decisions(self) -> Plan:
        probe, settings = self.probe, self.settings
        survey = probe.survey
        decided = optimized_gaussians(survey, settings)
        optimized = decided if probe.kept is None else decided & ~probe.kept
        weighted = settings.position_weights == "on" or (
            settings.position_weights == "auto" and survey.uncovered_share > UNCOVERED_SHARE
        )
        scan = is_scan(survey, weighted=weighted)
        several = any(len(self.tiling.scales(size)) > 1 for size in probe.sizes)
        steps_coarse = settings.steps_coarse if several or settings.preset == "paper" else 0
        views = len(probe.distinct)
        form = self._kept_form((steps_coarse + settings.steps_sos) * settings.views_per_step / views)
        return Plan(
            survey=survey,
            optimized=optimized,
            seen=rendered_gaussians(decided, settings),
            covered=probe.distinct,
            weighted=weighted,
            steps_coarse=steps_coarse,
            training_background=training_background_of(settings, scan=scan),
            warm_start=starts_warm(settings, scan=scan),
            memory_limit=probe.machine.memory_limit,
            device=probe.machine.device,
            rasterizer=probe.rasterizer if form == "none" else "cached",
            uncached=next((name for name in GPU_RASTERIZERS if name == probe.rasterizer), "cpu"),
            precision=precision_of(settings.precision, probe.network.precision_ratio),
            search=probe.machine.device == "cuda" and self._passes_of_a_size(steps_coarse, weighted) >= LEAST_PASSES,
            graphs=self._graphs_pay(steps_coarse, weighted),
            cached_weights=form,
            measured=self.measured,
        )

    def _passes_of_a_size(self, steps_coarse: int, weighted: bool) -> int:
        """Return how often images of one size pass through the network.

        With weighted statistics, every view has its own size, because it is cropped to its covered pixels.
        """
        views = self.probe.distinct
        sizes = len(views) if weighted else len({self.probe.sizes[index] for index in views})
        return (steps_coarse + self.settings.steps_sos) * self.settings.views_per_step // sizes

    def _graphs_pay(self, steps_coarse: int, weighted: bool) -> bool:
        """Return whether CUDA graphs of the loss save more time than it takes to capture one per size and phase."""
        launches, settings = self.probe.launches, self.settings
        if self.probe.machine.device != "cuda" or launches is None or "launches" in settings.keep:
            return False
        if launches.least_visits is None or decisions.ranks_of_a_view(self.probe, settings) > 1:
            return False
        phases = bool(steps_coarse) + bool(settings.steps_sos)
        return self._passes_of_a_size(steps_coarse, weighted) >= phases * launches.least_visits

    def _kept_form(self, visits: float) -> CachedWeights:
        """Return the format of cached blend weights.

        It is float32 if that fits, else half precision, and "none" if caching does not pay off.
        """
        raster, form = self.probe.raster, self.settings.cached_weights
        if raster.bytes is None or raster.half_bytes is None or "blend-weights" in self.settings.keep:
            return "none"
        if form != "auto":
            return form
        if not self._keeping_pays(visits):
            return "none"
        exactly = raster.bytes <= self.budget or self.settings.preset == "paper"
        return "float32" if exactly else "half"

    def _keeping_pays(self, visits: float) -> bool:
        """Return whether caching blend weights pays off for this many visits of each view."""
        raster = self.probe.raster
        if self.probe.rasterizer not in GPU_RASTERIZERS:
            return visits >= LEAST_VISITS
        return raster.least_visits is not None and visits >= raster.least_visits

    def _decisions(self, ranks: Decision | None) -> tuple[Decision, ...]:
        probe, settings, plan = self.probe, self.settings, self.base
        shared = self._content_bytes(probe.survey.covered) - self._content_bytes(plan.covered)
        found = [
            *decisions.of_scene(probe, plan, settings),
            *decisions.of_views(probe, plan, settings, self.work, shared),
            *decisions.of_training_background(plan, settings, self.visits),
            *decisions.of_colors(settings),
            *decisions.of_network(probe, settings, self.work, self.activations),
            *decisions.of_rasterizer(probe, plan),
            *decisions.of_search(plan, self._passes_of_a_size(plan.steps_coarse, plan.weighted)),
            *decisions.of_launches(probe, plan, settings, self._passes_of_a_size(plan.steps_coarse, plan.weighted)),
            decisions.of_blend_weights(probe, plan, settings, self.budget),
            *decisions.of_schedule(plan, settings, [self.tiling.scale_count(size) for size in self.sizes]),
        ]
        found += [ranks] if ranks else []
        return (*found, *decisions.of_precision(probe, settings))

    # --- predictions
    # ---------------------------------------------------------------------------------------------------

    def _content_bytes(self, views: Iterable[int]) -> int:
        sizes = [self.probe.sizes[index] for index in views]
        return content_bytes(sizes, self.tiling, self.probe.network.content_bytes)

    def _nearest_bytes(self) -> int:
        """Return the memory for feature matching in bytes; every rank stores all of the style's vectors."""
        network, device = self.probe.network, self.probe.machine.device
        return nearest_bytes(self.sizes, self.tiling, network.vector_channels, 4, device)

    def _one_rank(self) -> tuple[Prediction, int, int, None]:
        """Return the prediction for a single rank.

        Returns:
            Prediction, bytes of activations, number of ranks, and no decision about ranks.
        """
        rate, visits = self.probe.network.rate, self.visits
        turns = self.settings.views_per_step
        seconds, seconds_coarse = (
            turns * (work.seconds(rate) + visits.rasterized() + visits.later(coarse=work is self.coarse))
            for work in (self.work, self.coarse)
        )
        return Prediction(seconds, seconds_coarse, 0), int(self.work.peak * self.probe.network.held_bytes), 1, None

    def _several_ranks(self) -> tuple[Prediction, int, int, Decision]:
        """Choose the number of ranks, and return the prediction for it.

        Returns:
            Prediction, bytes of each rank's activations, number of ranks, and the decision about ranks.
        """
        available, link = self.probe.machine.ranks, self.probe.link
        samples = [self._sampled(coarsest=True), self._sampled(coarsest=False)]
        phases = list(zip((self.base.steps_coarse, self.settings.steps_sos), samples, strict=True))
        choice = choose_ranks(phases, self.settings.views_per_step, available, link)
        if "ranks" in self.settings.keep:
            choice = replace(choice, ranks=available)
        expected, activations = self._expected(choice, *samples)
        return expected, activations, choice.ranks, decisions.of_ranks(choice, available, link)

    def _expected(
        self, choice: RanksChoice, coarse: list[IterationWork], sos: list[IterationWork]
    ) -> tuple[Prediction, int]:
        """Return the prediction for the chosen number of ranks, and each rank's activations in bytes.

        Groups of ranks process views in parallel, one view per group.
        """
        link, network = self.probe.link, self.probe.network
        groups = math.gcd(self.settings.views_per_step, choice.ranks)
        each, turns = choice.ranks // groups, self.settings.views_per_step // groups

        def mean(values: Iterable[float]) -> float:
            found = list(values)
            return turns * sum(found) / len(found)

        largest = max(max(loads(divide(work.pieces, work.halo, (1.0,) * each), work.halo)) for work in sos)
        sharing = self.probe.machine.sharing
        memory = self.activations * sharing / min(choice.ranks, sharing)  # with fewer ranks, each has more
        activations = int(min(largest * (network.held_bytes + network.working_bytes), memory))
        expected = Prediction(
            mean(work.seconds(each, link, groups) for work in sos),
            mean(work.seconds(each, link, groups) for work in coarse),
            0,
            mean(work.communication(each, link) for work in sos),
            mean(work.seconds(1, link) for work in sos) * groups,
        )
        return expected, activations

    def _sampled(self, *, coarsest: bool) -> list[IterationWork]:
        """Return the work of iterations of a sample of views, for `choose_ranks`: of phase 1, or on all scales."""
        network, sharing = self.probe.network, self.probe.machine.sharing
        step = max(1, len(self.sizes) // SAMPLED_VIEWS)
        found = []
        for index in range(0, len(self.sizes), step):
            region = self.regions[index] if self.regions else None
            pieces = pieces_of(self.sizes[index], self.tiling, region, coarsest=coarsest)
            found.append(
                IterationWork(
                    pieces,
                    network.halo,
                    network.rate.both,
                    self.visits.rasterized(),
                    network.fixed * len(pieces),
                    int(self.base.seen.sum()),
                    forward=network.rate.forward,
                    held=self.tiling.held * sharing,
                    working=self.tiling.working,
                    sharing=sharing,
                    shown=self.base.survey.shown,
                    matching=network.rate.search * sum(map(pairs_of, pieces)),
                )
            )
        return found
