"""Stylizer: Adam on the DC colors, in a coarse phase followed by a phase on all scales.

Each call of `Stylizer.run_step` makes one step; `loop.run` makes all steps.
"""

from __future__ import annotations

import math
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from typing import Any, Self

import psutil
import torch
from torch import Tensor

from sgsst_core.budget import device_peak, forget_device_peak, least_intersection_memory, memory_for
from sgsst_core.errors import DivergedError
from sgsst_core.features.network_weights import BackboneWeights, load_network_weights
from sgsst_core.loss.feature_scale import weights_for
from sgsst_core.loss.graphs import LossGraphs
from sgsst_core.loss.sos import SosLoss, SosResult, make_loss
from sgsst_core.loss.targets import StyleTargets, ViewTarget
from sgsst_core.parallel.collectives import ALONE, Collectives
from sgsst_core.planning.choices import ends_with_transfer
from sgsst_core.planning.context import PlanningContext, make_network, sharing_memory
from sgsst_core.planning.plan import Plan
from sgsst_core.planning.planner import make_plan
from sgsst_core.rasterizer import RASTERIZERS, Rasterizer, make_rasterizer
from sgsst_core.rasterizer.cached import CachedRasterizer
from sgsst_core.regions.definition import Regions
from sgsst_core.scene.camera import Camera, fit_cameras, spread
from sgsst_core.scene.gaussians import Scene
from sgsst_core.settings import Settings
from sgsst_core.style import Style
from sgsst_core.stylizing.ahead import PhotoLoader
from sgsst_core.stylizing.evaluation import (
    Evaluation,
    evaluate,
    mean_evaluation,
    mean_loss,
)
from sgsst_core.stylizing.job_styles import JobStyles
from sgsst_core.stylizing.optimizer import ColorOptimizer, constrained, is_too_large
from sgsst_core.stylizing.refining import refine, refined
from sgsst_core.stylizing.schedule import Phase, drawn_round, drawn_views, phase_at, planned_phases
from sgsst_core.stylizing.state import BEFORE_STEPS, StepRecord, StylizerState
from sgsst_core.stylizing.team import Team
from sgsst_core.stylizing.training_background import Color, drawn_color
from sgsst_core.stylizing.unseen import neighbors_change, neighbors_change_by_region
from sgsst_core.stylizing.views import Views
from sgsst_core.timing import Timer


class Stylizer:
    """Stylization of one scene according to a plan, step by step.

    Args:
        plan: Plan for this scene, these cameras and settings: from `make_plan`, or from an earlier run of the same job.
        scene: Scene to stylize, refined if the plan says so.
        cameras: Cameras of the views; larger ones are reduced to `settings.max_resolution`.
        style: Image [H, W, 3] in 0..1, or a mixture of several images.
        settings: Settings of the job.
        weights: Weights of the feature network.
        photos: Function that loads the content image of a camera by its index, at the (reduced) size of the view; None
            for unstylized renders.
        collectives: Ranks that stylize the scene together. Every rank has a stylizer with the same arguments, and calls
            the same methods in the same order. Methods that only read, such as `state` and `stylized`, may be called by
            a single rank.
        planning_context: Planning context of the plan; None to create its objects again.
        regions: Regions for which the plan was made, each with its own style or frozen; None for one style everywhere.

    Attributes:
        collectives: Ranks that take part.
        group: Ranks that process the same views as this one.

    Raises:
        RankLeftOut: If the job continues without this rank.
    """

    def __init__(
        self,
        plan: Plan,
        scene: Scene,
        cameras: Sequence[Camera],
        style: Tensor | Style,
        settings: Settings,
        *,
        weights: BackboneWeights,
        photos: PhotoLoader | None = None,
        collectives: Collectives = ALONE,
        planning_context: PlanningContext | None = None,
        regions: Regions | None = None,
    ) -> None:
        self.plan = plan
        self.settings = settings
        self.timer = Timer(plan.device)
        self.seconds = 0.0
        self.seconds_by_part: dict[str, float] = {}
        self.step = 0
        self.history: list[StepRecord] = []
        #: Measurements between steps (`loop.Callbacks.measure`), JSON-serializable and preserved by a resume.
        self.measured: list[dict[str, Any]] = []
        #: Time in seconds spent on the style's statistics, which are computed in the first step that needs them.
        self.style_seconds = 0.0
        #: Views of the latest step.
        self.latest: list[int] = []
        self.weights = weights = weights_for(weights, settings)
        self.photos = photos
        weights_of_views = plan.survey.total_blend_weights
        self.regions = regions = regions and regions.resolved(weights_of_views)
        self.styles = JobStyles.prepared(Style.of(style), regions, settings, scene.sh_dc, weights_of_views)
        forget_device_peak(plan.device)
        self.network = (
            planning_context.network
            if planning_context
            else make_network(weights, settings, plan.precision, plan.device)
        )
        self._styles = self.styles.to(self.network.device)
        self.network.search = plan.search
        self._team = Team(plan, settings, collectives)
        self.collectives, self.group = self._team.everybody, self._team.group
        #: Memory budget of all ranks on one machine together, in bytes. It determines the partition, and thereby
        #: rounding, so it is identical on all ranks.
        self.memory_limit = settings.memory_limit or plan.memory_limit
        self.memory = self.memory_limit // sharing_memory(self.collectives, plan.device)
        self.loss = self._loss()
        #: Replacement for `loss` in steps, if the plan uses graphs.
        self.graphs = LossGraphs(self.loss) if plan.graphs and self.group.size == 1 else None
        self.sh_degree = scene.sh_degree
        #: Scene with the SH attenuation of the settings applied.
        self.scene = scene = planning_context.scene if planning_context else scene.attenuated(settings.sh_attenuation)
        seen = scene if plan.seen.all() else scene.subset(plan.seen)
        seen = seen if "sh" in settings.keep else seen.without_zero_bands()
        rasterizer = self._make_rasterizer(seen, planning_context)
        self.views = self._views(seen, fit_cameras(cameras, settings), rasterizer)
        self._style_targets: dict[tuple[int, int], StyleTargets] = {}
        # Computed once, because another processor may round differently and ranks must start with the same bits.
        start = self.collectives.broadcast(self.transferred) if plan.warm_start else seen.sh_dc
        self.sh_dc = start.clone().to(rasterizer.device)
        kept = regions.frozen[plan.seen] if regions else torch.zeros(0, dtype=torch.bool)
        #: Frozen Gaussians among the rendered ones; None if there are none.
        self._kept = kept.to(rasterizer.device)[:, None] if kept.any() else None
        chroma_of = seen.sh_dc.to(rasterizer.device) if self._keeps_chroma else None
        self._optimizer = ColorOptimizer(
            self.sh_dc,
            self.network.unit,
            chroma_of,
            bounded=settings.bounded,
            kept=self._kept,
        )
        self._generator = torch.Generator().manual_seed(settings.seed)
        self._queue: list[int] = []
        #: Number of steps before a resume whose blend weights have yet to be cached again.
        self._visited_before = 0
        self.schedule = planned_phases(plan, settings)
        self.total = sum(phase.steps for phase in self.schedule)
        self._process = psutil.Process()
        self._start: Evaluation | None = None
        self._stylized: Tensor | None = None
        self._cost = 0  # pixels that this rank passes through the network in the present step

    @classmethod
    def planned(
        cls,
        scene: Scene,
        cameras: Sequence[Camera],
        style: Tensor | Style,
        settings: Settings,
        *,
        weights: BackboneWeights | None = None,
        photos: PhotoLoader | None = None,
        rasterizer: str | None = None,
        collectives: Collectives = ALONE,
        regions: Regions | None = None,
    ) -> Self:
        """Plan a job and create its stylizer; see `make_plan` for `weights`, `rasterizer` and exceptions.

        If the settings request refinement, the stylizer contains the refined scene.
        """
        weights = weights or load_network_weights("auto")
        mixture = Style.of(style)
        made = refine(
            scene,
            cameras,
            mixture,
            settings,
            weights=weights,
            rasterizer=rasterizer,
            collectives=collectives,
            regions=regions,
        )
        scene, regions = refined(scene, made), regions and regions.refined(made)
        plan, planning_context = make_plan(
            scene,
            cameras,
            settings,
            weights=weights,
            rasterizer=rasterizer,
            collectives=collectives,
            style=mixture,
            regions=regions,
            refinement=made,
        )
        return cls(
            plan,
            scene,
            cameras,
            style,
            settings,
            weights=weights,
            photos=photos,
            collectives=collectives,
            planning_context=planning_context,
            regions=regions,
        )

    def transferred(self, own: Tensor | None = None) -> Tensor:
        """Return the colors [n, 3] of the rendered Gaussians after a transfer of the style's colors; see `warm_start`.

        Args:
            own: [n, 3] on the CPU, colors before the transfer; None for the scene's, as before the first step.

        Returns:
            [n, 3] on the CPU.
        """
        seen = self.plan.seen
        own = self.scene.sh_dc[seen] if own is None else own
        weights = self.plan.survey.total_blend_weights[seen]
        found = self.styles.transferred(own, weights, seen, keep_chroma=self._keeps_chroma)
        # `stylized` derives colors that no view determines from those of their neighbors.
        return torch.where(self.plan.optimized[seen][:, None], found, own)

    @property
    def transfers_last(self) -> bool:
        """Whether the style's colors are transferred to results once more: see `ends_with_transfer`."""
        return ends_with_transfer(self.settings, warm=self.plan.warm_start)

    def _transferred_last(self, optimized: Tensor) -> Tensor:
        """Return optimized colors [n, 3] after the final transfer, if the job has one.

        Before the first step, colors need no transfer, because they already are the style's.
        """
        if not (self.transfers_last and self.step):
            return optimized
        found = self.transferred(optimized)
        if not self._keeps_chroma:
            return found
        bounded = constrained(found, self.scene.sh_dc[self.plan.seen], bounded=self.settings.bounded)
        return torch.where(found != optimized, bounded, optimized)  # frozen colors remain bit-identical

    @property
    def _keeps_chroma(self) -> bool:
        """Whether only luminance changes."""
        return self.settings.preserve_colors == "luminance"

    def _loss(self) -> SosLoss:
        memory = memory_for("activations", self.memory)
        return make_loss(self.network, self.settings, memory, timer=self.timer, collectives=self.group)

    def _make_rasterizer(self, seen: Scene, planning_context: PlanningContext | None) -> Rasterizer:
        """Return the plan's rasterizer of the rendered Gaussians."""
        plan, settings = self.plan, self.settings
        memory = memory_for("rasterizer", self.memory)
        whole = planning_context.rasterizer if planning_context else None
        if whole is None:
            uncached = make_rasterizer(
                plan.uncached, seen, background=settings.background, near=settings.near, memory=memory
            )
        elif plan.seen.all():
            uncached = whole
        else:
            uncached = whole.for_subset(seen, plan.seen, memory)
        if plan.cached_weights == "none":
            return uncached
        return CachedRasterizer(
            seen,
            max_bytes=memory,
            least_intersection_bytes=self._least_intersection_bytes,
            precision="half" if plan.cached_weights == "half" else "float32",
            at_first_use=False,
            uncached=uncached,
        )

    @property
    def _least_intersection_bytes(self) -> int:
        """Budget in bytes for tile intersections next to cached weights, taken from the memory for views."""
        shared = self.plan.cached_weights != "none" and not RASTERIZERS[self.plan.uncached].on_gpu
        return least_intersection_memory(self.memory) if shared else 0

    def _views(self, seen: Scene, cameras: Sequence[Camera], rasterizer: Rasterizer) -> Views:
        plan, settings = self.plan, self.settings
        return Views(
            seen,
            cameras,
            rasterizer,
            self.loss,
            covered=list(plan.covered),
            weighted=plan.weighted,
            photos=self.photos,
            memory=memory_for("views", self.memory) - self._least_intersection_bytes,
            keep_content="content" not in settings.keep,
            clamp_aware_gradient=settings.clamp_aware_gradient,
            regions=plan.survey.regions if plan.weighted else None,
            background=settings.background,
            drawn=plan.training_background != "background",
            maps=self.styles.maps(rasterizer.repeatable, plan.seen),
            collectives=self.group,
        )

    @property
    def style(self) -> Style:
        """Style of all Gaussians that are not in a region with its own style."""
        return self.styles.own

    @property
    def phase(self) -> Phase:
        """Phase of the next step; the last phase if all steps are done."""
        return phase_at(self.schedule, self.step)

    def share_done(self) -> float:
        """Return the completed fraction of the schedule, 0 to 1, which determines the learning rate."""
        return self.step / max(self.total - 1, 1)

    @property
    def stops_early(self) -> bool:
        """Whether the run ends when its losses stop falling; this requires a constant background."""
        return self.settings.early_stop and self.plan.training_background == "background"

    @property
    def round_length(self) -> int:
        """Number of steps in which every view is visited once."""
        return math.ceil(len(self.views.covered) / self.settings.views_per_step)

    def scale_count(self, index: int) -> int:
        """Return n_s of a view."""
        camera = self.views.cameras[index]
        return self.loss.tiling.scale_count((camera.height, camera.width))

    def scales(self, index: int) -> list[int]:
        """Return the scales of a view with a positive weight, finest first."""
        camera = self.views.cameras[index]
        return self.loss.tiling.scales((camera.height, camera.width))

    @property
    def evaluation_views(self) -> list[int]:
        """Indices of the plan's `loss_views`, evenly spread over the views that see anything.

        The contact sheet shows the same views.
        """
        return spread(self.views.covered, self.plan.loss_views)

    def start(self) -> Evaluation:
        """Return the loss of the unstylized scene on the evaluation views; evaluated once, at the first call."""
        if self._start is None:
            with self.measuring():
                self._start = self.evaluate(self.evaluation_views, self.views.scene.sh_dc)
        return self._start

    @contextmanager
    def measuring(self) -> Iterator[None]:
        """Record the time of a `with` block as measuring, separately from the steps."""
        started, parts = time.perf_counter(), self.seconds_by_part
        yield
        parts["measuring"] = parts.get("measuring", 0.0) + time.perf_counter() - started

    def behind(self, index: int) -> Color | None:
        """Return the background color of a view in the next step; None for the background of the settings."""
        return drawn_color(self.plan.training_background, self.settings.seed, self.step, index, self.style)

    def style_targets(self, camera: Camera) -> StyleTargets:
        """Return the style's targets for views of the camera's size."""
        size = (camera.height, camera.width)
        if size not in self._style_targets:
            started = time.perf_counter()
            self._style_targets[size] = self._styles.targets(self.loss, size)
            self.style_seconds += time.perf_counter() - started
        return self._style_targets[size]

    def run_step(self) -> StepRecord:
        """Run one iteration.

        Raises:
            DivergedError: If the gradient has left the range of float32; the colors are those before the step.
        """
        started = time.perf_counter()
        self._stylized = None
        self.timer.clear()
        self._keep_visited()
        sent = dict(self.collectives.sent)
        phase = self.phase
        self.latest = views = [self._next_view() for _ in range(self.settings.views_per_step)]
        gradient, results = self._mean_gradient(views, phase)
        with self.timer("optimizer"):
            largest = self._optimizer.update(gradient, self.settings.learning_rate_at(self.share_done()))
        with self.timer("communication"):
            self._team.check_drift(self.step + 1, self.sh_dc)
        terms = self._read(largest, results)
        self.step += 1
        self.timer.read()
        if phase.scale is None:
            self._balance()
        self.seconds += time.perf_counter() - started
        for name, seconds in self.timer.seconds.items():
            self.seconds_by_part[name] = self.seconds_by_part.get(name, 0.0) + seconds
        record = StepRecord(
            self.step,
            phase.stage,
            views[0],
            self.seconds,
            mean_loss(terms, self.loss.weights),
            terms,
            dict(self.timer.seconds),
            self._process.memory_info().rss,
            {kind: total - sent[kind] for kind, total in self.collectives.sent.items() if total > sent[kind]},
            device_peak(self.network.device),
        )
        self.history.append(record)
        return record

    def _mean_gradient(self, views: list[int], phase: Phase) -> tuple[Tensor, list[SosResult]]:
        """Return dE/dsh_dc [n, 3], mean over some views, and the results of this group's views."""
        gradient: Tensor | None = None
        results = []
        self._cost = 0
        own_views = views[self._team.own_group :: self._team.groups]
        for place, index in enumerate(own_views):
            scales = phase.scales(self.scales(index))
            behind = self.behind(index)
            with self.timer("prepare", whole=True):
                self.keep_weights(index)
                target = self.views.target(index, scales, behind)
                self._look_ahead(own_views[place + 1 :], phase)
                style = self.style_targets(self.views.cameras[index])
            assert target.division is not None
            self._cost += target.division.cost(self.group.rank, self.network.halo)
            own, result = self._gradient(index, style, target, scales, behind)
            gradient = own if gradient is None else gradient.add_(own)
            results.append(result)
        assert gradient is not None
        if len(views) > 1:
            if self._team.groups > 1:  # all ranks of a group have the same gradient: count it once
                with self.timer("communication"):
                    gradient = self.collectives.all_reduce(gradient / self.group.size)
            gradient = gradient / len(views)
        if self._kept is not None:
            gradient = gradient.masked_fill(self._kept, 0)  # Adam does not change colors with zero gradient
        return gradient, results

    def _read(self, largest: Tensor, results: Sequence[SosResult]) -> Evaluation:
        """Synchronize with the device, once per step, and return the loss of each scale, mean over the step's views.

        Args:
            largest: Largest magnitude in the gradient.
            results: Results of this group's views.

        Raises:
            DivergedError: If `largest` is too large for a step.
        """
        # The rasterizer, and with it the colors, may be on the CPU while the network is on a GPU.
        first = largest.double()[None].to(self.network.device)
        tensors = [first, *(result.values.flatten() for result in results)]
        magnitude, *values = torch.cat(tensors).cpu().split([len(tensor) for tensor in tensors])
        if is_too_large(float(magnitude)):
            raise self._diverged(float(magnitude))
        evaluations = [
            replace(result, values=own.view_as(result.values)).terms
            for result, own in zip(results, values, strict=True)
        ]
        if self._team.groups > 1:
            with self.timer("communication"):
                every = self.collectives.all_gather(evaluations)[:: self.group.size]
            evaluations = [terms for part in every for terms in part]
        return mean_evaluation(evaluations)

    def _diverged(self, largest: float) -> DivergedError:
        return DivergedError(
            f"Step {self.step + 1}: the color gradient has grown to {largest:.3g}, which cannot be optimized; the "
            f"largest color coefficient is {float(self.sh_dc.detach().abs().max()):.3g}. Give a smaller "
            f"--learning-rate than {self.settings.learning_rate:g}, or look for extreme coefficients with `sgsst "
            "check`."
        )

    def _balance(self) -> None:
        """Divide the work again, once in phase 2, in proportion to the measured speeds of the ranks."""
        speeds = self._team.compare_speeds(self._cost, self.timer.seconds)
        if speeds:
            self.loss.divider.speeds = speeds
            self.views.uncached_fraction()

    def _next_view(self) -> int:
        """Return a random view without replacement: every view is visited once before any is visited again."""
        if not self._queue:
            self._queue = drawn_round(self.views.covered, self._generator)
        return self._queue.pop()

    def _look_ahead(self, left: Sequence[int], phase: Phase) -> None:
        """Announce the view that this group processes next, so that its data can be read while the device works.

        The queue is only inspected, not refilled: a new round is drawn only when it is needed, because checkpoints
        contain the queue and the random state.

        Args:
            left: Remaining views of this group in the present step.
            phase: Phase of the present step.
        """
        if left:
            index = left[0]
        elif self.step + 1 < self.total and len(self._queue) > self._team.own_group:
            index, phase = self._queue[-1 - self._team.own_group], phase_at(self.schedule, self.step + 1)
        else:
            return
        self.views.look_ahead(index, phase.scales(self.scales(index)))

    @property
    def coming(self) -> list[int]:
        """Remaining views of this round, next one first."""
        return self._queue[::-1]

    def evaluate(self, indices: Sequence[int], sh_dc: Tensor | None = None) -> Evaluation:
        """Return the mean SOS loss over views, split by scale.

        This does not affect steps, and its time is not recorded.

        Args:
            indices: Indices of the views.
            sh_dc: [n, 3], colors of the rendered Gaussians to evaluate; None for the present ones.
        """
        self._keep_visited()
        values = (self.sh_dc.detach() if sh_dc is None else sh_dc).to(self.sh_dc.device)
        return evaluate(self.views, self.style_targets, indices, values)

    def gradient(self, index: int, scales: Sequence[int]) -> tuple[Tensor, float]:
        """Return dE/dsh_dc [n, 3] of the rendered Gaussians on the CPU, as a step computes it, and its time in seconds.

        Targets are prepared before timing starts. This does not affect steps.
        """
        self._keep_visited()
        target, style = self.views.target(index, scales), self.style_targets(self.views.cameras[index])
        with self.views.lending_weights(index):
            started = time.perf_counter()
            gradient = self._gradient(index, style, target, scales)[0]
            return gradient.cpu(), time.perf_counter() - started

    def _gradient(
        self,
        index: int,
        style: StyleTargets,
        target: ViewTarget,
        scales: Sequence[int],
        behind: Color | None = None,
    ) -> tuple[Tensor, SosResult]:
        """Return dE/dsh_dc [n, 3] of one view over a background color (None: that of the settings), and the loss."""
        with self.timer("render"), torch.no_grad():
            colors = self.views.colors(index, self.sh_dc.detach())
            image = self.views.render(index, colors)
            if behind is not None:
                image = self.views.put_behind(index, image, behind)
        with self.timer("loss"):
            evaluate = self.graphs.evaluate if self.graphs is not None else self.loss.evaluate
            result = evaluate(image, style, target, scales)
        with self.timer("raster_backward"):
            assert result.image_gradient is not None
            return self.views.gradient(index, result.image_gradient.to(colors.device), colors), result

    def keep_weights(self, index: int) -> None:
        """Cache a view's blend weights, if they fit, as its first step does.

        Only steps cache weights. Renders between steps happen at varying times, and must not affect the results of
        steps.
        """
        self.views.keep_weights(index)

    def _keep_visited(self) -> None:
        """Cache, once after a resume, the blend weights that previous steps cached.

        The order is the same, so that the same views fit.
        """
        steps, self._visited_before = self._visited_before, 0
        if not steps:
            return
        order = drawn_views(self.views.covered, self.settings.seed)
        with self.timer("prepare"):
            for _ in range(steps):
                views = [next(order) for _ in range(self.settings.views_per_step)]
                for index in views[self._team.own_group :: self._team.groups]:
                    self.keep_weights(index)

    def stylized(self) -> Tensor:
        """Return sh_dc [N, 3] float32 of the whole scene on the CPU: optimized colors, and colors of unseen Gaussians.

        This is the output of a job that ends now, including the final transfer if there is one. It is cached until the
        colors change, because finding the neighbors of millions of unseen Gaussians takes seconds. It must not be
        modified.
        """
        if self._stylized is None:
            result = self.scene.sh_dc.clone()
            result[self.plan.seen] = self._transferred_last(self.sh_dc.detach().cpu())
            if self.settings.unseen == "neighbors":
                weights = torch.where(self.plan.optimized, self.plan.survey.total_blend_weights, 0.0)
                change = result - self.scene.sh_dc
                regions = self.regions
                takes = weights <= 0 if regions is None else (weights <= 0) & ~regions.frozen
                if regions is None:
                    change = neighbors_change(self.scene.means, change, weights)
                else:
                    change = neighbors_change_by_region(self.scene.means, change, weights, regions)[takes]
                change = change.mean(dim=1, keepdim=True) if self._keeps_chroma else change
                own = self.scene.sh_dc[takes]
                chroma_of = own if self._keeps_chroma else None
                result[takes] = constrained(own + change, chroma_of, bounded=self.settings.bounded)
            self._stylized = result
        return self._stylized

    def shown(self) -> Tensor:
        """Return sh_dc [n, 3] of the rendered Gaussians in the output of a job that ends now.

        It is on the rasterizer's device. In contrast to `sh_dc`, from which steps continue, it includes the final
        transfer, if the job has one.
        """
        if not self.transfers_last:
            return self.sh_dc.detach()
        return self.stylized()[self.plan.seen].to(self.sh_dc.device)

    def set_colors(self, sh_dc: Tensor) -> None:
        """Replace the present colors with sh_dc [N, 3] of the whole scene, for example to evaluate them."""
        self._stylized = None
        with torch.no_grad():
            self.sh_dc.copy_(sh_dc[self.plan.seen])

    @contextmanager
    def with_colors(self, sh_dc: Tensor) -> Iterator[None]:
        """Use sh_dc [N, 3] of the whole scene inside a `with` block, then restore the present colors exactly."""
        present, stylized = self.sh_dc.detach().clone(), self._stylized
        self.set_colors(sh_dc)
        try:
            yield
        finally:
            self._stylized = stylized
            with torch.no_grad():
                self.sh_dc.copy_(present)

    def state(self) -> StylizerState:
        """Return a copy of everything that a resumed run needs."""
        first_moment, second_moment = self._optimizer.moments()
        return StylizerState(
            sh_dc=self.sh_dc.detach().cpu().clone(),
            first_moment=first_moment,
            second_moment=second_moment,
            step=self.step,
            seconds=self.seconds,
            generator=self._generator.get_state().clone(),
            queue=list(self._queue),
            history=list(self.history),
            seconds_by_part=dict(self.seconds_by_part),
            memory=self.memory_limit,
            measured=list(self.measured),
        )

    def load_state(self, state: StylizerState) -> None:
        """Resume from the state of a stylizer with the same arguments, and `state.memory` as its memory limit."""
        self._stylized = None
        with torch.no_grad():
            self.sh_dc.copy_(state.sh_dc)
        if state.step:
            self._optimizer.load_moments(state.step, state.first_moment, state.second_moment)
        self.step = state.step
        self.seconds = state.seconds
        self._generator.set_state(state.generator)
        self._queue = list(state.queue)
        self.history = list(state.history)
        own = {name: self.seconds_by_part[name] for name in BEFORE_STEPS if name in self.seconds_by_part}
        earlier = state.seconds_by_part
        self.seconds_by_part = {**earlier, **{name: earlier.get(name, 0.0) + own[name] for name in own}}
        self.measured = list(state.measured)
        self._visited_before = state.step
