"""What a hard case is, and the measurements that cases share."""

from __future__ import annotations

import math
import resource
import sys
import time
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import cache
from typing import Literal

import torch
from torch import Tensor

from sgsst_core.constants import NEAR
from sgsst_core.features.network_weights import BackboneWeights, load_network_weights
from sgsst_core.features.vgg import Activations, FeatureNetwork
from sgsst_core.loss.sos import SosLoss, SosResult, resize_area
from sgsst_core.loss.sos_reference import sos_reference
from sgsst_core.rasterizer import RasterizerName, make_rasterizer
from sgsst_core.rasterizer.reference import ReferenceRasterizer
from sgsst_core.scene.camera import Camera
from sgsst_core.scene.gaussians import Scene
from sgsst_core.scene.pyramid import style_size

Group = Literal[
    "Gaussians", "views", "style and content", "stiff optimization", "precision", "jobs", "files and orbits"
]

#: Images and coverage in float32 agree with float64 to this share of the brightest color.
IMAGE_BOUND = 1e-4
#: Where a value lies within this of a cut-off, float32 may skip what float64 keeps: a step, not an error.
CLOSE_TO_CUT = 2e-5
#: A contribution just above ALPHA_MIN, or a crossing Gaussian at a transmittance of up to 1e-2, times the color.
LARGEST_STEP = 1e-2
#: Loss and gradient in float32 agree with float64 under the same ReLU and max-pool decisions to this.
LOSS_BOUND = 1e-5


@dataclass(frozen=True)
class CaseResult:
    """What a case came to.

    Attributes:
        error: measured against the float64 reference; NaN or infinite where a result is not finite.
        bound: what it may be.
        note: what else was seen, for people.
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
        name: what is extreme about it.
        group: what part of the method it strains.
        measure: what the error is.
        run: the measurement; True for its full size, False for one that takes at most seconds.
    """

    name: str
    group: Group
    measure: str
    run: Callable[[bool], CaseResult]


@dataclass(frozen=True)
class Measurement:
    """A case that was run: its result, wall-clock seconds, and bytes by which the process's peak memory grew."""

    result: CaseResult
    seconds: float
    peak_growth: int


def measure(case: Case, *, full: bool = False) -> Measurement:
    """Run a case; full size, or one that takes at most seconds."""
    peak, started = _peak_memory(), time.perf_counter()
    result = case.run(full)
    return Measurement(result, time.perf_counter() - started, _peak_memory() - peak)


def _peak_memory() -> int:
    """Bytes; Linux counts in KiB, macOS in bytes."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * (1 if sys.platform == "darwin" else 1024)


def camera(width: int = 37, height: int = 29, *, focal: float = 30.0) -> Camera:
    """At the origin, looking along +z; the principal point is off the middle."""
    pose = torch.eye(4, dtype=torch.float64)
    return Camera("hard case", width, height, focal, focal * 1.1, width / 2 + 1.3, height / 2 - 0.7, pose)


def ordinary(count: int = 80, *, seed: int = 0, degree: int = 0) -> Scene:
    """Gaussians as trained scenes have them, in front of `camera()`."""
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
    """Extreme Gaussians first, then ordinary ones, whose pixels must not suffer."""
    rest = ordinary(count, degree=extreme.sh_degree)
    return Scene(*(torch.cat([getattr(extreme, name), getattr(rest, name)]) for name in Scene.__dataclass_fields__))


def repeated(
    count: int,
    *,
    mean: tuple[float, float, float] = (0.0, 0.0, 4.0),
    scale: float = 0.1,
    logit: float = 2.0,
) -> Scene:
    """The same round Gaussian `count` times, to be made extreme; scale in world units."""
    return Scene(
        means=torch.tensor(mean).repeat(count, 1),
        quats=torch.tensor([1.0, 0.0, 0.0, 0.0]).repeat(count, 1),
        scales=torch.full((count, 3), math.log(scale)),
        opacities=torch.full((count,), logit),
        sh_dc=torch.zeros(count, 3),
        sh_rest=torch.zeros(count, 0, 3),
    )


def fast_rasterizers() -> tuple[RasterizerName, ...]:
    """What is held against `reference`: the rasterizers of processors, and that of GPUs where there is one."""
    return ("cpu", "cached", "triton") if torch.cuda.is_available() else ("cpu", "cached")


def compare_rasterizers(
    scene: Scene,
    view: Camera,
    *,
    near: float = NEAR,
    colors: Tensor | None = None,
    expected_scene: Scene | None = None,
    keep: Tensor | None = None,
) -> CaseResult:
    """Largest error of `fast_rasterizers` against the float64 reference.

    Images and coverage: as a share of the brightest color, outside pixels where a cut-off hangs by a thread (there
    a step up to LARGEST_STEP is allowed, and counted). Color gradients: as a share of the largest one.

    Args:
        colors: [N, 3]; None for random ones in 0..2.
        expected_scene: what the reference renders, where that is not the scene itself; it holds the scene's rows `keep`
            ([N] bool), and the others must contribute nothing.
    """
    generator = torch.Generator().manual_seed(5)
    if colors is None:
        colors = 2 * torch.rand(len(scene), 3, generator=generator)
    pixels = torch.randn(view.height, view.width, 3, generator=generator)
    kept = torch.ones(len(scene), dtype=torch.bool) if keep is None else keep
    reference = ReferenceRasterizer(expected_scene or scene, near=near)
    band = reference.near_cutoff(view, CLOSE_TO_CUT)
    brightest = max(float(colors.abs().max()) if len(colors) else 0.0, 1.0)
    image, coverage = reference.render(colors[kept], view), reference.coverage(view)
    pixels[band] = 0
    gradient = torch.zeros(len(scene), 3, dtype=torch.float64)
    gradient[kept] = reference.color_gradient(pixels, view)
    error, flipped = 0.0, 0
    for name in fast_rasterizers():
        fast = make_rasterizer(name, scene, near=near)
        shown = torch.cat([fast.render(colors, view) / brightest, fast.coverage(view)[..., None]], dim=-1).cpu()
        off = (shown.double() - torch.cat([image / brightest, coverage[..., None]], dim=-1)).abs().amax(-1)
        # a step that a cut-off explains is no error, any larger one is
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
    """The smaller network, for cases that need real features.

    Raises:
        WeightsError: it is not installed.
    """
    return load_network_weights("vgg16")


class DecisionsOf(FeatureNetwork):
    """A float64 network that back-propagates through the ReLU masks and pool positions of another one.

    Without them, a maximum that is tied in exact arithmetic (in any constant picture) sends the gradient to either
    pixel: both are subgradients, and no precision is high enough to agree.

    They are those of the passes that the other network made in a block of `listening`, in their order, and not of
    passes over the same pixels: those of a lower scale are averaged in float64 here and were in float32 there, and a
    maximum that is nearly tied may have moved.
    """

    def __init__(self, weights: BackboneWeights, other: FeatureNetwork) -> None:
        super().__init__(weights, other.layers, torch.float64)
        self.other = other
        self.flips = 0
        self._heard: deque[list[Tensor]] = deque()

    @contextmanager
    def listening(self) -> Iterator[None]:
        """A block in which the other network makes the passes that this one is to follow afterwards."""
        forward = self.other.forward

        def heard(rgb: Tensor, *, keep: bool = True) -> Activations:
            made = forward(rgb, keep=keep)
            self._heard.append(list(made.outputs))
            return made

        self.other.forward = heard  # type: ignore[method-assign]
        yield
        del self.other.forward

    def rounding_of(self, layer: str) -> float:
        """That of the other one: a channel that is constant but for it has no part in either's gradient."""
        return self.other.rounding_of(layer)

    def forward(self, rgb: Tensor, *, keep: bool = True) -> Activations:
        """As `FeatureNetwork.forward`, with the decisions of the other network's next pass kept for `backward`."""
        own = super().forward(rgb, keep=keep)
        theirs = Activations({}, self._heard.popleft())
        for mine, other in zip(own.decisions(), theirs.decisions(), strict=True):
            self.flips += int((mine != other).sum())
        own.outputs = [output.double() for output in theirs.outputs]
        return own


def compare_losses(
    image: Tensor,
    style: Tensor,
    content: Tensor,
    *,
    content_weight: float = 1.0,
    coverage: Tensor | None = None,
    untiled: bool = True,
    bound: float = LOSS_BOUND,
) -> CaseResult:
    """Error of the float32 loss and pixel gradient, relative, against float64 with the same decisions.

    Args:
        image, content: [H, W, 3].
        style: [H', W', 3], brought down to the view as always.
        untiled: also compare the loss with the autograd reference, which needs at least 16 x 16 pixels of everything.
    """
    style = resize_area(style, style_size((style.shape[0], style.shape[1]), (image.shape[0], image.shape[1])))
    single = FeatureNetwork(vgg16())
    double = DecisionsOf(vgg16(), single)
    with double.listening():
        found = _evaluate(single, image, style, content, content_weight, coverage)
    expected = _evaluate(double, image, style, content, content_weight, coverage)
    assert found.image_gradient is not None
    assert expected.image_gradient is not None
    loss = expected.loss
    if untiled:
        loss, _ = sos_reference(vgg16(), image, style, content, content_weight=content_weight, coverage=coverage)
    # one unit of loss is far below what anyone could see; it only keeps a perfect match from dividing by zero
    error = abs(found.loss - loss) / max(abs(loss), 1.0)
    if not bool(torch.isfinite(found.image_gradient).all()):
        error = math.inf
    norm = float(expected.image_gradient.norm())
    off = float((found.image_gradient.double() - expected.image_gradient).norm())
    error = max(error, off / max(norm, 1e-3))
    return CaseResult(error, bound, f"loss {found.loss:.3g}, {double.flips} ReLU and pool decisions flipped")


def _evaluate(
    network: FeatureNetwork,
    image: Tensor,
    style: Tensor,
    content: Tensor,
    content_weight: float,
    coverage: Tensor | None,
) -> SosResult:
    loss = SosLoss(network, content_weight=content_weight)
    targets = loss.style_targets(style.to(network.dtype), (image.shape[0], image.shape[1]))
    view = loss.view_target(content.to(network.dtype), coverage)
    return loss.evaluate(image.to(network.dtype), targets, view)


def texture(height: int, width: int, seed: int = 0) -> Tensor:
    """A picture [height, width, 3] float32 in 0..1 with structure at several sizes."""
    generator = torch.Generator().manual_seed(seed)
    result = torch.zeros(height, width, 3)
    for cell, strength in ((16, 0.6), (4, 0.4)):
        coarse = torch.rand((height // cell + 2, width // cell + 2, 3), generator=generator)
        rows = torch.arange(height) // cell
        result += strength * coarse[rows][:, torch.arange(width) // cell]
    return result


def without(scene: Scene, rows: Tensor) -> tuple[Scene, Tensor]:
    """The scene without some rows ([N] bool), and what is kept ([N] bool)."""
    kept = ~rows
    columns = {name: getattr(scene, name)[kept] for name in Scene.__dataclass_fields__}
    return replace(scene, **columns), kept
