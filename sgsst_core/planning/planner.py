"""Planner: survey all views, measure, and decide."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from torch import Tensor

from sgsst_core.decision import Decision
from sgsst_core.errors import CameraError
from sgsst_core.features.network_weights import BackboneWeights, load_network_weights
from sgsst_core.loss.feature_scale import weights_for
from sgsst_core.loss.scale_weights import band_count, check_scales, check_stroke_depth
from sgsst_core.loss.statistics_terms import has_statistics
from sgsst_core.orbit.choice import Orbit, orbit_decisions
from sgsst_core.parallel.collectives import ALONE, Collectives
from sgsst_core.planning.choices import ANOTHER_LOSS
from sgsst_core.planning.context import PlanningContext, equip
from sgsst_core.planning.decide import decide
from sgsst_core.planning.plan import Plan
from sgsst_core.planning.probe import measure, probe_link
from sgsst_core.planning.survey import ShowPlanning, Survey, survey_views
from sgsst_core.planning.view_costs import MAP_BYTES, MAPS_PER_RENDER
from sgsst_core.progress import Progress
from sgsst_core.refine.choice import refine_decision
from sgsst_core.refine.split import Refinement
from sgsst_core.regions.definition import Regions
from sgsst_core.scene.camera import Camera, fit_cameras
from sgsst_core.scene.colors import color_subspace_of
from sgsst_core.scene.gaussians import Scene
from sgsst_core.settings import Settings
from sgsst_core.style import Style
from sgsst_core.timing import Timer


def make_plan(
    scene: Scene,
    cameras: Sequence[Camera],
    settings: Settings,
    *,
    weights: BackboneWeights | None = None,
    rasterizer: str | None = None,
    collectives: Collectives = ALONE,
    survey: Survey | None = None,
    measured: bool = False,
    show: ShowPlanning | None = None,
    timer: Timer | None = None,
    orbit: Orbit | None = None,
    about_inputs: Sequence[Decision] = (),
    style: Style | None = None,
    regions: Regions | None = None,
    refinement: Refinement | None = None,
) -> tuple[Plan, PlanningContext]:
    """Plan a job. Every rank must call this with the same arguments, and gets the same plan.

    Args:
        scene: Scene, after refinement if there was one.
        cameras: Cameras; larger ones are reduced to `settings.max_resolution`.
        settings: Settings of the job.
        weights: Weights of the feature network; None for VGG19, or VGG16 if only that is installed.
        rasterizer: Rasterizer that computes blend weights: "cpu", "triton", "cuda" or "reference". None to choose one.
        collectives: Ranks of the job.
        survey: Survey from an earlier plan of the same job; None to survey the views.
        measured: Whether the job will be measured between its steps; see `decide`.
        show: Callback for the progress of the survey and the probe.
        timer: Timer that records the survey as "survey", and everything else as "planning".
        orbit: Orbit that produced the cameras, for the plan to report; None for cameras from files.
        about_inputs: Decisions about cameras and photos that start the plan.
        style: Style mixture, for the plan to report its images; None for one image.
        regions: Regions of the scene; None if there are none.
        refinement: Refinement that produced the scene, for the plan to report; None if it was not refined.

    Returns:
        The plan, and the planning context, whose objects a `Stylizer` continues to use.

    Raises:
        CameraError: If there are no cameras, or none sees a Gaussian.
        SettingsError: If regions freeze everything visible, views lack requested scales, or the rasterizer does not
            work here.
        WeightsError: If there are no weights.
    """
    if not cameras:
        raise CameraError("There are no cameras. Give a camera file, or use --orbit.")
    timer = timer or Timer()
    with timer("planning"):
        fitted = fit_cameras(cameras, settings)
        check_scales(settings.scales, fitted, settings.coarsest_side)
        check_stroke_depth(settings, fitted, regions=regions is not None)
        weights = weights_for(weights or load_network_weights("auto"), settings)
        planning_context = equip(scene, fitted, settings, weights, collectives, rasterizer)
        scene = planning_context.scene
        if survey is None:
            with timer("survey"):
                survey = survey_views(scene, fitted, planning_context.rasterizer, collectives, show)
        resolved = regions and regions.resolved(survey.total_blend_weights)
        maps = band_count(fitted, settings)
        if resolved is not None and resolved.mapped:
            maps = len(resolved.active)
        weighted = resolved is not None and resolved.content_weights(settings.content_weight) is not None
        if show:
            show(Progress(stage="probing"))
        link = probe_link(collectives, planning_context.network.device)

        def decide_here() -> Plan:
            probe = measure(planning_context, survey, link, maps)
            frozen = None if resolved is None else resolved.frozen
            images = _style_images(style, resolved)
            largest = max((4 * image.numel() for image in images if image is not None), default=0)
            probe = replace(probe, styles=len(images), style_bytes=largest, frozen=frozen, maps=maps + weighted)
            return decide(probe, settings, measured=measured)

        # Timings differ between ranks, so one rank decides for all.
        plan = collectives.broadcast(decide_here)
        request_lines = [
            *about_inputs,
            *([refine_decision(refinement, settings)] if refinement is not None else []),
            *(orbit_decisions(orbit, fitted, survey.uncovered) if orbit is not None else []),
            *(_about_regions(regions, resolved, plan, fitted) if regions is not None and resolved is not None else []),
            *(_about_styles(style, regions, settings) if style is not None else []),
        ]
    return replace(plan, refinement=refinement, decisions=(*request_lines, *plan.decisions)), planning_context


def _style_images(style: Style | None, regions: Regions | None) -> list[Tensor | None]:
    """Return all style images of a job; `regions` are those of `Regions.resolved`. None stands for an unknown image."""
    mixtures = [style] if regions is None else [regions.every[index].style or style for index in regions.active]
    return [image for mixture in mixtures for image in (mixture.images if mixture else (None,))]


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
    renders = 1 + -(-count // MAPS_PER_RENDER)  # plus one for the background
    decision = (
        f"statistics of {count} region{'' if count == 1 else 's'} are weighted by each region's fraction of a pixel's "
        f"blend weights; {renders} renders at a view's first visit, {int(MAP_BYTES * count * pixels) / 1e6:.1f} MB for "
        "all views"
    )
    return [*lines, Decision("regions", decision, "otherwise styles would leak into other regions", error=ANOTHER_LOSS)]
