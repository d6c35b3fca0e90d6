"""Predicted time of a whole job: steps, first visits of views, and measurements within their budget."""

from __future__ import annotations

from dataclasses import dataclass, replace

from sgsst_core.decision import Decision
from sgsst_core.planning.choices import pruned_gaussians
from sgsst_core.planning.cost import Work
from sgsst_core.planning.measuring import (
    LEAST_ALLOWED,
    LEVELS,
    LOSS_VIEWS,
    RENDERED,
    Prices,
    allowed_seconds,
    choose_level,
    choose_loss_views,
    novel_view_seconds,
)
from sgsst_core.planning.plan import Plan, Prediction
from sgsst_core.planning.probe import Probe
from sgsst_core.planning.visits import RENDER, Visits
from sgsst_core.settings import Settings

#: Time from the last step to the last file written: constant seconds for images and report, and seconds per Gaussian
#: for the neighbor search and for writing (measured with 4 million Gaussians on two cores; an estimate elsewhere).
ENDING_SECONDS = 1.5
ENDING_SECONDS_A_GAUSSIAN = 4e-6
#: Portion of `ENDING_SECONDS_A_GAUSSIAN` for the neighbor search. If some Gaussians are unseen, the search is repeated
#: at every measurement.
_NEIGHBORS_SECONDS_A_GAUSSIAN = 1.5e-6
#: Renders needed to compute the depth of a novel view.
_DEPTH_RENDERS = 2


@dataclass(frozen=True)
class Measured:
    """Chosen measurements outside the steps.

    Attributes:
        level: See `Plan.measuring`.
        loss_views: See `Plan.loss_views`.
    """

    level: int
    loss_views: int


def whole_job(
    expected: Prediction, plan: Plan, probe: Probe, settings: Settings, *, work: Work, visits: Visits
) -> tuple[Prediction, Measured]:
    """Extend a prediction to the whole job, and choose its measurements.

    Args:
        expected: Prediction for the steps.
        plan: Plan, complete except for prediction and measurements.
        probe: Measured facts.
        settings: Settings of the job.
        work: Work of an iteration on all scales.
        visits: Additional costs of views.
    """
    expected = replace(
        expected,
        first_visit=visits.first(coarse=False),
        first_visit_coarse=visits.first(coarse=True),
        style=probe.styles * work.without_region * probe.network.rate.forward,
    )
    steps = _steps_seconds(expected, plan, settings)
    expected = replace(expected, job=steps)
    views = len(plan.covered)
    if not plan.measured:
        return expected, Measured(plan.measuring, min(LOSS_VIEWS[0], views))
    once = RENDER * visits.rasterized() + visits.later(coarse=False) + work.evaluation(probe.network.rate)
    unvisited = max(1 - settings.steps_sos * settings.views_per_step / views, 0.0)
    price = 2 * once + unvisited * expected.first_visit
    # `target_loss` is relative to the initial loss on these views. Their number must not depend on timings, or timings
    # would determine the step at which the job ends.
    share = settings.measure
    loss_views = min(LOSS_VIEWS[0], views) if settings.target_loss else choose_loss_views(share, steps, price, views)
    ending = ENDING_SECONDS + ENDING_SECONDS_A_GAUSSIAN * probe.scene.gaussians
    expected = replace(expected, evaluation=loss_views * once, losses=loss_views * price, ending=ending)
    prices, total = _prices(expected, plan, probe, settings, work), plan.steps_coarse + settings.steps_sos
    level = choose_level(prices, novel_view_seconds(share, expected), total)
    measuring = expected.losses + prices.of(LEVELS[level], len(LEVELS[level].moments(total)))
    return replace(expected, measuring=measuring, job=steps + measuring), Measured(level, loss_views)


def _steps_seconds(expected: Prediction, plan: Plan, settings: Settings) -> float:
    """Return the time in seconds of all steps, including first visits and style."""
    phases = (
        (plan.steps_coarse, expected.seconds_coarse, expected.first_visit_coarse),
        (settings.steps_sos, expected.seconds, expected.first_visit),
    )
    views = len(plan.covered)
    steps = expected.style + sum(
        count * seconds + min(count * settings.views_per_step, views) * first for count, seconds, first in phases
    )
    return min(steps, settings.max_seconds or steps)


def _prices(expected: Prediction, plan: Plan, probe: Probe, settings: Settings, work: Work) -> Prices:
    """Return the expected cost of measuring novel views, assuming that one costs as much as a view of the job."""
    raster, forward = probe.raster, work.pixels * probe.network.rate.forward
    render = RENDER * raster.seconds
    pruned = bool(pruned_gaussians(plan.survey, plan.seen).any())
    approximated = plan.precision != "float32" or plan.cached_weights == "half" or pruned
    unseen = settings.unseen == "neighbors" and not bool(plan.seen.all())
    neighbors = _NEIGHBORS_SECONDS_A_GAUSSIAN * probe.scene.gaussians if unseen else 0.0
    return Prices(
        setup=RENDERED * (raster.first_seconds + raster.colors_seconds + _DEPTH_RENDERS * render),
        view=RENDERED * render + forward,
        moment=neighbors + (2 * expected.seconds if approximated else 0.0),
    )


def of_measuring(plan: Plan, expected: Prediction, settings: Settings) -> Decision:
    """Return the plan's line about measurements outside the steps and their cost."""
    steps = expected.job - expected.measuring
    cost = f"about {expected.measuring:.2g} s in addition to {steps:.3g} s of steps"
    losses = f"the loss before and after on {_count(plan.loss_views, 'view')}"
    if not settings.measure:
        return Decision("measuring", f"{losses} only", f"requested; {cost}")
    level = LEVELS[plan.measuring]
    moments = level.moments(plan.steps_coarse + settings.steps_sos)
    when = f"at {len(moments)} moments" if len(moments) > 1 else "at the end"
    found = f", and {when} up to {_count(level.views, 'novel view')}" if moments else " only"
    allowed = f"{allowed_seconds(settings.measure, steps):.3g} s are allowed, {settings.measure:.0%} of the steps' time"
    return Decision(
        "measuring",
        f"{losses}{found}",
        f"{cost}; {allowed} or {LEAST_ALLOWED:.0f} s, and less is measured if the first novel view takes longer",
    )


def _count(number: int, what: str) -> str:
    return f"{number} {what}{'' if number == 1 else 's'}"
