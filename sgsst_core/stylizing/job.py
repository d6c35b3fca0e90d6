"""Immutable context of a stylization: plan and settings of a job, and the objects that are prepared from its inputs."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, TypeVar

import torch
from torch import Tensor

from sgsst_core.budget import Cache, forget_device_peak, least_intersection_memory, measuring_memory, memory_for
from sgsst_core.decision import Decision
from sgsst_core.errors import DeviceMemoryError
from sgsst_core.features.network_weights import BackboneWeights
from sgsst_core.features.vgg import FeatureNetwork
from sgsst_core.loss.feature_scale import weights_for
from sgsst_core.loss.graphs import LossGraphs
from sgsst_core.loss.scale_weights import band_count
from sgsst_core.loss.sos import SosLoss, SosResult, make_loss
from sgsst_core.loss.targets import StyleTargets, ViewTarget
from sgsst_core.parallel.collectives import ALONE, Collectives
from sgsst_core.parallel.division import Size
from sgsst_core.planning.choices import ends_with_transfer
from sgsst_core.planning.facts import PlanningContext, make_network, sharing_memory
from sgsst_core.planning.plan import Plan
from sgsst_core.rasterizer import Rasterizer, make_rasterizer
from sgsst_core.rasterizer.base import Color
from sgsst_core.rasterizer.cached import CachedRasterizer
from sgsst_core.regions.definition import Regions
from sgsst_core.regions.maps import mean_level
from sgsst_core.scene.camera import Camera, fit_cameras, spread
from sgsst_core.scene.gaussians import Scene
from sgsst_core.settings import Settings
from sgsst_core.style import Style
from sgsst_core.stylizing.job_styles import JobStyles
from sgsst_core.stylizing.photo_prefetch import PhotoLoader
from sgsst_core.stylizing.schedule import Phase
from sgsst_core.stylizing.team import Team
from sgsst_core.stylizing.view_targets import ViewTargets
from sgsst_core.stylizing.views import Views
from sgsst_core.timing import Timer

T = TypeVar("T")


class StyleTargetCache:
    """Targets of the job's styles by view size, computed when a view first needs them.

    Args:
        styles: Styles of the job, on the network's device.

    Attributes:
        seconds: Time in seconds spent on computing targets.
    """

    def __init__(self, styles: JobStyles, loss: SosLoss) -> None:
        self.seconds = 0.0
        self._styles = styles
        self._loss = loss
        self._targets: dict[Size, StyleTargets] = {}

    def __call__(self, camera: Camera) -> StyleTargets:
        """Return the targets for views of the camera's size."""
        size = (camera.height, camera.width)
        if size not in self._targets:
            started = time.perf_counter()
            self._targets[size] = self._styles.targets(self._loss, size)
            self.seconds += time.perf_counter() - started
        return self._targets[size]

    def clear(self) -> None:
        """Clear the cache."""
        self._targets.clear()


@dataclass(frozen=True)
class StylizationJob:
    """Context of a stylization, which steps only read; `prepare_job` creates it.

    Attributes:
        scene: Scene with the SH attenuation of the settings applied.
        sh_degree: SH degree of the scene before the attenuation.
        graphs: Replacement for `loss` in steps; None if the plan uses no graphs.
        view_targets: Targets of the views, except the style's.
        memory_limit: Memory budget in bytes of all ranks on one machine together. It determines the partition, and
            thereby rounding, so it is identical on all ranks.
        survey_seconds: About the seconds of the rasterizer's pass over a view; 0 if unknown.
    """

    plan: Plan
    settings: Settings
    scene: Scene
    sh_degree: int
    styles: JobStyles
    weights: BackboneWeights
    network: FeatureNetwork
    loss: SosLoss
    graphs: LossGraphs | None
    views: Views
    view_targets: ViewTargets
    team: Team
    memory_limit: int
    memory: int
    style_targets: StyleTargetCache
    survey_seconds: float = 0.0

    @property
    def style(self) -> Style:
        """Style of all Gaussians that are not in a region with its own style."""
        return self.styles.own

    @property
    def regions(self) -> Regions | None:
        """Regions with their own style, or frozen; None for one style everywhere."""
        return self.styles.regions

    @property
    def collectives(self) -> Collectives:
        """All ranks that take part."""
        return self.team.everybody

    @property
    def group(self) -> Collectives:
        """Ranks that process the same views as this one."""
        return self.team.group

    @property
    def timer(self) -> Timer:
        """Timer of the activities of a step."""
        return self.loss.timer

    @property
    def schedule(self) -> list[Phase]:
        """The two phases of every preset."""
        return [Phase("coarse", self.plan.steps_coarse, 0), Phase("sos", self.settings.steps_sos)]

    @property
    def total_steps(self) -> int:
        """Number of steps of all phases."""
        return sum(phase.steps for phase in self.schedule)

    @property
    def round_length(self) -> int:
        """Number of steps in which every view is visited once."""
        return math.ceil(len(self.views.covered) / self.settings.views_per_step)

    @property
    def evaluation_views(self) -> list[int]:
        """Indices of the plan's `loss_views`, evenly spread over the views that see anything.

        The contact sheet shows the same views.
        """
        return spread(self.views.covered, self.plan.loss_views)

    @property
    def transfers_last(self) -> bool:
        """Whether the style's colors are transferred to results once more: see `ends_with_transfer`."""
        return ends_with_transfer(self.settings, warm=self.plan.warm_start)

    @property
    def preserves_chroma(self) -> bool:
        """Whether only luminance changes."""
        return self.settings.preserve_colors == "luminance"

    @property
    def caches(self) -> dict[str, Cache[Any, Any]]:
        """Caches of data of the views by name, "weights" before "intersections"."""
        return {**self.views.caches, **self.view_targets.caches}

    def gradient(
        self,
        index: int,
        sh_dc: Tensor,
        style: StyleTargets,
        target: ViewTarget,
        scales: Sequence[int] | Mapping[int, float],
        background: Color | None = None,
    ) -> tuple[Tensor, SosResult]:
        """Return dE/dsh_dc [n, 3] of one view for colors [n, 3], and the loss.

        Args:
            sh_dc: Colors of the rendered Gaussians.
            scales: Scales to evaluate; a mapping gives their weights (`SosLoss.evaluate`).
            background: Background color; None for that of the settings.
        """
        with self.timer("render"), torch.no_grad():
            colors = self.views.colors(index, sh_dc)
            image = self.views.render(index, colors)
            if background is not None:
                image = self.view_targets.replace_background(index, image, background)
        with self.timer("loss"):
            evaluate = self.graphs.evaluate if self.graphs is not None else self.loss.evaluate
            result = evaluate(image, style, target, scales)
        with self.timer("raster_backward"):
            assert result.image_gradient is not None
            return self.views.gradient(index, result.image_gradient.to(colors.device), colors), result

    def scales(self, index: int) -> list[int]:
        """Return the scales of a view with a positive weight, finest first."""
        camera = self.views.cameras[index]
        return self.loss.tiling.scales((camera.height, camera.width))


def prepare_job(
    plan: Plan,
    scene: Scene,
    cameras: Sequence[Camera],
    style: Style,
    settings: Settings,
    *,
    weights: BackboneWeights,
    photos: PhotoLoader | None = None,
    collectives: Collectives = ALONE,
    planning_context: PlanningContext | None = None,
    regions: Regions | None = None,
) -> StylizationJob:
    """Prepare a planned job. Every rank calls this with the same arguments.

    Args:
        plan: Plan for this scene, these cameras and settings, such as that of an earlier run of the same job.
        scene: Scene to stylize, refined if the plan says so.
        cameras: Cameras of the views; larger ones are reduced to `settings.max_resolution`.
        photos: Function that loads the content image of a camera by its index, at the (reduced) size of the view; None
            for unstylized renders.
        planning_context: Planning context of the plan; None to create its objects again.
        regions: Regions for which the plan was made, each with its own style or frozen; None for one style everywhere.
    """
    weights = weights_for(weights, settings)
    attenuated = planning_context.scene if planning_context else scene.attenuated(settings.sh_attenuation)
    fitted = fit_cameras(cameras, settings)
    styles = _job_styles(plan, scene, fitted, style, settings, regions)
    forget_device_peak(plan.device)
    network = (
        planning_context.network(plan.precision)
        if planning_context
        else make_network(weights, settings, plan.precision, plan.device)
    )
    team = Team(settings, collectives)
    memory_limit = settings.memory_limit or plan.memory_limit
    memory = memory_limit // sharing_memory(team.everybody, plan.device)
    loss = make_loss(
        network,
        settings,
        memory_for("activations", memory),
        content_weight=styles.content_weight,
        timer=Timer(plan.device),
        collectives=team.group,
    )
    rendered = attenuated if plan.seen.all() else attenuated.subset(plan.seen)
    rendered = rendered.without_zero_bands()
    rasterizer = _make_rasterizer(plan, settings, rendered, memory, planning_context)
    if team.group.size > 1:  # the survey's tile intersections are those of whole views
        rasterizer.forget_views()
    views = Views(
        rendered,
        fitted,
        rasterizer,
        covered=list(plan.covered),
        memory=view_memory(plan, memory),
        clamp_aware_gradient=settings.clamp_aware_gradient,
        regions=plan.survey.regions if plan.weighted else None,
        divider=loss.divider,
        timer=loss.timer,
    )
    if plan.spare:
        views.caches["intersections"].limit(memory_for("rasterizer", memory) + plan.spare // 2)
    repeatable = rasterizer.repeatable
    view_targets = ViewTargets(
        views,
        loss,
        weighted=plan.weighted,
        photos=photos,
        memory=view_memory(plan, memory),
        regions=plan.survey.regions if plan.weighted else None,
        background=settings.background,
        drawn=plan.training_background != "background",
        maps=styles.maps(repeatable, plan.seen),
        content_maps=styles.content_maps(repeatable, plan.seen),
    )
    return StylizationJob(
        plan=plan,
        settings=settings,
        scene=attenuated,
        sh_degree=scene.sh_degree,
        styles=styles,
        weights=weights,
        network=network,
        loss=loss,
        graphs=LossGraphs(loss) if plan.graphs and team.group.size == 1 else None,
        views=views,
        view_targets=view_targets,
        team=team,
        memory_limit=memory_limit,
        memory=memory,
        style_targets=StyleTargetCache(styles.to(network.device), loss),
    )


def in_bfloat16(job: StylizationJob, step: int) -> StylizationJob:
    """Return a job whose network continues in bfloat16 from a step in which float16 has overflowed."""
    network = make_network(job.weights, job.settings, "bfloat16", job.plan.device)
    job.loss.use(network)
    job.view_targets.forget_division()
    job.style_targets.clear()
    if job.graphs is not None:
        job.graphs.clear()
    line = Decision("precision", f"features in bfloat16 from step {step} on", "float16 has overflowed")
    plan = replace(job.plan, precision="bfloat16", decisions=(*job.plan.decisions, line))
    return replace(job, network=network, plan=plan)


def _job_styles(
    plan: Plan,
    scene: Scene,
    cameras: Sequence[Camera],
    style: Style,
    settings: Settings,
    regions: Regions | None,
) -> JobStyles:
    """Return the styles of a job, in depth bands if the settings say so."""
    blend_weights = plan.survey.total_blend_weights
    regions = regions and regions.resolved(blend_weights)
    styles = JobStyles.prepared(style, regions, settings, scene.sh_dc, blend_weights)
    if not settings.stroke_depth:
        return styles
    level = mean_level(scene.means, blend_weights, [cameras[index] for index in plan.covered], settings.near)
    return replace(styles, bands=band_count(cameras, settings), mean_level=level)


def _make_rasterizer(
    plan: Plan, settings: Settings, rendered: Scene, memory: int, planning_context: PlanningContext | None
) -> Rasterizer:
    """Return the plan's rasterizer of the rendered Gaussians."""
    budget = memory_for("rasterizer", memory)
    whole = planning_context.rasterizer if planning_context else None
    if whole is None:
        uncached = make_rasterizer(
            plan.uncached, rendered, background=settings.background, near=settings.near, memory=budget
        )
    elif plan.seen.all():
        uncached = whole
    else:
        uncached = whole.for_subset(rendered, plan.seen, budget)
    if plan.cached_weights == "none":
        return uncached
    return CachedRasterizer(
        rendered,
        max_bytes=budget,
        min_intersection_bytes=least_intersection_memory(memory),
        precision="half" if plan.cached_weights == "half" else "float32",
        at_first_use=False,
        uncached=uncached,
    )


def view_memory(plan: Plan, memory: int) -> int:
    """Return the budget in bytes for data of the views: what other caches leave of it, and half of `Plan.spare`."""
    left = memory_for("views", memory) + plan.spare // 2
    if plan.cached_weights != "none":
        left -= least_intersection_memory(memory)
    if plan.measured:
        left -= (2 if plan.is_approximated else 1) * measuring_memory(memory)
    return left


def with_second_attempt(job: StylizationJob, work: Callable[[], T]) -> T:
    """Return the result of a function, which is called again if the GPU runs out of memory.

    Before that, caches are cleared, and the memory budget for activations is halved for the rest of the job. Results
    then differ by rounding. Several ranks make no second attempt, because the others wait for messages of the first.

    Raises:
        DeviceMemoryError: If the memory is still not enough.
    """
    try:
        return work()
    except torch.OutOfMemoryError:
        if job.collectives.size > 1:
            raise _not_enough(job, "") from None
    # Outside of the handler, because the exception refers to the tensors of the first attempt.
    job.loss.halve_memory(max(camera.height * camera.width for camera in job.views.cameras))
    job.view_targets.forget_division()
    if job.graphs is not None:
        job.graphs.clear()
    torch.cuda.empty_cache()
    try:
        return work()
    except torch.OutOfMemoryError:
        raise _not_enough(job, ", not even with half of the activations in memory") from None


def _not_enough(job: StylizationJob, attempt: str) -> DeviceMemoryError:
    free, total = torch.cuda.mem_get_info(job.network.device)
    return DeviceMemoryError(
        f"The GPU's memory ({total / 1e9:.1f} GB, {free / 1e9:.1f} GB free) is not enough for a step{attempt}. Stop "
        f"other programs on this GPU, or give a smaller --memory-limit than {job.memory_limit / 1e9:.1f} GB or a "
        "smaller --resolution (`max_resolution` in Python)."
    )
