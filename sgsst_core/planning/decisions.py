"""Plan lines for display: each decision with its evidence."""

from __future__ import annotations

import math
from collections.abc import Sequence

from sgsst_core.decision import Decision
from sgsst_core.loss.convergence import LEAST_FALL, window_length
from sgsst_core.loss.mixture import StyleMixture
from sgsst_core.loss.nearest import MOST_VECTORS
from sgsst_core.loss.regions import Regions
from sgsst_core.loss.scale_weights import ScaleWeights
from sgsst_core.loss.style_losses import NEAREST_WEIGHTS, has_statistics
from sgsst_core.planning.choices import (
    GPU_RASTERIZERS,
    ends_with_transfer,
    is_scan,
    precision_of,
    pruned_gaussians,
)
from sgsst_core.planning.cost import OPTIMIZER_BYTES, LaunchCost, RasterCost, Work
from sgsst_core.planning.plan import Plan
from sgsst_core.planning.probe import Probe
from sgsst_core.planning.ranks_model import Link, RanksChoice
from sgsst_core.planning.visits import MAP_BYTES, MAPS_OF_A_RENDER, Made, Visits
from sgsst_core.scene.camera import Camera
from sgsst_core.settings import Settings

_ANOTHER_LOSS = "differs from the paper's loss"


def of_scene(probe: Probe, plan: Plan, settings: Settings) -> list[Decision]:
    """Return the lines about Gaussians and spherical harmonics."""
    scene = probe.scene
    pruned = int(pruned_gaussians(plan.survey, plan.seen).sum())
    unseen = int((~plan.seen).sum()) - pruned
    change = "keep their colors" if settings.unseen == "freeze" else "follow their neighbors' color change at the end"
    decisions = []
    if unseen:
        decisions.append(
            Decision(
                "unseen Gaussians",
                f"{unseen:,} of {scene.gaussians:,} are neither rendered nor optimized; they {change}",
                "their blend weights are 0 in every pixel of every view",
                bytes=unseen * OPTIMIZER_BYTES,
            )
        )
    if pruned:
        assert probe.pruned_error is not None
        decisions.append(
            Decision(
                "pruned Gaussians",
                f"{pruned:,} of {scene.gaussians:,} are neither rendered nor optimized; they {change}",
                f"the blend weights of each sum to at most {settings.prune_weight:g} over all views",
                bytes=pruned * OPTIMIZER_BYTES,
                error=f"in 8-bit levels, no pixel of a view changes by more than "
                f"{255 * probe.pruned_error.largest:.3g}, and the mean pixel by no more than "
                f"{255 * probe.pruned_error.mean:.2g}",
            )
        )
    return decisions + _of_harmonics(probe, settings)


def _of_harmonics(probe: Probe, settings: Settings) -> list[Decision]:
    scene, degree = probe.scene, probe.scene.used_degree
    if not scene.sh_degree:
        nothing = ": there is nothing to attenuate" if settings.sh_attenuation else ""
        return [Decision("spherical harmonics", "no view directions are computed", f"the scene has degree 0{nothing}")]
    if settings.sh_attenuation:
        return [_of_sh_attenuation(probe, settings.sh_attenuation)]
    if "sh" in settings.keep or degree == scene.sh_degree:
        return []
    return [
        Decision(
            "spherical harmonics",
            f"evaluated up to degree {degree}",
            f"all coefficients of degrees {degree + 1} to {scene.sh_degree} are 0",
            bytes=scene.gaussians * 3 * ((scene.sh_degree + 1) ** 2 - (degree + 1) ** 2) * 4,
        )
    ]


def _of_sh_attenuation(probe: Probe, attenuation: float) -> Decision:
    scene = probe.scene
    if attenuation == 1:
        return Decision(
            "spherical harmonics",
            f"degrees 1 to {scene.sh_degree} are attenuated to 0, in the result too; no view directions are computed",
            "requested",
            bytes=scene.gaussians * 3 * ((scene.sh_degree + 1) ** 2 - 1) * 4,
            error="colors no longer depend on the view direction",
        )
    return Decision(
        "spherical harmonics",
        f"coefficients of degrees 1 to {scene.sh_degree} are multiplied by {1 - attenuation:.3g}, in the result too; "
        f"evaluated up to degree {scene.used_degree}",
        "requested",
        error="colors depend less on the view direction",
    )


def of_views(probe: Probe, plan: Plan, settings: Settings, work: Work, content_bytes: int) -> list[Decision]:
    """Return the decisions about views and their pixels.

    Args:
        probe: Measurements of the job.
        plan: Plan that the decisions describe.
        settings: Settings of the job.
        work: Work of one step.
        content_bytes: Memory saved by dropping similar views.
    """
    decisions = []
    total = len(probe.sizes)
    blind = total - len(plan.survey.covered)
    if blind:
        decisions.append(Decision("views", f"{blind} of {total} are skipped", "they see no Gaussian"))
    similar = len(plan.survey.covered) - len(plan.covered)
    if similar:
        decisions.append(
            Decision(
                "similar views",
                f"{similar} of {total} are skipped",
                f"each shows the same as another view, shifted by less than {settings.similar_views:.1%} of its side",
                bytes=content_bytes,
                error="surfaces that only these views show get fewer steps, or none",
            )
        )
    share = f"{plan.survey.uncovered_share:.1%} of the views' pixels are uncovered"
    if plan.weighted and work.pixels < work.without_region:
        decisions.append(
            Decision(
                "uncovered pixels",
                f"{1 - work.pixels / work.without_region:.0%} of the pixels skip the network",
                share,
                seconds=(work.without_region - work.pixels) * probe.network.rate.both,
            )
        )
    if plan.weighted:
        decisions.append(
            Decision(
                "position weights",
                "statistics are weighted by coverage",
                share,
                error=_ANOTHER_LOSS,
            )
        )
    return decisions


def of_training_background(plan: Plan, settings: Settings, visits: Visits) -> list[Decision]:
    """Return the lines about the training background and the initial colors, unless they are the default ones."""
    share = f"{plan.survey.uncovered_share:.1%} of the views' pixels are uncovered"
    decisions = []
    if plan.training_background != "background":
        color = {"random": "a random color", "palette": "the color of a random pixel of the style"}[
            plan.training_background
        ]
        reason = (
            f"{share}: colors would be fitted to a fixed background"
            if settings.training_background == "auto"
            else "requested"
        )
        cost = visits.content.always + visits.images.always
        if cost:
            reason += f"; content features are recomputed with it, {cost:.2g} s per step"
        decisions.append(Decision("training_background", f"{color} each time", reason, error=_ANOTHER_LOSS))
    if plan.warm_start:
        reason = "steps change the overall color only slowly"
        if is_scan(plan.survey, weighted=plan.weighted):
            reason = f"{share}: nothing around the object determines how bright it should be"
        by_luminance = settings.preserve_colors == "luminance"
        begins = (
            "luminance starts with the style's mean and standard deviation"
            if by_luminance
            else "colors start with the style's distribution"
        )
        if ends_with_transfer(settings, warm=True):
            begins += f"; they are reset to it after the last step, because {settings.style_loss} lets them drift"
        decisions.append(
            Decision(
                "start",
                begins,
                reason if settings.warm_start is None else "requested",
                error="differs from the paper's start",
            )
        )
    return decisions


def of_colors(settings: Settings) -> list[Decision]:
    """Return the line about color preservation, if luminance alone is stylized."""
    if settings.preserve_colors != "luminance":
        return []
    return [
        Decision(
            "colors",
            "only luminance is compared and optimized; each Gaussian keeps its chroma",
            "requested",
            error=_ANOTHER_LOSS,
        )
    ]


def of_network(probe: Probe, settings: Settings, work: Work, activations: int) -> list[Decision]:
    """Return the lines about layers, content, partition and forward passes. `activations` is their budget in bytes."""
    layers = f"{probe.network.deepest}, the deepest one used"
    decisions = [Decision("network layers", f"up to {layers}", "the loss reads no deeper layer")]
    if settings.style_loss != "sos":
        decisions.append(_of_style_loss(probe, settings, work))
    if not settings.content_weight:
        decisions.append(Decision("content", "no content features are computed or cached", "its weight is 0"))
    gigabytes = f"the {activations / 1e9:.1f} GB for activations"
    if work.tiles <= 1:
        decisions.append(
            Decision("partition", "none: the network takes each view as a whole", f"it fits in {gigabytes}")
        )
    else:
        decisions.append(
            Decision("partition", f"up to {work.tiles} tiles per view", f"larger tiles would not fit in {gigabytes}")
        )
    if work.again:
        reason = f"activations of {1 - work.again / work.pixels:.0%} of the pixels fit in {gigabytes}"
        decisions.append(Decision("second forward", f"for {work.again / work.pixels:.0%} of the pixels", reason))
    else:
        decisions.append(
            Decision(
                "second forward",
                "none: activations are cached between statistics and gradient",
                f"they fit in {gigabytes}",
                seconds=work.pixels * probe.network.rate.forward,
            )
        )
    return decisions


def _of_style_loss(probe: Probe, settings: Settings, work: Work) -> Decision:
    """Return the line about a style loss that matches features."""
    weight, network = NEAREST_WEIGHTS[settings.style_loss], probe.network
    what = "replaces the statistics" if settings.style_loss == "nnfm" else "is added to the statistics"
    return Decision(
        "style loss",
        f"the distance of relu3 features to the nearest of at most {MOST_VECTORS:,} style features {what}, with "
        f"weight {weight:.3g}; the search takes {work.pairs * network.rate.search:.2g} s per view",
        f"{settings.style_loss} was requested",
        error=_ANOTHER_LOSS,
    )


def of_styles(style: StyleMixture, settings: Settings) -> list[Decision]:
    """Return the line about the mixture of several style images."""
    reason = f"{len(style.pictures)} images were given"
    if not has_statistics(settings.style_loss):
        reason += (
            "; features are matched with those of all images, whose weights matter only if there are too many features"
        )
    return [Decision("styles", f"a mixture: {style.text}", reason, error=_ANOTHER_LOSS)]


def of_regions(asked: Regions, resolved: Regions, plan: Plan, cameras: Sequence[Camera]) -> list[Decision]:
    """Return the lines about the regions and the cost of their maps.

    Args:
        asked: Regions as requested.
        resolved: Regions after `Regions.resolved`.
        plan: Plan under construction.
        cameras: Cameras of all views.
    """
    weights = plan.survey.total_blend_weights
    found = []
    for place, region in enumerate(asked.every):
        own, now = asked.members(place), resolved.members(place)
        count, share = int(now.sum()), float(weights[now].sum() / weights.sum())
        reason = region.select or "not in any other region"
        taken = region.selected - int(own.sum())
        if taken > 0:
            reason += f"; {taken:,} more are also in a later region, which takes precedence"
        what = f"{count:,} of {len(weights):,} Gaussians, {share:.1%} of what the views show,"
        if place and not bool(own.any()):
            done = f"warning: ignored, because it has no Gaussians{' of its own' if taken > 0 else ''}"
        elif region.freeze:
            done = f"{int(own.sum()):,} Gaussians stay unchanged"
        elif place and place not in resolved.active:
            done = f"warning: ignored, because no view sees its {int(own.sum()):,} Gaussians; they count as rest"
        elif place not in resolved.active:
            continue  # the rest is empty
        else:
            done = f"{what} use {region.style.text if region.style else 'the style'}"
            done += f", with weight {region.weight:g}" if region.weight != 1 else ""
        found.append(Decision(f"region {region.name}", done, reason, error=_ANOTHER_LOSS))
    if not resolved.mapped:
        return found
    sizes = [cameras[index].width * cameras[index].height for index in plan.covered]
    total, renders = (
        int(MAP_BYTES * len(resolved.active) * sum(sizes)),
        -(-len(resolved.active) // MAPS_OF_A_RENDER) + 1,
    )
    several = "1 region" if len(resolved.active) == 1 else f"{len(resolved.active)} regions"
    how = f"statistics of {several} are weighted by each region's fraction of a pixel's blend weights"
    how += f"; {renders} renders at a view's first visit, {total / 1e6:.1f} MB for all views"
    return [*found, Decision("regions", how, "otherwise styles would leak into other regions", error=_ANOTHER_LOSS)]


def of_rasterizer(probe: Probe, plan: Plan) -> list[Decision]:
    """Return the line about the rasterizer on a GPU; on the CPU there is no choice."""
    if plan.device != "cuda":
        return []
    names = {"cuda": "gsplat", "triton": "Triton"}
    how = f"{names[plan.uncached]} on the GPU" if plan.uncached in names else "on the CPU"
    if plan.rasterizer == "cached":
        how += ", with cached blend weights"
    failed = [f"{names[name]} cannot be used: {problem}" for name, problem in probe.machine.problems.items()]
    if plan.uncached in names:
        failed.append(f"{names[plan.uncached]} works here")
    return [Decision("rasterizer", how, "; ".join(failed) or "requested")]


def of_search(plan: Plan, passes: int) -> list[Decision]:
    """Return the line about cuDNN's algorithms on a GPU. `passes` is the number of passes per image size."""
    if plan.device != "cuda":
        return []
    reason = f"the network evaluates images of one size about {passes:,} times"
    if plan.search:
        return [Decision("convolutions", "cuDNN benchmarks its algorithms", reason, error="runs may round differently")]
    return [Decision("convolutions", "cuDNN does not benchmark its algorithms", reason)]


def ranks_of_a_view(probe: Probe, settings: Settings) -> int:
    """Return the number of ranks that evaluate a view together if all take part."""
    return probe.machine.ranks // math.gcd(settings.views_per_step, probe.machine.ranks)


def of_launches(probe: Probe, plan: Plan, settings: Settings, visits: int) -> list[Decision]:
    """Return the line about kernel launches on a GPU. `visits` is the number of visits of views that share a graph."""
    if plan.device != "cuda":
        return []
    launches, come = probe.launches, f"views of one size are visited about {visits:,} times"
    if plan.graphs:
        assert launches is not None
        reason = f"{_against_graphs(launches)}; {come}"
        return [Decision("launches", "the loss of a view is captured as a CUDA graph", reason, seconds=launches.saved)]
    if "launches" in settings.keep:
        reason = "requested"
    elif ranks_of_a_view(probe, settings) > 1:
        reason = "a graph cannot contain communication between workers"
    elif launches is None:
        reason = come
    elif launches.problem is not None:
        reason = f"CUDA graphs are unavailable: {launches.problem}"
    elif launches.least_visits is None:
        reason = f"a graph saves hardly any time: {_against_graphs(launches)}"
    else:
        pays = f"one graph per phase pays off from {launches.least_visits:.1f} visits"
        reason = f"{come}, but {pays}; {_against_graphs(launches)}"
    return [Decision("launches", "kernel by kernel", reason)]


def _against_graphs(launches: LaunchCost) -> str:
    """Return the measured times of graphs and of single launches as text."""
    return (
        f"measured per view: {1e3 * launches.replayed:.3g} ms as a graph, {1e3 * launches.seconds:.3g} ms kernel by "
        f"kernel, {1e3 * launches.capture:.3g} ms to capture"
    )


def of_blend_weights(probe: Probe, plan: Plan, settings: Settings, budget: int) -> Decision:
    """Return the line about caching blend weights. `budget` is their memory in bytes."""
    raster = probe.raster
    if plan.cached_weights == "none":
        visits = (plan.steps_coarse + settings.steps_sos) * settings.views_per_step / len(plan.covered)
        reason = f"a view is visited {visits:.1f} times"
        if settings.cached_weights == "none" or "blend-weights" in settings.keep:
            reason = "requested"
        elif raster.bytes is None:
            reason = "gsplat cannot cache them"
        elif plan.uncached in GPU_RASTERIZERS:
            reason = _why_not_on_a_gpu(raster, reason)
        return Decision("blend weights", "recomputed in every step", reason, bytes=raster.bytes)
    room = f"{budget / 1e9:.1f} GB are available for blend weights"
    saved = raster.seconds - raster.kept_seconds if raster.kept_seconds else None
    size, error = raster.bytes or 0, "none"
    if plan.cached_weights == "half":
        size = raster.half_bytes or 0
        error = "each weight is off by at most 1/2048 of its value: 0.12 of 255 levels per pixel"
    share = Made(0.0, size, budget, len(plan.covered)).kept
    part = "all" if share == 1 else f"{share:.0%} of the views'"
    decision = f"{part} cached in {'half precision' if plan.cached_weights == 'half' else 'float32'}"
    reason = f"they take {size / 1e9:.2f} GB for all views; {room}"
    if plan.uncached in GPU_RASTERIZERS and raster.kept_seconds is not None:
        reason += f"; {_against(raster)}"
    return Decision(
        "blend weights", decision, reason, seconds=saved * share if saved is not None else None, error=error
    )


def _why_not_on_a_gpu(raster: RasterCost, visits: str) -> str:
    """Return the reason, from measurements, why no weights are cached on a GPU."""
    if raster.kept_seconds is None:
        return "the weights of one view do not fit"
    if raster.least_visits is None:
        return f"cached weights are not faster here: {_against(raster)}"
    return f"{visits}, but caching pays off from {raster.least_visits:.1f} visits; {_against(raster)}"


def _against(raster: RasterCost) -> str:
    """Return the measured times of cached and of recomputed weights as text."""
    return (
        f"measured per view: {1e3 * (raster.kept_seconds or 0):.3g} ms cached, {1e3 * raster.seconds:.3g} ms recomputed"
    )


def of_schedule(plan: Plan, settings: Settings, counts: Sequence[int]) -> list[Decision]:
    """Return the lines about scales, phase 1 and early stopping. `counts` are the numbers of scales of the views."""
    decisions = []
    scales = f"{min(counts)} to {max(counts)}" if min(counts) < max(counts) else f"{counts[0]}"
    reason = f"the shorter side is halved until it is at most {settings.coarsest_side} pixels"
    decisions.append(Decision("scales", scales, reason))
    if settings.scales:
        decisions.append(_of_scale_weights(settings, max(counts)))
    if settings.steps_coarse and not plan.steps_coarse:
        decisions.append(
            Decision(
                "phase 1",
                f"its {settings.steps_coarse} steps are skipped",
                "only one scale has a weight, so it would be the same as phase 2"
                if settings.scales
                else "there is only one scale, so it would be the same as phase 2",
                error="these steps, which would reduce the same loss",
            )
        )
    if settings.early_stop and plan.training_background != "background":
        reason = "losses on different backgrounds cannot be compared"
        decisions.append(Decision("early stop", "none: all steps are run", reason))
    elif settings.early_stop:
        decisions.append(
            Decision(
                "early stop",
                f"when the mean loss of {window_length(len(plan.covered))} steps is less than {LEAST_FALL:.1%} below "
                "that of the same number of steps before",
                "later steps would gain little",
                error="the remaining decrease of the loss",
            )
        )
    return decisions


def _of_scale_weights(settings: Settings, most: int) -> Decision:
    weights = ScaleWeights(settings.scales)
    chosen = weights.chosen(most)
    told = ", ".join(f"scale {scale} {weights.of(scale):g}" for scale in chosen)
    left = most - len(chosen)
    nothing = f"; {left} of {most} scales are not computed" if left else ""
    return Decision("weights of scales", f"{told}{nothing}", "requested", error=_ANOTHER_LOSS)


def of_ranks(choice: RanksChoice, available: int, link: Link) -> Decision:
    """Return the line about the number of ranks."""
    speed = f"{choice.speed_up:.2f} times as fast as one"
    measured = f"{link.bandwidth / 1e9:.2g} GB/s and {link.latency * 1e6:.0f} microseconds between ranks were measured"
    if choice.ranks == available:
        return Decision("ranks", f"all {available} take part, {speed}", measured)
    other = choice.seconds[1] / choice.seconds[available]
    reason = (
        f"all of them would be {other:.2f} times as fast, because the others would only add communication; {measured}"
    )
    return Decision("ranks", f"{choice.ranks} of {available} take part, {speed}", reason)


def of_precision(probe: Probe, settings: Settings) -> list[Decision]:
    """Return the line about the network's precision, unless float32 was requested."""
    asked, ratio, error = settings.precision, probe.network.precision_ratio, probe.network.gradient_error
    if asked == "float32":
        return []
    if ratio is None:
        reason = f"{asked} was requested, but needs an NVIDIA GPU of compute capability 8.0 or higher"
        return [Decision("precision", "features in float32", reason)]
    if precision_of(asked, ratio) == "float32":
        reason = f"{asked} was requested, but takes {1 / ratio:.1f} times as long as float32 on this processor"
        return [Decision("precision", "features in float32", reason)]
    known = "the error of the colors is measured during the run"
    if error is not None:
        known = (
            f"the first view's pixel gradient has a relative error of {error.relative_error:.2g} (cosine "
            f"{error.cosine:.5f}); {known}"
        )
    what = {"bfloat16": "features in bfloat16", "tf32": "convolutions in TF32"}[asked]
    return [Decision("precision", what, f"requested, {ratio:.1f} times faster here", error=known)]
