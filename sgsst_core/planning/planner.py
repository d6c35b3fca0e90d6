"""What a scene does not need is left out: decisions before the first iteration, each with its evidence.

The plan looks at scene, views and machine (one survey of the views, timed probes of network and rasterizer), decides,
and predicts seconds an iteration and peak memory. `Stylizer` follows it; the report sets what happened beside it.
"""

from __future__ import annotations

import math
import time
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, field, replace
from typing import Any

import psutil
import torch
from torch import Tensor

from sgsst_core.budget import MEMORY_SHARES
from sgsst_core.errors import SettingsError
from sgsst_core.features.network_weights import BackboneWeights
from sgsst_core.features.vgg import ALIGNMENT, CONTENT_LAYER, STYLE_LAYERS, FeatureNetwork
from sgsst_core.loss.convergence import LEAST_FALL, window_length
from sgsst_core.loss.sos import SosLoss
from sgsst_core.parallel.collectives import ALONE, Collectives
from sgsst_core.parallel.division import divide, loads
from sgsst_core.planning.cost import RasterCost, Rate, Work, content_bytes, image_bytes, pieces_of, probe, raster_cost
from sgsst_core.planning.pruning import distinct_views, pruned_image_error
from sgsst_core.planning.ranks_model import IterationWork, Link, RanksChoice, choose_ranks, probe_link
from sgsst_core.planning.survey import Survey, survey
from sgsst_core.rasterizer import Rasterizer
from sgsst_core.scene.camera import Camera
from sgsst_core.scene.gaussians import Scene
from sgsst_core.settings import KeptWeights, Settings

#: With this share of pixels uncovered, views are taken for those of an object scan, with an empty surround.
UNCOVERED_SHARE = 0.01
#: Largest side of the picture that the network is timed on: large enough that its rate is that of a partition tile.
PROBE_SIDE = 384
#: Building a view's kept weights costs about three renders with gradient, and each use of them saves two thirds of one:
#: with fewer visits they do not pay.
LEAST_VISITS = 5
#: Views on which the model of several ranks is evaluated; the others are taken to be like them.
SAMPLED_VIEWS = 3
#: Bytes an optimised Gaussian costs beside the scene: colours, gradient and two moments, float32.
OPTIMISER_BYTES = 4 * 3 * 4


@dataclass(frozen=True)
class Decision:
    """One line of a plan.

    Attributes:
        item: what was looked at.
        decision: what was decided.
        reason: the evidence.
        seconds: saved in every iteration, estimated; None where that is not known.
        bytes: of memory saved; None likewise.
        error: what it may cost in accuracy; "none" for what changes no result beyond rounding.
    """

    item: str
    decision: str
    reason: str
    seconds: float | None = None
    bytes: int | None = None
    error: str = "none"


@dataclass(frozen=True)
class Prediction:
    """What the plan expects, mean over views.

    Attributes:
        seconds: of an SOS iteration.
        seconds_coarse: of an iteration of phase 1.
        peak_bytes: of physical memory of a rank, at any time.
        communication: seconds of an SOS iteration in which a rank waits for what others send.
        seconds_one_rank: of an SOS iteration on one rank; None where there is only one.
    """

    seconds: float
    seconds_coarse: float
    peak_bytes: int
    communication: float = 0.0
    seconds_one_rank: float | None = None


@dataclass(frozen=True)
class Plan:
    """What was decided for a scene.

    Attributes:
        survey: what the views show.
        optimised: [N] bool, Gaussians whose colours the views decide.
        seen: [N] bool, Gaussians that are rendered: the optimised ones, or all for comparison.
        covered: indices of the views that are stylized.
        weighted: statistics are weighted by coverage.
        steps_coarse: of phase 1; 0 where it is left out.
        kept_weights: in which form blend weights are kept between iterations.
        coarse_weights: phase 1 keeps the weights of the coarsest scale only.
        ranks: how many take part.
        decisions: for people.
        prediction: for comparison with what happens.
    """

    survey: Survey
    optimised: Tensor
    seen: Tensor
    covered: list[int]
    weighted: bool
    steps_coarse: int
    kept_weights: KeptWeights = "none"
    coarse_weights: bool = False
    ranks: int = 1
    decisions: list[Decision] = field(default_factory=list)
    prediction: Prediction | None = None

    def as_dict(self) -> dict[str, Any]:
        """For JSON."""
        return {
            "decisions": [asdict(decision) for decision in self.decisions],
            "prediction": asdict(self.prediction) if self.prediction else None,
        }


def make_plan(
    scene: Scene,
    cameras: Sequence[Camera],
    settings: Settings,
    loss: SosLoss,
    rasterizer: Rasterizer,
    memory: int,
    collectives: Collectives = ALONE,
    sharing: int = 1,
) -> Plan:
    """Survey the views, time network, rasterizer and what connects the ranks, decide. Every rank gets the same plan.

    Args:
        cameras: at the size at which they are stylized.
        loss: of one rank, whose network and memory budget are used.
        rasterizer: of the whole scene.
        memory: bytes that this rank may plan with.
        collectives: of all ranks that there are.
        sharing: among how many of them a machine's memory is divided: fewer ranks have more each.

    Raises:
        CameraError: no camera sees a Gaussian.
        SettingsError: pruning would leave no Gaussian.
    """
    looked = survey(scene, cameras, rasterizer, collectives)
    link = probe_link(collectives, rasterizer.device)
    # Timings differ from rank to rank: one decides for all.
    return collectives.broadcast(
        lambda: _decide(scene, cameras, settings, loss, rasterizer, memory, looked, link, collectives.size, sharing)
    )


def _decide(
    scene: Scene,
    cameras: Sequence[Camera],
    settings: Settings,
    loss: SosLoss,
    rasterizer: Rasterizer,
    memory: int,
    looked: Survey,
    link: Link,
    available: int,
    sharing: int,
) -> Plan:
    plan = _choose(scene, cameras, settings, loss, looked)
    leave_out = plan.weighted and "uncovered" not in settings.keep
    work = Work.of(cameras, loss, looked, plan.covered, leave_out=leave_out)
    coarse = Work.of(cameras, loss, looked, plan.covered, leave_out=leave_out, coarsest=True)
    rate = probe(loss, min(PROBE_SIDE, max(max(camera.width, camera.height) for camera in cameras)))
    budget = int(memory * MEMORY_SHARES["rasterizer"])
    raster = raster_cost(scene, cameras, plan.covered, rasterizer, settings.near, budget)
    plan = _choose_kept_weights(plan, settings, raster, budget)
    plan.decisions.extend(_scene_decisions(scene, plan, cameras, settings, rasterizer))
    plan.decisions.extend(_view_decisions(cameras, plan, settings, work, rate, loss))
    plan.decisions.extend(_network_decisions(settings, work, rate, loss))
    plan.decisions.append(_weights_decision(plan, settings, raster, budget))
    plan.decisions.extend(_schedule_decisions(plan, settings, loss, cameras))
    seconds = raster.kept_seconds if plan.kept_weights != "none" and raster.kept_seconds else raster.seconds
    kept = {"none": 0, "float32": raster.bytes, "half": raster.half_bytes}[plan.kept_weights]
    content = 0 if "content" in settings.keep else content_bytes(cameras, plan.covered, settings, loss)
    peak = psutil.Process().memory_info().rss + image_bytes(cameras)
    peak += min(content // available, int(memory * MEMORY_SHARES["views"]) // 2) + min(kept // available, budget)
    if available == 1:
        peak += work.peak_bytes(loss)
        expected = Prediction(work.seconds(rate) + seconds, coarse.seconds(rate) + seconds, int(peak))
        return replace(plan, prediction=expected)
    samples = _samples(plan, cameras, loss, rate, seconds, sharing, leave_out=leave_out)
    return _share_out(plan, settings, loss, samples, link, available, int(peak))


def _samples(
    plan: Plan,
    cameras: Sequence[Camera],
    loss: SosLoss,
    rate: Rate,
    raster: float,
    sharing: int,
    *,
    leave_out: bool,
) -> tuple[list[IterationWork], list[IterationWork]]:
    """Iterations of some views, for the model of several ranks: of phase 1, and on all scales."""
    fixed = probe(loss, ALIGNMENT).both * ALIGNMENT**2  # as good as no pixel: what it takes is the same for any number
    views = plan.covered[:: max(1, len(plan.covered) // SAMPLED_VIEWS)]
    gaussians = int(plan.seen.sum())

    def of(index: int, coarsest: bool) -> IterationWork:
        region = plan.survey.regions[index] if leave_out else None
        pieces = pieces_of(cameras[index], loss, region, coarsest=coarsest)
        return IterationWork(
            pieces,
            loss.network.halo,
            rate.both,
            raster,
            fixed * len(pieces),
            gaussians,
            whole_image=not (coarsest and plan.coarse_weights),
            forward=rate.forward,
            held=loss.held * sharing,
            working=loss.working,
            sharing=sharing,
        )

    return [of(index, True) for index in views], [of(index, False) for index in views]


def _share_out(
    plan: Plan,
    settings: Settings,
    loss: SosLoss,
    samples: tuple[list[IterationWork], list[IterationWork]],
    link: Link,
    available: int,
    peak: int,
) -> Plan:
    """How many of the ranks take part, and what is expected of them."""
    phases = list(zip((plan.steps_coarse, settings.steps_sos), samples, strict=True))
    choice = choose_ranks(phases, settings.views_per_step, available, link)
    ranks = available if "ranks" in settings.keep else choice.ranks
    choice = replace(choice, ranks=ranks)
    # Ranks that form groups take a view each, at the same time.
    groups = math.gcd(settings.views_per_step, ranks)
    each, turns = ranks // groups, settings.views_per_step // groups

    def mean(values: Iterable[float]) -> float:
        found = list(values)
        return turns * sum(found) / len(found)

    largest = max(max(loads(divide(work.pieces, work.halo, (1.0,) * each), work.halo)) for work in samples[1])
    held = loss.network.held_bytes_per_pixel() + loss.network.working_bytes_per_pixel()
    sharing = samples[1][0].sharing
    memory = loss.memory * sharing / min(ranks, sharing)  # of fewer ranks, each has more
    expected = Prediction(
        mean(work.seconds(each, link, groups) for work in samples[1]),
        mean(work.seconds(each, link, groups) for work in samples[0]),
        peak + int(min(largest * held, memory)),
        mean(work.communication(each, link) for work in samples[1]),
        mean(work.seconds(1, link) for work in samples[1]) * groups,
    )
    decisions = [*plan.decisions, _ranks_decision(choice, available, link)]
    return replace(plan, ranks=ranks, decisions=decisions, prediction=expected)


def _ranks_decision(choice: RanksChoice, available: int, link: Link) -> Decision:
    speed = f"{choice.speed_up:.2f} times as fast as one"
    measured = f"{link.bandwidth / 1e9:.2g} GB/s and {link.latency * 1e6:.0f} microseconds between ranks were measured"
    if choice.ranks == available:
        return Decision("ranks", f"all {available} take part, {speed}", measured)
    other = choice.seconds[1] / choice.seconds[available]
    reason = f"all of them would be {other:.2f} times as fast: the rest would only add communication; {measured}"
    return Decision("ranks", f"{choice.ranks} of {available} take part, {speed}", reason)


def choose_network(
    weights: BackboneWeights, settings: Settings, collectives: Collectives = ALONE
) -> tuple[FeatureNetwork, list[Decision]]:
    """The feature network: layers up to the deepest one used, in the precision that was asked for if that pays.

    Processors without bfloat16 instructions compute it hundreds of times slower than float32, so both are timed.
    """
    layers = (*STYLE_LAYERS, CONTENT_LAYER) if settings.content_weight else STYLE_LAYERS
    device = "cuda" if torch.cuda.is_available() else "cpu"
    if settings.precision == "float32":
        return FeatureNetwork(weights, layers, torch.float32, device), []
    ratio = collectives.broadcast(
        lambda: _convolution_seconds(torch.float32, device) / _convolution_seconds(torch.bfloat16, device)
    )
    if ratio > 1:
        error = "about 20 % of the gradient's norm; measured during the run"
        made = Decision("precision", "features in bfloat16", f"asked for, {ratio:.1f} times faster here", error=error)
        return FeatureNetwork(weights, layers, torch.bfloat16, device), [made]
    reason = f"bfloat16 was asked for, but this processor computes it {1 / ratio:.0f} times slower"
    return FeatureNetwork(weights, layers, torch.float32, device), [
        Decision("precision", "features in float32", reason)
    ]


def _convolution_seconds(dtype: torch.dtype, device: str) -> float:
    """Of a 3x3 convolution with 128 channels on 24 x 24 cells, the second of two runs."""
    image = torch.ones((1, 128, 24, 24), dtype=dtype, device=device)
    kernel = torch.ones((128, 128, 3, 3), dtype=dtype, device=device)
    seconds = 0.0
    for _ in range(2):
        started = time.perf_counter()
        torch.nn.functional.conv2d(image, kernel, padding=1)
        if device == "cuda":
            torch.cuda.synchronize()
        seconds = time.perf_counter() - started
    return seconds


def _choose(scene: Scene, cameras: Sequence[Camera], settings: Settings, loss: SosLoss, looked: Survey) -> Plan:
    """What follows from the survey alone."""
    optimised = looked.total_weights > settings.prune_weight
    if not optimised.any():
        raise SettingsError(
            f"--prune-weight {settings.prune_weight:g} would leave out every Gaussian: the largest total blend weight "
            f"is {float(looked.total_weights.max()):.3g}. Give a smaller one."
        )
    everything = "unseen" in settings.keep and not settings.prune_weight
    weighted = settings.position_weights == "on" or (
        settings.position_weights == "auto" and looked.uncovered_share > UNCOVERED_SHARE
    )
    several = any(loss.scale_count(camera.height, camera.width) > 1 for camera in cameras)
    return Plan(
        survey=looked,
        optimised=optimised,
        seen=torch.ones_like(optimised) if everything else optimised,
        covered=distinct_views(scene, cameras, looked.covered, looked.total_weights, settings.similar_views),
        weighted=weighted,
        steps_coarse=settings.steps_coarse if several or settings.preset == "paper" else 0,
    )


def _choose_kept_weights(plan: Plan, settings: Settings, raster: RasterCost, budget: int) -> Plan:
    """How blend weights are kept: exactly where they fit, in half precision where only that fits, and where it pays."""
    form = settings.kept_weights
    visits = (plan.steps_coarse + settings.steps_sos) * settings.views_per_step / len(plan.covered)
    if "blend-weights" in settings.keep or (form == "auto" and visits < LEAST_VISITS):
        form = "none"
    elif form == "auto":
        form = "float32" if raster.bytes <= budget or settings.preset == "paper" else "half"
    fits = {"none": False, "float32": raster.bytes <= budget, "half": raster.half_bytes <= budget, "auto": False}[form]
    phase_1 = plan.steps_coarse / len(plan.covered) >= LEAST_VISITS
    coarse = phase_1 and not fits and "blend-weights" not in settings.keep and settings.kept_weights == "auto"
    return replace(plan, kept_weights=form, coarse_weights=coarse)


def _scene_decisions(
    scene: Scene, plan: Plan, cameras: Sequence[Camera], settings: Settings, rasterizer: Rasterizer
) -> list[Decision]:
    decisions = []
    left_out = ~plan.seen
    unseen = int((left_out & (plan.survey.total_weights <= 0)).sum())
    pruned = int(left_out.sum()) - unseen
    change = "keep their colours" if settings.unseen == "keep" else "take their neighbours' colour change at the end"
    if unseen:
        decisions.append(
            Decision(
                "unseen Gaussians",
                f"{unseen:,} of {len(scene):,} are not rendered and not optimised; they {change}",
                "their blend weights are 0 in every pixel of every view",
                bytes=unseen * OPTIMISER_BYTES,
            )
        )
    if pruned:
        error = pruned_image_error(left_out, cameras, plan.covered, rasterizer)
        decisions.append(
            Decision(
                "pruned Gaussians",
                f"{pruned:,} of {len(scene):,} are not rendered and not optimised; they {change}",
                f"their blend weights over all views add up to at most {settings.prune_weight:g} each",
                bytes=pruned * OPTIMISER_BYTES,
                error=f"of colours in 0..255, no pixel of a view changes by more than {255 * error.largest:.3g}, the "
                f"mean pixel by no more than {255 * error.mean:.2g}",
            )
        )
    if scene.sh_degree and "sh" not in settings.keep:
        degree = scene.subset(plan.seen).without_zero_bands().sh_degree
        if degree < scene.sh_degree:
            decisions.append(
                Decision(
                    "spherical harmonics",
                    f"evaluated up to degree {degree}",
                    f"all coefficients of degrees {degree + 1} to {scene.sh_degree} are 0",
                    bytes=len(scene) * 3 * ((scene.sh_degree + 1) ** 2 - (degree + 1) ** 2) * 4,
                )
            )
    elif not scene.sh_degree:
        decisions.append(Decision("spherical harmonics", "no view directions are computed", "the scene has degree 0"))
    return decisions


def _view_decisions(
    cameras: Sequence[Camera], plan: Plan, settings: Settings, work: Work, rate: Rate, loss: SosLoss
) -> list[Decision]:
    decisions = []
    blind = len(cameras) - len(plan.survey.covered)
    if blind:
        decisions.append(Decision("views", f"{blind} of {len(cameras)} are left out", "they see no Gaussian"))
    similar = len(plan.survey.covered) - len(plan.covered)
    if similar:
        decisions.append(
            Decision(
                "similar views",
                f"{similar} of {len(cameras)} are left out",
                f"their picture is that of another view, shifted by less than {settings.similar_views:.1%} of its side",
                bytes=content_bytes(cameras, plan.survey.covered, settings, loss)
                - content_bytes(cameras, plan.covered, settings, loss),
                error="what only these views show gets fewer steps, or none",
            )
        )
    share = f"{plan.survey.uncovered_share:.1%} of the views' pixels are uncovered"
    if plan.weighted and work.pixels < work.without_region:
        decisions.append(
            Decision(
                "uncovered pixels",
                f"{1 - work.pixels / work.without_region:.0%} of the pixels do not go through the network",
                share,
                seconds=(work.without_region - work.pixels) * rate.both,
            )
        )
    if plan.weighted:
        decisions.append(
            Decision(
                "position weights",
                "statistics are weighted by coverage",
                share,
                error="it is another loss than the paper's",
            )
        )
    return decisions


def _network_decisions(settings: Settings, work: Work, rate: Rate, loss: SosLoss) -> list[Decision]:
    layers = "relu5_1, the deepest one used"
    decisions = [Decision("network layers", f"none behind {layers}", "the loss reads no deeper one")]
    if not settings.content_weight:
        decisions.append(Decision("content", "no content features are computed or kept", "its weight is 0"))
    gigabytes = f"{loss.memory / 1e9:.1f} GB for activations"
    if work.tiles <= 1:
        decisions.append(Decision("partition", "none: a view goes through the network whole", f"it fits {gigabytes}"))
    else:
        decisions.append(Decision("partition", f"up to {work.tiles} tiles a view", f"more would not fit {gigabytes}"))
    if work.again:
        reason = f"activations of {1 - work.again / work.pixels:.0%} of the pixels fit {gigabytes}"
        decisions.append(Decision("second forward", f"for {work.again / work.pixels:.0%} of the pixels", reason))
    else:
        decisions.append(
            Decision(
                "second forward",
                "none: activations are kept between statistics and gradient",
                f"they fit {gigabytes}",
                seconds=work.pixels * rate.forward,
            )
        )
    return decisions


def _weights_decision(plan: Plan, settings: Settings, raster: RasterCost, budget: int) -> Decision:
    room = f"{budget / 1e9:.1f} GB are there for blend weights"
    saved = raster.seconds - raster.kept_seconds if raster.kept_seconds else None
    if plan.kept_weights == "none":
        visits = (plan.steps_coarse + settings.steps_sos) * settings.views_per_step / len(plan.covered)
        reason = (
            "asked for" if "none" in (settings.kept_weights, *settings.keep) else f"a view comes {visits:.1f} times"
        )
        return Decision("blend weights", "computed anew in every iteration", reason, bytes=raster.bytes)
    size, error = (raster.bytes, "none")
    if plan.kept_weights == "half":
        size, error = raster.half_bytes, "each weight is off by at most 1/4096 of itself: 0.06 of 255 levels in a pixel"
    part = "all" if size <= budget else f"{budget / size:.0%} of the views'"
    decision = f"{part} kept in {'half precision' if plan.kept_weights == 'half' else 'float32'}"
    if plan.coarse_weights:
        decision += "; in phase 1 only those of the coarsest scale"
    share = min(1.0, budget / max(size, 1))
    reason = f"they take {size / 1e9:.2f} GB of all views; {room}"
    return Decision(
        "blend weights", decision, reason, seconds=saved * share if saved is not None else None, error=error
    )


def _schedule_decisions(plan: Plan, settings: Settings, loss: SosLoss, cameras: Sequence[Camera]) -> list[Decision]:
    decisions = []
    counts = [loss.scale_count(cameras[index].height, cameras[index].width) for index in plan.covered]
    side = loss.coarsest
    scales = f"{min(counts)} to {max(counts)}" if min(counts) < max(counts) else f"{counts[0]}"
    decisions.append(Decision("scales", scales, f"the shorter side is halved until it is at most {side} pixels"))
    if settings.steps_coarse and not plan.steps_coarse:
        decisions.append(
            Decision(
                "phase 1",
                f"its {settings.steps_coarse} steps are left out",
                "the coarsest scale is the only one, so that it would be the same as phase 2",
                error="the steps, which work on the same loss",
            )
        )
    if settings.early_stop:
        decisions.append(
            Decision(
                "early stop",
                f"when the mean loss of {window_length(len(plan.covered))} steps is less than {LEAST_FALL:.1%} below "
                "that of as many steps before",
                "later steps would buy little",
                error="what the loss would still have fallen",
            )
        )
    return decisions
