"""Planner: survey all views, decide what a job leaves out, make a trial of it, and predict its cost."""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import replace
from functools import partial

from sgsst_core.budget import memory_for
from sgsst_core.decision import ANOTHER_LOSS, Decision
from sgsst_core.errors import CameraError
from sgsst_core.features.network_weights import BackboneWeights, load_network_weights
from sgsst_core.loss.feature_scale import weights_for
from sgsst_core.loss.scale_weights import check_scales, check_stroke_depth
from sgsst_core.loss.sos import make_loss
from sgsst_core.loss.statistics_terms import has_statistics
from sgsst_core.orbit.choice import Orbit, orbit_decisions
from sgsst_core.parallel.collectives import ALONE, Collectives, RankLeftOut
from sgsst_core.planning import choices
from sgsst_core.planning.context import (
    Facts,
    NetworkPixels,
    Networks,
    PlanningContext,
    available_precisions,
    common_device,
    compare_precisions,
    equip,
    weight_cost,
)
from sgsst_core.planning.plan import Device, Plan, Shape
from sgsst_core.planning.survey import ShowPlanning, Survey, survey_views
from sgsst_core.planning.time_budget import SecondsLeft, TimeChoice, ViewCost, choosable, choose, pixels_of
from sgsst_core.progress import Progress
from sgsst_core.refine.choice import refine_decision
from sgsst_core.refine.split import Refinement
from sgsst_core.regions.definition import Regions, region_decisions
from sgsst_core.scene.camera import Camera, fit_cameras, resized, spread
from sgsst_core.scene.colors import color_subspace_of
from sgsst_core.scene.gaussians import Scene
from sgsst_core.scene.spherical_harmonics import harmonics_energy
from sgsst_core.settings import PlannedPrecision, Settings
from sgsst_core.style import Style
from sgsst_core.stylizing.job import StylizationJob, continued, prepare_job
from sgsst_core.stylizing.photo_prefetch import PhotoLoader
from sgsst_core.stylizing.prediction import (
    completed_plan,
    ending_seconds,
    sos_seconds,
    step_seconds,
    with_spare_memory,
)
from sgsst_core.stylizing.trial import Trial, launch_cost, run_trial
from sgsst_core.timing import Timer

#: Longer side in pixels of the views that a time budget is chosen from, and their number for each rank. The time of
#: larger views is about in proportion to their pixels; smaller ones take a third more for each pixel on a CPU, and hide
#: how much a GPU can do at once.
_TRIED_SIDE: dict[Device, int] = {"cpu": 256, "cuda": 1280}
_TRIED_VIEWS = 4


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
    left: SecondsLeft | None = None,
    networks: Networks | None = None,
) -> StylizationJob:
    """Plan and prepare a job. Every rank must call this with the same arguments, and gets the same plan.

    The job keeps what the survey and the trial have computed.

    Args:
        scene: Scene, after refinement if there was one.
        cameras: Cameras; larger ones are reduced to `settings.max_resolution`.
        weights: Weights of the feature network; None for VGG19, or VGG16 if only that is installed.
        photos: See `prepare_job`.
        rasterizer: Rasterizer that computes blend weights: "cpu", "triton" or "reference". None to choose one.
        plan: Plan from an earlier run of the same job, which is used unchanged; None to make one.
        survey: Survey from an earlier plan of the same job; None to survey the views.
        groups: `Plan.groups` of an earlier plan of the same job; None to choose them.
        measured: Whether quality is measured between steps and a report is written, as in `sgsst stylize`.
        show: Callback for the progress of the survey and the trial.
        timer: Timer that records the survey as "survey", other planning as "planning", and the preparation of a job
            with an earlier plan as "preparing".
        orbit: Orbit that produced the cameras, for the plan to report; None for cameras from files.
        about_inputs: Decisions about cameras and photos that start the plan.
        regions: Regions of the scene; None if there are none.
        refinement: Refinement that produced the scene, for the plan to report; None if it was not refined.
        chosen: Choice of the time budget, to which `cameras` and `photos` belong (`choose_within`); None without one.
        left: Seconds left of the time budget, for which the trial corrects the number of steps; None to leave it.
        networks: Networks of earlier plans of the same job, to reuse and to replace; None if this is the first plan.

    Raises:
        CameraError: If there are no cameras, or none sees a Gaussian.
        SettingsError: If regions freeze everything visible, views lack requested scales, or the rasterizer does not
            work here.
        WeightsError: If there are no weights.
        RankLeftOut: If the plan does not use this rank.
    """
    if not cameras:
        raise CameraError("There are no cameras. Give a camera file, or use --orbit.")
    timer, weights = timer or Timer(), weights_for(weights or load_network_weights("auto"), settings)
    asked, settings = settings, chosen.applied(settings) if chosen else settings

    def prepared(plan: Plan, context: PlanningContext | None = None) -> StylizationJob:
        return prepare_job(
            plan, scene, cameras, style, choices.with_groups(settings, plan.groups), weights=weights, photos=photos,
            collectives=collectives, planning_context=context, regions=regions,
        )  # fmt: skip

    if plan is not None:
        with timer("preparing"):
            return prepared(plan)
    with timer("planning"):
        fitted = fit_cameras(cameras, settings)
        check_scales(settings.scales, fitted, settings.coarsest_side)
        check_stroke_depth(settings, fitted, regions=regions is not None)
        context = equip(scene, fitted, settings, weights, collectives, rasterizer, networks)
        if survey is None:
            with timer("survey"):
                survey = survey_views(context.scene, fitted, context.rasterizer, collectives, show)
        if show:
            show(Progress(stage="probing"))
        precisions = available_precisions(settings, context.machine.device, collectives)
        facts = collectives.broadcast(lambda: _facts(context, survey, regions, precisions))
        draft = choices.draft_plan(facts, settings, measured=measured)
        network = context.networks.get(draft.precision, context.weights, settings, draft.device)
        context.networks.created, context.networks.precisions = {draft.precision: network}, facts.precisions
        context = replace(context, network=network)
        activations = memory_for("activations", context.machine.memory)
        pixels = NetworkPixels.of(draft, facts.sizes, make_loss(context.network, settings, activations).tiling)
        of_a_view = int(pixels.held * context.network.held_bytes_per_pixel())
        draft = with_spare_memory(draft, facts, of_a_view)
        lines = [*about_inputs]
        if refinement is not None:
            lines.append(refine_decision(refinement, settings))
        if orbit is not None:
            lines += orbit_decisions(orbit, fitted, survey.uncovered)
        if regions is not None:
            lines += region_decisions(regions, survey.total_blend_weights, [fitted[index] for index in draft.covered])
        lines += _about_styles(style, regions, settings)

        def shaped(shape: Shape) -> StylizationJob:
            return prepared(replace(draft, ranks=shape[0], groups=shape[1]), context)

        job, trials = _try_shapes(shaped, draft, facts, settings, groups, collectives, show)
        if chosen and left:
            correct = partial(_corrected, chosen, draft, asked, trials.values(), facts, left)
            chosen = collectives.broadcast(correct)
            settings = chosen.applied(asked)
            draft = replace(draft, steps_coarse=settings.steps_coarse if draft.steps_coarse else 0)
        cost = launch_cost(job) if job and choices.considers_graphs(draft, facts, job.settings) else None
        plan = collectives.broadcast(lambda: completed_plan(draft, facts, settings, pixels, trials, cost))
        plan = with_spare_memory(plan, facts, of_a_view)  # graphs, which the draft lacks, leave less
        lines += [chosen.decision(asked.within, plan.steps_coarse + settings.steps_sos)] if chosen else []
        intersections = max(trials[plan.ranks, plan.groups].spare - (draft.spare - plan.spare), 0)
        plan = replace(plan, spare_intersections=intersections, refinement=refinement, time_choice=chosen)
        plan = replace(plan, decisions=(*lines, *plan.decisions))
        if job and (plan.ranks, plan.groups) == (job.collectives.size, job.plan.groups):
            return continued(job, plan, choices.with_groups(settings, plan.groups))
        job = None  # frees its memory
        return prepared(plan, context)


def choose_within(
    scene: Scene,
    cameras: Sequence[Camera],
    style: Style,
    settings: Settings,
    left: SecondsLeft,
    *,
    weights: BackboneWeights | None = None,
    rasterizer: str | None = None,
    collectives: Collectives = ALONE,
    regions: Regions | None = None,
    show: ShowPlanning | None = None,
    networks: Networks | None = None,
) -> TimeChoice | None:
    """Choose what fits a time budget, from a trial of a few small views. Every rank must call this function.

    Args:
        left: Seconds left of the budget.
        networks: Networks to create for the trial, which `plan_job` can reuse; None if it does not.

    Returns:
        The choice; None if the settings give everything.
    """
    if not choosable(settings):
        return None
    if not cameras:
        raise CameraError("There are no cameras. Give a camera file, or use --orbit.")
    fitted, side, timer = fit_cameras(cameras, settings), _TRIED_SIDE[common_device(collectives)], Timer()
    small = [resized(each, min(side, each.side)) for each in spread(fitted, _TRIED_VIEWS * collectives.size)]
    own = {"max_resolution": side, "rebalance": False, "scales": (), "stroke_depth": False, "refine": 1.0}
    tried = plan_job(
        scene, small, style, settings.model_copy(update=own), weights=weights, rasterizer=rasterizer,
        collectives=collectives, regions=regions, timer=timer, show=show, networks=networks,
    ).plan.prediction  # fmt: skip
    assert tried is not None
    # The trial visits up to half of the views, so the prediction has half of the first visits.
    first, survey = 2 * tried.first_visit, timer.seconds.get("survey", 0.0) / len(small)
    cost = ViewCost(pixels_of(small, side, settings)[0], tried.seconds, first, survey)
    return collectives.broadcast(lambda: choose(fitted, settings, cost, left(), ending_seconds(len(scene))))


def _corrected(
    chosen: TimeChoice, draft: Plan, settings: Settings, trials: Collection[Trial], facts: Facts, left: SecondsLeft
) -> TimeChoice:
    """Return the choice of a time budget with the steps that fit after the trial.

    Args:
        draft: Plan of the chosen views.
        settings: Settings without the choice.
        left: Seconds left of the budget.
    """
    coarse = settings.steps_coarse if draft.steps_coarse else 0

    def seconds_of(trial: Trial) -> float:
        return coarse * trial.coarse.seconds + settings.steps_sos * sos_seconds(trial, facts, settings)

    best = min(trials, key=seconds_of)
    first = best.sos.first + (best.coarse.first if coarse else 0.0)
    once = min(chosen.steps_sos * settings.views_per_step, len(draft.covered)) * first
    return chosen.corrected(settings, seconds_of(best), once + ending_seconds(facts.gaussians), left())


def _try_shapes(
    prepared: Callable[[Shape], StylizationJob],
    draft: Plan,
    facts: Facts,
    settings: Settings,
    groups: int | None,
    collectives: Collectives,
    show: ShowPlanning | None,
) -> tuple[StylizationJob | None, dict[Shape, Trial]]:
    """Make a trial of a job with some numbers of ranks that divide each view, and with a view for each if that may pay.

    Args:
        groups: Groups of the job if they were chosen before.

    Returns:
        The last job, or None if this rank does not take part in it; and the trials by number of ranks and groups.
    """
    trials: dict[Shape, Trial] = {}
    ranks, shapes = facts.machine.ranks, [(count, groups or 1) for count in _rank_counts(facts.machine.ranks, settings)]

    def show_views(visited: int, views: int) -> None:
        if show:
            show(Progress(stage="probing", step=len(trials) * views + visited, total=len(shapes) * views))

    for shape in shapes:
        job = own = None  # frees the memory of the last one
        try:
            job = prepared(shape)
            own = run_trial(job, show_views)
        except RankLeftOut:
            pass
        of_first = collectives.all_gather(own)[0]
        assert of_first is not None  # the first rank takes part in every trial
        trials[shape] = of_first
        if shape == (ranks, 1) and not groups:
            seconds = step_seconds(draft, facts, settings, trials)
            shapes += [(ranks, ranks)] * choices.considers_groups(draft, facts, settings, seconds)
    return job, trials


def _rank_counts(available: int, settings: Settings) -> list[int]:
    """Return the numbers of ranks to try: all, half of them and so on. The job of the last trial can be continued."""
    if not settings.rebalance:
        return [available]
    return sorted({max(available >> halvings, 1) for halvings in range(available.bit_length())})


def _facts(
    context: PlanningContext, survey: Survey, regions: Regions | None, precisions: Sequence[PlannedPrecision]
) -> Facts:
    """Gather the facts on which the decisions before the trial depend; one rank does this for all."""
    scene, settings = context.scene, context.settings
    views = [context.cameras[index] for index in survey.covered]
    budget = memory_for("rasterizer", context.machine.memory)
    sizes = tuple((camera.height, camera.width) for camera in context.cameras)
    # A CPU compares on an image as small as the first trial's; on a GPU, speeds depend on the size of views.
    compared = context.networks.precisions if context.machine.device == "cpu" else None
    if compared is None and choices.compares_precisions(sizes, settings):
        compared = compare_precisions(context, views[0], precisions)
    return Facts(
        gaussians=len(scene),
        sh_degree=context.sh_degree,
        used_degree=scene.used_degree(survey.total_blend_weights > 0),
        harmonics_energy=harmonics_energy(scene, survey.total_blend_weights),
        sizes=sizes,
        survey=survey,
        machine=context.machine,
        rasterizer=context.rasterizer.name,
        weights=weight_cost(context.rasterizer, views, settings, budget),
        frozen=None if regions is None else regions.resolved(survey.total_blend_weights).frozen,
        deepest=max(context.network.layers),
        precisions=compared,
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
