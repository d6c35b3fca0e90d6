"""What a whole job is expected to take: steps, first visits of views, and measuring, which is kept to its share."""

from __future__ import annotations

from dataclasses import replace

from sgsst_core.planning.choices import pruned_gaussians
from sgsst_core.planning.cost import Work
from sgsst_core.planning.measuring import LEVELS, RENDERED, Prices, choose_level, held_out_seconds
from sgsst_core.planning.plan import Decision, Plan, Prediction
from sgsst_core.planning.probe import Probe
from sgsst_core.settings import Settings

#: Views on which a job is evaluated before and after.
EVALUATION_VIEWS = 4
#: Making a view's kept weights on the CPU, in renders with gradient.
KEEPING_RENDERS = 3
#: A render without its gradient, in renders with it.
_RENDER = 0.5
#: Small renders by which a held-out view is judged: coverage and depth, of itself and two neighbours.
_OUTLOOKS = 6


def whole_job(
    expected: Prediction, plan: Plan, probe: Probe, settings: Settings, *, work: Work, coarse: Work
) -> tuple[Prediction, int]:
    """The prediction with what the whole job takes, and what is measured in it (`Plan.measuring`).

    Args:
        expected: of the steps.
        plan: but for prediction and measuring.
        work: of an iteration on all scales, and `coarse` on the coarsest alone.
    """
    raster, forward = probe.raster, probe.network.rate.forward
    rendered = _RENDER * raster.seconds if settings.content_weight else 0.0
    rate = forward if settings.content_weight else 0.0
    lists = raster.first_seconds + _keeping_seconds(plan, probe)
    in_coarse = plan.steps_coarse > 0
    views = len(plan.covered)
    expected = replace(
        expected,
        first_visit=rendered + work.pixels * rate + (0.0 if in_coarse and not plan.coarse_weights else lists),
        first_visit_coarse=rendered + coarse.pixels * rate + (raster.first_seconds if plan.coarse_weights else lists),
        evaluation=min(views, EVALUATION_VIEWS) * (_RENDER * raster.seconds + work.pixels * forward),
    )
    phases = (
        (plan.steps_coarse, expected.seconds_coarse, expected.first_visit_coarse),
        (settings.steps_sos, expected.seconds, expected.first_visit),
    )
    steps = sum(
        count * seconds + min(count * settings.views_per_step, views) * first for count, seconds, first in phases
    )
    expected = replace(expected, job=min(steps, settings.max_seconds or steps))
    if not plan.measured:
        return expected, 0
    prices, total = _prices(expected, plan, probe, work), plan.steps_coarse + settings.steps_sos
    place = choose_level(prices, held_out_seconds(settings.measure, expected), total)
    held_out = prices.of(LEVELS[place], len(LEVELS[place].moments(total))) if settings.measure else 0.0
    measuring = 2 * expected.evaluation + held_out
    return replace(expected, measuring=measuring, job=expected.job + measuring), place


def _keeping_seconds(plan: Plan, probe: Probe) -> float:
    """Of making a view's kept weights."""
    if plan.kept_weights == "none":
        return 0.0
    seconds = probe.raster.keeping_seconds
    return KEEPING_RENDERS * probe.raster.seconds if seconds is None else seconds


def _prices(expected: Prediction, plan: Plan, probe: Probe, work: Work) -> Prices:
    """What held-out views are expected to cost; they lie between the job's, and are taken to be like them."""
    raster = probe.raster
    render = raster.first_seconds + _RENDER * raster.seconds
    pruned = bool(pruned_gaussians(plan.survey, plan.seen).any())
    approximated = plan.precision != "float32" or plan.kept_weights == "half" or pruned
    return Prices(
        setup=RENDERED * (_OUTLOOKS * raster.first_seconds + render),
        view=RENDERED * render + work.pixels * probe.network.rate.forward,
        moment=2 * expected.seconds if approximated else 0.0,
    )


def of_measuring(plan: Plan, expected: Prediction, settings: Settings) -> Decision:
    """The line that says what is measured beside the steps, and what it costs."""
    cost = f"about {expected.measuring:.2g} s beside {expected.job - expected.measuring:.3g} s of steps"
    if not settings.measure:
        return Decision("measuring", "the loss before and after alone", f"asked for; {cost}")
    level = LEVELS[plan.measuring]
    moments = level.moments(plan.steps_coarse + settings.steps_sos)
    when = f"at {len(moments)} moments" if len(moments) > 1 else "at the end"
    views = f"{level.views} view{'s' if level.views > 1 else ''}"
    return Decision(
        "measuring",
        f"the loss before and after, and {when} up to {views} between the cameras",
        f"{cost}; {settings.measure:.0%} of the steps' time is allowed, or 30 s, and less is measured where the first "
        "view between the cameras takes longer",
    )
