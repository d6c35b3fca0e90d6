"""Definition of a hard case, and the scenes and comparisons that cases share."""

from __future__ import annotations

import itertools
import math
import resource
import sys
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import cache, partial
from typing import Any, Literal

import torch
import torch.nn.functional as F
from torch import Tensor

from benchmarks.stability.sos_reference import sos_reference
from sgsst_core.constants import NEAR
from sgsst_core.features.layers import winograd_pays_off
from sgsst_core.features.network_weights import BLOCKS, CAFFE_MEAN, BackboneWeights, load_network_weights
from sgsst_core.features.vgg import Activations, FeatureNetwork
from sgsst_core.loss.sos import SosLoss, SosResult
from sgsst_core.parallel import ALONE, Collectives
from sgsst_core.planning.plan import DTYPES
from sgsst_core.rasterizer import make_rasterizer
from sgsst_core.scene.camera import Camera
from sgsst_core.scene.colors import resize_area, style_size
from sgsst_core.scene.gaussians import TENSORS, Scene
from sgsst_core.settings import PlannedPrecision, Settings
from sgsst_core.style import Style
from sgsst_core.stylizing.job import JobInputs, plan_job
from sgsst_core.stylizing.stylizer import Stylizer
from tests.sgsst_core.rasterizer.splat_reference import ReferenceRasterizer

Group = Literal[
    "Gaussians", "views", "style and content", "stiff optimization", "precision", "jobs", "files and orbits"
]

#: Error bound of float32 images and coverage against float64, relative to the brightest color.
IMAGE_BOUND = 1e-4
#: Distance to a cutoff within which float32 and float64 may decide differently. Such a discontinuity is not an error.
CLOSE_TO_CUTOFF = 2e-5
#: Largest jump at a cutoff, relative to the color: the contribution of a Gaussian just above ALPHA_MIN, or of one that
#: reduces a transmittance of up to 1e-2 to its cutoff.
LARGEST_STEP = 1e-2
#: Relative error bound of float32 loss and gradient against float64, with the same ReLU and max-pool decisions.
LOSS_BOUND = 1e-5
#: Safety factor for the gradient's change due to rounded features. The change in float32 is up to 8 times as large,
#: because float32 also rounds sums, and rounds sums of equal numbers the same way each time.
SAFETY = 8.0
#: Upper limit of a gradient's allowed error, regardless of rounding errors: its direction remains about right.
MOST_UNCERTAIN = 0.5


@dataclass(frozen=True)
class Way:
    """Way to evaluate a loss or to run a job, in which a case is measured.

    Attributes:
        name: Name, as in tables.
        precision: Precision of the feature network. On a CPU without matrix units, 16 bits are emulated.
        bits: Significant bits of features that are rounded slightly more than in this precision.
        channels: Channels of each layer of random networks.
        settings: Settings of jobs, which override those of a case.
        ranks: Number of ranks of jobs.
    """

    name: str
    precision: PlannedPrecision = "float32"
    bits: int = 20
    channels: int = 8
    settings: Mapping[str, Any] = field(default_factory=dict)
    ranks: int = 1

    @property
    def in_16_bits(self) -> bool:
        """Whether features have 16 bits."""
        return DTYPES[self.precision] != torch.float32

    def network(self, weights: BackboneWeights) -> FeatureNetwork:
        """Return a feature network in this precision."""
        return FeatureNetwork(weights, dtype=DTYPES[self.precision], winograd=self.precision == "winograd")

    def suits(self, height: int, width: int) -> bool:
        """Return whether an image is computed in this way: Winograd's algorithm leaves small ones to float32."""
        return self.precision != "winograd" or winograd_pays_off(height, width)


FLOAT32 = Way("float32")
BFLOAT16 = Way("bfloat16", "bfloat16", bits=7)
#: Ways to evaluate a loss. Winograd's algorithm, which needs 64 channels, rounds up to four times as far as float32;
#: the same bounds are wide enough. Formats of 16 bits have one significant bit more than stated, because not only
#: features are rounded to them, but weights and gradients too.
PRECISIONS = (
    FLOAT32,
    Way("Winograd", "winograd", bits=18, channels=64),
    BFLOAT16,
    Way("float16", "float16", bits=10),
)


def in_ways(
    name: str,
    group: Group,
    measure: str,
    run: Callable[[Way, bool], CaseResult],
    ways: Sequence[Way] = PRECISIONS,
) -> list[Case]:
    """Return a case for each way."""
    return [Case(name, group, measure, partial(run, way), way.name) for way in ways]


def planned(
    scene: Scene,
    cameras: Sequence[Camera],
    style: Tensor,
    settings: Settings,
    weights: BackboneWeights,
    way: Way = FLOAT32,
    collectives: Collectives = ALONE,
) -> Stylizer:
    """Create the stylizer of a job in a precision, even if the plan would refuse it on this machine."""
    own = settings.model_copy(update={"precision": "float32"})
    first = Stylizer.planned(scene, cameras, style, own, weights=weights, collectives=collectives)
    if way.precision == "float32":
        return first
    plan = replace(first.job.plan, precision=way.precision)
    inputs = JobInputs(scene, cameras, Style.given(style), own, weights)
    return Stylizer(plan_job(inputs, plan=plan, collectives=collectives))


@dataclass(frozen=True)
class CaseResult:
    """Result of a case.

    Attributes:
        error: Measured error against the float64 reference; NaN or infinite if a result is not finite.
        bound: Maximum allowed error.
        note: Other observations, human-readable.
    """

    error: float
    bound: float
    note: str = ""

    @property
    def passed(self) -> bool:
        """Whether the error is finite and within its bound."""
        return math.isfinite(self.error) and self.error <= self.bound


@dataclass(frozen=True)
class Case:
    """One hard case.

    Attributes:
        name: Description of what is extreme.
        group: Part of the method under stress.
        measure: Description of the measured error.
        run: Function that runs the measurement: at full size if its argument is true, else in a version that takes a
            few seconds.
        way: Name of the way that it is measured in.
    """

    name: str
    group: Group
    measure: str
    run: Callable[[bool], CaseResult]
    way: str = "float32"


@dataclass(frozen=True)
class Measurement:
    """Result of a case, its wall-clock seconds, and the growth of the process's peak memory in bytes."""

    result: CaseResult
    seconds: float
    peak_growth: int


def measure(case: Case, *, full: bool = False) -> Measurement:
    """Run a case: at full size if `full` is true, else in a version that takes at most a few seconds.

    A case that raises an error is not passed, and leaves others to be measured.
    """
    peak, started = _peak_memory(), time.perf_counter()
    try:
        result = case.run(full)
    except Exception as error:
        result = CaseResult(math.inf, 0.0, f"{type(error).__name__}: {error}")
    return Measurement(result, time.perf_counter() - started, _peak_memory() - peak)


def _peak_memory() -> int:
    """Return the peak memory in bytes; `ru_maxrss` is in KiB on Linux and in bytes on macOS."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * (1 if sys.platform == "darwin" else 1024)


def camera(width: int = 37, height: int = 29, *, focal: float = 30.0) -> Camera:
    """Return a camera at the origin that looks along +z, with its principal point off center."""
    pose = torch.eye(4, dtype=torch.float64)
    return Camera("hard case", width, height, focal, focal * 1.1, width / 2 + 1.3, height / 2 - 0.7, pose)


def ordinary(count: int = 80, *, seed: int = 0, degree: int = 0) -> Scene:
    """Return Gaussians like those of trained scenes, in front of `camera()`."""
    generator = torch.Generator().manual_seed(seed)

    def normal(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=generator)

    return Scene(
        means=normal(count, 3) * torch.tensor([1.2, 0.9, 1.0]) + torch.tensor([0.0, 0.0, 5.0]),
        quats=normal(count, 4),
        scales=-2.0 + 0.7 * normal(count, 3),
        opacities=2.0 * normal(count),
        sh_dc=normal(count, 3),
        sh_rest=0.3 * normal(count, (degree + 1) ** 2 - 1, 3),
    )


def among_ordinary(extreme: Scene, *, count: int = 80) -> Scene:
    """Return the extreme Gaussians followed by ordinary Gaussians, whose pixels must stay correct."""
    rest = ordinary(count, degree=extreme.sh_degree)
    return Scene(*(torch.cat([getattr(extreme, name), getattr(rest, name)]) for name in TENSORS))


def repeated(
    count: int,
    *,
    mean: tuple[float, float, float] = (0.0, 0.0, 4.0),
    scale: float = 0.1,
    logit: float = 2.0,
) -> Scene:
    """Return `count` copies of one round Gaussian, as a base for extreme cases; `scale` is in world units."""
    return Scene(
        means=torch.tensor(mean).repeat(count, 1),
        quats=torch.tensor([1.0, 0.0, 0.0, 0.0]).repeat(count, 1),
        scales=torch.full((count, 3), math.log(scale)),
        opacities=torch.full((count,), logit),
        sh_dc=torch.zeros(count, 3),
        sh_rest=torch.zeros(count, 0, 3),
    )


def fast_rasterizers() -> tuple[str, ...]:
    """Return the rasterizers to compare with `reference`: those for CPUs, and the GPU's if there is a GPU."""
    return ("cpu", "cached", "triton") if torch.cuda.is_available() else ("cpu",)


def compare_rasterizers(
    scene: Scene,
    view: Camera,
    *,
    near: float = NEAR,
    colors: Tensor | None = None,
    expected_scene: Scene | None = None,
    rows: Tensor | None = None,
) -> CaseResult:
    """Return the largest error of `fast_rasterizers` against the float64 reference.

    Errors of images and coverage are relative to the brightest color. At pixels very close to a cutoff, a jump of up to
    LARGEST_STEP is allowed and counted. Errors of color gradients are relative to the largest gradient.

    Args:
        scene: Scene to render.
        view: Camera to render with.
        near: Distance of the near plane in world units.
        colors: Colors [N, 3]; None for random colors in 0 to 2.
        expected_scene: Scene that the reference renders: only the rows `rows` of `scene`, whose other rows must
            contribute nothing. None for `scene`.
        rows: Mask [N] bool of the rows in `expected_scene`; None for all.
    """
    generator = torch.Generator().manual_seed(5)
    if colors is None:
        colors = 2 * torch.rand(len(scene), 3, generator=generator)
    pixels = torch.randn(view.height, view.width, 3, generator=generator)
    rows = torch.ones(len(scene), dtype=torch.bool) if rows is None else rows
    reference = ReferenceRasterizer(expected_scene or scene, near=near)
    band = reference.near_cutoff(view, CLOSE_TO_CUTOFF)
    brightest = max(float(colors.abs().max()) if len(colors) else 0.0, 1.0)
    image, coverage = reference.render(colors[rows], view), reference.coverage(view)
    pixels[band] = 0
    gradient = torch.zeros(len(scene), 3, dtype=torch.float64)
    gradient[rows] = reference.color_gradient(pixels, view)
    error, flipped = 0.0, 0
    for name in fast_rasterizers():
        fast = make_rasterizer(name, scene, near=near)
        shown = torch.cat([fast.render(colors, view) / brightest, fast.coverage(view)[..., None]], dim=-1).cpu()
        off = (shown.double() - torch.cat([image / brightest, coverage[..., None]], dim=-1)).abs().amax(-1)
        # A jump that a cutoff explains is not an error; a larger one is.
        explained = band & (off > IMAGE_BOUND) & (off <= LARGEST_STEP)
        flipped += int(explained.sum())
        error = _worst(error, off[~explained])
        largest = max(float(gradient.abs().max()) if len(scene) else 0.0, 1e-30)
        error = _worst(error, (fast.color_gradient(pixels, view).cpu().double() - gradient).abs() / largest)
    note = f"{flipped} pixels differ by one cut-off" if flipped else ""
    return CaseResult(error, IMAGE_BOUND, note)


def _worst(error: float, values: Tensor) -> float:
    if not bool(torch.isfinite(values).all()):
        return math.inf
    return max(error, float(values.max()) if values.numel() else 0.0)


@cache
def vgg16() -> BackboneWeights:
    """Load VGG16, the smaller network, for cases that need trained features.

    Raises:
        WeightsError: If it is not installed.
    """
    return load_network_weights("vgg16")


class DecisionsOf(FeatureNetwork):
    """Float64 network that back-propagates through the ReLU masks and max-pool positions of another network.

    Maxima can be tied even in exact arithmetic, for example in a constant image. The gradient may then go to either
    pixel: both are valid subgradients, so higher precision does not make two networks agree.

    These decisions are recorded from the other network's forward passes in a `listening` block, and used in the same
    order. They are not recomputed from the same pixels: coarser scales are averaged in float64 here but in float32
    there, which can change the position of a nearly tied maximum.
    """

    def __init__(self, weights: BackboneWeights, other: FeatureNetwork) -> None:
        super().__init__(weights, other.layers, torch.float64)
        self.other = other
        self.flips = 0
        self._recorded: deque[list[Tensor]] = deque()

    @contextmanager
    def listening(self) -> Iterator[None]:
        """Record the other network's forward passes in this block; later passes of this network use their decisions."""
        forward = self.other.forward

        def recorded(rgb: Tensor, *, cache: bool = True, until: str | None = None) -> Activations:
            activations = forward(rgb, cache=cache, until=until)
            self._recorded.append(list(activations.outputs))
            return activations

        self.other.forward = recorded  # type: ignore[method-assign]
        yield
        del self.other.forward

    def beside(self, evaluate: Callable[[FeatureNetwork], SosResult]) -> tuple[SosResult, SosResult]:
        """Evaluate with the other network, then with this one and the same decisions; return both results."""
        with self.listening():
            actual = evaluate(self.other)
        return actual, evaluate(self)

    def rounding_of(self, layer: str) -> float:
        """Return the rounding error of the other network.

        Both networks then agree on which channels are constant up to rounding, and give them no gradient.
        """
        return self.other.rounding_of(layer)

    def forward(self, rgb: Tensor, *, cache: bool = True, until: str | None = None) -> Activations:
        """Run `FeatureNetwork.forward`; store the decisions of the next recorded pass for `backward`."""
        own = super().forward(rgb, cache=cache, until=until)
        theirs = Activations({}, self._recorded.popleft())
        for mine, other in zip(decisions(own), decisions(theirs), strict=True):
            self.flips += int((mine != other).sum())
        own.outputs = [output.double() for output in theirs.outputs]
        return own


def decisions(activations: Activations) -> list[Tensor]:
    """Return the discrete decisions of each step of a network: ReLU masks, and positions of pooling maxima."""
    pairs = itertools.pairwise([*activations.outputs[:1], *activations.outputs])
    return [
        output > 0 if output.numel() else F.max_pool2d(source, 2, return_indices=True)[1] for source, output in pairs
    ]


class RoundedNetwork(DecisionsOf):
    """Float64 network whose features are rounded to some bits after every layer.

    Images are rounded to float32 too, because the pixels of coarser scales are averages.
    """

    def __init__(self, weights: BackboneWeights, other: FeatureNetwork, bits: int) -> None:
        super().__init__(weights, other)
        #: Factor for rounding a number x of 53 bits, by adding and subtracting its product.
        self._factor = 2.0 ** (53 - bits)

    def forward(self, rgb: Tensor, *, cache: bool = True, until: str | None = None) -> Activations:
        return super().forward(rgb.float(), cache=cache, until=until)

    def _convolve(self, x: Tensor, step: Any) -> Tensor:
        features = super()._convolve(x, step)
        large = features * self._factor
        return (features + large) - large


def rounding_error(
    exact: SosResult, evaluate: Callable[[FeatureNetwork], SosResult], network: FeatureNetwork, weights: Any, way: Way
) -> tuple[float, float]:
    """Return `SAFETY` times the relative changes of loss and gradient if all features are rounded as in a precision.

    They are large if the style loss is a difference of nearly equal statistics, or if a standard deviation is hardly
    larger than the rounding of the features.
    """
    _, rounded = RoundedNetwork(weights, network, way.bits).beside(evaluate)
    loss = abs(rounded.loss - exact.loss) / max(abs(exact.loss), 1.0)
    return SAFETY * loss, SAFETY * gradient_error(rounded, exact)


def compare_losses(
    image: Tensor,
    style: Tensor,
    content: Tensor,
    *,
    way: Way = FLOAT32,
    content_weight: float = 1.0,
    untiled: bool = True,
) -> CaseResult:
    """Return the relative error of loss and pixel gradient against float64, with equal ReLU and pool decisions.

    In 16 bits, the bound is what rounding of features changes, however much that is. What overflows in float16 is
    compared in bfloat16, in which jobs continue then.

    Args:
        image: Image [H, W, 3].
        style: Style image [H', W', 3], downscaled to the view as usual.
        content: Content image [H, W, 3].
        way: Precision to compare.
        content_weight: Weight of the content term.
        untiled: Whether to compare the loss with the untiled autograd reference instead of the float64 `SosLoss`;
            requires at least 16 x 16 pixels.
    """
    style = resize_area(style, style_size((style.shape[0], style.shape[1]), (image.shape[0], image.shape[1])))
    single = way.network(vgg16())
    double = DecisionsOf(vgg16(), single)

    def evaluated(network: FeatureNetwork) -> SosResult:
        return evaluate(SosLoss(network, content_weight=content_weight), image, Style.of(style), content)

    actual, expected = double.beside(evaluated)
    loss = expected.loss
    if untiled:
        loss, _ = sos_reference(vgg16(), image, style, content, content_weight=content_weight)
    # The floor of 1 is far below any visible loss. It only prevents a division by zero for a perfect match.
    off, turned = abs(actual.loss - loss) / max(abs(loss), 1.0), gradient_error(actual, expected)
    if way.precision == "float16" and not math.isfinite(turned):
        return compare_losses(image, style, content, way=BFLOAT16, content_weight=content_weight, untiled=untiled)
    note = f"loss {actual.loss:.3g}, {double.flips} ReLU and pool decisions flipped"
    bound = LOSS_BOUND
    if way.in_16_bits:
        bound = max(rounding_error(expected, evaluated, single, vgg16(), way))
    return CaseResult(max(off, turned), bound, note)


def evaluate(loss: SosLoss, image: Tensor, style: Style, content: Tensor, coverage: Tensor | None = None) -> SosResult:
    """Return loss and gradient of an image [H, W, 3], in the precision of the loss's network."""
    dtype = torch.promote_types(loss.network.dtype, torch.float32)
    targets = loss.targets.of_style(style.map(lambda own: own.to(dtype)), (image.shape[0], image.shape[1]))
    return loss.evaluate(image.to(dtype), targets, loss.targets.of_view(content.to(dtype), coverage))


def gradient_error(actual: SosResult, exact: SosResult) -> float:
    """Return the relative error of a pixel gradient; infinity if the gradient is not finite."""
    assert actual.image_gradient is not None
    assert exact.image_gradient is not None
    if not bool(torch.isfinite(actual.image_gradient).all()):
        return math.inf
    error = float((actual.image_gradient.double() - exact.image_gradient).norm())
    return error / max(float(exact.image_gradient.norm()), 1e-3)


@cache
def small_network(channels: int = FLOAT32.channels) -> BackboneWeights:
    """Return VGG16's layers with few channels each and fixed random weights (He et al. 2015)."""
    generator = torch.Generator().manual_seed(8)
    layers, before = {}, 3
    for block, count in enumerate(BLOCKS["vgg16"], start=1):
        for index in range(1, count + 1):
            weight = torch.randn(channels, before, 3, 3, generator=generator) * math.sqrt(2 / (9 * before))
            layers[f"conv{block}_{index}"] = weight, torch.randn(channels, generator=generator)
            before = channels
    scale, shift = torch.full((3,), 255.0), -torch.tensor(CAFFE_MEAN)
    return BackboneWeights("vgg16", "random", "0" * 64, layers, scale, shift)


def flat(red: float, green: float, blue: float, height: int, width: int) -> Tensor:
    """Return an image [height, width, 3] float32 of one color."""
    return torch.tensor([red, green, blue], dtype=torch.float32).expand(height, width, 3).clone()


def texture(height: int, width: int, seed: int = 0) -> Tensor:
    """Return an image [height, width, 3] float32 in 0 to 1 with structure at several sizes."""
    generator = torch.Generator().manual_seed(seed)
    result = torch.zeros(height, width, 3)
    for cell, strength in ((16, 0.6), (4, 0.4)):
        coarse = torch.rand((height // cell + 2, width // cell + 2, 3), generator=generator)
        rows = torch.arange(height) // cell
        result += strength * coarse[rows][:, torch.arange(width) // cell]
    return result


def without(scene: Scene, rows: Tensor) -> tuple[Scene, Tensor]:
    """Remove rows ([N] bool) from a scene; return the new scene, and the mask [N] bool of the remaining rows."""
    others = ~rows
    columns = {name: getattr(scene, name)[others] for name in TENSORS}
    return replace(scene, **columns), others
