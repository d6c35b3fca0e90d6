"""Context of a stylization: inputs of a job, its plan, the objects made from both, and an estimate of its time.

`plan_job` surveys all views, makes the plan and prepares what it describes. Estimates and time budgets use the rate of
the feature network on this machine, in pixels per second, which earlier jobs leave behind. It belongs to a device, a
precision, a network and a style loss, and to a size of steps, because a GPU is slower at small ones.
"""

import json
import math
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Literal, TypeVar

import numpy as np
import torch
from torch import Tensor

from sgsst_core.budget import forget_device_peak, memory_for
from sgsst_core.devices import Timer, wait_for
from sgsst_core.errors import CameraError, DeviceMemoryError, OutputError
from sgsst_core.features.network_weights import BackboneWeights
from sgsst_core.features.vgg import FeatureNetwork, weights_for
from sgsst_core.features.weight_files import cache_folder
from sgsst_core.files.atomic import write_json
from sgsst_core.loss.graphs import LossGraphs
from sgsst_core.loss.sos import SosLoss, SosResult, make_loss
from sgsst_core.loss.terms import StyleTargets, ViewTarget
from sgsst_core.orbit import Orbit, orbit_decisions
from sgsst_core.parallel import ALONE, Collectives, Team
from sgsst_core.planning.plan import (
    Facts,
    Plan,
    PlanningContext,
    check_scales,
    choose_precision,
    count_intersections,
    count_weights,
    ends_with_transfer,
    equip,
    is_weighted,
    make_network,
    make_plan,
    sharing_memory,
    with_groups,
)
from sgsst_core.planning.survey import ShowPlanning, Survey, survey_views
from sgsst_core.planning.time_budget import Pace, SecondsLeft, TimeChoice, choosable, choose, ending_seconds
from sgsst_core.progress import ANOTHER_LOSS, Decision
from sgsst_core.rasterizer import Rasterizer, make_rasterizer
from sgsst_core.rasterizer.base import Color
from sgsst_core.rasterizer.triton import CachedRasterizer
from sgsst_core.refine import Refinement, refine_decision
from sgsst_core.regions import Regions, region_decisions
from sgsst_core.scene.camera import Camera, fit_cameras, resized, spread
from sgsst_core.scene.colors import color_subspace_of
from sgsst_core.scene.gaussians import Scene
from sgsst_core.scene.spherical_harmonics import harmonics_energy
from sgsst_core.settings import PlannedPrecision, Settings
from sgsst_core.style import Style
from sgsst_core.stylizing.styles import JobStyles
from sgsst_core.stylizing.views import PhotoLoader, Views, ViewTargets

T = TypeVar("T")


@dataclass(frozen=True)
class JobInputs:
    """Inputs of a job, the same on every rank.

    Attributes:
        scene: Scene to stylize, after refinement if there was one.
        cameras: Cameras of the views; larger ones are reduced to `settings.max_resolution`.
        weights: Weights of the feature network.
        photos: Function that loads the content image of a camera by its index, at the (reduced) size of the view; None
            for unstylized renders.
        regions: Regions of the scene, each with its own style or frozen; None for one style everywhere.
        rasterizer: Rasterizer that computes blend weights: "cpu" or "triton". None to choose one.
        measured: Whether quality is measured and a report is written, as in `sgsst stylize`.
        orbit: Orbit that produced the cameras, for the plan to report; None for cameras from files.
        about_inputs: Decisions about cameras and photos that start the plan.
        refinement: Refinement that produced the scene, for the plan to report; None if it was not refined.
        chosen: Choice of the time budget, to which `cameras` and `photos` belong (`choose_within`); None without one.

    Raises:
        CameraError: If there are no cameras.
    """

    scene: Scene
    cameras: Sequence[Camera]
    style: Style
    settings: Settings
    weights: BackboneWeights
    photos: PhotoLoader | None = None
    regions: Regions | None = None
    rasterizer: str | None = None
    measured: bool = False
    orbit: Orbit | None = None
    about_inputs: Sequence[Decision] = ()
    refinement: Refinement | None = None
    chosen: TimeChoice | None = None

    def __post_init__(self) -> None:
        if not self.cameras:
            raise CameraError("There are no cameras. Give a camera file, or use --orbit.")

    def refined(self, refinement: Refinement | None, scene: Scene | None = None) -> "JobInputs":
        """Return the inputs with their scene refined, unless `scene` is the refined scene."""
        if refinement is None:
            return self
        regions = self.regions and self.regions.refined(refinement)
        return replace(self, scene=scene or refinement.of(self.scene), regions=regions, refinement=refinement)


@dataclass(frozen=True)
class Phase:
    """Phase of the schedule.

    Attributes:
        stage: Name of the phase: "coarse" (phase 1, on the coarsest scale with a weight) or "sos" (phase 2, on all).
    """

    stage: Literal["coarse", "sos"]
    steps: int

    def scales(self, chosen: Sequence[int]) -> list[int]:
        """Return the scales to optimize, given a view's scales with a positive weight (`chosen`), finest first."""
        return list(chosen if self.stage == "sos" else chosen[-1:])


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
        survey_seconds: Seconds of the rasterizer's pass over a view, mean; 0 if unknown.
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
    style_targets: Callable[[Camera], StyleTargets]
    survey_seconds: float = 0.0

    @property
    def collectives(self) -> Collectives:
        """All ranks that take part."""
        return self.team.everybody

    @property
    def schedule(self) -> list[Phase]:
        """The two phases of every preset."""
        return [Phase("coarse", self.plan.steps_coarse), Phase("sos", self.settings.steps_sos)]

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
        with self.loss.timer("render"), torch.no_grad():
            colors = self.views.colors(index, sh_dc)
            image = self.views.render(index, colors)
            if background is not None:
                image = self.view_targets.replace_background(index, image, background)
        with self.loss.timer("loss"):
            evaluate = self.graphs.evaluate if self.graphs is not None else self.loss.evaluate
            result = evaluate(image, style, target, scales)
        with self.loss.timer("raster_backward"):
            assert result.image_gradient is not None
            return self.views.gradient(index, result.image_gradient.to(colors.device), colors), result

    def scales(self, index: int) -> list[int]:
        """Return the scales of a view with a positive weight, finest first."""
        camera = self.views.cameras[index]
        return self.loss.tiling.scales((camera.height, camera.width))


# --- planning ------------------------------------------------------------------------------------------------------

#: Longer side in pixels of the views that a time budget is chosen from, and their number.
_SMALL_SIDE, _SMALL_VIEWS = 256, 4


def plan_job(
    inputs: JobInputs,
    *,
    collectives: Collectives = ALONE,
    plan: Plan | None = None,
    survey: Survey | None = None,
    groups: int | None = None,
    show: ShowPlanning | None = None,
    timer: Timer | None = None,
) -> StylizationJob:
    """Plan and prepare a job. Every rank must call this with the same arguments, and gets the same plan.

    Args:
        plan: Plan from an earlier run of the same job, which is used unchanged; None to make one.
        survey: Survey from an earlier plan of the same job; None to survey the views.
        groups: `Plan.groups` of an earlier plan of the same job; None to choose them.
        show: Callback for the progress of the survey.
        timer: Timer that records the survey as "survey", other planning as "planning", and the preparation of the job
            as "preparing".

    Raises:
        CameraError: If no camera sees a Gaussian.
        SettingsError: If regions freeze everything visible, views lack requested scales, or the rasterizer or the
            precision does not work here.
    """
    timer, chosen, context = timer or Timer(), inputs.chosen, None
    settings = chosen.applied(inputs.settings) if chosen else inputs.settings
    if plan is None:
        with timer("planning"):
            fitted = fit_cameras(inputs.cameras, settings)
            check_scales(settings.scales, fitted, settings.coarsest_side)
            weights = weights_for(inputs.weights, settings)
            context = equip(inputs.scene, fitted, settings, weights, collectives, inputs.rasterizer)
            if survey is None:
                with timer("survey"):
                    survey = survey_views(context.scene, fitted, context.rasterizer, collectives, show)
            about = [*_about_inputs(inputs, settings, survey, fitted)]
            facts = collectives.broadcast(lambda: _facts(context, survey, inputs))
            plan = make_plan(facts, settings, groups=groups, measured=inputs.measured, about=about)
            plan = replace(plan, refinement=inputs.refinement, time_choice=chosen)
    if chosen and not plan.steps_coarse:  # so that the learning rate falls alike for any number of steps
        settings = settings.with_steps(0, settings.steps_sos)
    with timer("preparing"):
        inputs = replace(inputs, settings=with_groups(settings, plan.groups))
        job = prepare_job(plan, inputs, collectives=collectives, planning_context=context)
    surveyed = timer.seconds.get("survey", 0.0) * collectives.size
    return replace(job, survey_seconds=surveyed / len(inputs.cameras))


def choose_within(inputs: JobInputs, left: SecondsLeft, collectives: Collectives = ALONE) -> TimeChoice | None:
    """Choose what fits a time budget, from a survey of a few small views. Every rank must call this function.

    Args:
        left: Seconds left of the budget.

    Returns:
        The choice; None if the settings give everything.
    """
    settings = inputs.settings
    if not choosable(settings):
        return None
    fitted, weights = fit_cameras(inputs.cameras, settings), weights_for(inputs.weights, settings)
    small = [resized(each, min(_SMALL_SIDE, each.side)) for each in spread(fitted, _SMALL_VIEWS)]
    context = equip(inputs.scene, small, settings, weights, collectives, inputs.rasterizer)
    precision, ranks = choose_precision(settings, context.machine), collectives.size

    def choice() -> TimeChoice:
        rates = Rates(context.network(precision), precision, settings)
        context.rasterizer.survey(small[0])  # the first pass starts libraries and compiles kernels
        context.rasterizer.forget_views()
        started = time.perf_counter()
        survey = survey_views(context.scene, small, context.rasterizer)
        seconds = (time.perf_counter() - started) / len(small)
        areas = [camera.width * camera.height for camera in small]
        weighted = is_weighted(survey, settings)
        passed = [survey.regions[index].pixels if weighted else areas[index] for index in survey.covered]
        portion = sum(passed) / sum(areas[index] for index in survey.covered)
        pace = Pace(lambda pixels: ranks * rates.rate(pixels / ranks), seconds, sum(areas) / len(areas), portion)
        return choose(fitted, settings, pace, left(), len(inputs.scene))

    return collectives.broadcast(choice)


def _facts(context: PlanningContext, survey: Survey, inputs: JobInputs) -> Facts:
    """Gather the facts on which the plan depends; one rank does this for all."""
    scene, settings, machine = context.scene, context.settings, context.machine
    views = [context.cameras[index] for index in survey.covered]
    precision = choose_precision(settings, machine)
    network = context.network(precision)
    return Facts(
        gaussians=len(scene),
        sh_degree=inputs.scene.sh_degree,
        used_degree=scene.used_degree(survey.total_blend_weights > 0),
        harmonics_energy=harmonics_energy(scene, survey.total_blend_weights),
        sizes=tuple((camera.height, camera.width) for camera in context.cameras),
        survey=survey,
        machine=machine,
        rasterizer=context.rasterizer.name,
        precision=precision,
        tiling=make_loss(network, settings, memory_for("activations", machine.memory)).tiling,
        pixel_bytes=network.held_bytes_per_pixel(),
        weight_bytes=count_weights(context.rasterizer, views),
        intersection_bytes=count_intersections(context.rasterizer, len(views)),
        frozen=inputs.regions.resolved(survey.total_blend_weights).frozen if inputs.regions else None,
    )


def _about_inputs(
    inputs: JobInputs, settings: Settings, survey: Survey, fitted: Sequence[Camera]
) -> Iterator[Decision]:
    """Yield the decisions about the inputs: cameras, time budget, refinement, orbit, regions and styles."""
    yield from inputs.about_inputs
    if inputs.chosen:
        yield inputs.chosen.decision(inputs.settings.within, settings.steps_coarse + settings.steps_sos)
    if inputs.refinement is not None:
        yield refine_decision(inputs.refinement, settings)
    if inputs.orbit is not None:
        yield from orbit_decisions(inputs.orbit, len(fitted))
    style, regions = inputs.style, inputs.regions
    if regions is not None:
        yield from region_decisions(regions, survey.total_blend_weights)
    own = [region.style for region in regions.every if region.style] if regions else []
    for each in (style, *own):
        yield from (Decision("style", "warning", note) for note in each.notes)
    if subspace := color_subspace_of((style, *own), settings):
        form = "a plane" if subspace.dimensions == 2 else "a line"
        reason = f"the style's colors differ from it by {255 * subspace.deviation:.1f} of 255 levels"
        yield Decision("color subspace", f"colors stay on {form} in RGB", reason, error=ANOTHER_LOSS)
    if len(style.images) > 1:
        given = f"{len(style.images)} images were given"
        yield Decision("styles", f"a mixture: {style.text}", given, error=ANOTHER_LOSS)


# --- preparation ---------------------------------------------------------------------------------------------------


def prepare_job(
    plan: Plan,
    inputs: JobInputs,
    *,
    collectives: Collectives = ALONE,
    planning_context: PlanningContext | None = None,
) -> StylizationJob:
    """Prepare a planned job. Every rank calls this with the same arguments.

    Args:
        plan: Plan for these inputs, such as that of an earlier run of the same job.
        planning_context: Planning context of the plan; None to create its objects again.
    """
    scene, settings = inputs.scene, inputs.settings
    weights = weights_for(inputs.weights, settings)
    attenuated = planning_context.scene if planning_context else scene.attenuated(settings.sh_attenuation)
    fitted = fit_cameras(inputs.cameras, settings)
    blend_weights = plan.survey.total_blend_weights
    regions = inputs.regions and inputs.regions.resolved(blend_weights)
    styles = JobStyles.prepared(inputs.style, regions, settings, scene.sh_dc, blend_weights)
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
        rasterizer.caches["intersections"].limit(memory_for("rasterizer", memory) + plan.spare // 2)
    view_targets = ViewTargets(
        views,
        loss,
        weighted=plan.weighted,
        photos=inputs.photos,
        memory=view_memory(plan, memory),
        regions=plan.survey.regions if plan.weighted else None,
        background=settings.background,
        drawn=plan.training_background != "background",
        maps=styles.maps(rasterizer.uncached, plan.seen),
        content_maps=styles.content_maps(rasterizer.uncached, plan.seen),
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
        style_targets=styles.cached_targets(loss),
    )


def in_bfloat16(job: StylizationJob, step: int) -> StylizationJob:
    """Return a job whose network continues in bfloat16 from a step in which float16 has overflowed."""
    network = make_network(job.weights, job.settings, "bfloat16", job.plan.device)
    job.loss.network = network
    job.view_targets.forget_division()
    if job.graphs is not None:
        job.graphs.clear()
    line = Decision("precision", f"features in bfloat16 from step {step} on", "float16 has overflowed")
    plan = replace(job.plan, precision="bfloat16", decisions=(*job.plan.decisions, line))
    return replace(job, network=network, plan=plan, style_targets=job.styles.cached_targets(job.loss))


def _make_rasterizer(
    plan: Plan, settings: Settings, rendered: Scene, memory: int, planning_context: PlanningContext | None
) -> Rasterizer:
    """Return the plan's rasterizer of the rendered Gaussians."""
    budget = memory_for("rasterizer", memory)
    uncached = (
        planning_context.rasterizer
        if planning_context and plan.seen.all()
        else make_rasterizer(plan.uncached, rendered, background=settings.background, near=settings.near, memory=budget)
    )
    if plan.cached_weights == "none":
        return uncached
    return CachedRasterizer(
        rendered,
        max_bytes=budget,
        min_intersection_bytes=memory_for("intersections", memory),
        precision="half" if plan.cached_weights == "half" else "float32",
        at_first_use=False,
        uncached=uncached,
    )


def view_memory(plan: Plan, memory: int) -> int:
    """Return the budget in bytes for data of the views: what other caches leave of it, and half of `Plan.spare`."""
    measuring = (1 + plan.is_approximated) * plan.measured * memory_for("measuring", memory)
    cached = (plan.cached_weights != "none") * memory_for("intersections", memory)
    return memory_for("views", memory) + plan.spare // 2 - cached - measuring


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


# --- estimates -----------------------------------------------------------------------------------------------------

#: Activities of a step that pass pixels through the network.
NETWORK_PARTS = ("vgg_forward", "vgg_backward", "statistics", "matching", "network")
#: Sides of the image that a machine without a remembered rate is tried on: first one that compiles kernels.
_SIDES: dict[str, tuple[int, int]] = {"cpu": (32, 96), "cuda": (64, 512)}
#: Weight of the latest job in a remembered rate.
_LATEST = 0.5


@dataclass(frozen=True)
class Estimate:
    """About how long a job takes, until its own pace is known.

    Attributes:
        seconds: Seconds of a mean step on all scales.
        seconds_coarse: Seconds of a step of phase 1.
        measuring: Seconds of all measurements.
        ending: Seconds from the last step to the last file, except for measurements.
        job: Seconds of all steps and measurements.
    """

    seconds: float
    seconds_coarse: float
    measuring: float
    ending: float
    job: float


def estimate(job: StylizationJob) -> Estimate:
    """Estimate the seconds of a job from the rate that earlier jobs have left behind, and from its survey."""
    plan, settings, cameras = job.plan, job.settings, [job.views.cameras[index] for index in job.views.covered]
    pixels = sum(camera.width * camera.height for camera in cameras) / len(cameras)
    pace = Pace(Rates(job.network, plan.precision, settings).rate, job.survey_seconds, pixels)
    views = settings.views_per_step / plan.ranks
    sos, coarse = (pace.step(work, pixels, views) for work in (plan.work.sos, plan.work.coarse))
    measuring = plan.work.measuring / pace.rate(plan.work.sos)
    seconds = plan.steps_coarse * coarse + settings.steps_sos * sos + measuring
    return Estimate(sos, coarse, measuring, ending_seconds(len(job.scene)), min(seconds, settings.within or seconds))


class Rates:
    """Rates of a network on the device of a job, by the number of pixels in a step."""

    def __init__(self, network: FeatureNetwork, precision: PlannedPrecision, settings: Settings) -> None:
        device = network.device
        name = torch.cuda.get_device_name(device) if device.type == "cuda" else f"{torch.get_num_threads()} threads"
        self._network, self._settings = network, settings
        size = f"{network.name} of {network.held_bytes_per_pixel():.0f} bytes per pixel"
        self._key = f"{name}, {precision}, {size}, {settings.style_loss}"
        self._path = cache_folder() / "rates.json"

    def rate(self, pixels: float) -> float:
        """Return the rate of steps with so many pixels, between remembered ones; that of a small image without any."""
        known = {int(size): rate for size, rate in _read(self._path).get(self._key, {}).items()}
        sizes = sorted(known)
        if not sizes:
            return self._tried
        return float(np.interp(math.log2(max(pixels, 1.0)), sizes, [known[size] for size in sizes]))

    def remember(self, pixels: float, rate: float) -> None:
        """Remember the rate of a job's steps; one that cannot be written is forgotten."""
        rates, size = _read(self._path), str(round(math.log2(max(pixels, 1.0))))
        own = rates.setdefault(self._key, {})
        own[size] = math.exp((1 - _LATEST) * math.log(own.get(size, rate)) + _LATEST * math.log(rate))
        with suppress(OSError, OutputError):
            self._path.parent.mkdir(parents=True, exist_ok=True)
            write_json(self._path, rates)

    @cached_property
    def _tried(self) -> float:
        """Return the rate of one pass over a small image, in less than half a second."""
        settings, seconds = self._settings.model_copy(update={"scales": ()}), 1.0
        loss = make_loss(self._network, settings, 1 << 40, content_weight=0)
        for side in _SIDES[self._network.device.type]:
            image = torch.rand((side, side, 3), generator=torch.Generator().manual_seed(0)).to(self._network.device)
            style, view = loss.targets.of_style(Style.of(image.cpu()), (side, side)), loss.targets.of_view(image)
            started = time.perf_counter()
            loss.evaluate(image, style, view, [0])
            wait_for(self._network.device)
            seconds = time.perf_counter() - started
        return side * side / seconds


def _read(path: Path) -> dict[str, dict[str, float]]:
    """Return the remembered rates; none if there is no file or it cannot be used."""
    try:
        stored = json.loads(path.read_text("utf-8"))
        return {
            key: {str(int(size)): float(rate) for size, rate in own.items() if 0 < float(rate) < math.inf}
            for key, own in stored.items()
        }
    except (OSError, ValueError, AttributeError, TypeError):
        return {}
