"""Planner: survey all views, and prepare the job that the plan describes."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import replace
from statistics import median

from sgsst_core.budget import memory_for
from sgsst_core.decision import ANOTHER_LOSS, Decision
from sgsst_core.errors import CameraError
from sgsst_core.features.network_weights import BackboneWeights, load_network_weights
from sgsst_core.loss.feature_scale import weights_for
from sgsst_core.loss.scale_weights import check_scales, check_stroke_depth
from sgsst_core.loss.sos import make_loss
from sgsst_core.loss.statistics_terms import has_statistics
from sgsst_core.orbit.choice import Orbit, orbit_decisions
from sgsst_core.parallel.collectives import ALONE, Collectives
from sgsst_core.planning import choices
from sgsst_core.planning.facts import (
    Facts,
    PlanningContext,
    count_intersections,
    count_weights,
    equip,
    evaluated_pixels,
)
from sgsst_core.planning.plan import Plan
from sgsst_core.planning.survey import ShowPlanning, Survey, survey_views
from sgsst_core.planning.time_budget import Pace, SecondsLeft, TimeChoice, choosable, choose
from sgsst_core.refine.choice import refine_decision
from sgsst_core.refine.split import Refinement
from sgsst_core.regions.definition import Regions, region_decisions
from sgsst_core.scene.camera import Camera, fit_cameras, resized, spread
from sgsst_core.scene.colors import color_subspace_of
from sgsst_core.scene.gaussians import Scene
from sgsst_core.scene.spherical_harmonics import harmonics_energy
from sgsst_core.settings import Settings
from sgsst_core.style import Style
from sgsst_core.stylizing.job import StylizationJob, prepare_job
from sgsst_core.stylizing.photo_prefetch import PhotoLoader
from sgsst_core.stylizing.rates import Rates
from sgsst_core.timing import Timer

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
            check_stroke_depth(settings, fitted, regions=regions is not None)
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
