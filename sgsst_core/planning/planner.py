"""From inputs to a plan: look at every view, measure, decide."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from sgsst_core.errors import CameraError
from sgsst_core.features.network_weights import BackboneWeights, load_network_weights
from sgsst_core.loss.feature_scale import at_scale
from sgsst_core.parallel.collectives import ALONE, Collectives
from sgsst_core.planning.decide import decide
from sgsst_core.planning.orbit import Orbit, orbit_decisions
from sgsst_core.planning.plan import Plan
from sgsst_core.planning.probe import Workshop, equip, measure
from sgsst_core.planning.progress import ShowPlanning
from sgsst_core.planning.ranks_model import probe_link
from sgsst_core.planning.refine import refine_decision
from sgsst_core.planning.survey import Survey, survey
from sgsst_core.scene.camera import Camera, fit_cameras
from sgsst_core.scene.gaussians import Scene
from sgsst_core.scene.split import Refinement
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
    looked: Survey | None = None,
    measured: bool = False,
    show: ShowPlanning | None = None,
    timer: Timer | None = None,
    orbit: Orbit | None = None,
    refinement: Refinement | None = None,
) -> tuple[Plan, Workshop]:
    """Plan a job. Every rank calls this with the same arguments, and gets the same plan.

    Args:
        scene: as it was refined, where it was.
        cameras: larger ones are brought down to `settings.max_resolution`.
        weights: of the feature network; None loads VGG19, or VGG16 where only that is installed.
        rasterizer: "cpu", "cuda" or "reference", to compute blend weights anew; None chooses.
        looked: the survey of an earlier plan of the same job; None looks at the views.
        measured: see `decide`.
        show: told how far the survey has come.
        timer: counts the seconds of `survey`, and of all else as `planning`.
        orbit: that the cameras are of, for the plan to tell of it; None for those of files.
        refinement: what made the scene, likewise; None where it is as it was read.

    Returns:
        The plan, and what was built to make it, for a `Stylizer` to go on with.

    Raises:
        CameraError: no cameras, or none sees a Gaussian.
        SettingsError: pruning would leave no Gaussian, or a rasterizer that cannot be used here.
        WeightsError: no weights.
    """
    if not cameras:
        raise CameraError("There are no cameras. Give a camera file, or let --orbit make some.")
    timer = timer or Timer()
    with timer("planning"):
        fitted = fit_cameras(cameras, settings)
        weights = at_scale(weights or load_network_weights("auto"), settings.feature_scale)
        workshop = equip(scene, fitted, settings, weights, collectives, rasterizer)
        if looked is None:
            with timer("survey"):
                looked = survey(scene, fitted, workshop.rasterizer, collectives, show)
        link = probe_link(collectives, workshop.network.device)
        # Timings differ from rank to rank: one decides for all.
        plan = collectives.broadcast(lambda: decide(measure(workshop, looked, link), settings, measured=measured))
        if orbit is not None:
            plan = replace(plan, decisions=(*orbit_decisions(orbit, fitted, looked), *plan.decisions))
        if refinement is not None:
            decisions = (refine_decision(refinement, settings), *plan.decisions)
            plan = replace(plan, refinement=refinement, decisions=decisions)
    return plan, workshop
