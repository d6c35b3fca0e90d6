"""Measurements before planning, on the rasterizer and the device that will do the work.

A `Probe` contains plain facts, from which `decide` makes a plan. The objects created for measuring form the planning
context (`PlanningContext`), which the job continues to use.
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

from sgsst_core.budget import default_memory_limit, memory_for
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
from sgsst_core.rasterizer.tile_intersections import build_tile_intersections
from sgsst_core.rasterizer.trial import drawing_problem
from sgsst_core.rasterizer.triton import TritonRasterizer
from sgsst_core.scene.camera import Camera, spread
from sgsst_core.scene.gaussians import Scene
from sgsst_core.scene.spherical_harmonics import rest_colors
from sgsst_core.scene.stored_harmonics import StoredHarmonics
from sgsst_core.settings import Precision, Settings
from sgsst_core.timing import Timer, wait_for

#: Maximum side of the image for timing the network: large enough for the rate of a partition tile. A GPU needs more
#: work before launch times become negligible.
PROBE_SIDE: dict[Device, int] = {"cpu": 384, "cuda": 1024}
#: Minimum visits per view size for which a CUDA graph of the loss is considered at all.
LEAST_GRAPH_VISITS = 20
#: Number of views whose blend weights are counted and timed, as representatives of all.
SAMPLED_VIEWS = 3

#: Number of synthetic vectors compared with each other to time the nearest-neighbor search.
SEARCHED = {"cpu": 1 << 11, "cuda": 1 << 14}
#: Number of runs of the network, of which the fastest counts.
_RATE_RUNS = 2
#: Precisions of cached blend weights, the exact one first.
_FORMS: tuple[WeightPrecision, ...] = ("float32", "half")


@dataclass(frozen=True)
class SceneFacts:
    """Facts about the scene.

    Attributes:
        gaussians: Number N of Gaussians.
        sh_degree: SH degree of its file.
        used_degree: Highest SH degree with a non-zero coefficient after SH attenuation, among the rendered Gaussians.
        held_degree: SH degree in memory; 0 if coefficients stay in the file.
    """

    gaussians: int
    sh_degree: int
    used_degree: int
    held_degree: int


@dataclass(frozen=True)
class NetworkFacts:
    """Facts about the feature network, in the precision in which it will run.

    Attributes:
        halo: Pixels around a partition tile.
        held_bytes: Bytes per pixel stored by a forward pass for the backward pass.
        working_bytes: Additional bytes per pixel needed by a pass.
        content_bytes: Bytes per cell of the content layer.
        rate: Time per pixel.
        fixed: Constant time in seconds of a partition tile, measured on one with almost no pixels.
        precision_ratio: Ratio of a convolution's time in float32 to that in the requested precision; None if float32
            was requested, or the requested one is unavailable.
        gradient_error: Error of a view's pixel gradient relative to float32; None if the network runs in float32.
        vector_channels: Length of a vector that is matched with the style's; 0 if nothing is matched.
        deepest: Name of the deepest layer in use.
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
    """Facts about the machine and its ranks.

    Attributes:
        device: Device of the feature network.
        memory_limit: Memory budget in bytes of all ranks on one machine together.
        sharing: Maximum number of ranks that share one machine's memory; 1 if they run on GPUs.
        ranks: Number of available ranks.
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
class Probe:
    """All facts from which decisions follow, apart from the settings.

    Attributes:
        scene: Facts about the scene.
        sizes: (height, width) of each view.
        survey: Survey of the views.
        distinct: Indices of the views to stylize: those that see anything and do not nearly repeat another view.
        network: Facts about the feature network.
        rasterizer: Timed rasterizer, which computes blend weights.
        raster: Cost of rendering with recomputed and with cached weights.
        machine: Facts about the machine.
        link: Connection between ranks.
        process_bytes: Physical memory of the process in bytes, with scene and network loaded.
        pruned_error: Error of leaving out visible Gaussians; None if there are none.
        device_bytes: GPU memory in bytes, with scene and network loaded; 0 on a CPU.
        launches: Cost of launching a view's loss on a GPU; None on a CPU, or if no decision depends on it.
        styles: Number of images in the style mixture.
        kept: [N] bool, frozen Gaussians; None if there are none.
        maps: Number of regions whose maps are rendered in each view.
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
    """Objects that are created for measuring before the job, and that the job continues to use.

    Attributes:
        scene: Whole scene, with the SH attenuation of the settings applied.
        cameras: Cameras at the size used for stylization.
        settings: Settings of the job.
        machine: Facts about the machine.
        weights: Weights of the network.
        network: Network in the precision in which it will run.
        precision_ratio: See `NetworkFacts`.
        rasterizer: Rasterizer of the whole scene that computes blend weights.
        sh_degree: SH degree of the original scene.
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
    """Create the planning context. Every rank must call this, and gets the same result up to rounding.

    Args:
        scene: Scene as it was read.
        cameras: Cameras at the size used for stylization.
        settings: Settings of the job.
        weights: Weights of the network.
        collectives: Ranks of the job.
        rasterizer: Rasterizer that computes blend weights; None to choose one.
    """
    sh_degree, scene = scene.sh_degree, scene.attenuated(settings.sh_attenuation)
    device = common_device(collectives)
    problems = gpu_problems(collectives) if device == "cuda" else {}
    ratio = precision_ratio(settings.precision, device, collectives)
    network = make_network(weights, settings, precision_of(settings.precision, ratio), device)
    limit = settings.memory_limit or default_memory_limit(network.device)
    machine = Machine(
        device,
        # The partition, and thereby rounding, depends on the limit, so it must be identical on all ranks.
        memory_limit=min(collectives.all_gather(limit)),
        sharing=sharing_memory(collectives, device),
        ranks=collectives.size,
        problems=problems,
    )
    name = rasterizer or uncached_rasterizer(device, problems)
    whole = make_rasterizer(name, scene, **rasterizer_options(name, settings, machine.memory))
    return PlanningContext(scene, tuple(cameras), settings, machine, weights, network, ratio, whole, sh_degree)


def common_device(collectives: Collectives) -> Device:
    """Return the device that is available on all ranks."""
    return "cuda" if all(collectives.all_gather(torch.cuda.is_available())) else "cpu"


def gpu_problems(collectives: Collectives) -> dict[str, str]:
    """Return the reason, by name, why each GPU rasterizer that was tried does not work on some rank.

    Rasterizers are tried in order of preference, until one works.
    """
    problems: dict[str, str] = {}
    for name in GPU_RASTERIZERS:
        problem = rasterizer_problem(collectives, name)
        if problem is None:
            break
        problems[name] = problem
    return problems


def rasterizer_problem(collectives: Collectives, name: RasterizerName) -> str | None:
    """Return the reason why a GPU rasterizer does not work on some rank; None if it works on all."""
    return next(filter(None, collectives.all_gather(drawing_problem(name))), None)


def sharing_memory(collectives: Collectives, device: Device) -> int:
    """Return the maximum number of ranks that share the memory of a machine; GPUs do not share theirs."""
    return max(collectives.all_gather(1 if device == "cuda" else collectives.local_size))


def make_network(weights: BackboneWeights, settings: Settings, precision: Precision, device: Device) -> FeatureNetwork:
    """Create the feature network with layers up to the deepest one used."""
    layers = layers_of(settings.style_loss, weights, content=settings.content_weight > 0)
    use_whole_float32()
    return FeatureNetwork(weights, layers, DTYPES[precision], device, tf32=precision == "tf32")


def measure(planning_context: PlanningContext, survey: Survey, link: Link, maps: int = 0) -> Probe:
    """Measure everything that decisions depend on.

    One rank does this for all, because timings differ between ranks.

    Args:
        planning_context: Objects to measure with.
        survey: Survey of the views.
        link: Connection between ranks.
        maps: Number of regions whose maps are rendered in each view.

    Raises:
        SettingsError: If pruning would leave no Gaussian.
    """
    scene, cameras, settings = planning_context.scene, planning_context.cameras, planning_context.settings
    seen = rendered_gaussians(optimized_gaussians(survey, settings), settings)
    distinct = distinct_views(scene, cameras, survey.covered, survey.total_blend_weights, settings.similar_views)
    network = _network_facts(planning_context, cameras[distinct[0]], maps)
    launches = _launch_cost(planning_context, [cameras[index] for index in distinct])
    budget = memory_for("rasterizer", planning_context.machine.memory)
    raster = _raster_cost(planning_context, [cameras[index] for index in distinct], budget)
    pruned = pruned_gaussians(survey, seen)
    error = pruned_image_error(~seen, cameras, distinct, planning_context.rasterizer) if pruned.any() else None
    used_degree = scene.used_degree(seen)
    held_degree = 0 if isinstance(scene.sh_rest, StoredHarmonics) else scene.sh_degree
    return Probe(
        SceneFacts(len(scene), planning_context.sh_degree, used_degree, held_degree),
        tuple((camera.height, camera.width) for camera in cameras),
        survey,
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
    """Benchmark the network on synthetic images; if it is not float32, measure its gradient error on the first view."""
    network, settings, loss = planning_context.network, planning_context.settings, _loss(planning_context)
    side = min(
        _side(planning_context, loss), max(max(camera.width, camera.height) for camera in planning_context.cameras)
    )
    fixed = 0.0
    rate = measure_rate(loss, side, maps)
    if planning_context.machine.ranks > 1:  # with almost no pixels: the time that does not depend on their number
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
    """Return the loss of a single rank."""
    settings = planning_context.settings
    return SosLoss(
        planning_context.network,
        content_weight=settings.content_weight,
        style_loss=settings.style_loss,
        memory=memory_for("activations", planning_context.machine.memory),
        coarsest=settings.coarsest_side,
        scales=scales,
        keep_activations="activations" not in settings.keep,
    )


def _launch_cost(planning_context: PlanningContext, views: Sequence[Camera]) -> LaunchCost | None:
    """Measure the first view on a GPU, if views of one size are visited often enough to consider graphs."""
    settings, sizes = planning_context.settings, {(camera.height, camera.width) for camera in views}
    visits = (settings.steps_coarse + settings.steps_sos) * settings.views_per_step / len(sizes)
    if planning_context.machine.device == "cpu" or "launches" in settings.keep or visits < LEAST_GRAPH_VISITS:
        return None
    return launch_cost(_loss(planning_context, ScaleWeights(settings.scales)), (views[0].height, views[0].width))


def _side(planning_context: PlanningContext, loss: SosLoss) -> int:
    """Return the maximum side of images for measuring; on a GPU, their activations must fit in memory."""
    most = PROBE_SIDE[planning_context.machine.device]
    if planning_context.machine.device == "cpu":
        return most
    fits = math.isqrt(int(loss.memory / (loss.network.held_bytes_per_pixel() + loss.network.working_bytes_per_pixel())))
    return max(min(most, fits), ALIGNMENT)


def measure_rate(loss: SosLoss, side: int, maps: int = 0) -> Rate:
    """Time the feature network on a small synthetic image.

    The first run is a warm-up, and the fastest of the others counts, because disturbances are not a property of the
    network.

    Args:
        loss: Loss with the network.
        side: Side of the square image in pixels.
        maps: Number of regions that have statistics of their own; 0 for none.
    """
    image = soft_picture(side).to(loss.network.device)
    style, view = loss.style_targets(image.flip(0), (side, side)), loss.view_target(image)
    vectors = style[0].vectors
    if vectors is not None:  # the search time depends on their number and is measured separately
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
    """Return the seconds per pair of position and style vector in the nearest-neighbor search."""
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
    """Count and time blend weights on a few evenly spread views. `budget` is the memory for cached weights in bytes."""
    scene, rasterizer = planning_context.scene, planning_context.rasterizer
    sample = spread(cameras, SAMPLED_VIEWS)
    count, middle = len(sample), len(sample) // 2
    if isinstance(rasterizer, CpuRasterizer):
        _raster_seconds(CpuRasterizer(scene.subset(torch.arange(1))), 1, sample[0])  # compiles the kernels
        seconds = []
        for camera in sample:
            rasterizer.intersections(camera)  # reuses those of the survey if it cached them
            seconds += _raster_seconds(rasterizer, len(scene), camera)
        more, intersection_bytes = _intersections_cost(scene, sample, planning_context.settings.near)
    else:
        timed = [_raster_seconds(rasterizer, len(scene), camera, visits=2) for camera in sample]
        seconds = [later for _, later in timed]
        # Minimum, because one of them may include compilation or waiting for memory.
        more, intersection_bytes = max(min(first - later for first, later in timed), 0.0), 0
    mean = sum(seconds) / count
    known: dict[str, Any] = {
        "first_seconds": more,
        "intersection_bytes": intersection_bytes,
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
    if isinstance(uncached, TritonRasterizer):  # known on the CPU: see `choices.LEAST_VISITS`
        keeping = _keeping_seconds(cached, sample[middle], fitting[0])
    cached = CachedRasterizer(scene, precision=fitting[0], uncached=uncached)
    kept = _raster_seconds(cached, len(scene), sample[middle], visits=2)[1]
    # Scaled to the mean view, like the seconds that it is compared with.
    return RasterCost(mean, kept * mean / seconds[middle], total, half, keeping, **known)


def _comes_too_seldom(settings: Settings, views: int) -> bool:
    """Return whether views are visited too few times for caching to pay off on a CPU, and it was not requested."""
    visits = (settings.steps_coarse + settings.steps_sos) * settings.views_per_step / views
    return settings.cached_weights == "auto" and visits < LEAST_VISITS


def _intersections_cost(scene: Scene, cameras: Sequence[Camera], near: float) -> tuple[float, int]:
    """Return the time in seconds and the size in bytes of recomputed tile intersections, mean over some views."""
    seconds, size, shapes = 0.0, 0, Shapes.of(scene)
    for camera in cameras:
        started = time.perf_counter()
        size += build_tile_intersections(scene, camera, near=near, shapes=shapes).nbytes
        seconds += time.perf_counter() - started
    return seconds / len(cameras), size // len(cameras)


def _colors_seconds(scene: Scene, camera: Camera, device: torch.device) -> float:
    """Return the time in seconds of a view's SH colors on the second run; the first one compiles."""
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
    """Return the time in seconds to compute a view's cached weights on the second run; the first one compiles."""
    seconds = 0.0
    for _ in range(2):
        started = time.perf_counter()
        cached.count(camera).keep(form)
        wait_for(cached.device)
        seconds = time.perf_counter() - started
    return seconds


def _raster_seconds(rasterizer: Rasterizer, gaussians: int, camera: Camera, visits: int = 1) -> list[float]:
    """Return the time in seconds of each of several renders with gradient.

    The first one includes the time to prepare the view, unless it is already prepared.
    """
    colors = torch.full((gaussians, 3), 0.5, device=rasterizer.device)
    seconds = []
    for _ in range(visits):
        started = time.perf_counter()
        rasterizer.color_gradient(rasterizer.render(colors, camera), camera)
        wait_for(rasterizer.device)
        seconds.append(time.perf_counter() - started)
    return seconds
