"""Choices of a plan: what a job leaves out or does differently for its scene, and the plan lines with the reasons."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace

import numpy as np

from sgsst_core.budget import memory_for
from sgsst_core.decision import ANOTHER_LOSS, VIEWS, Decision
from sgsst_core.loss.convergence import MIN_FALL, window_length
from sgsst_core.loss.graphs import FIRST_VISITS, failure_is_fatal
from sgsst_core.loss.nearest import MAX_VECTORS, NEAREST_WEIGHTS
from sgsst_core.loss.scale_weights import ScaleWeights, scale_count
from sgsst_core.loss.statistics_terms import has_statistics
from sgsst_core.number_format import duration
from sgsst_core.parallel.division import Size
from sgsst_core.planning.context import LEAST_VISITS, Facts, NetworkPixels, Saving
from sgsst_core.planning.measurement_choice import LOSS_VIEWS
from sgsst_core.planning.plan import Plan, Shape
from sgsst_core.rasterizer import RASTERIZERS
from sgsst_core.settings import CachedWeights, PlannedBackground, PlannedPrecision, Settings

#: Fraction of uncovered pixels above which statistics are weighted by coverage, unless the settings say otherwise.
_UNCOVERED = 0.01
#: Above this fraction of uncovered pixels, views are assumed to show an object without background. (Views of a room
#: that was captured from only some places have holes of a few percent.)
_SCAN = 0.2
#: Fraction of the color energy that depends on the view direction, from which on attenuating it is recommended: it
#: then shows beside the style (benchmarks/results/README.md).
_VIEW_DEPENDENT = 0.05
#: Default training background for such an object (docs/quality.md).
_SCAN_BACKGROUND: PlannedBackground = "palette"
#: Speedup of convolutions from which on a CPU uses a precision instead of the more accurate one before it. Runs on one
#: machine must choose alike, also if it is busy: Winograd's algorithm reaches 1.7 to 2.2, and processors with
#: instructions for bfloat16 2.0 to 2.4, or several times more with matrix units. The speedup of a view's loss would
#: depend on its size.
_LEAST_SPEEDUP: dict[PlannedPrecision, float] = {"winograd": 1.0, "bfloat16": 2.0}
#: GPU that computes in each precision.
_GPU = "an NVIDIA GPU of compute capability 8.0 or higher"
#: Fraction of the greatest speedup that a more accurate precision must reach on a GPU.
_AS_FAST = 0.9
#: Relative error of the pixel gradient up to which a precision is chosen. With errors of 0.3, the float32 loss falls as
#: with float32 (docs/quality.md).
_LARGEST_ERROR = 0.5
#: Pixels through the network in all steps below which no precisions are compared: seconds on two cores.
_COMPARED_PIXELS = 1_000_000
#: Minimum visits per view size for which a CUDA graph of the loss is considered at all.
LEAST_GRAPH_VISITS = 20
#: The same if the capture is first tried in a child process, whose start takes as long as so many visits save: 6 s.
LEAST_TRIED_VISITS = 1000
#: Minimum fraction of a step's time that additional ranks must save.
LEAST_GAIN = 0.03
#: Fraction of the steps' time that steps with a view for each rank must save in comparison with divided views.
_LEAST_GROUP_GAIN = 0.1
#: Number of steps with one view that a step with several is worth, by the loss left (benchmarks/results/README.md).
#: More views were not measured.
_WORTH = {1: 1.0, 2: 1.9, 4: 2.6, 8: 3.4}
#: Bytes per optimized Gaussian: color, gradient and two moments, float32.
OPTIMIZER_BYTES = 4 * 3 * 4


# --- choices -------------------------------------------------------------------------------------------------------


def draft_plan(facts: Facts, settings: Settings, *, measured: bool) -> Plan:
    """Choose everything that needs no trial. The plan lacks ranks, graphs, measurements, decisions and prediction.

    Args:
        measured: Whether quality is measured between steps and a report is written, as in `sgsst stylize`.
    """
    survey, requested = facts.survey, settings.position_weights
    weighted = requested == "on" or (requested == "auto" and survey.uncovered_fraction > _UNCOVERED)
    scan = weighted and survey.uncovered_fraction > _SCAN
    background, warm = settings.training_background, settings.warm_start
    seen = survey.total_blend_weights > 0
    draft = Plan(
        survey=survey,
        optimized=seen if facts.frozen is None else seen & ~facts.frozen,
        seen=seen,
        covered=tuple(survey.covered),
        weighted=weighted,
        # Optimization changes the overall color of a scene only slowly (docs/quality.md). If only luminance is
        # stylized, a warm start pays off only for scans, because nothing around the object determines its brightness.
        warm_start=scan or settings.preserve_colors != "luminance" if warm is None else warm,
        training_background=(_SCAN_BACKGROUND if scan else "background") if background == "auto" else background,
        steps_coarse=0 if _has_one_phase(facts, settings) else settings.steps_coarse,
        memory_limit=facts.machine.memory_limit,
        device=facts.machine.device,
        rasterizer=facts.rasterizer,
        uncached=facts.rasterizer,
        precision=choose_precision(facts, settings),
        measured=measured,
        loss_views=min(LOSS_VIEWS[0], len(survey.covered)),
    )
    cached = _blend_weights(draft, facts, settings)[0]
    return draft if cached == "none" else replace(draft, rasterizer="cached", cached_weights=cached)


def compares_precisions(sizes: Sequence[Size], settings: Settings) -> bool:
    """Return whether a job without float32 would save enough time to compare precisions.

    Args:
        sizes: (height, width) of each view.
    """
    if settings.precision != "auto":
        return settings.precision != "float32"
    pixels = 0.0
    for height, width in sizes:
        coarsest = scale_count(height, width, settings.coarsest_side) - 1
        pixels += height * width * (settings.steps_sos + settings.steps_coarse / 4**coarsest) / len(sizes)
    return settings.views_per_step * pixels >= _COMPARED_PIXELS


def choose_precision(facts: Facts, settings: Settings) -> PlannedPrecision:
    """Choose the precision of the network: the requested one if its convolutions are faster than in float32.

    With "auto", a CPU uses a less accurate precision if it is much faster; a GPU uses the most accurate of the fastest
    precisions.
    """
    measured = facts.precisions or {}
    if settings.precision != "auto":
        requested = measured.get(settings.precision) if settings.precision != "float32" else None
        return settings.precision if requested and requested.error else "float32"
    on_cpu = facts.machine.device == "cpu"
    errors = {
        name: own.error.relative_error
        for name, own in measured.items()
        if own.error and own.error.relative_error <= _LARGEST_ERROR and (on_cpu or own.speedup > 1)
    }
    if on_cpu:
        chosen: PlannedPrecision = "float32"
        for name, least in _LEAST_SPEEDUP.items():
            before = 1.0 if chosen == "float32" else measured[chosen].convolution
            chosen = name if name in errors and measured[name].convolution >= least * before else chosen
        return chosen
    most = max((measured[name].speedup for name in errors), default=0.0)
    fastest = [name for name in errors if measured[name].speedup >= _AS_FAST * most]
    return min(fastest, key=lambda name: errors[name], default="float32")


def _has_one_phase(facts: Facts, settings: Settings) -> bool:
    """Return whether phase 1 is skipped, because every view has a single scale with a weight."""
    weights = ScaleWeights(settings.scales)
    counts = [len(weights.chosen(scale_count(*size, settings.coarsest_side))) for size in facts.sizes]
    return max(counts) <= 1 and settings.preset != "paper"


def ends_with_transfer(settings: Settings, *, warm: bool) -> bool:
    """Return whether a job with a warm start transfers the style's colors once more after the last step.

    A loss without statistics lets colors drift from the style's during the steps; ARF (Zhang et al. 2022) transfers
    them twice too. With statistics, a second transfer would undo what the steps have achieved.
    """
    return warm and not has_statistics(settings.style_loss)


def considers_graphs(plan: Plan, facts: Facts, settings: Settings) -> bool:
    """Return whether CUDA graphs of the loss are possible, and may pay off."""
    least = LEAST_TRIED_VISITS if failure_is_fatal() else LEAST_GRAPH_VISITS
    often = _visits_of_a_size(plan, facts, settings) >= least
    return plan.device == "cuda" and often and not _divides_views(facts, settings)


def uses_graphs(plan: Plan, facts: Facts, settings: Settings, cost: Saving | None) -> bool:
    """Choose whether the loss of a view is captured as a CUDA graph, one per image size and phase.

    Args:
        cost: Cost of launching a view's loss; None if it was not measured.
    """
    if cost is None or cost.least_visits is None or _divides_views(facts, settings):
        return False
    phases = bool(plan.steps_coarse) + bool(settings.steps_sos)
    return _visits_of_a_size(plan, facts, settings) >= phases * (FIRST_VISITS + cost.least_visits)


def choose_ranks(seconds: Mapping[Shape, float]) -> Shape:
    """Choose the number of ranks and of their groups.

    Returns:
        The smallest number of ranks whose seconds per step are within `LEAST_GAIN` of the best with as few groups as
        possible, unless a view for each rank saves much more.
    """
    least = min(groups for _, groups in seconds)
    few = {shape: own for shape, own in seconds.items() if shape[1] == least}
    best = min(shape for shape, own in few.items() if own <= min(few.values()) * (1 + LEAST_GAIN))
    most = (1 - _LEAST_GROUP_GAIN) * few[best] / worth(least)
    more = (shape for shape, own in seconds.items() if shape[1] > least and own / worth(shape[1]) <= most)
    return min(more, default=best)


def worth(views: int) -> float:
    """Return how many steps with one view leave as little of the loss as a step with several views."""
    return float(np.interp(math.log2(views), [math.log2(known) for known in _WORTH], list(_WORTH.values())))


def considers_groups(plan: Plan, facts: Facts, settings: Settings, seconds: Mapping[Shape, float]) -> bool:
    """Return whether a view for each rank in every step may save time, given the seconds of steps on divided views.

    Steps that were given, and those of the published schedule, remain as they are.
    """
    ranks = facts.machine.ranks
    given = {"views_per_step", "steps_coarse", "steps_sos"} & {*settings.fixed}
    if settings.preset == "paper" or given or settings.within or not settings.rebalance or ranks == 1:
        return False
    possible = len(plan.covered) >= 2 * ranks
    return possible and choose_ranks({**seconds, (ranks, ranks): seconds[1, 1]}) == (ranks, ranks)


def with_groups(settings: Settings, groups: int) -> Settings:
    """Return the settings of a job whose plan has formed groups of ranks: one view for each in fewer steps."""
    if groups == 1:
        return settings
    steps = {name: math.ceil(getattr(settings, name) / worth(groups)) for name in ("steps_coarse", "steps_sos")}
    return settings.model_copy(update={**steps, "views_per_step": groups})


def _visits(plan: Plan, settings: Settings) -> int:
    return (plan.steps_coarse + settings.steps_sos) * settings.views_per_step


def _visits_of_a_size(plan: Plan, facts: Facts, settings: Settings) -> int:
    """Return the passes of images of one size through the network in the whole schedule.

    With weighted statistics, every view has its own size, because it is cropped to its covered pixels.
    """
    different = len(plan.covered) if plan.weighted else len({facts.sizes[index] for index in plan.covered})
    return _visits(plan, settings) // different


def _divides_views(facts: Facts, settings: Settings) -> bool:
    """Return whether several ranks work on the same view."""
    return facts.machine.ranks > math.gcd(settings.views_per_step, facts.machine.ranks)


def _blend_weights(plan: Plan, facts: Facts, settings: Settings) -> tuple[CachedWeights, Decision]:
    """Choose the format of cached blend weights: float32 or half precision, as fits; none if it saves no time."""
    cost, item = facts.weights, "blend weights"
    why_not = _why_not_cached(plan, facts, settings)
    if why_not is not None:
        return "none", Decision(item, "recomputed in every step", why_not, bytes=cost.bytes)
    budget, cached = memory_for("rasterizer", facts.machine.memory), settings.cached_weights
    if cached == "auto":
        cached = "float32" if (cost.bytes or 0) <= budget or settings.preset == "paper" else "half"
    name, size, error = "float32", cost.bytes or 0, "none"
    if cached == "half":
        name, size = "half precision", cost.half_bytes or 0
        error = "each weight is off by at most 1/2048 of its value: 0.12 of 255 levels per pixel"
    of_a_view = size / len(plan.covered)
    portion = "all" if size <= budget else f"{budget // of_a_view * of_a_view / size:.0%} of the views'"
    reason = f"they take {size / 1e9:.2f} GB for all views; {budget / 1e9:.1f} GB are available for blend weights"
    if cost.saving.problem is None:
        reason += f"; {cost.saving.text('cached', 'recomputed')}"
    return cached, Decision(item, f"{portion} cached in {name}", reason, error=error)


def _why_not_cached(plan: Plan, facts: Facts, settings: Settings) -> str | None:
    """Return the reason why blend weights are not cached; None if they are."""
    cost, visits = facts.weights, _visits(plan, settings) / len(plan.covered)
    visited = f"a view is visited {visits:.1f} times"
    if settings.cached_weights == "none":
        return "requested"
    if cost.bytes is None or cost.half_bytes is None:
        return f"{RASTERIZERS[facts.rasterizer].title} cannot cache them"
    if settings.cached_weights != "auto":
        return None
    if not RASTERIZERS[facts.rasterizer].on_gpu:
        return visited if visits < LEAST_VISITS else None
    if cost.saving.problem is not None:
        return cost.saving.problem
    least, measured = cost.saving.least_visits, cost.saving.text("cached", "recomputed")
    if least is None:
        return f"cached weights are not faster here: {measured}"
    return f"{visited}, but caching pays off from {least:.1f} visits; {measured}" if visits < least else None


# --- plan lines ----------------------------------------------------------------------------------------------------


def decisions(
    plan: Plan,
    facts: Facts,
    settings: Settings,
    pixels: NetworkPixels,
    parts: Mapping[str, float],
    cost: Saving | None,
    seconds: Mapping[Shape, float],
) -> Iterator[Decision]:
    """Yield the decisions of a plan, with their reasons.

    Args:
        parts: Seconds of a step per view by activity; "cached weights" are the seconds that these save.
        cost: Cost of launching a view's loss; None if it was not measured.
        seconds: Measured mean seconds of a step by number of ranks and groups.
    """
    yield from _about_gaussians(plan, facts, settings)
    yield from _about_coverage(plan, facts, settings, pixels, parts)
    yield from _about_network(facts, settings, pixels, parts)
    yield from _about_rasterizer(plan, facts, settings, cost)
    weights = _blend_weights(plan, facts, settings)[1]
    yield weights if plan.cached_weights == "none" else replace(weights, seconds=parts["cached weights"])
    yield from _about_schedule(plan, facts, settings)
    yield from _about_ranks(plan, facts, seconds)
    yield from _about_precision(plan, facts, settings, parts)


def _about_gaussians(plan: Plan, facts: Facts, settings: Settings) -> Iterator[Decision]:
    """Yield the decisions about Gaussians that are not rendered, and about spherical harmonics."""
    unseen, count = int((~plan.seen).sum()), facts.gaussians
    if unseen:
        frozen = settings.unseen == "freeze"
        change = "keep their colors" if frozen else "follow their neighbors' color change at the end"
        unused = f"{unseen:,} of {count:,} are neither rendered nor optimized; they {change}"
        reason = "no pixel of any view shows them"
        yield Decision("unseen Gaussians", unused, reason, bytes=unseen * OPTIMIZER_BYTES)
    item, attenuation = "spherical harmonics", settings.sh_attenuation
    degree, used = facts.sh_degree, facts.used_degree
    saved = count * 3 * ((degree + 1) ** 2 - (used + 1) ** 2) * 4
    if not degree:
        nothing = ": there is nothing to attenuate" if attenuation else ""
        yield Decision(item, "no view directions are computed", f"the scene has degree 0{nothing}")
    elif attenuation == 1:
        without = f"degrees 1 to {degree} are attenuated to 0, in the result too; no view directions are computed"
        error = "colors no longer depend on the view direction"
        yield Decision(item, without, "requested", bytes=saved, error=error)
    elif attenuation:
        less = (
            f"coefficients of degrees 1 to {degree} are multiplied by {1 - attenuation:.3g}, in the result too; "
            f"evaluated up to degree {used}"
        )
        yield Decision(item, less, "requested", error="colors depend less on the view direction")
    else:
        if facts.harmonics_energy >= _VIEW_DEPENDENT:
            advice = "unchanged, so highlights keep their tint; --sh-attenuation 1 removes it"
            reason = f"{facts.harmonics_energy:.0%} of the color variance depends on the view direction"
            yield Decision("view-dependent color", advice, reason)
        if used < degree:
            zeros = f"all coefficients of degrees {used + 1} to {degree} are 0"
            yield Decision(item, f"evaluated up to degree {used}", zeros, bytes=saved)


def _about_coverage(
    plan: Plan, facts: Facts, settings: Settings, pixels: NetworkPixels, parts: Mapping[str, float]
) -> Iterator[Decision]:
    """Yield the decisions about empty views, uncovered pixels, backgrounds, and the colors at the start."""
    uncovered = f"{plan.survey.uncovered_fraction:.1%} of the views' pixels are uncovered"
    total, blind = len(facts.sizes), len(facts.sizes) - len(plan.covered)
    if blind:
        yield Decision(VIEWS, f"{blind} of {total} are skipped", "they see no Gaussian")
    if pixels.all < pixels.without_region:
        skipped = f"{1 - pixels.all / pixels.without_region:.0%} of the pixels skip the network"
        seconds = sum(parts.get(name, 0.0) for name in ("vgg_forward", "vgg_backward", "statistics"))
        seconds *= pixels.without_region / pixels.all - 1
        yield Decision("uncovered pixels", skipped, uncovered, seconds=seconds)
    if plan.weighted:
        yield Decision("position weights", "statistics are weighted by coverage", uncovered, error=ANOTHER_LOSS)
    if plan.training_background != "background":
        random = plan.training_background == "random"
        color = "a random color" if random else "the color of a random pixel of the style"
        requested = settings.training_background != "auto"
        reason = "requested" if requested else f"{uncovered}: colors would be fitted to a fixed background"
        if settings.content_weight:
            recomputed = duration(parts.get("prepare", 0.0), " ")
            reason += f"; content features are recomputed with it, {recomputed} per step"
        yield Decision("training background", f"{color} each time", reason, error=ANOTHER_LOSS)
    by_luminance = settings.preserve_colors == "luminance"
    if plan.warm_start:
        start = "colors start with the style's distribution"
        if by_luminance:
            start = "luminance starts with the style's mean and standard deviation"
        if ends_with_transfer(settings, warm=True):
            start += f"; they are reset to it after the last step, because {settings.style_loss} lets them drift"
        reason = "steps change the overall color only slowly"
        if settings.warm_start is not None:
            reason = "requested"
        elif plan.weighted and plan.survey.uncovered_fraction > _SCAN:
            reason = f"{uncovered}: nothing around the object determines how bright it should be"
        yield Decision("start", start, reason, error="differs from the paper's start")
    if by_luminance:
        line = "only luminance is compared and optimized; each Gaussian keeps its chroma"
        yield Decision("colors", line, "requested", error=ANOTHER_LOSS)


def _about_network(
    facts: Facts, settings: Settings, pixels: NetworkPixels, parts: Mapping[str, float]
) -> Iterator[Decision]:
    """Yield the decisions about layers, style loss, content, partition and forward passes."""
    layers = f"up to {facts.deepest}, the deepest one used"
    yield Decision("network layers", layers, "the loss reads no deeper layer")
    if settings.style_loss != "sos":
        weight = NEAREST_WEIGHTS[settings.style_loss]
        what = "replaces the statistics" if settings.style_loss == "nnfm" else "is added to the statistics"
        search = duration(parts.get("matching", 0.0), " ")
        distance = (
            f"the distance of relu3 features to the nearest of at most {MAX_VECTORS:,} style features {what}, with "
            f"weight {weight:.3g}; the search takes {search} per view"
        )
        yield Decision("style loss", distance, f"{settings.style_loss} was requested", error=ANOTHER_LOSS)
    if not settings.content_weight:
        yield Decision("content", "no content features are computed or cached", "its weight is 0")
    memory = f"the {memory_for('activations', facts.machine.memory) / 1e9:.1f} GB for activations"
    if pixels.tiles <= 1:
        yield Decision("partition", "none: the network takes each view as a whole", f"it fits in {memory}")
    else:
        tiles = f"up to {pixels.tiles} tiles per view"
        yield Decision("partition", tiles, f"larger tiles would not fit in {memory}")
    if pixels.again:
        again = pixels.again / pixels.all
        reason = f"activations of {1 - again:.0%} of the pixels fit in {memory}"
        yield Decision("second forward", f"for {again:.0%} of the pixels", reason)
    else:
        none, forward = "none: activations are cached between statistics and gradient", parts.get("vgg_forward", 0.0)
        yield Decision("second forward", none, f"they fit in {memory}", seconds=forward)


def _about_rasterizer(plan: Plan, facts: Facts, settings: Settings, cost: Saving | None) -> Iterator[Decision]:
    """Yield the decisions about the rasterizer and kernel launches on a GPU; on the CPU there is no choice."""
    if plan.device != "cuda":
        return
    used = RASTERIZERS[facts.rasterizer]
    how = f"{used.title} on the GPU" if used.on_gpu else "on the CPU"
    if plan.cached_weights != "none":
        how += ", with cached blend weights"
    problems = facts.machine.problems.items()
    reasons = [f"{RASTERIZERS[name].title} cannot be used: {problem}" for name, problem in problems]
    if used.on_gpu:
        reasons.append(f"{used.title} works here")
    yield Decision("rasterizer", how, "; ".join(reasons) or "requested")
    visited = f"views of one size are visited about {_visits_of_a_size(plan, facts, settings):,} times"
    measured = ""
    if cost is not None:
        measured = f"{cost.text('as a graph', 'kernel by kernel')}, {1e3 * cost.once:.3g} ms to capture"
    if plan.graphs and cost is not None:
        graph = "the loss of a view is captured as a CUDA graph"
        yield Decision("launches", graph, f"{measured}; {visited}", seconds=cost.saved)
        return
    if _divides_views(facts, settings):
        reason = "a graph cannot contain communication between workers"
    elif cost is None:
        reason = visited
    elif cost.problem is not None:
        reason = f"CUDA graphs are unavailable: {cost.problem}"
    elif cost.least_visits is None:
        reason = f"a graph saves hardly any time: {measured}"
    else:
        least = FIRST_VISITS + cost.least_visits
        reason = f"{visited}, but one graph per phase pays off from {least:.1f} visits; {measured}"
    yield Decision("launches", "kernel by kernel", reason)


def _about_schedule(plan: Plan, facts: Facts, settings: Settings) -> Iterator[Decision]:
    """Yield the decisions about scales and their weights, phases, and stopping early."""
    counts = [scale_count(*facts.sizes[index], settings.coarsest_side) for index in plan.covered]
    scales = f"{min(counts)} to {max(counts)}" if min(counts) < max(counts) else f"{counts[0]}"
    reason = f"the shorter side is halved until it is at most {settings.coarsest_side} pixels"
    yield Decision("scales", scales, reason)
    if settings.scales:
        weights, most = ScaleWeights(settings.scales), max(counts)
        chosen = weights.chosen(most)
        text = ", ".join(f"scale {scale} {weights.of(scale):g}" for scale in chosen)
        if len(chosen) < most:
            text += f"; {most - len(chosen)} of {most} scales are not computed"
        yield Decision("weights of scales", text, "requested", error=ANOTHER_LOSS)
    if settings.scale_sampling > 1 and not _has_one_phase(facts, settings):
        saved = 1 - ScaleWeights(settings.scales).sampled_cost(max(counts), settings.scale_sampling)
        text = f"of {settings.scale_sampling} visits of a view, drawn at random, one evaluates the next finer scale too"
        reason = f"gradients are the same on average, and finer scales cost {saved:.0%} less"
        yield Decision("scale sampling", text, reason, error="more noise in single gradients")
    if settings.stroke_depth:
        text = "strokes keep their size in the scene: near parts are compared at coarse scales, far ones at fine scales"
        yield Decision("stroke depth", text, "requested", error=ANOTHER_LOSS)
    if plan.steps_coarse < settings.steps_coarse:
        reason = f"{'only one scale has a weight' if settings.scales else 'there is only one scale'}, so it would be "
        skipped, error = (
            f"its {settings.steps_coarse} steps are skipped",
            "these steps, which would reduce the same loss",
        )
        yield Decision("phase 1", skipped, f"{reason}the same as phase 2", error=error)
    if settings.early_stop and plan.training_background != "background":
        reason = "losses on different backgrounds cannot be compared"
        yield Decision("early stop", "none: all steps are run", reason)
    elif settings.early_stop:
        when = (
            f"when the mean loss of {window_length(len(plan.covered))} steps is less than {MIN_FALL:.1%} below that of "
            "the same number of steps before"
        )
        yield Decision("early stop", when, "later steps would gain little", error="the remaining decrease of the loss")


def _about_ranks(plan: Plan, facts: Facts, seconds: Mapping[Shape, float]) -> Iterator[Decision]:
    """Yield the decisions about ranks that share a GPU, and about the number of ranks and their groups."""
    available, chosen = facts.machine.ranks, plan.ranks
    if plan.device != "cpu" and facts.machine.sharing > 1:
        reason = f"{facts.machine.sharing} of them share a GPU, which NCCL does not support; give each a GPU of its own"
        yield Decision("communication", "ranks exchange data over the CPU (gloo)", reason)
    if available == 1:
        return
    measured = "a step takes " + ", ".join(
        f"{duration(own, ' ')} on {ranks}" + (f" with {groups} views, worth {worth(groups):.1f} steps" * (groups > 1))
        for (ranks, groups), own in seconds.items()
    )
    one = 1, min(groups for _, groups in seconds)
    if one not in seconds:
        yield Decision("ranks", f"all {available} take part", f"requested; {measured}")
        return
    speeds = {shape: seconds[one] / own * worth(shape[1]) / worth(one[1]) for shape, own in seconds.items()}
    who = f"all {available}" if chosen == available else f"{chosen} of {available}"
    if chosen < available:
        every = f"all of them would be {speeds[available, one[1]]:.2f} times as fast"
        measured = f"{every}, because the others would only add communication; {measured}"
    faster = f"{speeds[chosen, plan.groups]:.2f} times as fast as one"
    if plan.groups > 1:
        each = f"{who} take part, each with a view of its own in fewer steps, {faster}"
        yield Decision("ranks", each, measured, error="steps average the gradients of several views")
        return
    yield Decision("ranks", f"{who} take part, {faster}", measured)


def _about_precision(plan: Plan, facts: Facts, settings: Settings, parts: Mapping[str, float]) -> Iterator[Decision]:
    """Yield the decision about the network's precision; none if float32 was requested."""
    requested, measured = settings.precision, facts.precisions or {}
    if requested == "float32":
        return
    compared = [
        f"convolutions {_in(name)} are {own.convolution:.2g} times as fast as in float32"
        + (
            f", a view's loss {own.speedup:.2g} times, with an error of {own.error.relative_error:.2g}"
            if own.error
            else ""
        )
        for name, own in measured.items()
    ]
    reason = "; ".join(compared)
    if plan.precision != "float32":
        own = measured[plan.precision]
        assert own.error is not None
        colors = "is measured during the run" if plan.is_approximated else "is that of rounding"
        known = (
            f"the first view's pixel gradient has a relative error of {own.error.relative_error:.2g} (cosine "
            f"{own.error.cosine:.5f}); the error of the colors {colors}"
        )
        what = f"{'convolutions' if plan.precision in ('tf32', 'winograd') else 'features'} {_in(plan.precision)}"
        saved = max(own.speedup - 1, 0.0) * sum(
            parts.get(name, 0.0) for name in ("vgg_forward", "vgg_backward", "statistics")
        )
        how = "requested" if requested != "auto" else "measured on the first view"
        yield Decision("precision", what, f"{how}: {reason}", seconds=saved, error=known)
        return
    if requested != "auto":
        needed = {"winograd": "a CPU", "bfloat16": f"a CPU, an AMD GPU, or {_GPU}"}.get(requested, _GPU)
        missing = f"{requested} needs {needed}"
        reason = f"{requested} was requested, but {reason or missing}"
    elif facts.precisions is None:
        reason = "exact; the steps take too little time to compare others"
    elif not measured:
        reason = "exact; this device has no faster precision"
    else:
        faster = "much faster convolutions" if facts.machine.device == "cpu" else "a faster loss"
        reason = f"exact; {reason}, but {faster} and an error of at most {_LARGEST_ERROR} are needed"
    yield Decision("precision", "features in float32", reason)


def _in(precision: PlannedPrecision) -> str:
    """Return how something is computed in a precision."""
    return {"winograd": "by Winograd's algorithm", "tf32": "in TF32"}.get(precision, f"in {precision}")
