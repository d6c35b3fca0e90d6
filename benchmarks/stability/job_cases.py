"""Hard cases of whole jobs: degenerate and extreme styles, scenes and settings.

Jobs are small. Each is checked for the same properties. Colors are finite, no step
exceeds Adam's maximum, a repeated run is bit-identical, the loss does not rise, and loss and gradient of the final
image match float64.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import torch
from torch import Tensor

from benchmarks.stability.case import (
    Case,
    CaseResult,
    DecisionsOf,
    camera,
    evaluate,
    flat,
    gradient_error,
    ordinary,
    repeated,
    texture,
    vgg16,
)
from sgsst_core.constants import COLOR_OFFSET, SH_C0
from sgsst_core.errors import SgsstError
from sgsst_core.features.network_weights import BLOCKS, CAFFE_MEAN, BackboneWeights
from sgsst_core.features.vgg import CONTENT_LAYER, PIXELS, Activations, FeatureNetwork
from sgsst_core.loss.feature_scale import PUBLISHED, even_scales, with_scales
from sgsst_core.loss.sos import SosLoss, SosResult
from sgsst_core.loss.terms import nearest_weight
from sgsst_core.scene.camera import Camera
from sgsst_core.scene.colors import luminance
from sgsst_core.scene.gaussians import Scene
from sgsst_core.scene.stored_harmonics import held
from sgsst_core.settings import make_settings
from sgsst_core.stylizing.loop import run
from sgsst_core.stylizing.steps import mean_loss
from sgsst_core.stylizing.stylizer import Stylizer, constrained

#: Relative error bound of loss and pixel gradient of the last image against float64.
REFERENCE_BOUND = 1e-4
#: Adam's longest step in units of the learning rate. It occurs if the gradient was 0 in all earlier steps.
LONGEST_STEP = 0.1 / math.sqrt(0.001) + 0.1
#: Fraction by which the final loss may exceed the initial one.
RISE = 1e-3
#: Losses up to this value count as rounding errors if scene and style match from the start.
NO_LOSS = 1e-3
#: Upper limit of a gradient's allowed error, regardless of rounding errors in the content term.
_MOST_UNCERTAIN = 0.5
#: Rounding error of the cosine of two float32 vectors of length 1.
_ROUNDING_OF_COSINES = 2**-22
STEPS, LEARNING_RATE = 4, 0.02
_CHANNELS = 8
#: Rounding error of float32 features, relative to their size.
_FEATURE_ROUNDING = 2**-20
#: Factor for rounding a float64 number x from 53 bits to 20 bits, by adding and subtracting _ROUNDING * x.
_ROUNDING = 2.0**33
#: Safety factor for the gradient's change due to rounded features. The change in float32 is up to 8 times as large,
#: because float32 also rounds sums, and rounds sums of equal numbers the same way each time.
_SAFETY = 8.0


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
        weights: Weights of the network; None for `small_network`.
    """

    scene: Scene
    style: Tensor
    settings: Mapping[str, Any] = field(default_factory=dict)
    cameras: tuple[Camera, ...] = ()
    falls: bool = True
    weights: BackboneWeights | None = None


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


@functools.cache
def small_network() -> BackboneWeights:
    """Return VGG16's layers with 8 channels each and fixed random weights (He et al. 2015)."""
    generator = torch.Generator().manual_seed(8)
    layers, channels = {}, 3
    for block, count in enumerate(BLOCKS["vgg16"], start=1):
        for index in range(1, count + 1):
            weight = torch.randn(_CHANNELS, channels, 3, 3, generator=generator) * math.sqrt(2 / (9 * channels))
            layers[f"conv{block}_{index}"] = weight, torch.randn(_CHANNELS, generator=generator)
            channels = _CHANNELS
    scale, shift = torch.full((3,), 255.0), -torch.tensor(CAFFE_MEAN)
    return BackboneWeights("vgg16", "random", "0" * 64, layers, scale, shift)


@functools.cache
def even_network() -> BackboneWeights:
    """Return `small_network` at the feature scale "even"."""
    return with_scales(small_network(), even_scales(small_network()))


def make(situation: Situation) -> Stylizer:
    """Create the stylizer of a situation, before its first step."""
    values: dict[str, Any] = {
        "steps_coarse": 1,
        "steps_sos": STEPS,
        "scale_sampling": 1,
        "learning_rate": LEARNING_RATE,
        "early_stop": False,
        "coarsest_side": 16,
        "memory_limit": 1 << 28,
    }
    settings = make_settings(**(values | dict(situation.settings)))
    weights = situation.weights or small_network()
    cameras = situation.cameras or views()
    return Stylizer.planned(situation.scene, cameras, situation.style, settings, weights=weights)


def strain(situation: Situation) -> CaseResult:
    """Run a situation twice and check the properties that the module lists.

    Returns the final error against float64, or infinity if another property is violated.

    Raises:
        SgsstError: If the situation is refused.
    """
    jobs = [make(situation) for _ in range(2)]
    start = jobs[0].sh_dc.detach().clone()
    before = mean_loss(jobs[0].evaluate(jobs[0].job.evaluation_views), jobs[0].job.loss.weights)
    for job in jobs:
        run(job)
    job = jobs[0]
    after = mean_loss(job.evaluate(job.job.evaluation_views), job.job.loss.weights)
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
    error, bound, flips = reference_error(job)
    note = "; ".join(broken) or f"loss {before:.3g} to {after:.3g}; {flips} ReLU and pool decisions flipped"
    return CaseResult(math.inf if broken else error, bound, note)


def _moved(job: Stylizer, start: Tensor) -> float:
    """Return the largest change of a coefficient, ignoring the clamping of initial colors to their bounds."""
    sh_dc = job.sh_dc.detach()
    chroma_of = start if job.job.settings.preserve_colors == "luminance" else None
    subspace = job.job.styles.color_subspace(job.job.settings)
    within = constrained(start, chroma_of, subspace, bounded=job.job.settings.bounded)
    return float(torch.minimum((sh_dc - start).abs(), (sh_dc - within).abs()).max())


def reference_error(job: Stylizer) -> tuple[float, float, int]:
    """Compare loss and pixel gradient of a view's current image with float64.

    Rounding of features is unavoidable in float32. The allowed error therefore grows with the effect of rounding on the
    gradient, and on a content term whose features have changed by little more than rounding. If they have changed by
    less, the content term may consist of rounding errors alone, and loss and gradient are compared without it.

    For nearest-neighbor losses, only the loss is compared, and the rounding of cosines near 1 is subtracted from its
    error. Matching another neighbor at the same distance is not an error.

    Returns:
        Relative error, allowed error, and number of flipped ReLU and pool decisions.
    """
    index = job.job.views.covered[0]
    image = job.job.views.render(index, job.job.views.colors(index, job.sh_dc.detach()))
    content = job.job.view_targets.content(index)
    coverage = job.job.view_targets.coverage(index)[0] if job.job.view_targets.weighted else None
    double = DecisionsOf(job.job.weights, job.job.network)
    given, weight = (image, content, coverage), job.job.settings.content_weight
    actual, exact = _evaluate_both(job, double, *given, weight)
    uncertain = _rounding_of_content(job, exact, content)
    if uncertain > _MOST_UNCERTAIN and _content_is_rounding(job, actual, exact, content):
        uncertain, weight = 0.0, 0.0
        actual, exact = _evaluate_both(job, double, *given, weight)
    gradient = gradient_error(actual, exact)
    if not math.isfinite(gradient):
        return math.inf, REFERENCE_BOUND, double.flips
    rounding = nearest_weight(job.job.settings.style_loss, job.job.loss.network.unit) * _ROUNDING_OF_COSINES
    error = max(abs(actual.loss - exact.loss) - rounding, 0.0) / max(abs(exact.loss), 1.0)
    if job.job.settings.style_loss == "sos":
        error = max(error, gradient)
        uncertain = max(uncertain, _rounding_of_features(job, exact, given, weight))
    return error, max(REFERENCE_BOUND, min(uncertain, _MOST_UNCERTAIN)), double.flips


def _rounding_of_features(
    job: Stylizer, exact: SosResult, given: tuple[Tensor, Tensor, Tensor | None], content_weight: float
) -> float:
    """Return the relative change of the gradient if all features are rounded slightly more than in float32.

    The change is large if the style loss is a difference of nearly equal statistics, or if a standard deviation is
    hardly larger than the rounding of the features.
    """
    rounded = _Rounded(job.job.weights, job.job.network)
    _, actual = _evaluate_both(job, rounded, *given, content_weight)
    return _SAFETY * gradient_error(actual, exact)


class _Rounded(DecisionsOf):
    """Float64 network whose features are rounded after every layer, slightly more than in float32.

    Images are rounded too, because the pixels of coarser scales are averages.
    """

    def forward(self, rgb: Tensor, *, cache: bool = True, until: str | None = None) -> Activations:
        return super().forward(rgb.float(), cache=cache, until=until)

    def _convolve(self, x: Tensor, step: Any) -> Tensor:
        features = super()._convolve(x, step)
        large = features * _ROUNDING
        return (features + large) - large


def _feature_rounding(job: Stylizer, content: Tensor) -> float:
    """Return the rounding error of a difference of float32 content features."""
    features = job.job.network.forward(content, cache=False).features[CONTENT_LAYER]
    return _FEATURE_ROUNDING * float(features.square().mean().sqrt()) if features.numel() else 0.0


def _rounding_of_content(job: Stylizer, exact: SosResult, content: Tensor) -> float:
    """Return the relative uncertainty of the content term and its gradient with float32 features.

    The magnitude of the feature differences d follows from E_c = lambda mean(d^2). If d has an error of delta, E_c has
    a relative error of 2 delta / d.
    """
    weight = job.job.settings.content_weight
    rounding = _feature_rounding(job, content) if weight else 0.0
    terms = [each["content"] for each in exact.terms.values() if each["content"] > 0]
    return max((2 * rounding * math.sqrt(weight / term) for term in terms), default=0.0)


def _content_is_rounding(job: Stylizer, actual: SosResult, exact: SosResult, content: Tensor) -> bool:
    """Return whether rounding errors of the features explain the content term.

    If the feature differences d have an error of delta, the term is lambda mean((d + delta)^2).
    """
    most = 2 * job.job.settings.content_weight * _feature_rounding(job, content) ** 2
    return all(terms["content"] <= 2 * exact.terms[scale]["content"] + most for scale, terms in actual.terms.items())


def _evaluate_both(
    job: Stylizer,
    double: DecisionsOf,
    image: Tensor,
    content: Tensor,
    coverage: Tensor | None,
    content_weight: float,
) -> tuple[SosResult, SosResult]:
    """Evaluate the loss with the job's network, and in float64 with the same ReLU and max-pool decisions."""
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
        return evaluate(loss, image, job.job.style, content, coverage)

    return double.beside(evaluated)


_MEASURE = "loss and gradient at the end, relative to float64; finite, bounded, repeated, not above the start"


def cases() -> list[Case]:
    """Return all cases of this group."""
    entries = [Case(name, "jobs", _MEASURE, partial(_strained, situation)) for name, situation in _SITUATIONS.items()]
    entries += [
        Case(name, "jobs", "jobs that were not refused", partial(_refused, situation))
        for name, situation in _REFUSED.items()
    ]
    return [*entries, Case("chroma of colors from 1e-6 to 1e3", "jobs", "change of chroma, relative", _chroma)]


def _strained(situation: Callable[[], Situation], full: bool) -> CaseResult:
    return strain(situation())


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
    return replace(scene, sh_rest=held(scene.sh_rest) * size)


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
    return replace(_job(), weights=with_scales(small_network(), scales))


def _black_views(scale: str) -> Situation:
    """Return a job on black views with the trained network.

    The factors of the feature scale "paper" are fixed to avoid computing them.
    """
    weights = vgg16()
    if scale == "paper":
        weights = with_scales(weights, dict.fromkeys(PUBLISHED, 20.0))
    job = _job(lambda: colored(crowd(), 0.0, 0.0, 0.0), feature_scale=scale, steps_coarse=0, steps_sos=1)
    return replace(job, weights=weights, cameras=views()[:1])


def _pixels(situation: Situation, factor: float | None = None) -> Situation:
    """Return the same job with pixel colors as an additional feature layer; None for the default factor."""
    weights = even_network()
    scales = weights.scales if factor is None else weights.scales | {PIXELS: factor}
    return replace(situation, weights=replace(weights, scales=scales))


def _white_on_white() -> Situation:
    """Return a job with a nearly white scene (0.95), and a white style and background.

    The loss depends on small differences of large values, which amplifies rounding errors.
    """
    style = partial(_flat, 1, 1, 1, 64, 64)
    settings = {"background": (1.0, 1.0, 1.0), "content_weight": 0, "learning_rate": 0.01}
    job = _unlike(lambda: colored(crowd(), 0.95, 0.95, 0.95), style, **settings)
    return replace(_pixels(job), cameras=views(32, 32))


def _tiny_views(width: int, height: int, **settings: Any) -> Situation:
    return replace(_job(**settings), cameras=views(width, height), falls=False)


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
}

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
