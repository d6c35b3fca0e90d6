"""Planner: survey all views, prepare the job that the plan describes, and estimate how long it takes.

Estimates and time budgets use the rate of the feature network on this machine, in pixels per second, which earlier jobs
leave behind. It belongs to a device, a precision, a network and a style loss, and to a size of steps, because a GPU is
slower at small ones.
"""

from __future__ import annotations

import json
import math
import time
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from statistics import median

import torch

from sgsst_core.budget import memory_for
from sgsst_core.devices import Timer, wait_for
from sgsst_core.errors import CameraError, OutputError
from sgsst_core.features.network_weights import BackboneWeights, load_network_weights
from sgsst_core.features.vgg import FeatureNetwork
from sgsst_core.features.weight_files import cache_folder
from sgsst_core.files.atomic import write_json
from sgsst_core.loss.feature_scale import weights_for
from sgsst_core.loss.sos import make_loss
from sgsst_core.loss.terms import has_statistics
from sgsst_core.orbit import Orbit, orbit_decisions
from sgsst_core.parallel.collectives import ALONE, Collectives
from sgsst_core.planning import plan as choices
from sgsst_core.planning.facts import (
    Facts,
    PlanningContext,
    check_scales,
    count_intersections,
    count_weights,
    equip,
    evaluated_pixels,
)
from sgsst_core.planning.plan import Plan
from sgsst_core.planning.survey import ShowPlanning, Survey, survey_views
from sgsst_core.planning.time_budget import Pace, SecondsLeft, TimeChoice, choosable, choose, ending_seconds
from sgsst_core.progress import ANOTHER_LOSS, Decision
from sgsst_core.refine import Refinement, refine_decision
from sgsst_core.regions import Regions, region_decisions
from sgsst_core.scene.camera import Camera, fit_cameras, resized, spread
from sgsst_core.scene.colors import color_subspace_of
from sgsst_core.scene.gaussians import Scene
from sgsst_core.scene.spherical_harmonics import harmonics_energy
from sgsst_core.settings import PlannedPrecision, Settings
from sgsst_core.style import Style
from sgsst_core.stylizing.job import StylizationJob, prepare_job
from sgsst_core.stylizing.views import PhotoLoader

#: Longer side in pixels of the views that a time budget is chosen from, and their number.
_SMALL_SIDE, _SMALL_VIEWS = 256, 4


def plan_job(
    scene: Scene,
    cameras: Sequence[Camera],
    style: Style,
    settings: Settings,
    *,
    weights: BackboneWeights | None = None,
    photos: PhotoLoader | None = None,
    rasterizer: str | None = None,
    collectives: Collectives = ALONE,
    plan: Plan | None = None,
    survey: Survey | None = None,
    groups: int | None = None,
    measured: bool = False,
    show: ShowPlanning | None = None,
    timer: Timer | None = None,
    orbit: Orbit | None = None,
    about_inputs: Sequence[Decision] = (),
    regions: Regions | None = None,
    refinement: Refinement | None = None,
    chosen: TimeChoice | None = None,
) -> StylizationJob:
    """Plan and prepare a job. Every rank must call this with the same arguments, and gets the same plan.

    Args:
        scene: Scene, after refinement if there was one.
        cameras: Cameras; larger ones are reduced to `settings.max_resolution`.
        weights: Weights of the feature network; None for VGG19, or VGG16 if only that is installed.
        photos: See `prepare_job`.
        rasterizer: Rasterizer that computes blend weights: "cpu", "triton" or "reference". None to choose one.
        plan: Plan from an earlier run of the same job, which is used unchanged; None to make one.
        survey: Survey from an earlier plan of the same job; None to survey the views.
        groups: `Plan.groups` of an earlier plan of the same job; None to choose them.
        measured: Whether quality is measured and a report is written, as in `sgsst stylize`.
        show: Callback for the progress of the survey.
        timer: Timer that records the survey as "survey", other planning as "planning", and the preparation of the job
            as "preparing".
        orbit: Orbit that produced the cameras, for the plan to report; None for cameras from files.
        about_inputs: Decisions about cameras and photos that start the plan.
        regions: Regions of the scene; None if there are none.
        refinement: Refinement that produced the scene, for the plan to report; None if it was not refined.
        chosen: Choice of the time budget, to which `cameras` and `photos` belong (`choose_within`); None without one.

    Raises:
        CameraError: If there are no cameras, or none sees a Gaussian.
        SettingsError: If regions freeze everything visible, views lack requested scales, or the rasterizer or the
            precision does not work here.
        WeightsError: If there are no weights.
    """
    if not cameras:
        raise CameraError("There are no cameras. Give a camera file, or use --orbit.")
    timer, weights = timer or Timer(), weights_for(weights or load_network_weights("auto"), settings)
    asked, settings, context = settings, chosen.applied(settings) if chosen else settings, None
    if plan is None:
        with timer("planning"):
            fitted = fit_cameras(cameras, settings)
            check_scales(settings.scales, fitted, settings.coarsest_side)
            context = equip(scene, fitted, settings, weights, collectives, rasterizer)
            if survey is None:
                with timer("survey"):
                    survey = survey_views(context.scene, fitted, context.rasterizer, collectives, show)
            about = [*about_inputs]
            if chosen:
                about.append(chosen.decision(asked.within, settings.steps_coarse + settings.steps_sos))
            if refinement is not None:
                about.append(refine_decision(refinement, settings))
            if orbit is not None:
                about += orbit_decisions(orbit, fitted, survey.uncovered)
            if regions is not None:
                covered = [fitted[index] for index in survey.covered]
                about += region_decisions(regions, survey.total_blend_weights, covered)
            about += _about_styles(style, regions, settings)
            facts = collectives.broadcast(lambda: _facts(context, survey, regions))
            plan = choices.make_plan(facts, settings, groups=groups, measured=measured, about=about)
            plan = replace(plan, refinement=refinement, time_choice=chosen)
    if chosen and not plan.steps_coarse:  # so that the learning rate falls alike for any number of steps
        settings = settings.with_steps(0, settings.steps_sos)
    with timer("preparing"):
        job = prepare_job(
            plan, scene, cameras, style, choices.with_groups(settings, plan.groups), weights=weights, photos=photos,
            collectives=collectives, planning_context=context, regions=regions,
        )  # fmt: skip
    cache = context.rasterizer.caches.get("intersections") if context else None
    costs = [seconds for _, seconds in cache.costs.values()] if cache is not None else []
    # The median, because the first view may compile kernels; a pass takes about as long as the intersections.
    return replace(job, survey_seconds=2 * median(costs)) if costs else job


def choose_within(
    scene: Scene,
    cameras: Sequence[Camera],
    settings: Settings,
    left: SecondsLeft,
    *,
    weights: BackboneWeights | None = None,
    rasterizer: str | None = None,
    collectives: Collectives = ALONE,
) -> TimeChoice | None:
    """Choose what fits a time budget, from a survey of a few small views. Every rank must call this function.

    Args:
        left: Seconds left of the budget.

    Returns:
        The choice; None if the settings give everything.
    """
    if not choosable(settings):
        return None
    if not cameras:
        raise CameraError("There are no cameras. Give a camera file, or use --orbit.")
    fitted = fit_cameras(cameras, settings)
    weights = weights_for(weights or load_network_weights("auto"), settings)
    small = [resized(each, min(_SMALL_SIDE, each.side)) for each in spread(fitted, _SMALL_VIEWS)]
    context = equip(scene, small, settings, weights, collectives, rasterizer)
    precision = choices.choose_precision(settings, context.machine)

    def choice() -> TimeChoice:
        context.rasterizer.survey(small[0])  # the first pass starts libraries and compiles kernels
        context.rasterizer.forget_views()
        started = time.perf_counter()
        survey = survey_views(context.scene, small, context.rasterizer)
        seconds = (time.perf_counter() - started) / len(small)
        areas = [camera.width * camera.height for camera in small]
        weighted = choices.is_weighted(survey, settings)
        passed = [survey.regions[index].pixels if weighted else areas[index] for index in survey.covered]
        pixels = evaluated_pixels(fitted, settings)[0] * settings.views_per_step / collectives.size
        rate = collectives.size * Rates(context.network(precision), precision, settings).rate(pixels)
        portion = sum(passed) / sum(areas[index] for index in survey.covered)
        pace = Pace(rate, seconds, sum(areas) / len(areas), portion)
        return choose(fitted, settings, pace, left(), len(scene))

    return collectives.broadcast(choice)


def _facts(context: PlanningContext, survey: Survey, regions: Regions | None) -> Facts:
    """Gather the facts on which the plan depends; one rank does this for all."""
    scene, settings, machine = context.scene, context.settings, context.machine
    views = [context.cameras[index] for index in survey.covered]
    precision = choices.choose_precision(settings, machine)
    network = context.network(precision)
    return Facts(
        gaussians=len(scene),
        sh_degree=context.sh_degree,
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
        frozen=None if regions is None else regions.resolved(survey.total_blend_weights).frozen,
        deepest=max(network.layers),
    )


def _about_styles(style: Style, regions: Regions | None, settings: Settings) -> list[Decision]:
    """Return the decisions about unused parts of style images, the color subspace, and the mixture of images."""
    own = [region.style for region in regions.every if region.style] if regions else []
    lines = [Decision("style", "warning", note) for each in (style, *own) for note in each.notes]
    if subspace := color_subspace_of((style, *own), settings):
        form = "a plane" if subspace.dimensions == 2 else "a line"
        reason = f"the style's colors differ from it by {255 * subspace.deviation:.1f} of 255 levels"
        lines.append(Decision("color subspace", f"colors stay on {form} in RGB", reason, error=ANOTHER_LOSS))
    if len(style.images) == 1:
        return lines
    reason = f"{len(style.images)} images were given"
    if not has_statistics(settings.style_loss):
        reason += (
            "; features are matched with those of all images, whose weights matter only if there are too many features"
        )
    return [*lines, Decision("styles", f"a mixture: {style.text}", reason, error=ANOTHER_LOSS)]


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
    pace = Pace(Rates(job.network, plan.precision, settings).rate(plan.work.sos), job.survey_seconds, pixels)
    views = settings.views_per_step / plan.ranks
    sos, coarse = (pace.step(work, pixels, views) for work in (plan.work.sos, plan.work.coarse))
    measuring = plan.work.measuring / pace.rate
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
        """Return the rate of steps with so many pixels: the nearest remembered one, or that of a small image."""
        own, size = _read(self._path).get(self._key, {}), _size(pixels)
        if own:
            return own[min(own, key=lambda known: abs(int(known) - int(size)))]
        return self._tried()

    def remember(self, pixels: float, rate: float) -> None:
        """Remember the rate of a job's steps; one that cannot be written is forgotten."""
        rates, size = _read(self._path), _size(pixels)
        own = rates.setdefault(self._key, {})
        own[size] = math.exp((1 - _LATEST) * math.log(own.get(size, rate)) + _LATEST * math.log(rate))
        with suppress(OSError, OutputError):
            self._path.parent.mkdir(parents=True, exist_ok=True)
            write_json(self._path, rates)

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


def _size(pixels: float) -> str:
    return str(round(math.log2(max(pixels, 1.0))))


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
