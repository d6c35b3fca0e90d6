"""Planner: survey all views, measure, and decide."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from sgsst_core.errors import CameraError
from sgsst_core.features.network_weights import BackboneWeights, load_network_weights
from sgsst_core.loss.feature_scale import weights_for
from sgsst_core.loss.mixture import StyleMixture
from sgsst_core.loss.regions import Regions
from sgsst_core.loss.scale_weights import check_scales
from sgsst_core.orbit.choice import Orbit, orbit_decisions
from sgsst_core.parallel.collectives import ALONE, Collectives
from sgsst_core.planning.decide import decide
from sgsst_core.planning.decisions import of_regions, of_styles
from sgsst_core.planning.plan import Plan
from sgsst_core.planning.probe import PlanningContext, Probe, equip, measure
from sgsst_core.planning.progress import ShowPlanning
from sgsst_core.planning.ranks_model import probe_link
from sgsst_core.planning.survey import Survey, survey_views
from sgsst_core.refine.choice import refine_decision
from sgsst_core.refine.split import Refinement
from sgsst_core.scene.camera import Camera, fit_cameras
from sgsst_core.scene.gaussians import Scene
from sgsst_core.settings import Settings
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
    style: StyleMixture | None = None,
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
        show: Callback for the progress of the survey.
        timer: Timer that records the survey as "survey", and everything else as "planning".
        orbit: Orbit that produced the cameras, for the plan to report; None for cameras from files.
        style: Style mixture, for the plan to report its images; None for one image.
        regions: Regions of the scene; None if there are none.
        refinement: Refinement that produced the scene, for the plan to report; None if it was not refined.

    Returns:
        The plan, and the planning context, whose objects a `Stylizer` continues to use.

    Raises:
        CameraError: If there are no cameras, or none sees a Gaussian.
        SettingsError: If pruning leaves no Gaussian, regions freeze everything visible, views lack requested scales, or
            the rasterizer does not work here.
        WeightsError: If there are no weights.
    """
    if not cameras:
        raise CameraError("There are no cameras. Give a camera file, or use --orbit.")
    timer = timer or Timer()
    with timer("planning"):
        fitted = fit_cameras(cameras, settings)
        check_scales(settings.scales, fitted, settings.coarsest_side)
        weights = weights_for(weights or load_network_weights("auto"), settings)
        planning_context = equip(scene, fitted, settings, weights, collectives, rasterizer)
        scene = planning_context.scene
        if survey is None:
            with timer("survey"):
                survey = survey_views(scene, fitted, planning_context.rasterizer, collectives, show)
        resolved = regions and regions.resolved(survey.total_blend_weights)
        maps = len(resolved.active) if resolved is not None and resolved.mapped else 0
        link = probe_link(collectives, planning_context.network.device)
        # Timings differ between ranks, so one rank decides for all.
        plan = collectives.broadcast(
            lambda: _decide(measure(planning_context, survey, link, maps), settings, measured, style, resolved)
        )
        if regions is not None and resolved is not None:
            plan = replace(plan, decisions=(*of_regions(regions, resolved, plan, fitted), *plan.decisions))
        if orbit is not None:
            plan = replace(plan, decisions=(*orbit_decisions(orbit, fitted, survey.uncovered), *plan.decisions))
        if refinement is not None:
            decisions = (refine_decision(refinement, settings), *plan.decisions)
            plan = replace(plan, refinement=refinement, decisions=decisions)
    return plan, planning_context


def _decide(
    probe: Probe, settings: Settings, measured: bool, style: StyleMixture | None, regions: Regions | None
) -> Plan:
    """Plan for one or several style images, and for one or several regions as resolved by `Regions.resolved`."""
    if regions is not None:
        own = [regions.every[place].style or style for place in regions.active]
        count = sum(len(each.pictures) if each else 1 for each in own)
        probe = replace(probe, kept=regions.frozen, styles=count)
    elif style is not None:
        probe = replace(probe, styles=len(style.pictures))
    plan = decide(probe, settings, measured=measured)
    if style is None or len(style.pictures) == 1:
        return plan
    return replace(plan, decisions=(*of_styles(style, settings), *plan.decisions))
