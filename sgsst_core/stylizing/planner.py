"""Planner: survey all views, prepare the job that the plan describes, and estimate how long it takes.

Estimates and time budgets use the rate of the feature network on this machine, in pixels per second, which earlier jobs
leave behind. It belongs to a device, a precision, a network and a style loss, and to a size of steps, because a GPU is
slower at small ones.
"""

from __future__ import annotations

import json
import math
import time
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np
import torch

from sgsst_core.budget import memory_for
from sgsst_core.devices import Timer, wait_for
from sgsst_core.errors import CameraError, OutputError
from sgsst_core.features.vgg import FeatureNetwork
from sgsst_core.features.weight_files import cache_folder
from sgsst_core.files.atomic import write_json
from sgsst_core.loss.feature_scale import weights_for
from sgsst_core.loss.sos import make_loss
from sgsst_core.loss.terms import has_statistics
from sgsst_core.orbit import orbit_decisions
from sgsst_core.parallel.collectives import ALONE, Collectives
from sgsst_core.planning.plan import (
    Facts,
    Plan,
    PlanningContext,
    check_scales,
    choose_precision,
    count_intersections,
    count_weights,
    equip,
    is_weighted,
    make_plan,
    with_groups,
)
from sgsst_core.planning.survey import ShowPlanning, Survey, survey_views
from sgsst_core.planning.time_budget import Pace, SecondsLeft, TimeChoice, choosable, choose, ending_seconds
from sgsst_core.progress import ANOTHER_LOSS, Decision
from sgsst_core.refine import refine_decision
from sgsst_core.regions import Regions, region_decisions
from sgsst_core.scene.camera import Camera, fit_cameras, resized, spread
from sgsst_core.scene.colors import color_subspace_of
from sgsst_core.scene.spherical_harmonics import harmonics_energy
from sgsst_core.settings import PlannedPrecision, Settings
from sgsst_core.style import Style
from sgsst_core.stylizing.job import JobInputs, StylizationJob, prepare_job

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
        CameraError: If there are no cameras, or none sees a Gaussian.
        SettingsError: If regions freeze everything visible, views lack requested scales, or the rasterizer or the
            precision does not work here.
    """
    _check_cameras(inputs)
    timer, chosen, context = timer or Timer(), inputs.chosen, None
    survey_seconds = 0.0
    settings = chosen.applied(inputs.settings) if chosen else inputs.settings
    if plan is None:
        with timer("planning"):
            fitted = fit_cameras(inputs.cameras, settings)
            check_scales(settings.scales, fitted, settings.coarsest_side)
            weights = weights_for(inputs.weights, settings)
            context = equip(inputs.scene, fitted, settings, weights, collectives, inputs.rasterizer)
            if survey is None:
                started = time.perf_counter()
                with timer("survey"):
                    survey = survey_views(context.scene, fitted, context.rasterizer, collectives, show)
                survey_seconds = (time.perf_counter() - started) * collectives.size / len(fitted)
            about = [*_about_inputs(inputs, settings, survey, fitted)]
            facts = collectives.broadcast(lambda: _facts(context, survey, inputs.regions))
            plan = make_plan(facts, settings, groups=groups, measured=inputs.measured, about=about)
            plan = replace(plan, refinement=inputs.refinement, time_choice=chosen)
    if chosen and not plan.steps_coarse:  # so that the learning rate falls alike for any number of steps
        settings = settings.with_steps(0, settings.steps_sos)
    with timer("preparing"):
        inputs = replace(inputs, settings=with_groups(settings, plan.groups))
        job = prepare_job(plan, inputs, collectives=collectives, planning_context=context)
    return replace(job, survey_seconds=survey_seconds)


def _check_cameras(inputs: JobInputs) -> None:
    if not inputs.cameras:
        raise CameraError("There are no cameras. Give a camera file, or use --orbit.")


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
    _check_cameras(inputs)
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


def _facts(context: PlanningContext, survey: Survey, regions: Regions | None) -> Facts:
    """Gather the facts on which the plan depends; one rank does this for all."""
    scene, settings, machine = context.scene, context.settings, context.machine
    views = [context.cameras[index] for index in survey.covered]
    precision = choose_precision(settings, machine)
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
        reason = f"{len(style.images)} images were given"
        if not has_statistics(settings.style_loss):
            reason += (
                "; features are matched with those of all images, whose weights matter only if there are too many "
                "features"
            )
        yield Decision("styles", f"a mixture: {style.text}", reason, error=ANOTHER_LOSS)


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
        rates, size = _read(self._path), _size(pixels)
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
