"""Choices of a plan, with the plan lines that state their reasons."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from torch import Tensor

from sgsst_core.budget import memory_for
from sgsst_core.decision import VIEWS, Decision
from sgsst_core.loss.convergence import MIN_FALL, window_length
from sgsst_core.loss.nearest import MAX_VECTORS, NEAREST_WEIGHTS
from sgsst_core.loss.scale_weights import ScaleWeights
from sgsst_core.loss.statistics_terms import has_statistics
from sgsst_core.number_format import duration
from sgsst_core.parallel.division import Size
from sgsst_core.planning.facts import Facts, LaunchCost, NetworkPixels, WeightCost
from sgsst_core.planning.survey import Survey
from sgsst_core.rasterizer import RASTERIZERS
from sgsst_core.scene.pyramid import scale_count
from sgsst_core.settings import CachedWeights, PlannedBackground, Precision, Settings

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
#: Speedup of convolutions from which on bfloat16 is recommended: at 1.9, less of the float32 loss is left than with
#: float32 after the same seconds, on each of four pairs (docs/performance.md).
_MUCH_FASTER = 1.5
#: Minimum visits of a view for which caching its blend weights pays off on a CPU. Computing them takes as long as about
#: three renders with gradient, and each use saves two thirds of a render. On GPUs, both times are measured.
LEAST_VISITS = 5
#: Minimum visits per view size for which a CUDA graph of the loss is considered at all.
LEAST_GRAPH_VISITS = 20
#: Minimum fraction of a step's time that additional ranks must save.
LEAST_GAIN = 0.03
#: Bytes per optimized Gaussian: color, gradient and two moments, float32.
OPTIMIZER_BYTES = 4 * 3 * 4
ANOTHER_LOSS = "differs from the paper's loss"


# --- scene and views -----------------------------------------------------------------------------------------------


def rendered_gaussians(survey: Survey) -> Tensor:
    """Return the mask [N] bool of rendered Gaussians: those that any view shows."""
    return survey.total_blend_weights > 0


def about_gaussians(facts: Facts, rendered: Tensor, settings: Settings) -> list[Decision]:
    """Return the decisions about Gaussians that are not rendered, and about spherical harmonics."""
    unseen = int((~rendered).sum())
    harmonics = _about_harmonics(facts, settings)
    if not unseen:
        return harmonics
    change = "keep their colors" if settings.unseen == "freeze" else "follow their neighbors' color change at the end"
    line = Decision(
        "unseen Gaussians",
        f"{unseen:,} of {facts.gaussians:,} are neither rendered nor optimized; they {change}",
        "no pixel of any view shows them",
        bytes=unseen * OPTIMIZER_BYTES,
    )
    return [line, *harmonics]


def _about_harmonics(facts: Facts, settings: Settings) -> list[Decision]:
    item, attenuation = "spherical harmonics", settings.sh_attenuation
    if not facts.sh_degree:
        nothing = ": there is nothing to attenuate" if attenuation else ""
        return [Decision(item, "no view directions are computed", f"the scene has degree 0{nothing}")]
    if attenuation == 1:
        return [
            Decision(
                item,
                f"degrees 1 to {facts.sh_degree} are attenuated to 0, in the result too; no view directions are "
                "computed",
                "requested",
                bytes=facts.gaussians * 3 * ((facts.sh_degree + 1) ** 2 - 1) * 4,
                error="colors no longer depend on the view direction",
            )
        ]
    if attenuation:
        return [
            Decision(
                item,
                f"coefficients of degrees 1 to {facts.sh_degree} are multiplied by {1 - attenuation:.3g}, in the "
                f"result too; evaluated up to degree {facts.used_degree}",
                "requested",
                error="colors depend less on the view direction",
            )
        ]
    lines = []
    if facts.harmonics_energy >= _VIEW_DEPENDENT:
        advice = "unchanged, so highlights keep their tint; --sh-attenuation 1 removes it"
        reason = f"{facts.harmonics_energy:.0%} of the color variance depends on the view direction"
        lines = [Decision("view-dependent color", advice, reason)]
    degree = facts.used_degree
    if degree == facts.sh_degree:
        return lines
    return [
        *lines,
        Decision(
            item,
            f"evaluated up to degree {degree}",
            f"all coefficients of degrees {degree + 1} to {facts.sh_degree} are 0",
            bytes=facts.gaussians * 3 * ((facts.sh_degree + 1) ** 2 - (degree + 1) ** 2) * 4,
        ),
    ]


def about_views(facts: Facts) -> list[Decision]:
    """Return the decision about views that show nothing."""
    total = len(facts.sizes)
    blind = total - len(facts.survey.covered)
    return [Decision(VIEWS, f"{blind} of {total} are skipped", "they see no Gaussian")] if blind else []


def position_weights(survey: Survey, settings: Settings) -> tuple[bool, list[Decision]]:
    """Choose whether statistics are weighted by coverage."""
    requested = settings.position_weights
    if requested == "off" or (requested == "auto" and survey.uncovered_fraction <= _UNCOVERED):
        return False, []
    line = Decision("position weights", "statistics are weighted by coverage", _uncovered(survey), error=ANOTHER_LOSS)
    return True, [line]


def about_uncovered_pixels(pixels: NetworkPixels, survey: Survey, seconds: float) -> list[Decision]:
    """Return the decision about uncovered pixels that skip the network, given the seconds of those that do not."""
    if pixels.all >= pixels.without_region:
        return []
    return [
        Decision(
            "uncovered pixels",
            f"{1 - pixels.all / pixels.without_region:.0%} of the pixels skip the network",
            _uncovered(survey),
            seconds=(pixels.without_region / pixels.all - 1) * seconds,
        )
    ]


def _uncovered(survey: Survey) -> str:
    return f"{survey.uncovered_fraction:.1%} of the views' pixels are uncovered"


def is_scan(survey: Survey, *, weighted: bool) -> bool:
    """Return whether a job has an object scan: coverage weights its statistics, and many pixels are uncovered."""
    return weighted and survey.uncovered_fraction > _SCAN


def training_background(settings: Settings, *, scan: bool) -> PlannedBackground:
    """Return the training background, the background of renders in optimization steps."""
    if settings.training_background == "auto":
        return _SCAN_BACKGROUND if scan else "background"
    return settings.training_background


def about_training_background(
    background: PlannedBackground, survey: Survey, settings: Settings, seconds: float
) -> list[Decision]:
    """Return the decision about the training background, unless it is the job's own background.

    Args:
        background: Training background.
        survey: Survey of the views.
        settings: Settings of the job.
        seconds: Seconds per step for recomputing content features.
    """
    if background == "background":
        return []
    color = {"random": "a random color", "palette": "the color of a random pixel of the style"}[background]
    reason = "requested"
    if settings.training_background == "auto":
        reason = f"{_uncovered(survey)}: colors would be fitted to a fixed background"
    if settings.content_weight:
        reason += f"; content features are recomputed with it, {duration(seconds, ' ')} per step"
    return [Decision("training background", f"{color} each time", reason, error=ANOTHER_LOSS)]


def warm_start(survey: Survey, settings: Settings, *, scan: bool) -> tuple[bool, list[Decision]]:
    """Choose whether the job starts with the style's colors.

    Optimization changes the overall color of a scene only slowly (docs/quality.md). If only luminance is stylized, a
    warm start pays off only for scans, because nothing around the object determines its brightness.
    """
    by_luminance = settings.preserve_colors == "luminance"
    warm = settings.warm_start
    if warm is None:
        warm = scan or not by_luminance
    if not warm:
        return False, []
    start = "colors start with the style's distribution"
    if by_luminance:
        start = "luminance starts with the style's mean and standard deviation"
    if ends_with_transfer(settings, warm=True):
        start += f"; they are reset to it after the last step, because {settings.style_loss} lets them drift"
    reason = "steps change the overall color only slowly"
    if settings.warm_start is not None:
        reason = "requested"
    elif scan:
        reason = f"{_uncovered(survey)}: nothing around the object determines how bright it should be"
    return True, [Decision("start", start, reason, error="differs from the paper's start")]


def ends_with_transfer(settings: Settings, *, warm: bool) -> bool:
    """Return whether a job with a warm start transfers the style's colors once more after the last step.

    A loss without statistics lets colors drift from the style's during the steps; ARF (Zhang et al. 2022) transfers
    them twice too. With statistics, a second transfer would undo what the steps have achieved.
    """
    return warm and not has_statistics(settings.style_loss)


def about_colors(settings: Settings) -> list[Decision]:
    """Return the decision about color preservation, if luminance alone is stylized."""
    if settings.preserve_colors != "luminance":
        return []
    line = "only luminance is compared and optimized; each Gaussian keeps its chroma"
    return [Decision("colors", line, "requested", error=ANOTHER_LOSS)]


# --- schedule ------------------------------------------------------------------------------------------------------


def computed_scales(sizes: Sequence[Size], settings: Settings) -> list[int]:
    """Return the number of scales with a positive weight of views of each size (height, width)."""
    weights = ScaleWeights(settings.scales)
    return [len(weights.chosen(scale_count(*size, settings.coarsest_side))) for size in sizes]


def steps_coarse(scales: Sequence[int], settings: Settings) -> tuple[int, list[Decision]]:
    """Choose the number of steps of phase 1, given the number of scales with a weight of each view."""
    if not settings.steps_coarse or max(scales) > 1 or settings.preset == "paper":
        return settings.steps_coarse, []
    reason = "there is only one scale, so it would be the same as phase 2"
    if settings.scales:
        reason = "only one scale has a weight, so it would be the same as phase 2"
    skipped = f"its {settings.steps_coarse} steps are skipped"
    return 0, [Decision("phase 1", skipped, reason, error="these steps, which would reduce the same loss")]


def about_scales(counts: Sequence[int], settings: Settings) -> list[Decision]:
    """Return the decisions about scales and their weights, given the number of scales of each view."""
    scales = f"{min(counts)} to {max(counts)}" if min(counts) < max(counts) else f"{counts[0]}"
    reason = f"the shorter side is halved until it is at most {settings.coarsest_side} pixels"
    lines = [Decision("scales", scales, reason)]
    if settings.scales:
        weights, most = ScaleWeights(settings.scales), max(counts)
        chosen = weights.chosen(most)
        text = ", ".join(f"scale {scale} {weights.of(scale):g}" for scale in chosen)
        if len(chosen) < most:
            text += f"; {most - len(chosen)} of {most} scales are not computed"
        lines.append(Decision("weights of scales", text, "requested", error=ANOTHER_LOSS))
    if settings.stroke_depth:
        text = "strokes keep their size in the scene: near parts are compared at coarse scales, far ones at fine scales"
        lines.append(Decision("stroke depth", text, "requested", error=ANOTHER_LOSS))
    return lines


def about_early_stop(background: PlannedBackground, views: int, settings: Settings) -> list[Decision]:
    """Return the decision about the condition to stop early. `views` is the number of views of the job."""
    if not settings.early_stop:
        return []
    if background != "background":
        return [Decision("early stop", "none: all steps are run", "losses on different backgrounds cannot be compared")]
    return [
        Decision(
            "early stop",
            f"when the mean loss of {window_length(views)} steps is less than {MIN_FALL:.1%} below that of the same "
            "number of steps before",
            "later steps would gain little",
            error="the remaining decrease of the loss",
        )
    ]


@dataclass(frozen=True)
class Visits:
    """Numbers of visits in the whole schedule.

    Attributes:
        of_a_view: Visits of each view.
        of_a_size: Passes of images of one size through the network.
    """

    of_a_view: float
    of_a_size: int

    @staticmethod
    def of(survey: Survey, sizes: Sequence[Size], settings: Settings) -> Visits:
        """Count the visits of the schedule of a job whose views have these sizes (height, width).

        With weighted statistics, every view has its own size, because it is cropped to its covered pixels.
        """
        weighted, _ = position_weights(survey, settings)
        coarse, _ = steps_coarse(computed_scales(sizes, settings), settings)
        views, visits = survey.covered, (coarse + settings.steps_sos) * settings.views_per_step
        different = len(views) if weighted else len({sizes[index] for index in views})
        return Visits(visits / len(views), visits // different)


# --- network -------------------------------------------------------------------------------------------------------


def about_network(
    pixels: NetworkPixels, facts: Facts, settings: Settings, matching: float, forward: float
) -> list[Decision]:
    """Return the decisions about layers, style loss, content, partition and forward passes.

    Args:
        pixels: Pixels through the network.
        facts: Facts about the job.
        settings: Settings of the job.
        matching: Seconds per view for the nearest-neighbor search.
        forward: Seconds per view for the network's forward pass.
    """
    layers = f"up to {facts.deepest}, the deepest one used"
    lines = [Decision("network layers", layers, "the loss reads no deeper layer")]
    if settings.style_loss != "sos":
        weight = NEAREST_WEIGHTS[settings.style_loss]
        what = "replaces the statistics" if settings.style_loss == "nnfm" else "is added to the statistics"
        distance = (
            f"the distance of relu3 features to the nearest of at most {MAX_VECTORS:,} style features {what}, with "
            f"weight {weight:.3g}; the search takes {duration(matching, ' ')} per view"
        )
        lines.append(Decision("style loss", distance, f"{settings.style_loss} was requested", error=ANOTHER_LOSS))
    if not settings.content_weight:
        lines.append(Decision("content", "no content features are computed or cached", "its weight is 0"))
    memory = f"the {memory_for('activations', facts.machine.memory) / 1e9:.1f} GB for activations"
    if pixels.tiles <= 1:
        lines.append(Decision("partition", "none: the network takes each view as a whole", f"it fits in {memory}"))
    else:
        tiles = f"up to {pixels.tiles} tiles per view"
        lines.append(Decision("partition", tiles, f"larger tiles would not fit in {memory}"))
    if pixels.again:
        again = pixels.again / pixels.all
        reason = f"activations of {1 - again:.0%} of the pixels fit in {memory}"
        return [*lines, Decision("second forward", f"for {again:.0%} of the pixels", reason)]
    none = "none: activations are cached between statistics and gradient"
    return [*lines, Decision("second forward", none, f"they fit in {memory}", seconds=forward)]


def precision_of(requested: Precision, ratio: float | None) -> Precision:
    """Return the precision of the network: the requested one if it is faster than float32, else float32.

    Processors without bfloat16 instructions compute it hundreds of times more slowly than float32.

    Args:
        requested: Requested precision.
        ratio: See `Facts.precision_ratio`.
    """
    return requested if ratio is not None and ratio > 1 else "float32"


def precision(facts: Facts, settings: Settings) -> tuple[Precision, list[Decision]]:
    """Choose the network's precision. If float32 was requested, at most recommend bfloat16."""
    requested, ratio, error = settings.precision, facts.precision_ratio, facts.gradient_error
    chosen = precision_of(requested, ratio)
    if requested == "float32":
        if ratio is None or ratio < _MUCH_FASTER:
            return chosen, []
        reason = f"exact; with --precision bfloat16 (approximate), convolutions are {ratio:.1f} times faster here"
        return chosen, [Decision("precision", "features in float32", reason)]
    if ratio is None:
        needed = "an NVIDIA GPU" if requested == "tf32" else "a CPU, an AMD GPU, or an NVIDIA GPU"
        reason = f"{requested} was requested, but needs {needed} of compute capability 8.0 or higher"
        return chosen, [Decision("precision", "features in float32", reason)]
    if chosen == "float32":
        reason = f"{requested} was requested, but takes {1 / ratio:.1f} times as long as float32 on this processor"
        return chosen, [Decision("precision", "features in float32", reason)]
    known = "the error of the colors is measured during the run"
    if error is not None:
        known = (
            f"the first view's pixel gradient has a relative error of {error.relative_error:.2g} (cosine "
            f"{error.cosine:.5f}); {known}"
        )
    what = {"bfloat16": "features in bfloat16", "tf32": "convolutions in TF32"}[requested]
    return chosen, [Decision("precision", what, f"requested, {ratio:.1f} times faster here", error=known)]


def launches(
    facts: Facts, settings: Settings, visits: Visits, phases: int, cost: LaunchCost | None
) -> tuple[bool, list[Decision]]:
    """Choose whether the loss of a view is captured as a CUDA graph on a GPU, one per image size and phase.

    Args:
        facts: Facts about the job.
        settings: Settings of the job.
        visits: Visits of the schedule.
        phases: Number of phases.
        cost: Cost of launching a view's loss; None if the views are visited too rarely to measure it.
    """
    if facts.machine.device != "cuda":
        return False, []
    visited = f"views of one size are visited about {visits.of_a_size:,} times"
    if divides_views(facts.machine.ranks, settings):
        reason = "a graph cannot contain communication between workers"
    elif cost is None:
        reason = visited
    elif cost.problem is not None:
        reason = f"CUDA graphs are unavailable: {cost.problem}"
    elif cost.least_visits is None:
        reason = f"a graph saves hardly any time: {_launch_times(cost)}"
    elif visits.of_a_size < phases * cost.least_visits:
        pays = f"one graph per phase pays off from {cost.least_visits:.1f} visits"
        reason = f"{visited}, but {pays}; {_launch_times(cost)}"
    else:
        reason = f"{_launch_times(cost)}; {visited}"
        graph = "the loss of a view is captured as a CUDA graph"
        return True, [Decision("launches", graph, reason, seconds=cost.saved)]
    return False, [Decision("launches", "kernel by kernel", reason)]


def divides_views(ranks: int, settings: Settings) -> bool:
    """Return whether several of these ranks work on the same view."""
    return ranks > math.gcd(settings.views_per_step, ranks)


def _launch_times(cost: LaunchCost) -> str:
    return (
        f"measured per view: {1e3 * cost.replayed:.3g} ms as a graph, {1e3 * cost.seconds:.3g} ms kernel by kernel, "
        f"{1e3 * cost.capture:.3g} ms to capture"
    )


# --- rasterizer ----------------------------------------------------------------------------------------------------


def blend_weights(facts: Facts, settings: Settings, visits: Visits) -> tuple[CachedWeights, Decision]:
    """Choose the format of cached blend weights: float32 or half precision, as fits; none if it saves no time."""
    cost, item = facts.weights, "blend weights"
    why_not = _why_not_cached(facts, settings, visits)
    if why_not is not None:
        return "none", Decision(item, "recomputed in every step", why_not, bytes=cost.bytes)
    budget, cached = memory_for("rasterizer", facts.machine.memory), settings.cached_weights
    if cached == "auto":
        cached = "float32" if (cost.bytes or 0) <= budget or settings.preset == "paper" else "half"
    name, size, error = "float32", cost.bytes or 0, "none"
    if cached == "half":
        name, size = "half precision", cost.half_bytes or 0
        error = "each weight is off by at most 1/2048 of its value: 0.12 of 255 levels per pixel"
    of_a_view = size / len(facts.survey.covered)
    portion = "all" if size <= budget else f"{budget // of_a_view * of_a_view / size:.0%} of the views'"
    reason = f"they take {size / 1e9:.2f} GB for all views; {budget / 1e9:.1f} GB are available for blend weights"
    if RASTERIZERS[facts.rasterizer].on_gpu and cost.cached_seconds is not None:
        reason += f"; {_weight_times(cost)}"
    return cached, Decision(item, f"{portion} cached in {name}", reason, error=error)


def _why_not_cached(facts: Facts, settings: Settings, visits: Visits) -> str | None:
    """Return the reason why blend weights are not cached; None if they are."""
    cost, visited = facts.weights, f"a view is visited {visits.of_a_view:.1f} times"
    if settings.cached_weights == "none":
        return "requested"
    if cost.bytes is None or cost.half_bytes is None:
        return f"{RASTERIZERS[facts.rasterizer].title} cannot cache them"
    if settings.cached_weights != "auto":
        return None
    if not RASTERIZERS[facts.rasterizer].on_gpu:
        return visited if visits.of_a_view < LEAST_VISITS else None
    if cost.cached_seconds is None:
        return "the weights of one view do not fit"
    if cost.least_visits is None:
        return f"cached weights are not faster here: {_weight_times(cost)}"
    if visits.of_a_view < cost.least_visits:
        return f"{visited}, but caching pays off from {cost.least_visits:.1f} visits; {_weight_times(cost)}"
    return None


def _weight_times(cost: WeightCost) -> str:
    cached, recomputed = 1e3 * (cost.cached_seconds or 0), 1e3 * cost.seconds
    return f"measured per view: {cached:.3g} ms cached, {recomputed:.3g} ms recomputed"


def about_rasterizer(facts: Facts, *, cached: bool) -> list[Decision]:
    """Return the decision about the rasterizer on a GPU; on the CPU there is no choice.

    Args:
        facts: Facts about the job.
        cached: Whether blend weights are cached.
    """
    if facts.machine.device != "cuda":
        return []
    used = RASTERIZERS[facts.rasterizer]
    how = f"{used.title} on the GPU" if used.on_gpu else "on the CPU"
    if cached:
        how += ", with cached blend weights"
    problems = facts.machine.problems.items()
    reasons = [f"{RASTERIZERS[name].title} cannot be used: {problem}" for name, problem in problems]
    if used.on_gpu:
        reasons.append(f"{used.title} works here")
    return [Decision("rasterizer", how, "; ".join(reasons) or "requested")]


def about_shared_gpus(facts: Facts) -> list[Decision]:
    """Return the decision about ranks that share a GPU, if there are any."""
    if facts.machine.device == "cpu" or facts.machine.sharing == 1:
        return []
    reason = f"{facts.machine.sharing} of them share a GPU, which NCCL does not support; give each a GPU of its own"
    return [Decision("communication", "ranks exchange data over the CPU (gloo)", reason)]


def choose_ranks(seconds: Mapping[int, float]) -> int:
    """Return the smallest number of ranks whose seconds per step are within `LEAST_GAIN` of the best."""
    return min(ranks for ranks, own in seconds.items() if own <= min(seconds.values()) * (1 + LEAST_GAIN))


def about_ranks(chosen: int, seconds: Mapping[int, float], available: int) -> list[Decision]:
    """Return the decision about the number of ranks, unless there is only one.

    Args:
        chosen: Chosen number of ranks.
        seconds: Measured mean seconds of a step by number of ranks.
        available: Number of available ranks.
    """
    if available == 1:
        return []
    measured = ", ".join(f"{duration(own, ' ')} on {ranks}" for ranks, own in seconds.items())
    if 1 not in seconds:
        return [Decision("ranks", f"all {available} take part", f"requested; a step takes {measured}")]
    speed, measured = f"{seconds[1] / seconds[chosen]:.2f} times as fast as one", f"a step takes {measured}"
    if chosen == available:
        return [Decision("ranks", f"all {available} take part, {speed}", measured)]
    other = seconds[1] / seconds[available]
    reason = f"all of them would be {other:.2f} times as fast, because the others would only add communication"
    return [Decision("ranks", f"{chosen} of {available} take part, {speed}", f"{reason}; {measured}")]
