"""Planner: survey all views, decide what a job leaves out, make a trial of it, and predict its cost."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

from numpy.typing import NDArray
from torch import Tensor

from sgsst_core.budget import memory_for
from sgsst_core.decision import Decision
from sgsst_core.errors import CameraError
from sgsst_core.features.network_weights import BackboneWeights, load_network_weights
from sgsst_core.loss.feature_scale import weights_for
from sgsst_core.loss.graphs import LossGraphs
from sgsst_core.loss.scale_weights import check_scales, check_stroke_depth
from sgsst_core.loss.sos import make_loss
from sgsst_core.loss.statistics_terms import has_statistics
from sgsst_core.orbit.choice import Orbit, orbit_decisions
from sgsst_core.parallel.collectives import ALONE, Collectives, RankLeftOut
from sgsst_core.planning import choices
from sgsst_core.planning.choices import ANOTHER_LOSS
from sgsst_core.planning.context import PlanningContext, equip, gradient_error
from sgsst_core.planning.facts import Facts, weight_cost
from sgsst_core.planning.plan import Plan
from sgsst_core.planning.survey import ShowPlanning, Survey, survey_views
from sgsst_core.progress import Progress
from sgsst_core.refine.choice import refine_decision
from sgsst_core.refine.split import Refinement
from sgsst_core.regions.definition import Regions
from sgsst_core.scene.camera import Camera, checked_cameras, fit_cameras
from sgsst_core.scene.colors import color_subspace_of
from sgsst_core.scene.gaussians import Scene, checked_scene
from sgsst_core.scene.spherical_harmonics import harmonics_energy
from sgsst_core.settings import Settings
from sgsst_core.style import Style, image_of
from sgsst_core.stylizing.job import StylizationJob, prepare_job
from sgsst_core.stylizing.photo_prefetch import PhotoLoader
from sgsst_core.stylizing.prediction import (
    completed_plan,
    draft_plan,
    measures_launches,
    network_pixels,
    with_spare_memory,
)
from sgsst_core.stylizing.refining import refine, refined
from sgsst_core.stylizing.trial import Trial, launch_cost, run_trial
from sgsst_core.timing import Timer

#: Number of region maps that are computed by one render, and bytes per pixel of a map at all scales.
_MAPS_PER_RENDER, _MAP_BYTES = 3, 16 / 3


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
    survey: Survey | None = None,
    measured: bool = False,
    show: ShowPlanning | None = None,
    timer: Timer | None = None,
    orbit: Orbit | None = None,
    about_inputs: Sequence[Decision] = (),
    regions: Regions | None = None,
    refinement: Refinement | None = None,
) -> StylizationJob:
    """Plan and prepare a job. Every rank must call this with the same arguments, and gets the same plan.

    The job keeps what the survey and the trial have computed.

    Args:
        scene: Scene, after refinement if there was one.
        cameras: Cameras; larger ones are reduced to `settings.max_resolution`.
        style: Style of the job.
        settings: Settings of the job.
        weights: Weights of the feature network; None for VGG19, or VGG16 if only that is installed.
        photos: See `prepare_job`.
        rasterizer: Rasterizer that computes blend weights: "cpu", "triton", "cuda" or "reference". None to choose one.
        collectives: Ranks of the job.
        survey: Survey from an earlier plan of the same job; None to survey the views.
        measured: Whether quality is measured between steps and a report is written, as in `sgsst stylize`.
        show: Callback for the progress of the survey and the trial.
        timer: Timer that records the survey as "survey", and everything else as "planning".
        orbit: Orbit that produced the cameras, for the plan to report; None for cameras from files.
        about_inputs: Decisions about cameras and photos that start the plan.
        regions: Regions of the scene; None if there are none.
        refinement: Refinement that produced the scene, for the plan to report; None if it was not refined.

    Raises:
        CameraError: If there are no cameras, or none sees a Gaussian.
        SettingsError: If regions freeze everything visible, views lack requested scales, or the rasterizer does not
            work here.
        WeightsError: If there are no weights.
        RankLeftOut: If the plan does not use this rank.
    """
    if not cameras:
        raise CameraError("There are no cameras. Give a camera file, or use --orbit.")
    timer = timer or Timer()
    with timer("planning"):
        fitted = fit_cameras(cameras, settings)
        check_scales(settings.scales, fitted, settings.coarsest_side)
        check_stroke_depth(settings, fitted, regions=regions is not None)
        weights = weights or load_network_weights("auto")
        context = equip(scene, fitted, settings, weights_for(weights, settings), collectives, rasterizer)
        if survey is None:
            with timer("survey"):
                survey = survey_views(context.scene, fitted, context.rasterizer, collectives, show)
        resolved = regions and regions.resolved(survey.total_blend_weights)
        if show:
            show(Progress(stage="probing"))
        facts = collectives.broadcast(lambda: _facts(context, survey, resolved))
        draft = draft_plan(facts, settings, precision=context.precision, measured=measured)
        activations = memory_for("activations", context.machine.memory)
        pixels = network_pixels(draft, facts, make_loss(context.network, settings, activations).tiling)
        of_a_view = int(pixels.held * context.network.held_bytes_per_pixel())
        draft = with_spare_memory(draft, facts, of_a_view)
        request_lines = [
            *about_inputs,
            *([refine_decision(refinement, settings)] if refinement is not None else []),
            *(orbit_decisions(orbit, fitted, survey.uncovered) if orbit is not None else []),
            *(_about_regions(regions, resolved, draft, fitted) if regions and resolved is not None else []),
            *_about_styles(style, regions, settings),
        ]

        def prepared(plan: Plan) -> StylizationJob:
            return prepare_job(
                plan, scene, cameras, style, settings, weights=weights, photos=photos, collectives=collectives,
                planning_context=context, regions=regions,
            )  # fmt: skip

        job, trials, cost = None, dict[int, Trial](), None
        for ranks in _candidates(facts.machine.ranks, settings):
            job = own = None  # frees the memory of the last one
            try:
                job = prepared(replace(draft, ranks=ranks))
                own = run_trial(job)
            except RankLeftOut:
                pass
            of_first = collectives.all_gather(own)[0]
            assert of_first is not None  # the first rank takes part in every trial
            trials[ranks] = of_first
        if job is not None and measures_launches(draft, facts, settings):
            cost = launch_cost(job)
        plan = collectives.broadcast(lambda: completed_plan(draft, facts, settings, pixels, trials, cost))
        plan = with_spare_memory(plan, facts, of_a_view)  # graphs, which the draft lacks, leave less
        plan = replace(plan, refinement=refinement, decisions=(*request_lines, *plan.decisions))
        if job is None or (plan.ranks, plan.spare) != (job.collectives.size, draft.spare):
            job = None
            return prepared(plan)
        job.team.expect(plan)
        return replace(job, plan=plan, graphs=LossGraphs(job.loss) if plan.graphs else None)


def refine_and_plan(
    scene: Scene,
    cameras: Sequence[Camera],
    style: Tensor | NDArray[Any] | Style,
    settings: Settings,
    *,
    weights: BackboneWeights | None = None,
    photos: PhotoLoader | None = None,
    rasterizer: str | None = None,
    collectives: Collectives = ALONE,
    regions: Regions | None = None,
    show: ShowPlanning | None = None,
) -> StylizationJob:
    """Refine the scene if the settings request it, then plan and prepare the job; see `plan_job`.

    Inputs are checked, and converted if necessary.
    """
    style, regions = Style.given(style), regions and regions.with_checked_styles()
    scene, cameras = checked_scene(scene), checked_cameras(cameras)
    weights = weights or load_network_weights("auto")
    refinement = refine(
        scene,
        cameras,
        style,
        settings,
        weights=weights,
        rasterizer=rasterizer,
        collectives=collectives,
        regions=regions,
        show=show,
    )
    scene, regions = refined(scene, refinement), regions and regions.refined(refinement)
    return plan_job(
        scene,
        cameras,
        style,
        settings,
        weights=weights,
        photos=photos and (lambda index: image_of(photos(index), f"photo of view {index}")),
        rasterizer=rasterizer,
        collectives=collectives,
        regions=regions,
        refinement=refinement,
        show=show,
    )


def _candidates(available: int, settings: Settings) -> list[int]:
    """Return the numbers of ranks to try: all, half of them and so on. The job of the last trial can be continued."""
    if not settings.rebalance:
        return [available]
    return sorted({max(available >> halvings, 1) for halvings in range(available.bit_length())})


def _facts(context: PlanningContext, survey: Survey, resolved: Regions | None) -> Facts:
    """Gather the facts on which the decisions before the trial depend; one rank does this for all."""
    scene, settings = context.scene, context.settings
    views = [context.cameras[index] for index in survey.covered]
    budget = memory_for("rasterizer", context.machine.memory)
    return Facts(
        gaussians=len(scene),
        sh_degree=context.sh_degree,
        used_degree=scene.used_degree(choices.rendered_gaussians(survey)),
        harmonics_energy=harmonics_energy(scene, survey.total_blend_weights),
        sizes=tuple((camera.height, camera.width) for camera in context.cameras),
        survey=survey,
        machine=context.machine,
        rasterizer=context.rasterizer.name,
        weights=weight_cost(context.rasterizer, views, settings, budget, choices.LEAST_VISITS),
        frozen=None if resolved is None else resolved.frozen,
        deepest=max(context.network.layers),
        precision_ratio=context.precision_ratio,
        gradient_error=gradient_error(context, views[0]),
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


def _about_regions(regions: Regions, resolved: Regions, plan: Plan, cameras: Sequence[Camera]) -> list[Decision]:
    """Return the decisions about the regions and the cost of their maps.

    Args:
        regions: Regions as requested.
        resolved: Regions after `Regions.resolved`.
        plan: Plan under construction.
        cameras: Cameras of all views.
    """
    weights = plan.survey.total_blend_weights
    lines = []
    for index, region in enumerate(regions.every):
        requested, members = int(regions.members(index).sum()), resolved.members(index)
        seen = bool((weights[members] > 0).any())
        reason = region.select or "not in any other region"
        lost = region.selected - requested
        if lost > 0:
            reason += f"; {lost:,} more are also in a later region, which takes precedence"
        if index and not requested:
            decision = f"warning: ignored, because it has no Gaussians{' of its own' if lost > 0 else ''}"
        elif region.freeze:
            decision = f"{requested:,} Gaussians stay unchanged"
        elif index and not seen:
            decision = f"warning: ignored, because no view sees its {requested:,} Gaussians; they count as rest"
        elif not seen:
            continue  # the rest is empty
        else:
            fraction = float(weights[members].sum() / weights.sum())
            decision = f"{int(members.sum()):,} of {len(weights):,} Gaussians, {fraction:.1%} of what the views show,"
            decision += f" use {region.style.text if region.style else 'the style'}"
            decision += f", with weight {region.weight:g}" if region.weight != 1 else ""
            decision += "" if region.content_weight is None else f", with content weight {region.content_weight:,g}"
        lines.append(Decision(f"region {region.name}", decision, reason, error=ANOTHER_LOSS))
    if not resolved.mapped:
        return lines
    count = len(resolved.active)
    pixels = sum(cameras[index].width * cameras[index].height for index in plan.covered)
    renders = 1 + -(-count // _MAPS_PER_RENDER)  # plus one for the background
    decision = (
        f"statistics of {count} region{'' if count == 1 else 's'} are weighted by each region's fraction of a pixel's "
        f"blend weights; {renders} renders at a view's first visit, {int(_MAP_BYTES * count * pixels) / 1e6:.1f} MB "
        "for all views"
    )
    return [*lines, Decision("regions", decision, "otherwise styles would leak into other regions", error=ANOTHER_LOSS)]
