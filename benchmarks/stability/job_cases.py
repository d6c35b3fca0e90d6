"""Hard cases of whole jobs: degenerate and extreme styles, scenes and settings.

Jobs are small. Each is checked for the same properties, in each precision and with sampled scales. Colors are finite,
no step exceeds Adam's maximum, a repeated run is bit-identical, the loss of all scales does not rise, and loss and
gradient of the final image match float64.
"""

import functools
import hashlib
import math
import multiprocessing
from collections.abc import Callable, Mapping
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import torch
from torch import Tensor

from benchmarks.common import free_address
from benchmarks.stability.case import (
    FLOAT32,
    MOST_UNCERTAIN,
    PRECISIONS,
    Case,
    CaseResult,
    DecisionsOf,
    Way,
    camera,
    evaluate,
    flat,
    gradient_error,
    in_ways,
    ordinary,
    planned,
    repeated,
    rounding_error,
    small_network,
    texture,
    vgg16,
)
from sgsst_core.constants import COLOR_OFFSET, SH_C0
from sgsst_core.errors import SgsstError
from sgsst_core.features.network_weights import BackboneWeights
from sgsst_core.features.vgg import CONTENT_LAYER, PIXELS, PUBLISHED, FeatureNetwork, even_scales, with_scales
from sgsst_core.loss.sos import SosLoss, SosResult
from sgsst_core.loss.terms import nearest_weight
from sgsst_core.parallel import ALONE, Collectives
from sgsst_core.scales import scale_count
from sgsst_core.scene.camera import Camera
from sgsst_core.scene.colors import color_subspace_of, luminance
from sgsst_core.scene.gaussians import Scene
from sgsst_core.settings import make_settings
from sgsst_core.stylizing.job import in_bfloat16
from sgsst_core.stylizing.loop import run
from sgsst_core.stylizing.styles import constrained
from sgsst_core.stylizing.stylizer import Stylizer, mean_loss
from worker.ranks.process_group import process_group

#: Relative error bound of loss and pixel gradient of the last image against float64.
REFERENCE_BOUND = 1e-4
#: Adam's longest step in units of the learning rate. It occurs if the gradient was 0 in all earlier steps.
LONGEST_STEP = 0.1 / math.sqrt(0.001) + 0.1
#: Fraction by which the final loss may exceed the initial one.
RISE = 1e-3
#: Losses up to this value count as rounding errors if scene and style match from the start.
NO_LOSS = 1e-3
#: Rounding error of the cosine of two float32 vectors of length 1.
_ROUNDING_OF_COSINES = 2**-22
STEPS, LEARNING_RATE, COARSEST_SIDE = 4, 0.02, 16
#: Way with sampled scales. A scale with a third of the visits has three times the weight in each, so single steps are
#: noisier; enough of them are made for each view to visit all scales several times.
SAMPLED = Way("sampled scales", settings={"scale_sampling": 3, "steps_sos": 24})
#: Ways to run a job on one rank, and one on several.
WAYS, RANKS = (*PRECISIONS, SAMPLED), Way("four ranks", ranks=4)


@dataclass(frozen=True)
class Situation:
    """Inputs and settings of a job.

    Attributes:
        scene: Scene to stylize.
        style: Style image [H, W, 3].
        settings: Settings that override those of `make`.
        cameras: Cameras of the job; empty for `views()`.
        falls: Whether the final loss must not exceed the initial one. Only checked if steps use the same background as
            loss evaluations. False if scene and style (nearly) match from the start, so that a step of any length
            overshoots.
        network: Function that returns the weights of the network, given those of `small_network`; None for the latter.
        in_16_bits: Whether features of 16 bits represent what is compared: their size is about what some setting gives
            them, and they differ by more than they are rounded.
    """

    scene: Scene
    style: Tensor
    settings: Mapping[str, Any] = field(default_factory=dict)
    cameras: tuple[Camera, ...] = ()
    falls: bool = True
    network: Callable[[BackboneWeights], BackboneWeights] | None = None
    in_16_bits: bool = True

    def suits(self, way: Way) -> bool:
        """Return whether a way differs from that of float32, in the larger view."""
        side = self.settings.get("coarsest_side", COARSEST_SIDE)
        sizes = [(each.height, each.width) for each in self.cameras or views()]
        if "scale_sampling" in way.settings:
            weights = self.settings.get("scales", (1.0,) * 16)
            return any(sum(weight > 0 for weight in weights[: scale_count(*size, side)]) > 1 for size in sizes)
        return any(way.suits(*size) for size in sizes) and (self.in_16_bits or not way.in_16_bits)


def views(width: int = 24, height: int = 20) -> tuple[Camera, ...]:
    """Return two cameras side by side."""
    first = camera(width, height, focal=0.75 * max(width, height))
    pose = first.world_to_camera.clone()
    pose[0, 3] = -0.3
    return replace(first, name="left"), replace(first, name="right", world_to_camera=pose)


def crowd(count: int = 60, *, seed: int = 0, degree: int = 0) -> Scene:
    """Return Gaussians that cover most of each view, as in trained scenes."""
    scene = ordinary(count, seed=seed, degree=degree)
    return replace(scene, scales=scene.scales + 2.2, sh_dc=0.6 * scene.sh_dc)


def colored(scene: Scene, red: float, green: float, blue: float) -> Scene:
    """Return the same scene in one color (0 to 1)."""
    color = (torch.tensor([red, green, blue], dtype=torch.float32) - COLOR_OFFSET) / SH_C0
    return replace(scene, sh_dc=color.expand(len(scene), 3).clone())


def even_network(weights: BackboneWeights, pixels: float | None = None) -> BackboneWeights:
    """Return the network at the feature scale "even", with pixels multiplied by a factor; None for the default."""
    scales = even_scales(weights)
    return with_scales(weights, scales if pixels is None else scales | {PIXELS: pixels})


def make(situation: Situation, way: Way = FLOAT32, collectives: Collectives = ALONE) -> Stylizer:
    """Create the stylizer of a situation, before its first step."""
    values: dict[str, Any] = {
        "steps_coarse": 1,
        "steps_sos": STEPS,
        "scale_sampling": 1,
        "learning_rate": LEARNING_RATE,
        "early_stop": False,
        "coarsest_side": COARSEST_SIDE,
        "memory_limit": 1 << 28,
    }
    settings = make_settings(**(values | dict(situation.settings) | dict(way.settings)))
    weights = small_network(way.channels)
    weights = situation.network(weights) if situation.network else weights
    cameras = situation.cameras or views()
    return planned(situation.scene, cameras, situation.style, settings, weights, way, collectives)


def strain(situation: Situation, way: Way = FLOAT32) -> CaseResult:
    """Run a situation twice and check the properties that the module lists.

    The loss before and after is that of all scales in float32, whatever the steps evaluate.

    Returns the final error against float64, or infinity if another property is violated.

    Raises:
        SgsstError: If the situation is refused.
    """
    jobs = [make(situation, way) for _ in range(2)]
    start = jobs[0].sh_dc.detach().clone()
    before = _whole_loss(situation, way, start)
    for job in jobs:
        run(job)
    job = jobs[0]
    after = _whole_loss(situation, way, job.sh_dc.detach())
    colors, moved = job.stylized(), _moved(job, start)
    judged = job.job.plan.training_background == "background"  # other backgrounds change the loss of the steps
    most = job.job.total_steps * job.job.settings.learning_rate * LONGEST_STEP
    broken = []
    if not (torch.isfinite(colors).all() and math.isfinite(moved)):
        broken.append("colors are not finite")
    if not (math.isfinite(before) and math.isfinite(after)):
        broken.append("the loss is not finite")
    if not moved <= most + 1e-5 * float(start.abs().max()):
        broken.append(f"colors moved by {moved:.3g} in {job.job.total_steps} steps")
    if not torch.equal(colors, jobs[1].stylized()):
        broken.append("a repeated run is not bit-identical")
    if situation.falls and judged and not after <= max((1 + RISE) * before, NO_LOSS):
        broken.append(f"the loss rose from {before:.6g} to {after:.6g}")
    result = reference_error(job)
    note = "; ".join(broken) or f"loss {before:.3g} to {after:.3g}; {result.note}"
    return CaseResult(math.inf if broken else result.error, result.bound, note)


def _whole_loss(situation: Situation, way: Way, colors: Tensor) -> float:
    """Return the loss of colors [n, 3] on all views and scales in float32."""
    job = make(situation, replace(way, precision="float32"))
    return mean_loss(job.evaluate(job.job.evaluation_views, colors), job.job.loss.weights)


def _moved(job: Stylizer, start: Tensor) -> float:
    """Return the largest change of a coefficient, ignoring the clamping of initial colors to their bounds."""
    sh_dc = job.sh_dc.detach()
    chroma_of = start if job.job.settings.preserve_colors == "luminance" else None
    subspace = color_subspace_of(job.job.styles.all, job.job.settings)
    within = constrained(start, chroma_of, subspace, bounded=job.job.settings.bounded)
    return float(torch.minimum((sh_dc - start).abs(), (sh_dc - within).abs()).max())


def reference_error(job: Stylizer) -> CaseResult:
    """Compare loss and pixel gradient of a view's current image with float64.

    Rounding of features is unavoidable. The allowed error therefore grows with the effect of rounding on the gradient
    (in 16 bits without a limit, and with that on the loss), and on a content term whose features have changed by little
    more than rounding. If they have changed by less, the content term may consist of rounding errors alone, and loss
    and gradient are compared without it.

    For nearest-neighbor losses, only the loss is compared, and the rounding of cosines near 1 is subtracted from its
    error. Matching another neighbor at the same distance is not an error.
    """
    index = job.job.views.covered[0]
    image = job.job.views.render(index, job.job.views.colors(index, job.sh_dc.detach()))
    content = job.job.view_targets.content(index)
    coverage = job.job.view_targets.coverage(index)[0] if job.job.view_targets.weighted else None
    # Not that of the job's start, because float16 may have overflowed.
    way = next(each for each in PRECISIONS if each.precision == job.job.network.precision)
    double = DecisionsOf(job.job.weights, job.job.network)
    given, weight = (image, content, coverage), job.job.settings.content_weight
    evaluated = _evaluated(job, *given, weight)
    actual, exact = double.beside(evaluated)
    uncertain = _rounding_of_content(job, exact, content, way)
    if uncertain > MOST_UNCERTAIN and _content_is_rounding(job, actual, exact, content, way):
        uncertain = 0.0
        evaluated = _evaluated(job, *given, 0.0)
        actual, exact = double.beside(evaluated)
    gradient, note = gradient_error(actual, exact), f"{double.flips} ReLU and pool decisions flipped"
    if way.precision == "float16" and not math.isfinite(gradient):
        job.job = in_bfloat16(job.job, job.step)  # as the next step would
        return reference_error(job)
    if not math.isfinite(gradient):
        return CaseResult(math.inf, REFERENCE_BOUND, f"the gradient is not finite; {note}")
    rounding = nearest_weight(job.job.settings.style_loss, job.job.loss.network.unit) * _ROUNDING_OF_COSINES
    error = max(abs(actual.loss - exact.loss) - rounding, 0.0) / max(abs(exact.loss), 1.0)
    matched = job.job.settings.style_loss != "sos"
    off, turned = rounding_error(exact, evaluated, job.job.network, job.job.weights, way)
    if not matched:
        error, uncertain = max(error, gradient), max(uncertain, turned)
    if way.in_16_bits:
        return CaseResult(error, max(REFERENCE_BOUND, off, uncertain), note)
    return CaseResult(error, max(REFERENCE_BOUND, min(uncertain, MOST_UNCERTAIN)), note)


def _feature_rounding(job: Stylizer, content: Tensor, way: Way) -> float:
    """Return the rounding error of a difference of content features."""
    features = job.job.network.forward(content, cache=False).features[CONTENT_LAYER].double()
    size = float(features.square().mean().sqrt()) if features.numel() else 0.0
    return 2.0**-way.bits * job.job.network.feature_unit * size


def _rounding_of_content(job: Stylizer, exact: SosResult, content: Tensor, way: Way) -> float:
    """Return the relative uncertainty of the content term and its gradient with rounded features.

    The magnitude of the feature differences d follows from E_c = lambda mean(d^2). If d has an error of delta, E_c has
    a relative error of 2 delta / d.
    """
    weight = job.job.settings.content_weight
    rounding = _feature_rounding(job, content, way) if weight else 0.0
    terms = [each["content"] for each in exact.terms.values() if each["content"] > 0]
    return max((2 * rounding * math.sqrt(weight / term) for term in terms), default=0.0)


def _content_is_rounding(job: Stylizer, actual: SosResult, exact: SosResult, content: Tensor, way: Way) -> bool:
    """Return whether rounding errors of the features explain the content term.

    If the feature differences d have an error of delta, the term is lambda mean((d + delta)^2).
    """
    most = 2 * job.job.settings.content_weight * _feature_rounding(job, content, way) ** 2
    return all(terms["content"] <= 2 * exact.terms[scale]["content"] + most for scale, terms in actual.terms.items())


def _evaluated(
    job: Stylizer, image: Tensor, content: Tensor, coverage: Tensor | None, content_weight: float
) -> Callable[[FeatureNetwork], SosResult]:
    """Return a function that evaluates the job's loss of an image with a network."""
    settings = job.job.settings

    def evaluated(network: FeatureNetwork) -> SosResult:
        loss = SosLoss(
            network,
            content_weight=content_weight,
            style_loss=settings.style_loss,
            coarsest=settings.coarsest_side,
            style_scale=settings.style_scale,
            scales=job.job.loss.weights,
        )
        return evaluate(loss, image, job.job.styles.own, content, coverage)

    return evaluated


MEASURE = "loss and gradient at the end, relative to float64; finite, bounded, repeated, not above the start"
_SAME = "loss at the end, relative to one rank; the same on all ranks, repeated"


def cases() -> list[Case]:
    """Return all cases of this group."""
    entries = []
    for name, situation in _SITUATIONS.items():
        suited = [way for way in WAYS if way is FLOAT32 or situation().suits(way)]
        entries += in_ways(name, "jobs", MEASURE, partial(_strained, situation), suited)
    for name in _ON_RANKS:
        entries += in_ways(name, "jobs", _SAME, partial(_together, name), [RANKS])
    for precision in PRECISIONS[:2]:
        entries += in_ways(f"{CORNER}, again elsewhere", "jobs", "results that differ", _elsewhere, [precision])
    entries += [
        Case(name, "jobs", "jobs that were not refused", partial(_refused, situation))
        for name, situation in _REFUSED.items()
    ]
    return [*entries, Case("chroma of colors from 1e-6 to 1e3", "jobs", "change of chroma, relative", _chroma)]


def _strained(situation: Callable[[], Situation], way: Way, full: bool) -> CaseResult:
    return strain(situation(), way)


@functools.cache
def _processes() -> ProcessPoolExecutor:
    """Return as many processes as there are ranks. A task waits for all other ranks, so each runs one of them."""
    context = multiprocessing.get_context("spawn")
    return ProcessPoolExecutor(RANKS.ranks, context, torch.set_num_threads, (1,))


def _on_rank(name: str, rank: int, size: int, address: str) -> tuple[Tensor, float]:
    """Run a situation on one of several ranks twice; return the colors of both [2, N, 3], and the loss at the end.

    Its views are large enough to be divided, unless it has its own.
    """
    situation = _SITUATIONS[name]()
    situation = replace(situation, cameras=situation.cameras or views(400, 300))
    with process_group(rank, size, address) as collectives:
        jobs = [make(situation, collectives=collectives) for _ in range(2)]
        for job in jobs:
            run(job)
        loss = mean_loss(jobs[0].evaluate(jobs[0].job.evaluation_views), jobs[0].job.loss.weights)
        return torch.stack([job.stylized() for job in jobs]), loss


def _together(name: str, way: Way, full: bool) -> CaseResult:
    """Compare the loss after a job on several ranks with that on one rank.

    Sums over ranks are rounded in another order, and Adam's first steps amplify this where a gradient is nearly 0. The
    loss may therefore differ as much as it may rise. On all ranks, colors must have the same bits.
    """
    alone, loss = _on_rank(name, 0, 1, "")
    address = free_address()
    ranks = [_processes().submit(_on_rank, name, rank, way.ranks, address) for rank in range(way.ranks)]
    results = [rank.result(timeout=300) for rank in ranks]
    same = all(torch.equal(colors, results[0][0][:1].expand_as(colors)) for colors, _ in results)
    error = max(abs(each - loss) for _, each in results) / max(abs(loss), NO_LOSS)
    note = f"loss {loss:.3g}; colors within {float((results[0][0] - alone).abs().max()):.2g}"
    return CaseResult(error if same else math.inf, RISE, note if same else "ranks or repeated runs differ")


def _digest(way: Way, threads: int) -> str:
    """Run the job of `CORNER`; return a digest of its colors."""
    before = torch.get_num_threads()
    torch.set_num_threads(threads)
    job = make(_SITUATIONS[CORNER](), way)
    run(job)
    torch.set_num_threads(before)
    return hashlib.sha256(job.stylized().numpy().tobytes()).hexdigest()


def _elsewhere(way: Way, full: bool) -> CaseResult:
    """Run one job three times at one thread and at two, twice of them in another process."""
    digests = {}
    for threads in (1, 2):
        others = [_processes().submit(_digest, way, threads) for _ in range(2)]
        digests[threads] = {_digest(way, threads), *(other.result(timeout=300) for other in others)}
    different = sum(len(each) - 1 for each in digests.values())
    same = "the same" if digests[1] == digests[2] else "others"
    return CaseResult(float(different), 0.0, f"{same} at one thread as at two")


def _refused(situation: Callable[[], Situation], full: bool) -> CaseResult:
    """Check that a job raises an `SgsstError` no later than in its first step."""
    try:
        make(situation()).run_step()
    except SgsstError as error:
        return CaseResult(0.0, 0.0, f"refused: {error}")
    return CaseResult(1.0, 0.0, "was not refused")


def _flat(red: float, green: float, blue: float, height: int = 12, width: int = 16) -> Tensor:
    return flat(red, green, blue, height, width)


def _gray(scene: Scene) -> Scene:
    return replace(scene, sh_dc=scene.sh_dc[:, :1].expand(-1, 3).clone())


def _shaped(scale: tuple[float, float, float], count: int = 40) -> Scene:
    scene = crowd(count)
    return replace(scene, scales=torch.tensor(scale).log().repeat(count, 1))


def _coincident() -> Scene:
    return replace(repeated(40, scale=1.0), sh_dc=torch.randn(40, 3, generator=torch.Generator().manual_seed(2)))


def _opacities(*logits: float) -> Scene:
    scene = crowd(60)
    return replace(scene, opacities=torch.tensor(logits).repeat(60)[:60])


def _with_harmonics(size: float, degree: int = 2) -> Scene:
    scene = crowd(degree=degree)
    return replace(scene, sh_rest=scene.sh_rest * size)


def _scan(**settings: object) -> Situation:
    """Return a job with a scene of one color that covers little of the view, and a style of the same color."""
    scene = colored(replace(crowd(20), scales=torch.full((20, 3), math.log(0.2))), 0.4, 0.4, 0.4)
    return Situation(scene, _flat(0.4, 0.4, 0.4), settings, falls=False)


def _job(
    scene: Callable[[], Scene] = crowd, style: Callable[[], Tensor] | None = None, **settings: object
) -> Situation:
    return Situation(scene(), texture(30, 26, 7) if style is None else style(), settings)


def _unlike(scene: Callable[[], Scene], style: Callable[[], Tensor], **settings: object) -> Situation:
    """Return a job like `_job` whose loss is not required to decrease.

    Scene and style match from the start, or can never match.
    """
    return replace(_job(scene, style, **settings), falls=False)


def _scaled(factor: float) -> Situation:
    scales = dict.fromkeys(("relu1_1", "relu2_1", "relu3_1", "relu4_1", "relu4_2", "relu5_1"), factor)
    return replace(_job(), network=partial(with_scales, scales=scales), in_16_bits=False)


def _black_views(scale: str) -> Situation:
    """Return a job on black views with the trained network.

    The factors of the feature scale "paper" are fixed to avoid computing them.
    """
    factors = dict.fromkeys(PUBLISHED, 20.0) if scale == "paper" else None
    job = _job(lambda: colored(crowd(), 0.0, 0.0, 0.0), feature_scale=scale, steps_coarse=0, steps_sos=1)

    def network(small: BackboneWeights) -> BackboneWeights:
        return with_scales(vgg16(), factors) if factors else vgg16()

    return replace(job, network=network, cameras=views()[:1])


def _pixels(situation: Situation, factor: float | None = None) -> Situation:
    """Return the same job with pixel colors as an additional feature layer; None for the default factor."""
    return replace(situation, network=partial(even_network, pixels=factor))


def _white_on_white() -> Situation:
    """Return a job with a nearly white scene (0.95), and a white style and background.

    The loss depends on small differences of large values, which amplifies rounding errors.
    """
    style = partial(_flat, 1, 1, 1, 64, 64)
    settings = {"background": (1.0, 1.0, 1.0), "content_weight": 0, "learning_rate": 0.01}
    job = _unlike(lambda: colored(crowd(), 0.95, 0.95, 0.95), style, **settings)
    return replace(_pixels(job), cameras=views(32, 32), in_16_bits=False)


def _tiny_views(width: int, height: int, **settings: Any) -> Situation:
    return replace(_job(**settings), cameras=views(width, height), falls=False)


def _in_a_corner() -> Situation:
    """Return a job of three Gaussians that cover a few pixels of its view, so that nearly all of it is left out."""
    scene = repeated(3, mean=(-2.4, -1.6, 4.0), scale=0.08)
    scene.means[:, 0] += torch.tensor([0.0, 0.15, 0.3])
    return replace(_job(lambda: scene), cameras=views(400, 300))


def _small_memory() -> Situation:
    """Return a job with the trained network, whose views are divided into partition tiles."""
    return replace(_job(memory_limit=16 << 20), cameras=views(112, 88), network=lambda small: vgg16())


CORNER = "three Gaussians in a corner of 400 x 300"
_SITUATIONS: dict[str, Callable[[], Situation]] = {
    "style of one pixel, 1 x 1, in a job": lambda: _job(style=lambda: _flat(0.9, 0.5, 0.1, 1, 1)),
    "style of one row": lambda: _job(style=lambda: texture(1, 60, 3)),
    "style of one column": lambda: _job(style=lambda: texture(60, 1, 3)),
    "flat style: black": lambda: _job(style=lambda: _flat(0, 0, 0)),
    "flat style: white": lambda: _job(style=lambda: _flat(1, 1, 1)),
    "flat style: one color": lambda: _job(style=lambda: _flat(0.9, 0.3, 0.1)),
    "strokes larger than the view": lambda: _job(style_scale=4),
    "strokes larger than a view of 3 x 2": lambda: _tiny_views(3, 2, style_scale=4),
    "strokes smaller than a pixel": lambda: _job(style=lambda: texture(3, 3, 1), style_scale=0.25),
    "thin style turned by 33 degrees": lambda: _job(style=lambda: texture(2, 200, 1), style_rotation=33),
    "thin style turned by -271 degrees": lambda: _job(style=lambda: texture(300, 3, 1), style_rotation=-271),
    "style of one pixel turned by 45 degrees": lambda: _job(
        style=lambda: _flat(0.1, 0.2, 0.9, 1, 1), style_rotation=45
    ),
    "colors matched to a scene of one color": lambda: _job(
        lambda: colored(crowd(), 0.2, 0.5, 0.7), preserve_colors="match"
    ),
    "colors matched to a gray scene": lambda: _job(lambda: _gray(crowd()), preserve_colors="match"),
    "colors of a flat style matched": lambda: _job(style=lambda: _flat(1, 1, 1), preserve_colors="match"),
    "luminance of a scene of one color": lambda: _job(
        lambda: colored(crowd(), 0.2, 0.5, 0.7), preserve_colors="luminance"
    ),
    "luminance of a gray scene": lambda: _job(lambda: _gray(crowd()), preserve_colors="luminance"),
    "luminance of a black scene": lambda: _job(lambda: colored(crowd(), 0, 0, 0), preserve_colors="luminance"),
    "luminance of a flat style": lambda: _job(style=lambda: _flat(0, 0, 0), preserve_colors="luminance"),
    "one Gaussian in a job": lambda: _job(lambda: repeated(1, scale=1.0)),
    "all Gaussians at one place": lambda: _job(_coincident),
    "needles": lambda: _job(lambda: _shaped((3.0, 1e-5, 1e-5))),
    "points": lambda: _job(lambda: _shaped((1e-8, 1e-8, 1e-8))),
    "Gaussians larger than the world": lambda: _job(lambda: _shaped((1e5, 1e5, 1e5))),
    "opacity 0 and 1": lambda: _job(lambda: _opacities(-80.0, 80.0, 0.0)),
    "opacity 1 alone": lambda: _job(lambda: _opacities(90.0)),
    "hardly any opacity": lambda: _job(lambda: _opacities(-5.4)),
    "background in the object's color": lambda: _scan(training_background="palette"),
    "random background colors, style of one color": lambda: _scan(training_background="random"),
    "scan of one color, warm start": lambda: _scan(warm_start=True, training_background="background"),
    "scan of one color, warm start in luminance": lambda: _scan(
        warm_start=True, training_background="palette", preserve_colors="luminance"
    ),
    "nearest neighbors in a flat style": lambda: _unlike(crowd, lambda: _flat(0.5, 0.5, 0.5), style_loss="nnfm"),
    "nearest neighbors of a black scene": lambda: _unlike(
        lambda: colored(crowd(), 0, 0, 0), lambda: _flat(0, 0, 0), style_loss="nnfm"
    ),
    "both losses, a flat style": lambda: _unlike(crowd, lambda: _flat(1, 1, 1), style_loss="mixed"),
    "content weight 0": lambda: _job(content_weight=0),
    "content weight 1e12 in a job": lambda: _unlike(crowd, lambda: texture(30, 26, 7), content_weight=1e12),
    "content weight 1e12, and hardly a change": lambda: _unlike(
        crowd, lambda: texture(30, 26, 7), content_weight=1e12, learning_rate=1e-5
    ),
    "features 1e4 times as large": lambda: _scaled(1e4),
    "features 1e4 times as small": lambda: _scaled(1e-4),
    "black views, features at the paper's scale": lambda: _black_views("paper"),
    "black views, features at one scale": lambda: _black_views("even"),
    "harmonics of 1e4 that fade by half": lambda: _unlike(
        lambda: _with_harmonics(1e4), lambda: texture(30, 26, 7), sh_attenuation=0.5
    ),
    "harmonics of 1e30 that fade out": lambda: _job(lambda: _with_harmonics(1e30), sh_attenuation=1.0),
    "pixels of one color, style of the same": lambda: _pixels(_scan()),
    "pixels of one color, style of another": lambda: _pixels(
        _unlike(lambda: colored(crowd(), 0.4, 0.4, 0.4), lambda: _flat(0.9, 0.3, 0.1))
    ),
    "pixels of one color, style of many": lambda: _pixels(_job(lambda: colored(crowd(), 0.2, 0.5, 0.7))),
    "pixels in luminance, a gray scene": lambda: _pixels(_job(lambda: _gray(crowd()), preserve_colors="luminance")),
    "pixels, a style of one pixel": lambda: _pixels(_job(style=lambda: _flat(0.9, 0.5, 0.1, 1, 1))),
    "pixels, views of 3 x 2": lambda: _pixels(_tiny_views(3, 2)),
    "pixels 1e6 times as large": lambda: _pixels(_job(), 1e6),
    "pixels, harmonics of 100": lambda: _pixels(_unlike(lambda: _with_harmonics(100.0), lambda: texture(30, 26, 7))),
    "white scene before white, flat style: white": _white_on_white,
    "scales weighted 1e12 to 1e-12": lambda: _job(scales=(1e12, 1e-12)),
    "the coarsest scale of a tiny view alone": lambda: _job(scales=(0.0, 1.0)),
    CORNER: _in_a_corner,
    "a partition of 16 MB": _small_memory,
}
#: Jobs that are also run on several ranks: some have fewer pixels or Gaussians than ranks, others statistics of
#: extreme sizes.
_ON_RANKS = (
    "style of one row",
    "strokes larger than a view of 3 x 2",
    "one Gaussian in a job",
    "opacity 0 and 1",
    "harmonics of 1e30 that fade out",
    "pixels 1e6 times as large",
    "scales weighted 1e12 to 1e-12",
    CORNER,
)

_REFUSED: dict[str, Callable[[], Situation]] = {
    "nearest neighbors in a style without a cell": lambda: _job(style=lambda: texture(3, 3, 1), style_loss="nnfm"),
    "both losses, a style without a cell": lambda: _job(style=lambda: texture(1, 60, 1), style_loss="mixed"),
    "a scale that no view has": lambda: _job(scales=(0.0, 0.0, 1.0)),
}


def _chroma(full: bool) -> CaseResult:
    """Check that stylizing luminance alone preserves the chroma of colors of very different magnitudes.

    The error bound is one float32 rounding of the larger color, before or after the job.
    """
    scene = crowd(60)
    sizes = torch.logspace(-6, 3, 60)[:, None]
    scene = replace(scene, sh_dc=scene.sh_dc * sizes)
    job = make(Situation(scene, texture(30, 26, 7), {"preserve_colors": "luminance", "steps_sos": 20 if full else 4}))
    while job.step < job.job.total_steps:
        job.run_step()
    stylized = job.stylized().double()
    change = stylized - scene.sh_dc.double()
    size = torch.maximum(stylized.abs(), scene.sh_dc.double().abs()).amax(1, keepdim=True)
    error = float(((change - change.mean(1, keepdim=True)).abs() / size).max())
    if not bool(torch.isfinite(stylized).all()):
        error = math.inf
    return CaseResult(error, 2**-23, f"luminance moved by up to {float(luminance(change).abs().max()):.2g}")
