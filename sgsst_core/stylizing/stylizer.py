"""The optimizer loop: Adam on the DC colors, coarse phase then SOS, one view a step.

One step at a time; `loop.run` makes them all.
"""

from __future__ import annotations

import math
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any, Self

import psutil
import torch
from torch import Tensor

from sgsst_core.budget import LISTS_BESIDE_WEIGHTS, MEMORY_SHARES, device_peak, forget_device_peak
from sgsst_core.errors import DivergedError
from sgsst_core.features.network_weights import BackboneWeights, load_network_weights
from sgsst_core.loss.feature_scale import weights_for
from sgsst_core.loss.graphs import LossGraphs
from sgsst_core.loss.mixture import StyleMixture
from sgsst_core.loss.regions import Regions
from sgsst_core.loss.scale_weights import ScaleWeights
from sgsst_core.loss.sos import SosLoss, SosResult, ViewTarget
from sgsst_core.parallel.collectives import ALONE, Collectives
from sgsst_core.planning.choices import ends_with_transfer, rasterizer_options
from sgsst_core.planning.plan import Plan
from sgsst_core.planning.planner import make_plan
from sgsst_core.planning.probe import PlanningContext, make_network, sharing_memory
from sgsst_core.rasterizer import Rasterizer, make_rasterizer
from sgsst_core.rasterizer.cached import repeatable
from sgsst_core.rasterizer.coarse import CoarseRasterizer
from sgsst_core.rasterizer.cpu import CpuRasterizer
from sgsst_core.scene.camera import Camera, fit_cameras
from sgsst_core.scene.gaussians import Scene
from sgsst_core.settings import Settings
from sgsst_core.stylizing.ahead import PhotoLoader
from sgsst_core.stylizing.evaluation import (
    Evaluation,
    StyleTargets,
    evaluate,
    evaluation_views,
    mean_evaluation,
    mean_loss,
)
from sgsst_core.stylizing.optimizer import ColorOptimizer, constrained, is_too_large
from sgsst_core.stylizing.refining import refine, refined
from sgsst_core.stylizing.regions import JobStyles, neighbors_change_by_region
from sgsst_core.stylizing.schedule import Phase, drawn_round, drawn_views, phase_at, planned_phases
from sgsst_core.stylizing.state import BEFORE_STEPS, StepRecord, StylizerState
from sgsst_core.stylizing.team import Team
from sgsst_core.stylizing.training_background import Color, drawn_color
from sgsst_core.stylizing.unseen import neighbors_change
from sgsst_core.stylizing.views import Views
from sgsst_core.timing import Timer


class Stylizer:
    """One scene's stylization, step by step, as a plan says.

    Args:
        plan: of this scene, these cameras and settings: from `make_plan`, or of an earlier run of the same job.
        scene: what to stylize; as it was refined, where the plan says so.
        cameras: the views; larger ones are brought down to `settings.max_resolution`.
        style: a picture [H, W, 3] in 0..1, or several with their weights.
        settings: see `Settings`.
        weights: of the feature network.
        photos: content image of a camera by its index, at its (brought down) size; None for unstylized renders.
        collectives: of the ranks that stylize the scene together. Every rank has a stylizer with the same arguments and
            calls the same methods in the same order; `state`, `stylized` and the like, which only read, need no other.
        workshop: what was built to make the plan; None builds it anew.
        regions: of the scene, each with its own style or kept; the plan was made for them. None for one style for all.

    Attributes:
        collectives: of all ranks that take part.
        group: of those that work on the same views as this one.

    Raises:
        RankLeftOut: the job goes on without this rank.
    """

    def __init__(
        self,
        plan: Plan,
        scene: Scene,
        cameras: Sequence[Camera],
        style: Tensor | StyleMixture,
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
        #: What was measured between steps (`loop.Callbacks.measure`): values for JSON, kept through a resume.
        self.measured: list[dict[str, Any]] = []
        #: That the style's statistics have taken, in the steps that needed them first.
        self.style_seconds = 0.0
        #: Views of the latest step.
        self.latest: list[int] = []
        self.weights = weights = weights_for(weights, settings)
        self.photos = photos
        weights_of_views = plan.survey.total_blend_weights
        self.regions = regions = regions and regions.resolved(weights_of_views)
        self.styles = JobStyles.prepared(StyleMixture.of(style), regions, settings, scene.sh_dc, weights_of_views)
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
        #: The partition follows from it, and so does rounding: it is the same on all ranks.
        self.memory_limit = settings.memory_limit or plan.memory_limit
        self.memory = self.memory_limit // sharing_memory(self.collectives, plan.device)
        self.loss = self._loss()
        #: In place of `loss` in steps, where the plan says so.
        self.graphs = LossGraphs(self.loss) if plan.graphs and self.group.size == 1 else None
        self.sh_degree = scene.sh_degree
        #: With its spherical harmonics faded as the settings say.
        self.scene = scene = planning_context.scene if planning_context else scene.attenuated(settings.sh_attenuation)
        seen = scene if plan.seen.all() else scene.subset(plan.seen)
        seen = seen if "sh" in settings.keep else seen.without_zero_bands()
        rasterizer, self._coarse = self._rasterizers(seen, planning_context)
        self.views = self._views(seen, fit_cameras(cameras, settings), rasterizer)
        self._style_targets: dict[tuple[int, int], StyleTargets] = {}
        # Made once: another processor may round it otherwise, and ranks begin with the same bits.
        start = self.collectives.broadcast(self.transferred) if plan.warm_start else seen.sh_dc
        self.sh_dc = start.clone().to(rasterizer.device)
        kept = regions.frozen[plan.seen] if regions else torch.zeros(0, dtype=torch.bool)
        #: Of the Gaussians that are rendered, those that stay as they are; None where none do.
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
        #: Steps before a resume whose views' blend weights are still to be kept.
        self._visited_before = 0
        self.schedule = planned_phases(plan, settings)
        self.total = sum(phase.steps for phase in self.schedule)
        self._process = psutil.Process()
        self._start: Evaluation | None = None
        self._stylized: Tensor | None = None
        self._cost = 0  # pixels of this rank's share of the network in the present step

    @classmethod
    def planned(
        cls,
        scene: Scene,
        cameras: Sequence[Camera],
        style: Tensor | StyleMixture,
        settings: Settings,
        *,
        weights: BackboneWeights | None = None,
        photos: PhotoLoader | None = None,
        rasterizer: str | None = None,
        collectives: Collectives = ALONE,
        regions: Regions | None = None,
    ) -> Self:
        """Plan a job and make its stylizer: see `make_plan` for `weights`, `rasterizer` and what is raised.

        Where the settings refine the scene, the stylizer's is the refined one.
        """
        weights = weights or load_network_weights("auto")
        mixture = StyleMixture.of(style)
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
        """The Gaussians that are rendered in the style's colors, [n, 3] on the CPU: see `warm_start`.

        Args:
            own: [n, 3] on the CPU, what they have; None for the scene's, as before any step.
        """
        seen = self.plan.seen
        own = self.scene.sh_dc[seen] if own is None else own
        weights = self.plan.survey.total_blend_weights[seen]
        found = self.styles.transferred(own, weights, seen, keep_chroma=self._keeps_chroma)
        # Of what no view decides, colors follow from what becomes of the others: see `stylized`.
        return torch.where(self.plan.optimized[seen][:, None], found, own)

    @property
    def transfers_last(self) -> bool:
        """Whether results have the style's colors once more: see `ends_with_transfer`."""
        return ends_with_transfer(self.settings, warm=self.plan.warm_start)

    def _transferred_last(self, optimized: Tensor) -> Tensor:
        """What is written of optimized colors [n, 3]; before the first step they are the style's as they are."""
        if not (self.transfers_last and self.step):
            return optimized
        found = self.transferred(optimized)
        if not self._keeps_chroma:
            return found
        bounded = constrained(found, self.scene.sh_dc[self.plan.seen], bounded=self.settings.bounded)
        return torch.where(found != optimized, bounded, optimized)  # kept ones to the last bit

    @property
    def _keeps_chroma(self) -> bool:
        """Whether colors change in luminance alone."""
        return self.settings.preserve_colors == "luminance"

    def _loss(self) -> SosLoss:
        settings = self.settings
        return SosLoss(
            self.network,
            content_weight=settings.content_weight,
            style_loss=settings.style_loss,
            memory=int(self.memory * MEMORY_SHARES["activations"]),
            coarsest=settings.coarsest_side,
            style_scale=settings.style_scale,
            scales=ScaleWeights(settings.scales),
            leave_out="uncovered" not in settings.keep,
            keep_activations="activations" not in settings.keep,
            timer=self.timer,
            collectives=self.group,
        )

    def _rasterizers(
        self, seen: Scene, planning_context: PlanningContext | None
    ) -> tuple[Rasterizer, CoarseRasterizer | None]:
        """The rasterizer that the plan names, and the one that keeps weights of the coarsest scale for phase 1."""
        plan, settings = self.plan, self.settings
        name = plan.uncached if plan.rasterizer == "cached" else plan.rasterizer
        options = rasterizer_options(name, settings, self.memory)
        whole = planning_context.rasterizer if planning_context else None
        if whole is not None and whole.name == name and plan.seen.all():
            uncached = whole
        elif isinstance(whole, CpuRasterizer) and whole.name == name:
            uncached = whole.of_subset(seen, plan.seen, max_list_bytes=options["max_list_bytes"])
        else:  # what a GPU's prepared for the whole scene names its Gaussians by their place in it
            uncached = make_rasterizer(name, seen, **options)
        if plan.rasterizer != "cached":
            return uncached, None
        budget = int(self.memory * MEMORY_SHARES["rasterizer"])
        share = budget // 4 if plan.coarse_weights else 0
        cached = make_rasterizer(
            "cached",
            seen,
            max_bytes=budget - share,
            least_list_bytes=self._least_list_bytes,
            precision="half" if plan.cached_weights == "half" else "float32",
            at_first_use=False,
            uncached=uncached,
        )
        coarse = None
        if plan.coarse_weights and isinstance(uncached, CpuRasterizer):
            coarse = CoarseRasterizer(uncached, max_bytes=share, at_first_use=False)
        return cached, coarse

    @property
    def _least_list_bytes(self) -> int:
        """For raster lists beside kept weights, of the memory for views."""
        on_cpu = self.plan.rasterizer == "cached" and self.plan.uncached == "cpu"
        return self.memory // LISTS_BESIDE_WEIGHTS if on_cpu else 0

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
            memory=int(self.memory * MEMORY_SHARES["views"]) - self._least_list_bytes,
            keep_content="content" not in settings.keep,
            clamp_aware_gradient=settings.clamp_aware_gradient,
            regions=plan.survey.regions if plan.weighted else None,
            background=settings.background,
            drawn=plan.training_background != "background",
            maps=self.styles.maps(repeatable(rasterizer), plan.seen),
            collectives=self.group,
        )

    @property
    def style(self) -> StyleMixture:
        """The style of what no region says otherwise."""
        return self.styles.own

    @property
    def phase(self) -> Phase:
        """The phase that the next step belongs to; the last one when all steps are done."""
        return phase_at(self.schedule, self.step)

    def share_done(self) -> float:
        """How much of the schedule is done, 0 to 1: what the learning rate follows."""
        return self.step / max(self.total - 1, 1)

    @property
    def stops_early(self) -> bool:
        """Whether the run ends when its losses have stopped falling, which must be of the same surround for that."""
        return self.settings.early_stop and self.plan.training_background == "background"

    @property
    def round_length(self) -> int:
        """Steps in which every view comes once."""
        return math.ceil(len(self.views.covered) / self.settings.views_per_step)

    def scale_count(self, index: int) -> int:
        """n_s of a view."""
        camera = self.views.cameras[index]
        return self.loss.scale_count(camera.height, camera.width)

    def scales(self, index: int) -> list[int]:
        """The scales of a view that count, the finest first."""
        camera = self.views.cameras[index]
        return self.loss.scales(camera.height, camera.width)

    @property
    def evaluation_views(self) -> list[int]:
        """Indices of the plan's `loss_views`, evenly spread over those that see anything."""
        return evaluation_views(self.views.covered, self.plan.loss_views)

    def start(self) -> Evaluation:
        """Loss of the unstylized scene on the evaluation views; taken once, whenever it is first asked for."""
        if self._start is None:
            with self.measuring():
                self._start = self.evaluate(self.evaluation_views, self.views.scene.sh_dc)
        return self._start

    @contextmanager
    def measuring(self) -> Iterator[None]:
        """Count seconds as those of measuring, beside the steps."""
        started, parts = time.perf_counter(), self.seconds_by_part
        yield
        parts["measuring"] = parts.get("measuring", 0.0) + time.perf_counter() - started

    def behind(self, index: int) -> Color | None:
        """The color behind a view in the next step; None for the background of the settings."""
        return drawn_color(self.plan.training_background, self.settings.seed, self.step, index, self.style)

    def style_targets(self, camera: Camera) -> StyleTargets:
        """The style's statistics for views of the camera's size."""
        size = (camera.height, camera.width)
        if size not in self._style_targets:
            started = time.perf_counter()
            self._style_targets[size] = self._styles.targets(self.loss, size)
            self.style_seconds += time.perf_counter() - started
        return self._style_targets[size]

    def run_step(self) -> StepRecord:
        """One iteration.

        Raises:
            DivergedError: the gradient has left the range of float32; the colors are those before the step.
        """
        started = time.perf_counter()
        self._stylized = None
        self.timer.clear()
        self._keep_visited()
        sent = dict(self.collectives.sent)
        phase = self.phase
        if phase.scale is None:
            self._coarse = None  # phase 1 is over
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
        """dE/dsh_dc [n, 3], mean over some views, and what was found of those that this group of ranks took."""
        gradient: Tensor | None = None
        results = []
        self._cost = 0
        own_views = views[self._team.own_group :: self._team.groups]
        for place, index in enumerate(own_views):
            scales = phase.scales(self.scales(index))
            behind = self.behind(index)
            with self.timer("prepare", whole=True):
                self.keep_weights(index, scales)
                target = self.views.target(index, scales, behind)
                self._look_ahead(own_views[place + 1 :], phase)
                style = self.style_targets(self.views.cameras[index])
            assert target.share is not None
            self._cost += target.share.cost(self.group.rank, self.network.halo)
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
            gradient = gradient.masked_fill(self._kept, 0)  # Adam leaves colors of no gradient as they are
        return gradient, results

    def _read(self, largest: Tensor, results: Sequence[SosResult]) -> Evaluation:
        """Wait for the device, once in a step: loss of each scale, mean over all views of the step.

        Args:
            largest: magnitude in the gradient.
            results: of this group's views.

        Raises:
            DivergedError: that magnitude was too large for a step to be made.
        """
        # The rasterizer, and with it the colors, may be on the CPU while the network is on a GPU.
        first = largest.double()[None].to(self.network.device)
        numbers = torch.cat([first, *(result.values.flatten() for result in results)]).tolist()
        if is_too_large(numbers[0]):
            raise self._diverged(numbers[0])
        evaluations, place = [], 1
        for result in results:
            count = result.values.numel()
            evaluations.append(result.terms_from(numbers[place : place + count]))
            place += count
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
        """Once in the phase on all scales, share the work out in proportion to the speeds that ranks have shown."""
        speeds = self._team.compare_speeds(self._cost, self.timer.seconds)
        if speeds:
            self.loss.speeds = speeds
            self.views.uncached_fraction()

    def _next_view(self) -> int:
        """Random views without replacement: every view once before any comes again."""
        if not self._queue:
            self._queue = drawn_round(self.views.covered, self._generator)
        return self._queue.pop()

    def _look_ahead(self, left: Sequence[int], phase: Phase) -> None:
        """Name the view that this group takes next, so that what it needs can be read while the device works.

        The queue is looked at, not filled: the order of views is drawn when it is needed, as checkpoints expect.

        Args:
            left: this group's views that are left in the present step.
            phase: of the present step.
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
        """Views left in this round, the next one first."""
        return self._queue[::-1]

    def evaluate(self, indices: Sequence[int], sh_dc: Tensor | None = None) -> Evaluation:
        """Mean SOS loss over views, split by scale; changes nothing, its time does not count.

        Args:
            sh_dc: [n, 3], colors to evaluate in place of the present ones of the n optimized Gaussians.
        """
        self._keep_visited()
        values = (self.sh_dc.detach() if sh_dc is None else sh_dc).to(self.sh_dc.device)
        return evaluate(self.views, self.style_targets, indices, values)

    def gradient(self, index: int, scales: Sequence[int]) -> tuple[Tensor, float]:
        """dE/dsh_dc [n, 3] of the n optimized Gaussians on the CPU, as a step computes it, and its seconds.

        Targets are prepared before the clock starts. Changes nothing.
        """
        self._keep_visited()
        target, style = self.views.target(index, scales), self.style_targets(self.views.cameras[index])
        with self.views.lending_weights(index, self._rasterizer_for(scales)):
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
        """dE/dsh_dc [n, 3] of one view with a color behind it (None: the settings' background), and the loss."""
        rasterizer = self._rasterizer_for(scales)
        with self.timer("render"), torch.no_grad():
            colors = self.views.colors(index, self.sh_dc.detach())
            image = self.views.render(index, colors, rasterizer)
            if behind is not None:
                image = self.views.put_behind(index, image, behind, rasterizer.scale)
        with self.timer("loss"):
            evaluate = self.graphs.evaluate if self.graphs is not None else self.loss.evaluate
            result = evaluate(image, style, target, scales, image_scale=rasterizer.scale)
        with self.timer("raster_backward"):
            assert result.image_gradient is not None
            return self.views.gradient(index, result.image_gradient.to(colors.device), colors, rasterizer), result

    def keep_weights(self, index: int, scales: Sequence[int]) -> None:
        """Keep a view's blend weights for some scales, as its first step does, where they fit.

        Only steps do: what is rendered in between, which depends on the clock, changes none of their bits.
        """
        self.views.keep_weights(index, self._rasterizer_for(scales))

    def _keep_visited(self) -> None:
        """Once after a resume: keep what the steps before it kept, in their order, so that the same views fit."""
        steps, self._visited_before = self._visited_before, 0
        if not steps:
            return
        order = drawn_views(self.views.covered, self.settings.seed)
        with self.timer("prepare"):
            for step in range(steps):
                views = [next(order) for _ in range(self.settings.views_per_step)]
                phase = phase_at(self.schedule, step)
                for index in views[self._team.own_group :: self._team.groups]:
                    scales = phase.scales(self.scales(index))
                    if self.phase.scale is not None or not self._rasterizer_for(scales).scale:
                        self.keep_weights(index, scales)  # those of a phase that is over are not needed

    def _rasterizer_for(self, scales: Sequence[int]) -> Rasterizer:
        """What renders a view for some scales: at the one coarse scale alone, where its weights are kept."""
        if self._coarse is not None and len(scales) == 1 and scales[0] > 0:
            return self._coarse.at(scales[0])
        return self.views.rasterizer

    def stylized(self) -> Tensor:
        """sh_dc [N, 3] float32 of the whole scene, on the CPU: the optimized colors, and those of unseen Gaussians.

        They are what a job that ends now writes, so with the last transfer, where there is one. Kept until the colors
        change, because the neighbors of millions of unseen Gaussians take seconds to find: it must not be written to.
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
        """sh_dc [n, 3] of the Gaussians that are rendered, on the rasterizer's device, as a job that ends now has them.

        Unlike `sh_dc`, which steps go on from, they have the last transfer, where there is one.
        """
        if not self.transfers_last:
            return self.sh_dc.detach()
        return self.stylized()[self.plan.seen].to(self.sh_dc.device)

    def set_colors(self, sh_dc: Tensor) -> None:
        """Put the colors [N, 3] of the whole scene in place of the present ones, to evaluate them on these views."""
        self._stylized = None
        with torch.no_grad():
            self.sh_dc.copy_(sh_dc[self.plan.seen])

    @contextmanager
    def with_colors(self, sh_dc: Tensor) -> Iterator[None]:
        """Have the colors [N, 3] of the whole scene for a while; the present ones come back, bit for bit."""
        present, stylized = self.sh_dc.detach().clone(), self._stylized
        self.set_colors(sh_dc)
        try:
            yield
        finally:
            self._stylized = stylized
            with torch.no_grad():
                self.sh_dc.copy_(present)

    def state(self) -> StylizerState:
        """A copy of all that a resumed run needs."""
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
        """Go on from a state of a stylizer with the same arguments, and state.memory as its memory limit."""
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
