"""All decisions before the first iteration, as a pure function of probe and settings.

It neither renders nor measures anything: the same probe and settings give the same plan.
"""

from __future__ import annotations

from dataclasses import replace

from sgsst_core.decision import Decision
from sgsst_core.number_format import duration
from sgsst_core.planning import choices
from sgsst_core.planning.cost import CostModel, tiling_of
from sgsst_core.planning.facts import Probe
from sgsst_core.planning.measurement_choice import LEAST_ALLOWED, LEVELS, allowed_seconds
from sgsst_core.planning.plan import Plan, Prediction
from sgsst_core.planning.view_costs import RankPart
from sgsst_core.settings import Settings


def decide(probe: Probe, settings: Settings, *, measured: bool = False) -> Plan:
    """Plan a job: choose what to compute, predict its cost, and then choose ranks and measurements.

    Args:
        probe: Measured facts.
        settings: Settings of the job.
        measured: Whether quality is measured between steps and a report is written, as in `sgsst stylize`.
    """
    survey, machine, tiling = probe.survey, probe.machine, tiling_of(probe, settings)
    rendered = choices.rendered_gaussians(survey)
    optimized = survey.total_blend_weights > 0
    weighted, weighted_lines = choices.position_weights(survey, settings)
    scan = choices.is_scan(survey, weighted=weighted)
    background = choices.training_background(settings, scan=scan)
    warm_start, start_lines = choices.warm_start(survey, settings, scan=scan)
    steps_coarse, coarse_lines = choices.steps_coarse(choices.computed_scales(probe.sizes, settings), settings)
    visits = choices.Visits.of(survey, probe.sizes, settings)
    cached_weights, weights_line = choices.blend_weights(probe, settings, visits)
    caches = cached_weights != "none"
    precision, precision_lines = choices.precision(probe, settings)
    phases = bool(steps_coarse) + bool(settings.steps_sos)
    graphs, launch_lines = choices.launches(probe, settings, visits, phases)
    plan = Plan(
        survey=survey,
        optimized=optimized if probe.frozen is None else optimized & ~probe.frozen,
        seen=rendered,
        covered=tuple(survey.covered),
        weighted=weighted,
        steps_coarse=steps_coarse,
        training_background=background,
        warm_start=warm_start,
        memory_limit=machine.memory_limit,
        device=machine.device,
        rasterizer="cached" if caches else probe.rasterizer,
        uncached=probe.rasterizer,
        precision=precision,
        graphs=graphs,
        cached_weights=cached_weights,
        measured=measured,
    )
    model = CostModel(plan, probe, settings)
    ranks, rank_lines, part = 1, list[Decision](), RankPart()
    if machine.ranks == 1:
        steps, activations = model.on_one_rank()
    else:
        choice, steps, activations, part = model.on_several_ranks()
        ranks, rank_lines = choice.ranks, [choices.about_ranks(choice, machine.ranks, probe.link)]
    prediction, level, loss_views = model.whole_job(steps, activations, part)
    plan = replace(
        plan, spare=model.spare(), ranks=ranks, measuring=level, loss_views=loss_views, prediction=prediction
    )
    lines = (
        *choices.about_gaussians(probe, rendered, settings),
        *choices.about_views(probe),
        *choices.about_uncovered_pixels(model, probe),
        *weighted_lines,
        *choices.about_training_background(background, survey, settings, model),
        *start_lines,
        *choices.about_colors(settings),
        *choices.about_network(model, probe, settings),
        *choices.about_rasterizer(probe, cached=caches),
        *launch_lines,
        weights_line,
        *choices.about_scales([tiling.scale_count(size) for size in model.sizes], settings),
        *coarse_lines,
        *choices.about_early_stop(background, len(plan.covered), settings),
        *choices.about_shared_gpus(probe),
        *rank_lines,
        *precision_lines,
        *([_about_measuring(plan, prediction, settings)] if measured else []),
    )
    return replace(plan, decisions=lines)


def _about_measuring(plan: Plan, expected: Prediction, settings: Settings) -> Decision:
    """Return the decision about measurements outside the steps and their cost."""
    steps = expected.job - expected.measuring
    cost = f"about {duration(expected.measuring, ' ')} in addition to {duration(steps, ' ')} of steps"
    losses = f"the initial loss on {_count(plan.loss_views, 'view')}"
    if not settings.measure:
        return Decision("measuring", f"{losses} only", f"requested; {cost}")
    level = LEVELS[plan.measuring]
    moments = level.moments(plan.steps_coarse + settings.steps_sos)
    when = f"at {len(moments)} moments" if len(moments) > 1 else "at the end"
    novel = f", and {when} up to {_count(level.views, 'novel view')}" if moments else " only"
    allowed = duration(allowed_seconds(settings.measure, steps), " ")
    return Decision(
        "measuring",
        f"{losses}{novel}",
        f"{cost}; {allowed} is allowed, {settings.measure:.0%} of the steps' time or {LEAST_ALLOWED:.0f} s, and less "
        "is measured if the first novel view takes longer",
    )


def _count(number: int, what: str) -> str:
    return f"{number} {what}{'' if number == 1 else 's'}"
