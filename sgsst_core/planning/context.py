"""Facts about machine, scene, views and network that a plan depends on, and the objects created to measure them."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import partial

import torch
from torch import Tensor

from sgsst_core.budget import default_memory_limit, memory_for
from sgsst_core.features import winograd
from sgsst_core.features.network_weights import BackboneWeights
from sgsst_core.features.partition import computed_twice, scaled_region
from sgsst_core.features.vgg import (
    FeatureNetwork,
    convolutions,
    has_bfloat16,
    has_bfloat16_instructions,
    has_float16,
    has_tf32,
    use_whole_float32,
)
from sgsst_core.loss.gradient_error import Difference
from sgsst_core.loss.sos import SosLoss
from sgsst_core.loss.terms import layers_of
from sgsst_core.loss.tiling import Tiling
from sgsst_core.parallel.collectives import Collectives
from sgsst_core.parallel.division import Size
from sgsst_core.planning.plan import Device, Plan
from sgsst_core.planning.survey import Survey
from sgsst_core.rasterizer import Rasterizer, drawing_problem, gpu_rasterizers, make_rasterizer, rasterizer_for
from sgsst_core.rasterizer.base import Precision as WeightPrecision
from sgsst_core.rasterizer.cached import CachedRasterizer
from sgsst_core.scene.camera import Camera, spread
from sgsst_core.scene.gaussians import Scene
from sgsst_core.scene.pyramid import downscale
from sgsst_core.scene.spherical_harmonics import scene_colors
from sgsst_core.settings import PlannedPrecision, Settings
from sgsst_core.style import Style
from sgsst_core.timing import Timer, wait_for

DTYPES: dict[PlannedPrecision, torch.dtype] = {
    "float32": torch.float32,
    "winograd": torch.float32,
    "tf32": torch.float32,
    "bfloat16": torch.bfloat16,
    "float16": torch.float16,
}
#: Channels and side of the timed convolution: a few milliseconds of work on a CPU core, and enough to fill a GPU.
_CHANNELS: dict[Device, int] = {"cpu": 128, "cuda": 256}
_SIDE: dict[Device, int] = {"cpu": 48, "cuda": 256}
#: Number of measurements, of which the fastest counts: another process can interrupt one. A single one counts if it is
#: slower than `_SLOW` seconds, as on CPUs that emulate the precision.
_MEASUREMENTS = 10
_SLOW = 0.5
#: Resolution in seconds of a process's processor time while it is limited, as in the service's confined processes.
_TICK = 0.004
#: Maximum longer side of the view on which another precision is compared with float32, and number of comparisons, of
#: which the fastest counts. CPUs take processor time, which other processes hardly change.
_COMPARED_SIDE: dict[Device, int] = {"cpu": 160, "cuda": 2048}
_COMPARISONS: dict[Device, int] = {"cpu": 1, "cuda": 3}
#: Side of the image whose evaluation compiles kernels.
_WARM_UP_SIDE = 32
#: Precisions of cached blend weights, the exact one first, and number of views whose weights are counted.
_FORMATS: tuple[WeightPrecision, ...] = ("float32", "half")
_SAMPLED_VIEWS = 3
#: Minimum visits of a view for which caching its blend weights pays off on a CPU. Computing them takes as long as about
#: three renders with gradient, and each use saves two thirds of a render. On GPUs, both times are measured.
LEAST_VISITS = 5
#: Minimum fraction of a visit's time that cached weights or a CUDA graph must save to be worth their memory.
LEAST_SAVING = 0.03


@dataclass(frozen=True)
class Saving:
    """Measured time that something saves at each visit of a view: cached blend weights, or a CUDA graph of its loss.

    Attributes:
        without: Seconds of a visit without it.
        seconds: Seconds of a visit with it.
        once: Seconds to compute it.
        problem: Reason why it cannot be used and nothing was measured; None if it can.
    """

    without: float = 0.0
    seconds: float = 0.0
    once: float = 0.0
    problem: str | None = None

    @property
    def saved(self) -> float:
        """Seconds saved per visit; 0 if too few to matter."""
        saved = self.without - self.seconds
        return saved if self.problem is None and saved > LEAST_SAVING * self.without else 0.0

    @property
    def least_visits(self) -> float | None:
        """Minimum visits for which it saves time; None if it never does."""
        return self.once / self.saved if self.saved else None

    def text(self, used: str, unused: str) -> str:
        """Return the times as text, given descriptions of a visit with it and without it."""
        return f"measured per view: {1e3 * self.seconds:.3g} ms {used}, {1e3 * self.without:.3g} ms {unused}"


@dataclass(frozen=True)
class WeightCost:
    """Cost of caching the views' blend weights.

    Attributes:
        bytes: Size in bytes of the cached weights of all views, float32; None if the rasterizer cannot cache them.
        half_bytes: Size in bytes of the cached weights of all views in half precision; None as for `bytes`.
        saving: Time that cached weights save; measured on a GPU only.
    """

    bytes: int | None = None
    half_bytes: int | None = None
    saving: Saving = Saving(problem="the weights of one view do not fit")


@dataclass(frozen=True)
class Hardware:
    """Facts about the machine and its ranks.

    Attributes:
        device: Device of the feature network.
        memory_limit: Memory budget in bytes of all ranks on one machine together, or on one GPU.
        sharing: Maximum number of ranks that share one machine's memory, or that of a GPU.
        problems: Reason by name for each GPU rasterizer that does not work; empty on the CPU.
    """

    device: Device
    memory_limit: int
    sharing: int = 1
    ranks: int = 1
    problems: Mapping[str, str] = field(default_factory=dict)

    @property
    def memory(self) -> int:
        """Memory budget of one rank in bytes."""
        return self.memory_limit // self.sharing


@dataclass(frozen=True)
class Comparison:
    """Comparison of a precision of the network with float32.

    Attributes:
        convolution: Ratio of the time of a convolution in float32 to that in this precision.
        speedup: The same ratio for the loss of a view and its gradient; 0 if a convolution is not faster.
        error: Error of the gradient of the view's pixels that show more than background, relative to float32; None if a
            convolution is not faster.
    """

    convolution: float
    speedup: float = 0.0
    error: Difference | None = None


@dataclass(frozen=True)
class Facts:
    """All facts from which the decisions before the trial follow, apart from the settings.

    Attributes:
        gaussians: Number N of Gaussians.
        sh_degree: SH degree of the scene's file.
        used_degree: Highest SH degree with a non-zero coefficient after SH attenuation, among the rendered Gaussians.
        harmonics_energy: See `spherical_harmonics.harmonics_energy`, with the views' blend weights.
        sizes: (height, width) of each view.
        rasterizer: Rasterizer that computes blend weights.
        frozen: [N] bool, frozen Gaussians; None if there are none.
        deepest: Name of the deepest layer in use.
        precisions: Comparison of each precision that may be used; None if the job is too short to compare any.
    """

    gaussians: int
    sh_degree: int
    used_degree: int
    harmonics_energy: float
    sizes: tuple[Size, ...]
    survey: Survey
    machine: Hardware
    rasterizer: str
    weights: WeightCost
    frozen: Tensor | None = None
    deepest: str = "relu5_1"
    precisions: Mapping[PlannedPrecision, Comparison] | None = None


@dataclass(frozen=True)
class NetworkPixels:
    """Pixels through the network in one iteration on a single rank, mean over views.

    Attributes:
        all: Pixels through the forward and the backward pass, including halos.
        again: Pixels through a second forward pass, because their activations do not fit in memory.
        without_region: Value of `all` if uncovered pixels were processed too.
        tiles: Maximum number of tiles of a view at one scale.
        held: Maximum number of pixels in memory at a time, including the temporary memory of a pass in units of pixels.
    """

    all: float = 0.0
    again: float = 0.0
    without_region: float = 0.0
    tiles: int = 0
    held: float = 0.0

    @staticmethod
    def of(plan: Plan, sizes: Sequence[Size], tiling: Tiling, views: Sequence[int] | None = None) -> NetworkPixels:
        """Count the pixels of some of a plan's views, or of all covered ones; `sizes` (height, width) are of all."""
        pixels = again = without = held = 0.0
        tiles, views = 0, plan.covered if views is None else views
        for index in views:
            for scale in tiling.scales(sizes[index]):
                size = (sizes[index][0] >> scale, sizes[index][1] >> scale)
                region = scaled_region(plan.survey.regions[index], scale, size) if plan.weighted else None
                areas, whole = ([t.outer.pixels for t in tiling.tiles(size, each)] for each in (region, None))
                flags = tiling.cached(areas)
                twice, largest = computed_twice(areas, flags), max(areas, default=0)
                pixels, again, without = pixels + sum(areas), again + twice, without + sum(whole)
                tiles = max(tiles, len(areas))
                once = max((area for area, flag in zip(areas, flags, strict=True) if not flag), default=0)
                held = max(held, sum(areas) - twice + tiling.working * largest, (1 + tiling.working) * once)
        return NetworkPixels(pixels / len(views), again / len(views), without / len(views), tiles, held)


def weight_cost(rasterizer: Rasterizer, cameras: Sequence[Camera], settings: Settings, budget: int) -> WeightCost:
    """Count the blend weights of a few evenly spread views; on a GPU, also time a view with and without cached weights.

    Args:
        cameras: Cameras of the views that see anything.
        budget: Memory budget for blend weights in bytes.
    """
    if not rasterizer.can_cache:
        return WeightCost()
    sample = spread(cameras, _SAMPLED_VIEWS)
    middle = sample[len(sample) // 2]
    visits = (settings.steps_coarse + settings.steps_sos) * settings.views_per_step / len(cameras)
    if not rasterizer.on_gpu and settings.cached_weights == "auto" and visits < LEAST_VISITS:
        sample = [middle]
    sizes = [[counted.nbytes(format_) for format_ in _FORMATS] for counted in map(rasterizer.count_weights, sample)]
    total, half = (sum(column) * len(cameras) // len(sample) for column in zip(*sizes, strict=True))
    fitting = [format_ for format_, size in zip(_FORMATS, sizes[len(sample) // 2], strict=True) if size <= budget]
    if not rasterizer.on_gpu or not fitting:
        return WeightCost(total, half)
    caching = 0.0
    try:
        for _ in range(2):  # the first run compiles
            started = time.perf_counter()
            rasterizer.count_weights(middle).store(fitting[0])
            wait_for(rasterizer.device)
            caching = time.perf_counter() - started
        cached = CachedRasterizer(rasterizer.scene, precision=fitting[0], uncached=rasterizer)
        recomputed, applied = (each.step_seconds(middle, visits=2)[1] for each in (rasterizer, cached))
    except torch.OutOfMemoryError:
        return WeightCost(total, half)
    return WeightCost(total, half, Saving(recomputed, applied, caching))


@dataclass
class Networks:
    """Feature networks that the plans of one job share, and the comparison of their precisions, made once on a CPU.

    Attributes:
        precisions: Comparison of each precision; None if there was none yet.
    """

    precisions: Mapping[PlannedPrecision, Comparison] | None = None
    created: dict[PlannedPrecision, FeatureNetwork] = field(default_factory=dict)

    def get(
        self, precision: PlannedPrecision, weights: BackboneWeights, settings: Settings, device: Device
    ) -> FeatureNetwork:
        """Return the network in a precision, and create it if it is needed for the first time."""
        if precision not in self.created:
            self.created[precision] = make_network(weights, settings, precision, device)
        return self.created[precision]


@dataclass(frozen=True)
class PlanningContext:
    """Objects that are created for measuring before the job, and that the job continues to use.

    Attributes:
        scene: Whole scene, with the SH attenuation of the settings applied.
        cameras: Cameras at the size used for stylization.
        network: Network; in float32 if no precision was chosen yet.
        rasterizer: Rasterizer of the whole scene that computes blend weights.
        sh_degree: SH degree of the original scene.
        networks: Networks of all plans of the job.
    """

    scene: Scene
    cameras: tuple[Camera, ...]
    settings: Settings
    machine: Hardware
    weights: BackboneWeights
    network: FeatureNetwork
    rasterizer: Rasterizer
    sh_degree: int
    networks: Networks


def equip(
    scene: Scene,
    cameras: Sequence[Camera],
    settings: Settings,
    weights: BackboneWeights,
    collectives: Collectives,
    rasterizer: str | None = None,
    networks: Networks | None = None,
) -> PlanningContext:
    """Create the planning context. Every rank must call this, and gets the same result up to rounding.

    Args:
        scene: Scene as it was read.
        cameras: Cameras at the size used for stylization.
        rasterizer: Rasterizer that computes blend weights; None to choose one.
        networks: Networks of earlier plans of the same job; None if this is the first plan.
    """
    networks = networks or Networks()
    sh_degree, scene = scene.sh_degree, scene.attenuated(settings.sh_attenuation)
    device = common_device(collectives)
    problems = gpu_problems(collectives) if device == "cuda" else {}
    network = next(iter(networks.created.values()), None) or networks.get("float32", weights, settings, device)
    limit = settings.memory_limit or default_memory_limit(network.device)
    machine = Hardware(
        device,
        # The partition, and thereby rounding, depends on the limit, so it must be identical on all ranks.
        memory_limit=min(collectives.all_gather(limit)),
        sharing=sharing_memory(collectives, device),
        ranks=collectives.size,
        problems=problems,
    )
    name = rasterizer or rasterizer_for(device, problems)
    memory = memory_for("rasterizer", machine.memory)
    of_scene = make_rasterizer(name, scene, background=settings.background, near=settings.near, memory=memory)
    return PlanningContext(scene, tuple(cameras), settings, machine, weights, network, of_scene, sh_degree, networks)


def common_device(collectives: Collectives) -> Device:
    """Return the device that is available on all ranks."""
    return "cuda" if all(collectives.all_gather(torch.cuda.is_available())) else "cpu"


def gpu_problems(collectives: Collectives) -> dict[str, str]:
    """Return the problem of each GPU rasterizer that does not work on some rank, by the rasterizer's name.

    Rasterizers are tried in order of preference, until one works.
    """
    problems: dict[str, str] = {}
    for name in gpu_rasterizers():
        problem = rasterizer_problem(collectives, name)
        if problem is None:
            break
        problems[name] = problem
    return problems


def rasterizer_problem(collectives: Collectives, name: str) -> str | None:
    """Return the reason why a GPU rasterizer does not work on some rank; None if it works on all."""
    return next(filter(None, collectives.all_gather(drawing_problem(name))), None)


def sharing_memory(collectives: Collectives, device: Device) -> int:
    """Return the maximum number of ranks that share the memory of a machine, or of a GPU."""
    return collectives.gpu_sharing if device == "cuda" else max(collectives.all_gather(collectives.local_size))


def make_network(
    weights: BackboneWeights, settings: Settings, precision: PlannedPrecision, device: Device
) -> FeatureNetwork:
    """Create the feature network with layers up to the deepest one used."""
    layers = layers_of(settings.style_loss, weights, content=settings.content_weight > 0, settings=settings)
    use_whole_float32()
    ways = {"tf32": precision == "tf32", "winograd": precision == "winograd"}
    return FeatureNetwork(weights, layers, DTYPES[precision], device, **ways)


def available_precisions(settings: Settings, device: Device, collectives: Collectives) -> list[PlannedPrecision]:
    """Return the precisions other than float32 that a job may use. All ranks must call this.

    With "auto", a CPU must have instructions for bfloat16.
    """
    has: dict[PlannedPrecision, bool] = {
        "tf32": has_tf32(device),
        "float16": has_float16(device),
        "winograd": device == "cpu",
        "bfloat16": has_bfloat16(device) if settings.precision != "auto" else has_bfloat16_instructions(device),
    }
    everywhere = collectives.all_gather(has)
    return [name for name in has if settings.precision in (name, "auto") and all(each[name] for each in everywhere)]


def convolution_ratio(precision: PlannedPrecision, device: Device) -> float:
    """Return the ratio of a convolution's time in float32 to its time in another precision.

    On a CPU, these are processor times of one thread, which other processes hardly change.
    """
    with _one_thread(device):
        return _convolution_seconds("float32", device) / _convolution_seconds(precision, device)


@contextmanager
def _one_thread(device: Device) -> Iterator[None]:
    """Compute on one thread on a CPU inside a `with` block."""
    threads = torch.get_num_threads()
    if device == "cpu":
        torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)


def _convolution_seconds(precision: PlannedPrecision, device: Device) -> float:
    """Return the time in seconds of a 3x3 convolution, the fastest of some; the first one warms up."""
    channels, side, dtype = _CHANNELS[device], _SIDE[device], DTYPES[precision]
    image = torch.ones((1, channels, side, side), dtype=dtype, device=device)
    kernel = torch.ones((channels, channels, 3, 3), dtype=dtype, device=device)
    if device == "cuda":
        image, kernel = (tensor.contiguous(memory_format=torch.channels_last) for tensor in (image, kernel))
    convolve: Callable[[Tensor], Tensor] = partial(torch.nn.functional.conv2d, weight=kernel, padding=1)
    if precision == "winograd" and (transformed := winograd.transform_weight(kernel)) is not None:
        convolve = partial(winograd.convolve, transformed=transformed)
        convolve(image[:, :, :8, :8])  # compiles kernels
    seconds = []
    with convolutions(image.device, tf32=precision == "tf32"):
        for _ in range(1 + _MEASUREMENTS):
            timer, started = Timer(device), time.thread_time()
            with timer("convolution"):
                convolve(image)
            seconds.append(timer.read()["convolution"] if device == "cuda" else time.thread_time() - started)
            if seconds[-1] > _SLOW:
                break
    return min(seconds[1:] or seconds)


def compare_precisions(
    context: PlanningContext, camera: Camera, precisions: Sequence[PlannedPrecision]
) -> dict[PlannedPrecision, Comparison]:
    """Compare precisions with float32 on a view, for a synthetic style.

    A precision in which a convolution is not faster is not tried: processors without bfloat16 instructions compute it
    hundreds of times more slowly than float32.

    Args:
        context: Objects to measure with.
        camera: View, which is rendered unstylized and then downscaled.
        precisions: Precisions other than float32.
    """
    device = context.machine.device
    ratios = {name: convolution_ratio(name, device) for name in precisions}
    faster = [name for name in precisions if ratios[name] > 1]
    if not faster:
        return {name: Comparison(ratio) for name, ratio in ratios.items()}
    colors = scene_colors(context.scene, camera)
    image = context.rasterizer.render(colors.to(context.rasterizer.device), camera).to(context.network.device)
    longer, shorter = max(image.shape[:2]) / _COMPARED_SIDE[device], min(image.shape[:2])
    image = downscale(image, min(max(0, math.ceil(math.log2(longer))), shorter.bit_length() - 1))
    # The gradient of background depends on which of equal values a pooling window chooses, and changes no Gaussian.
    seen = (image != torch.tensor(context.settings.background).to(image)).any(dim=-1)
    reference = context.networks.get("float32", context.weights, context.settings, device)
    exact, seconds = compared_gradient(context, reference, image)
    result = {}
    for name in precisions:
        result[name] = Comparison(ratios[name])
        if name in faster:
            network = context.networks.get(name, context.weights, context.settings, device)
            gradient, own = compared_gradient(context, network, image)
            error = Difference.of(gradient[seen], exact[seen])
            result[name] = Comparison(ratios[name], seconds / max(own, _TICK), error)
    return result


def compared_gradient(context: PlanningContext, network: FeatureNetwork, image: Tensor) -> tuple[Tensor, float]:
    """Return the pixel gradient [h, w, 3] of an image for a synthetic style, and the seconds to compute it.

    On a CPU, these are the seconds of one thread.
    """
    device, memory = context.machine.device, memory_for("activations", context.machine.memory)
    loss = SosLoss(network, content_weight=0, style_loss=context.settings.style_loss, memory=memory)
    size = int(image.shape[0]), int(image.shape[1])
    style = loss.targets.of_style(Style.of(soft_image(max(size))), size)

    def evaluate(side: int) -> tuple[Tensor, float]:
        part = image[:side, :side].contiguous()
        view, timer, started = loss.targets.of_view(part), Timer(device), time.process_time()
        with timer("evaluation"):
            gradient = loss.evaluate(part, style, view, [0]).image_gradient
        assert gradient is not None
        return gradient, timer.read()["evaluation"] if device == "cuda" else time.process_time() - started

    with _one_thread(device):
        evaluate(_WARM_UP_SIDE)
        every = [evaluate(max(size)) for _ in range(_COMPARISONS[device])]
    return every[-1][0], min(seconds for _, seconds in every)


def soft_image(side: int) -> Tensor:
    """Return a smooth synthetic image [side, side, 3] in 0..1: fixed random colors 16 pixels apart, interpolated."""
    cells = torch.rand((1, 3, side // 16 + 1, side // 16 + 1), generator=torch.Generator().manual_seed(0))
    image = torch.nn.functional.interpolate(cells, size=(side, side), mode="bilinear")[0]
    return image.permute(1, 2, 0).contiguous()
