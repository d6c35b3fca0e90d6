"""What is measured before anything is decided, on the rasterizer and the device that will do the work.

A `Probe` holds plain facts; `decide` makes a plan of them. What measuring builds is a `PlanningContext`, which the job
continues to use.
"""

from __future__ import annotations

import math
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import psutil
import torch
from torch import Tensor

from sgsst_core.budget import MEMORY_SHARES, default_memory_limit
from sgsst_core.features.network_weights import BackboneWeights
from sgsst_core.features.vgg import ALIGNMENT, CONTENT_LAYER, FeatureNetwork, use_whole_float32
from sgsst_core.loss.difference import Difference
from sgsst_core.loss.nearest import search
from sgsst_core.loss.scale_weights import EVEN, ScaleWeights
from sgsst_core.loss.sos import RegionTarget, ScaleTarget, SosLoss
from sgsst_core.loss.style_losses import layers_of
from sgsst_core.parallel.collectives import Collectives
from sgsst_core.parallel.division import Size
from sgsst_core.planning.choices import (
    GPU_RASTERIZERS,
    LEAST_VISITS,
    optimized_gaussians,
    precision_of,
    pruned_gaussians,
    rasterizer_options,
    rendered_gaussians,
    uncached_rasterizer,
)
from sgsst_core.planning.cost import LaunchCost, RasterCost, Rate
from sgsst_core.planning.launches import launch_cost
from sgsst_core.planning.pictures import soft_picture
from sgsst_core.planning.plan import Device
from sgsst_core.planning.precision import DTYPES, gradient_error, precision_ratio
from sgsst_core.planning.pruning import ImageError, distinct_views, pruned_image_error
from sgsst_core.planning.ranks_model import Link
from sgsst_core.planning.survey import Survey
from sgsst_core.rasterizer import Rasterizer, RasterizerName, make_rasterizer
from sgsst_core.rasterizer.cached import CachedRasterizer
from sgsst_core.rasterizer.cached_weights import Precision as WeightPrecision
from sgsst_core.rasterizer.cpu import CpuRasterizer
from sgsst_core.rasterizer.projection import Shapes
from sgsst_core.rasterizer.raster_lists import build_raster_lists
from sgsst_core.rasterizer.trial import drawing_problem
from sgsst_core.rasterizer.triton import TritonRasterizer
from sgsst_core.scene.camera import Camera
from sgsst_core.scene.gaussians import Scene
from sgsst_core.scene.spherical_harmonics import rest_colors
from sgsst_core.scene.stored_harmonics import StoredHarmonics
from sgsst_core.settings import Precision, Settings
from sgsst_core.timing import Timer, wait_for

#: Largest side of the picture that the network is timed on: large enough that its rate is that of a partition tile.
#: A GPU has more to do before the seconds of its launches do not count.
PROBE_SIDE: dict[Device, int] = {"cpu": 384, "cuda": 1024}
#: Visits of views of one size below which no graph of their loss pays, whatever it saves.
LEAST_GRAPH_VISITS = 20
#: Views whose blend weights are counted and timed; the others are taken to be like them.
SAMPLED_VIEWS = 3

#: Made-up vectors that are compared with each other to measure the search.
SEARCHED = {"cpu": 1 << 11, "cuda": 1 << 14}
#: Runs of the network, of which the fastest counts.
_RATE_RUNS = 2
#: Of kept blend weights, the exact one first.
_FORMS: tuple[WeightPrecision, ...] = ("float32", "half")


@dataclass(frozen=True)
class SceneFacts:
    """Of the scene.

    Attributes:
        gaussians: N.
        sh_degree: of its file.
        used_degree: highest SH degree with a coefficient that is not 0 after fading, among the Gaussians that are
            rendered.
        held_degree: of what is in memory; 0 where coefficients stay in the file.
    """

    gaussians: int
    sh_degree: int
    used_degree: int
    held_degree: int


@dataclass(frozen=True)
class NetworkFacts:
    """Of the feature network, in the precision in which it will run.

    Attributes:
        halo: pixels around a partition tile.
        held_bytes: a pixel, that a forward pass keeps for the backward pass.
        working_bytes: a pixel, that a pass needs beside them.
        content_bytes: of a cell of the content layer.
        rate: seconds a pixel.
        fixed: seconds that a partition tile of hardly any pixel takes.
        precision_ratio: seconds of a convolution in float32, over those in the precision that was asked for; None where
            that is float32, or what there is not here.
        gradient_error: of a view's pixel gradient, against float32; None where that is what runs.
        vector_channels: of a vector that is matched with the style's; 0 where none is.
        deepest: layer that it reports.
    """

    halo: int
    held_bytes: float
    working_bytes: float
    content_bytes: int
    rate: Rate
    fixed: float = 0.0
    precision_ratio: float | None = None
    gradient_error: Difference | None = None
    vector_channels: int = 0
    deepest: str = "relu5_1"


@dataclass(frozen=True)
class Machine:
    """Of the machine and the ranks on it.

    Attributes:
        device: that computes.
        memory_limit: bytes to plan with, of the ranks that share a machine's memory together.
        sharing: most ranks that share it.
        ranks: that there are.
        problems: why GPU rasterizers cannot be used there, by their name; none on the CPU.
    """

    device: Device
    memory_limit: int
    sharing: int = 1
    ranks: int = 1
    problems: Mapping[str, str] = field(default_factory=dict)

    @property
    def memory(self) -> int:
        """Bytes that one rank may plan with."""
        return self.memory_limit // self.sharing


@dataclass(frozen=True)
class Probe:
    """Everything that decisions follow from, besides the settings.

    Attributes:
        sizes: (height, width) of each view.
        survey: what the views show.
        distinct: indices of the views that are not nearly another one.
        pruned_error: of leaving out Gaussians that a view shows; None where there are none.
        rasterizer: that was timed: it computes blend weights anew.
        raster: what it takes, and what kept weights would.
        link: between ranks.
        process_bytes: of physical memory, with scene and network loaded.
        device_bytes: of a GPU's memory, likewise; 0 where a CPU computes.
        launches: of a view's loss on a GPU; None on a CPU, and where nothing follows from it.
        styles: pictures that the style is mixed of.
        kept: [N] bool, Gaussians that stay as they are; None where none do.
        maps: regions whose share is rendered in each view.
    """

    scene: SceneFacts
    sizes: tuple[Size, ...]
    survey: Survey
    distinct: tuple[int, ...]
    network: NetworkFacts
    rasterizer: str
    raster: RasterCost
    machine: Machine
    link: Link
    process_bytes: int
    pruned_error: ImageError | None = None
    device_bytes: int = 0
    launches: LaunchCost | None = None
    styles: int = 1
    kept: Tensor | None = None
    maps: int = 0


@dataclass(frozen=True)
class PlanningContext:
    """What measuring needs, and a job that follows the plan goes on to use.

    Attributes:
        scene: the whole scene, with its spherical harmonics faded as the settings say.
        sh_degree: of the scene as it came.
        cameras: at the size at which they are stylized.
        weights: of the network.
        network: in the precision in which it will run.
        precision_ratio: see `NetworkFacts`.
        rasterizer: of the whole scene, computes blend weights anew.
    """

    scene: Scene
    cameras: tuple[Camera, ...]
    settings: Settings
    machine: Machine
    weights: BackboneWeights
    network: FeatureNetwork
    precision_ratio: float | None
    rasterizer: Rasterizer
    sh_degree: int


def equip(
    scene: Scene,
    cameras: Sequence[Camera],
    settings: Settings,
    weights: BackboneWeights,
    collectives: Collectives,
    rasterizer: str | None = None,
) -> PlanningContext:
    """See what there is to work with. Every rank calls this, and gets the same but for rounding.

    Args:
        cameras: at the size at which they are stylized.
        rasterizer: that computes blend weights anew; None chooses.
    """
    sh_degree, scene = scene.sh_degree, scene.attenuated(settings.sh_attenuation)
    device = common_device(collectives)
    problems = gpu_problems(collectives) if device == "cuda" else {}
    ratio = precision_ratio(settings.precision, device, collectives)
    network = make_network(weights, settings, precision_of(settings.precision, ratio), device)
    limit = settings.memory_limit or default_memory_limit(network.device)
    machine = Machine(
        device,
        # The partition follows from it, and so does rounding: it must be the same on all ranks.
        memory_limit=min(collectives.all_gather(limit)),
        sharing=sharing_memory(collectives, device),
        ranks=collectives.size,
        problems=problems,
    )
    name = rasterizer or uncached_rasterizer(device, problems)
    whole = make_rasterizer(name, scene, **rasterizer_options(name, settings, machine.memory))
    return PlanningContext(scene, tuple(cameras), settings, machine, weights, network, ratio, whole, sh_degree)


def common_device(collectives: Collectives) -> Device:
    """What all ranks can compute on."""
    return "cuda" if all(collectives.all_gather(torch.cuda.is_available())) else "cpu"


def gpu_problems(collectives: Collectives) -> dict[str, str]:
    """Why GPU rasterizers cannot be used, by their name, the preferred one first: what one rank cannot do, none does.

    A rasterizer is only tried where every preferred one has failed.
    """
    problems: dict[str, str] = {}
    for name in GPU_RASTERIZERS:
        problem = rasterizer_problem(collectives, name)
        if problem is None:
            break
        problems[name] = problem
    return problems


def rasterizer_problem(collectives: Collectives, name: RasterizerName) -> str | None:
    """Why one of the ranks cannot draw with a GPU rasterizer; None where all can."""
    return next(filter(None, collectives.all_gather(drawing_problem(name))), None)


def sharing_memory(collectives: Collectives, device: Device) -> int:
    """Most ranks that have to share the memory of a machine; each GPU has its own."""
    return max(collectives.all_gather(1 if device == "cuda" else collectives.local_size))


def make_network(weights: BackboneWeights, settings: Settings, precision: Precision, device: Device) -> FeatureNetwork:
    """The feature network, with layers up to the deepest one used."""
    layers = layers_of(settings.style_loss, weights, content=settings.content_weight > 0)
    use_whole_float32()
    return FeatureNetwork(weights, layers, DTYPES[precision], device, tf32=precision == "tf32")


def measure(planning_context: PlanningContext, looked: Survey, link: Link, maps: int = 0) -> Probe:
    """Time and count; one rank does it for all, because timings differ from rank to rank.

    Args:
        maps: regions whose share is rendered in each view.

    Raises:
        SettingsError: pruning would leave no Gaussian.
    """
    scene, cameras, settings = planning_context.scene, planning_context.cameras, planning_context.settings
    seen = rendered_gaussians(optimized_gaussians(looked, settings), settings)
    distinct = distinct_views(scene, cameras, looked.covered, looked.total_blend_weights, settings.similar_views)
    network = _network_facts(planning_context, cameras[distinct[0]], maps)
    launches = _launch_cost(planning_context, [cameras[index] for index in distinct])
    budget = int(planning_context.machine.memory * MEMORY_SHARES["rasterizer"])
    raster = _raster_cost(planning_context, [cameras[index] for index in distinct], budget)
    pruned = pruned_gaussians(looked, seen)
    error = pruned_image_error(~seen, cameras, distinct, planning_context.rasterizer) if pruned.any() else None
    used_degree = scene.used_degree(seen)
    held_degree = 0 if isinstance(scene.sh_rest, StoredHarmonics) else scene.sh_degree
    return Probe(
        SceneFacts(len(scene), planning_context.sh_degree, used_degree, held_degree),
        tuple((camera.height, camera.width) for camera in cameras),
        looked,
        tuple(distinct),
        network,
        planning_context.rasterizer.name,
        raster,
        planning_context.machine,
        link,
        psutil.Process().memory_info().rss,
        error,
        torch.cuda.memory_allocated(planning_context.network.device)
        if planning_context.machine.device == "cuda"
        else 0,
        launches,
        maps=maps,
    )


# --- the feature network -------------------------------------------------------------------------------------------


def _network_facts(planning_context: PlanningContext, first: Camera, maps: int) -> NetworkFacts:
    """Of the network on made-up pictures, and where it is not in float32, its error on the first view."""
    network, settings, loss = planning_context.network, planning_context.settings, _loss(planning_context)
    side = min(
        _side(planning_context, loss), max(max(camera.width, camera.height) for camera in planning_context.cameras)
    )
    fixed = 0.0
    rate = measure_rate(loss, side, maps)
    if planning_context.machine.ranks > 1:  # as good as no pixel: what it takes is the same for any number
        fixed = measure_rate(loss, ALIGNMENT).both * ALIGNMENT**2
    return NetworkFacts(
        network.halo,
        network.held_bytes_per_pixel(),
        network.working_bytes_per_pixel(),
        network.channels(CONTENT_LAYER) * torch.finfo(network.dtype).bits // 8 if settings.content_weight else 0,
        rate,
        fixed,
        planning_context.precision_ratio,
        gradient_error(
            network,
            planning_context.weights,
            planning_context.scene,
            first,
            planning_context.rasterizer,
            loss.memory,
            side,
            settings.style_loss,
        ),
        sum(network.channels(layer) for layer in loss.nearest_layers),
        max(network.layers),
    )


def _loss(planning_context: PlanningContext, scales: ScaleWeights = EVEN) -> SosLoss:
    """As one rank's."""
    settings = planning_context.settings
    return SosLoss(
        planning_context.network,
        content_weight=settings.content_weight,
        style_loss=settings.style_loss,
        memory=int(planning_context.machine.memory * MEMORY_SHARES["activations"]),
        coarsest=settings.coarsest_side,
        scales=scales,
        keep_activations="activations" not in settings.keep,
    )


def _launch_cost(planning_context: PlanningContext, views: Sequence[Camera]) -> LaunchCost | None:
    """Of the first view, on a GPU, where views of one size come often enough for graphs to be thought of."""
    settings, sizes = planning_context.settings, {(camera.height, camera.width) for camera in views}
    visits = (settings.steps_coarse + settings.steps_sos) * settings.views_per_step / len(sizes)
    if planning_context.machine.device == "cpu" or "launches" in settings.keep or visits < LEAST_GRAPH_VISITS:
        return None
    return launch_cost(_loss(planning_context, ScaleWeights(settings.scales)), (views[0].height, views[0].width))


def _side(planning_context: PlanningContext, loss: SosLoss) -> int:
    """Largest side of pictures for measuring; on a GPU, of those whose activations fit."""
    most = PROBE_SIDE[planning_context.machine.device]
    if planning_context.machine.device == "cpu":
        return most
    fits = math.isqrt(int(loss.memory / (loss.network.held_bytes_per_pixel() + loss.network.working_bytes_per_pixel())))
    return max(min(most, fits), ALIGNMENT)


def measure_rate(loss: SosLoss, side: int, maps: int = 0) -> Rate:
    """Time the feature network on a small picture of side x side pixels, with statistics of so many regions, if any.

    The first run prepares, the fastest of the others counts: what disturbs one of them is no property of the network.
    """
    image = soft_picture(side).to(loss.network.device)
    style, view = loss.style_targets(image.flip(0), (side, side)), loss.view_target(image)
    vectors = style[0].vectors
    if vectors is not None:  # its time grows with their number, and is not the pixels'
        style = {0: replace(style[0], vectors=replace(vectors, units=vectors.units[:1]))}
    if maps:
        share = torch.full((side, side), 1 / maps, device=loss.network.device)
        view.regions = [loss.position_weights(share)] * maps
        style = {0: ScaleTarget({}, None, (RegionTarget(style[0]),) * maps)}

    def seconds(gradient: bool) -> float:
        timer = Timer(loss.network.device)
        with timer("evaluation"):
            loss.evaluate(image, style, view, [0], gradient=gradient)
        return timer.read()["evaluation"] / side**2

    seconds(True)
    both = min(seconds(True) for _ in range(_RATE_RUNS))
    forward = min(seconds(False) for _ in range(_RATE_RUNS))
    return Rate(forward, both, 0.0 if vectors is None else _search_seconds(vectors.units))


def _search_seconds(units: Tensor) -> float:
    """Of a position and a style vector in the search for the nearest one."""
    size = SEARCHED[units.device.type]
    made = torch.rand((size, units.shape[1]), generator=torch.Generator().manual_seed(0)).to(units)

    def seconds() -> float:
        timer = Timer(units.device)
        with timer("search"):
            search(made, made)
        return timer.read()["search"] / size**2

    seconds()
    return min(seconds() for _ in range(_RATE_RUNS))


# --- the rasterizer ------------------------------------------------------------------------------------------------


def _raster_cost(planning_context: PlanningContext, cameras: Sequence[Camera], budget: int) -> RasterCost:
    """Count and time blend weights on a few of some views, evenly spread; `budget`: bytes for kept ones."""
    scene, rasterizer = planning_context.scene, planning_context.rasterizer
    count = min(SAMPLED_VIEWS, len(cameras))
    sample = [cameras[(2 * part + 1) * len(cameras) // (2 * count)] for part in range(count)]
    middle = count // 2
    if isinstance(rasterizer, CpuRasterizer):
        _raster_seconds(CpuRasterizer(scene.subset(torch.arange(1))), 1, sample[0])  # compiles
        seconds = []
        for camera in sample:
            rasterizer.lists(camera)  # the survey's, where it could keep them
            seconds += _raster_seconds(rasterizer, len(scene), camera)
        more, lists_bytes = _lists_cost(scene, sample, planning_context.settings.near)
    else:
        timed = [_raster_seconds(rasterizer, len(scene), camera, visits=2) for camera in sample]
        seconds = [later for _, later in timed]
        # The least: one of them may have compiled something, or waited for memory.
        more, lists_bytes = max(min(first - later for first, later in timed), 0.0), 0
    mean = sum(seconds) / count
    known: dict[str, Any] = {
        "first_seconds": more,
        "lists_bytes": lists_bytes,
        "colors_seconds": _colors_seconds(scene, sample[middle], rasterizer.device),
    }
    if rasterizer.name == "cuda":
        return RasterCost(mean, **known)
    uncached = rasterizer
    if not isinstance(uncached, CpuRasterizer | TritonRasterizer):
        uncached = CpuRasterizer(scene, near=planning_context.settings.near)
    cached = CachedRasterizer(scene, uncached=uncached)
    if isinstance(uncached, CpuRasterizer) and _comes_too_seldom(planning_context.settings, len(cameras)):
        total, half = (cached.count(sample[middle]).nbytes(form) * len(cameras) for form in _FORMS)
        return RasterCost(mean, None, total, half, **known)
    sizes = [[counted.nbytes(form) for form in _FORMS] for counted in map(cached.count, sample)]
    total, half = (sum(column) * len(cameras) // count for column in zip(*sizes, strict=True))
    fitting = [form for form, size in zip(_FORMS, sizes[middle], strict=True) if size <= budget]
    if not fitting:
        return RasterCost(mean, None, total, half, **known)
    keeping = None
    if isinstance(uncached, TritonRasterizer):  # on the CPU it is known: see `decide.LEAST_VISITS`
        keeping = _keeping_seconds(cached, sample[middle], fitting[0])
    cached = CachedRasterizer(scene, precision=fitting[0], uncached=uncached)
    kept = _raster_seconds(cached, len(scene), sample[middle], visits=2)[1]
    # Of the mean view, as the seconds it is compared with.
    return RasterCost(mean, kept * mean / seconds[middle], total, half, keeping, **known)


def _comes_too_seldom(settings: Settings, views: int) -> bool:
    """Whether a view comes so seldom that its kept weights, which nobody asked for, do not pay on a CPU."""
    visits = (settings.steps_coarse + settings.steps_sos) * settings.views_per_step / views
    return settings.cached_weights == "auto" and visits < LEAST_VISITS


def _lists_cost(scene: Scene, cameras: Sequence[Camera], near: float) -> tuple[float, int]:
    """Seconds and bytes of a view's lists, made once more; mean over some views."""
    seconds, size, shapes = 0.0, 0, Shapes.of(scene)
    for camera in cameras:
        started = time.perf_counter()
        size += build_raster_lists(scene, camera, near=near, shapes=shapes).nbytes
        seconds += time.perf_counter() - started
    return seconds / len(cameras), size // len(cameras)


def _colors_seconds(scene: Scene, camera: Camera, device: torch.device) -> float:
    """Of what spherical harmonics add to a view's colors, for the second time: the first one compiles."""
    seconds = 0.0
    if scene.sh_degree:
        sh_rest, means = scene.sh_rest.to(device), scene.means.to(device)
        for _ in range(2):
            started = time.perf_counter()
            rest_colors(sh_rest, means, camera)
            wait_for(device)
            seconds = time.perf_counter() - started
    return seconds


def _keeping_seconds(cached: CachedRasterizer, camera: Camera, form: WeightPrecision) -> float:
    """Of making a view's kept weights for the second time: the first one compiles."""
    seconds = 0.0
    for _ in range(2):
        started = time.perf_counter()
        cached.count(camera).keep(form)
        wait_for(cached.device)
        seconds = time.perf_counter() - started
    return seconds


def _raster_seconds(rasterizer: Rasterizer, gaussians: int, camera: Camera, visits: int = 1) -> list[float]:
    """Of some renders with gradient: the first one prepares the view, where that has not been done."""
    colors = torch.full((gaussians, 3), 0.5, device=rasterizer.device)
    seconds = []
    for _ in range(visits):
        started = time.perf_counter()
        rasterizer.color_gradient(rasterizer.render(colors, camera), camera)
        wait_for(rasterizer.device)
        seconds.append(time.perf_counter() - started)
    return seconds
