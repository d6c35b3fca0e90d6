"""Prediction of a job's time and memory from its trial, and the choices that depend on the trial."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace

from sgsst_core.budget import measuring_memory, memory_for, peak_memory
from sgsst_core.decision import Decision
from sgsst_core.loss.scale_weights import ScaleWeights, scale_count
from sgsst_core.number_format import duration
from sgsst_core.planning import choices
from sgsst_core.planning.context import Facts, NetworkPixels, Saving
from sgsst_core.planning.measurement_choice import (
    LEVELS,
    RENDERED,
    Prices,
    allowed_seconds,
    choose_level,
    choose_loss_views,
    novel_view_seconds,
)
from sgsst_core.planning.plan import Plan, Prediction, Shape
from sgsst_core.settings import Settings
from sgsst_core.stylizing.trial import Trial

#: Time from the last step to the last file written: constant seconds for images and report, and seconds per Gaussian
#: for the neighbor search and for writing (measured with 4 million Gaussians on two cores; an estimate elsewhere).
_ENDING_SECONDS, _ENDING_SECONDS_PER_GAUSSIAN = 1.5, 4e-6
#: Portion of `_ENDING_SECONDS_PER_GAUSSIAN` for the neighbor search. If some Gaussians are unseen, the search is
#: repeated at every measurement.
_NEIGHBORS_SECONDS_PER_GAUSSIAN = 1.5e-6
#: Bytes per Gaussian of the neighbor search for unseen Gaussians: result, color change, positions, and search tree.
_SEARCH_BYTES = 120
#: Memory of measurements and report apart from the data of novel views: libraries, LPIPS, images.
_MEASURING_BYTES = 100 << 20
#: Bytes of a novel view per Gaussian (colors), and per pixel (coverage, and two warps).
_NOVEL_GAUSSIAN_BYTES, _NOVEL_PIXEL_BYTES = 12, 84
#: Time of a render without gradient, relative to one with gradient, and renders for the depth of a novel view.
_RENDER, _DEPTH_RENDERS = 0.5, 2
#: Seconds of a job from which on the plan offers a time budget.
_LONG_SECONDS = 3600.0


def ending_seconds(gaussians: int) -> float:
    """Return the seconds from the last step of a job to its last file, except for measurements."""
    return _ENDING_SECONDS + _ENDING_SECONDS_PER_GAUSSIAN * gaussians


def with_spare_memory(plan: Plan, facts: Facts, activations: int) -> Plan:
    """Add to a plan the memory for activations that the steps of a single rank on a GPU do not need.

    Args:
        activations: Bytes of the activations of a view.
    """
    if plan.device == "cpu" or facts.machine.ranks > 1:
        return plan
    budget, needed = memory_for("activations", facts.machine.memory), activations
    if plan.measured and plan.is_approximated:  # the float32 reference needs more
        needed = max(min(int(activations * _reference_size(plan)), budget), activations)
    # A CUDA graph does not share its memory: evaluating the loss without the graph needs the same amount again.
    return replace(plan, spare=max(budget - needed - (activations if plan.graphs else 0), 0))


def completed_plan(
    plan: Plan,
    facts: Facts,
    settings: Settings,
    pixels: NetworkPixels,
    trials: Mapping[Shape, Trial],
    cost: Saving | None,
) -> Plan:
    """Choose ranks, graphs and measurements from the trials of a plan, predict its cost, and list its decisions.

    Args:
        plan: Plan from `draft_plan`.
        trials: Trials by number of ranks and groups.
        cost: Cost of launching a view's loss; None if it was not measured.
    """
    seconds = step_seconds(plan, facts, settings, trials)
    shape = choices.choose_ranks(seconds)
    trial, settings = trials[shape], choices.with_groups(settings, shape[1])
    coarse = settings.steps_coarse if plan.steps_coarse else 0
    plan = replace(plan, ranks=shape[0], groups=shape[1], steps_coarse=coarse)
    plan = replace(plan, graphs=choices.uses_graphs(plan, facts, settings, cost))
    alone = next((sos_seconds(own, facts, settings) / each[1] for each, own in trials.items() if each[0] == 1), None)
    one_rank = shape[1] * alone if alone and facts.machine.ranks > 1 else None
    prediction = replace(_predicted_steps(plan, facts, settings, trial, cost), seconds_one_rank=one_rank)
    if plan.measured:
        plan, prediction = _with_measurements(plan, prediction, facts, settings, trial)
    process, device = _peak_bytes(plan, facts, settings, trial)
    plan = replace(plan, prediction=replace(prediction, peak_bytes=process, device_bytes=device))
    saved = max(trial.render - trial.sos.of("render", "raster_backward"), 0.0)
    parts = {**trial.sos.parts, "cached weights": saved}
    lines = [*choices.decisions(plan, facts, settings, pixels, parts, cost, seconds)]
    lines += [_about_measuring(plan, settings)] if plan.measured else []
    lines += _about_time(plan, facts, settings)
    return replace(plan, decisions=tuple(lines))


def step_seconds(plan: Plan, facts: Facts, settings: Settings, trials: Mapping[Shape, Trial]) -> dict[Shape, float]:
    """Return the mean seconds of a step by number of ranks and groups."""
    coarse = plan.steps_coarse
    sos = settings.steps_sos or int(not coarse)  # phase 1 may have been the only one and be skipped
    return {
        shape: (coarse * trial.coarse.seconds + sos * sos_seconds(trial, facts, settings)) / (coarse + sos)
        for shape, trial in trials.items()
    }


def sos_seconds(trial: Trial, facts: Facts, settings: Settings) -> float:
    """Return the seconds of a step of phase 2 on average, because steps may leave out scales."""
    count = max(scale_count(*size, settings.coarsest_side) for size in facts.sizes)
    left_out = 1 - ScaleWeights(settings.scales).sampled_cost(count, settings.scale_sampling)
    return trial.sos.seconds - left_out * (trial.sos.seconds - trial.coarse.seconds)


def _predicted_steps(plan: Plan, facts: Facts, settings: Settings, trial: Trial, cost: Saving | None) -> Prediction:
    """Return the prediction for the steps, with first visits and style; those of the trial have been made already."""
    views = len(plan.covered)
    saved = settings.views_per_step * cost.saved if cost and plan.graphs else 0.0
    unvisited = max(1 - trial.views / views, 0.0)
    phases = [
        (steps, max(seconds - saved, 0.0), first * unvisited)
        for steps, seconds, first in (
            (settings.steps_sos, sos_seconds(trial, facts, settings), trial.sos.first),
            (plan.steps_coarse, trial.coarse.seconds, trial.coarse.first),
        )
    ]
    style = trial.style * max(len({facts.sizes[index] for index in plan.covered}) - 1, 0)
    job = style + sum(
        steps * seconds + min(steps * settings.views_per_step, views) * first for steps, seconds, first in phases
    )
    (_, seconds, first), (_, seconds_coarse, first_coarse) = phases
    return Prediction(
        seconds,
        seconds_coarse,
        0,
        communication=trial.sos.of("communication"),
        first_visit=first,
        first_visit_coarse=first_coarse,
        style=style,
        job=min(job, settings.within or job),
    )


def _with_measurements(
    plan: Plan, expected: Prediction, facts: Facts, settings: Settings, trial: Trial
) -> tuple[Plan, Prediction]:
    """Choose the measurements of a job, and add their time to its prediction.

    Novel views are assumed to cost as much as the job's own.
    """
    count, sos, total = len(plan.covered), trial.sos, plan.steps_coarse + settings.steps_sos
    evaluation = sum(sos.parts.values()) - sos.of("vgg_backward", "raster_backward", "optimizer")
    unvisited = max(1 - settings.steps_sos * settings.views_per_step / count, 0.0)
    before_and_after = evaluation + unvisited * expected.first_visit
    # `target_loss` is relative to the initial loss on these views. Their number must not depend on timings, or timings
    # would determine the step at which the job ends.
    loss_views = plan.loss_views
    if not settings.target_loss:
        loss_views = choose_loss_views(settings, expected.job, before_and_after, count)
    ending = ending_seconds(facts.gaussians)
    losses = loss_views * before_and_after
    expected = replace(expected, evaluation=loss_views * evaluation, losses=losses, ending=ending)
    neighbors = _NEIGHBORS_SECONDS_PER_GAUSSIAN * facts.gaussians if _searches_neighbors(plan, settings) else 0.0
    prices = Prices(
        setup=RENDERED * (trial.prepare + _DEPTH_RENDERS * _RENDER * trial.render),
        view=RENDERED * _RENDER * trial.render + sos.of("vgg_forward", "statistics"),
        moment=neighbors + (2 * expected.seconds if plan.is_approximated else 0.0),
    )
    level = choose_level(prices, novel_view_seconds(settings, expected), total)
    measuring = losses + prices.of(LEVELS[level], len(LEVELS[level].moments(total)))
    expected = replace(expected, measuring=measuring, job=expected.job + measuring)
    return replace(plan, measuring=level, loss_views=loss_views), expected


def _peak_bytes(plan: Plan, facts: Facts, settings: Settings, trial: Trial) -> tuple[int, int | None]:
    """Return the peak memory in bytes of a rank's process, and of its GPU (None on a CPU)."""
    memory, novel, measuring = facts.machine.memory * facts.machine.ranks // max(plan.ranks, 1), 0, 0
    if plan.measured:
        level, measuring = LEVELS[plan.measuring].views, _MEASURING_BYTES
        pixels = max(height * width for height, width in facts.sizes)
        colors = RENDERED * facts.gaussians * _NOVEL_GAUSSIAN_BYTES if facts.used_degree else 0
        novel = min(level * (colors + _NOVEL_PIXEL_BYTES * pixels), measuring_memory(memory))
        novel += min(RENDERED * level * trial.novel, trial.free)
        # The float32 reference evaluates the loss with larger activations.
        novel += int((_reference_size(plan) - 1) * trial.passing)
    if trial.device is not None:
        graphs = trial.passing if plan.graphs else 0
        return trial.process + measuring, trial.device + trial.growth + novel + graphs
    searching = _SEARCH_BYTES * facts.gaussians if _searches_neighbors(plan, settings) else 0
    held = trial.process - trial.passing + trial.growth + measuring + novel
    return max(peak_memory(), held + max(trial.passing, searching)), None


def _reference_size(plan: Plan) -> float:
    """Return the size of a feature value in the float32 reference, relative to the job's network."""
    return 2.0 if plan.precision in ("bfloat16", "float16") else 1.0


def _searches_neighbors(plan: Plan, settings: Settings) -> bool:
    """Return whether unseen Gaussians follow their neighbors' color change."""
    return settings.unseen == "neighbors" and not bool(plan.seen.all())


def _about_measuring(plan: Plan, settings: Settings) -> Decision:
    """Return the decision about measurements outside the steps and their cost."""
    expected = plan.prediction
    assert expected is not None
    steps = expected.job - expected.measuring
    cost = f"about {duration(expected.measuring, ' ')} in addition to {duration(steps, ' ')} of steps"
    losses = f"the initial loss on {_count(plan.loss_views, 'view')}"
    if not settings.measure:
        return Decision("measuring", f"{losses} only", f"requested; {cost}")
    level = LEVELS[plan.measuring]
    moments = level.moments(plan.steps_coarse + settings.steps_sos)
    when = f"at {len(moments)} moments" if len(moments) > 1 else "at the end"
    novel = f", and {when} up to {_count(level.views, 'novel view')}" if moments else " only"
    least = "" if settings.within else " or, in short jobs, half of it"
    allowed = duration(allowed_seconds(settings, steps), " ")
    return Decision(
        "measuring",
        f"{losses}{novel}",
        f"{cost}; {allowed} is allowed, {settings.measure:.0%} of the steps' time{least}, and less is measured if the "
        "first novel view takes longer",
    )


def _about_time(plan: Plan, facts: Facts, settings: Settings) -> list[Decision]:
    """Return the warning that a job takes long, with what is possible in an hour; empty if it takes less than that."""
    seconds = plan.prediction.job if plan.prediction else 0.0
    if settings.within or seconds <= _LONG_SECONDS:
        return []
    side = int(max(max(size) for size in facts.sizes) * math.sqrt(_LONG_SECONDS / seconds)) // 32 * 32
    faster = f"--within 1h (`within` 3600 in a request) paints it in an hour, at about {max(side, 96)} px"
    return [Decision("time", f"warning: the steps take about {duration(seconds, ' ')}", faster)]


def _count(number: int, what: str) -> str:
    return f"{number} {what}{'' if number == 1 else 's'}"
