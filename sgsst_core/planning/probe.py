"""Measurements before planning, on the rasterizer and the device that will do the work.

The result is a `Probe`: plain facts, from which `decide` makes a plan.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import psutil
import torch
from torch import Tensor

from sgsst_core.budget import memory_for
from sgsst_core.constants import RASTER_TILE
from sgsst_core.features.vgg import ALIGNMENT, CONTENT_LAYER, FeatureNetwork
from sgsst_core.loss.gradient_error import Difference
from sgsst_core.loss.graphs import LossGraphs, graphs_problem
from sgsst_core.loss.nearest import nearest_layers, search
from sgsst_core.loss.sos import SosLoss, SosResult, make_loss
from sgsst_core.parallel.collectives import Collectives
from sgsst_core.parallel.division import Size
from sgsst_core.planning.choices import rendered_gaussians
from sgsst_core.planning.context import PlanningContext
from sgsst_core.planning.facts import (
    LEAST_VISITS,
    LaunchCost,
    Link,
    NetworkFacts,
    Probe,
    RasterCost,
    Rate,
    SceneFacts,
)
from sgsst_core.planning.plan import Device
from sgsst_core.planning.survey import Survey
from sgsst_core.rasterizer import Rasterizer
from sgsst_core.rasterizer.base import Precision as WeightPrecision
from sgsst_core.rasterizer.cached import CachedRasterizer
from sgsst_core.scene.camera import Camera, spread
from sgsst_core.scene.gaussians import Scene
from sgsst_core.scene.pyramid import downscale
from sgsst_core.scene.spherical_harmonics import harmonics_energy, rest_colors, scene_colors
from sgsst_core.scene.stored_harmonics import StoredHarmonics
from sgsst_core.settings import Settings
from sgsst_core.style import Style
from sgsst_core.timing import Timer, wait_for

#: Maximum side of the image for timing the network: large enough for the rate of a partition tile. A GPU needs more
#: work before launch times become negligible: in bfloat16, a step was overestimated 2.4 times with 1024 pixels on an
#: H100, and 1.4 times with 2048 pixels on an H200.
PROBE_SIDE: dict[Device, int] = {"cpu": 384, "cuda": 2048}
#: Minimum visits per view size for which a CUDA graph of the loss is considered at all.
LEAST_GRAPH_VISITS = 20
#: Number of views whose blend weights are counted and timed, as representatives of all.
SAMPLED_VIEWS = 3

#: Number of synthetic vectors compared with each other to time the nearest-neighbor search.
SEARCHED = {"cpu": 1 << 11, "cuda": 1 << 14}
#: Number of runs of the network, of which the fastest counts.
_RATE_RUNS = 2
#: Precisions of cached blend weights, the exact one first.
_FORMATS: tuple[WeightPrecision, ...] = ("float32", "half")
#: Number of runs of a view's loss, of which the fastest counts, because other activity on the machine can only slow
#: launches down.
LAUNCH_RUNS = 3
#: Bytes sent to time a link between CPUs and between GPUs: enough to saturate it, and no more than the images of a few
#: views.
_PROBE_BYTES = {"cpu": 4 << 20, "cuda": 64 << 20}


def measure(context: PlanningContext, survey: Survey, link: Link, maps: int = 0) -> Probe:
    """Measure everything that decisions depend on.

    One rank does this for all, because timings differ between ranks.

    Args:
        context: Objects to measure with.
        survey: Survey of the views.
        link: Connection between ranks.
        maps: Number of regions whose maps are rendered in each view.
    """
    scene, device = context.scene, context.network.device
    views = [context.cameras[index] for index in survey.covered]
    sizes = tuple((camera.height, camera.width) for camera in context.cameras)
    return Probe(
        SceneFacts(
            len(scene),
            context.sh_degree,
            used_degree=scene.used_degree(rendered_gaussians(survey)),
            held_degree=0 if isinstance(scene.sh_rest, StoredHarmonics) else scene.sh_degree,
            harmonics_energy=harmonics_energy(scene, survey.total_blend_weights),
        ),
        sizes,
        survey,
        _network_facts(context, views[0], maps),
        context.rasterizer.name,
        launches=_launch_cost(context, views),
        raster=_raster_cost(context, views),
        machine=context.machine,
        link=link,
        process_bytes=psutil.Process().memory_info().rss,
        device_bytes=torch.cuda.memory_allocated(device) if context.machine.device == "cuda" else 0,
        maps=maps,
    )


# --- the feature network -------------------------------------------------------------------------------------------


def _network_facts(context: PlanningContext, first: Camera, maps: int) -> NetworkFacts:
    """Benchmark the network on synthetic images; if it is not float32, measure its gradient error on the first view."""
    network, settings, loss = context.network, context.settings, _loss(context)
    side = min(_side(context, loss), max(max(camera.width, camera.height) for camera in context.cameras))
    rate, fixed = measure_rate(loss, side, maps), Rate(0.0, 0.0, 0.0)
    if context.machine.ranks > 1 or context.machine.device == "cuda":
        fixed = measure_rate(loss, ALIGNMENT, maps).times(ALIGNMENT**2)
    return NetworkFacts(
        network.halo,
        network.held_bytes_per_pixel(),
        network.working_bytes_per_pixel(),
        network.channels(CONTENT_LAYER) * torch.finfo(network.dtype).bits // 8 if settings.content_weight else 0,
        rate,
        fixed,
        context.precision_ratio,
        gradient_error(context, first, side),
        sum(network.channels(layer) for layer in nearest_layers(settings.style_loss, network.name)),
        max(network.layers),
        network.largest_tile,
    )


def _loss(context: PlanningContext, scales: tuple[float, ...] = ()) -> SosLoss:
    """Return the loss of a single rank on synthetic images, with weights of the scales; empty for equal weights."""
    settings = context.settings.model_copy(update={"style_scale": 1.0, "scales": scales})
    return make_loss(context.network, settings, memory_for("activations", context.machine.memory))


def _side(context: PlanningContext, loss: SosLoss) -> int:
    """Return the maximum side of images for measuring; on a GPU, their activations must fit in memory."""
    device, network = context.machine.device, loss.network
    if device == "cpu":
        return PROBE_SIDE[device]
    fits = math.isqrt(int(loss.memory / (network.held_bytes_per_pixel() + network.working_bytes_per_pixel())))
    return max(min(PROBE_SIDE[device], fits), ALIGNMENT)


def measure_rate(loss: SosLoss, side: int, maps: int = 0) -> Rate:
    """Time the feature network on a small synthetic image.

    The first run is a warm-up, and the fastest of the others counts, because disturbances are not a property of the
    network.

    Args:
        loss: Loss with the network.
        side: Side of the square image in pixels.
        maps: Number of regions that have statistics of their own; 0 for none.
    """
    image = soft_image(side).to(loss.network.device)
    style, view = loss.targets.of_style(Style.of(image.flip(0)), (side, side)), loss.targets.of_view(image)
    target = style[0][0]
    vectors = target.vectors
    if vectors is not None:  # the search time depends on their number and is measured separately
        target = replace(target, vectors=replace(vectors, units=vectors.units[:1]))
    if maps:
        fraction = torch.full((side, side), 1 / maps, device=loss.network.device)
        view.regions = [loss.targets.position_weights(fraction)] * maps
    style = {0: (target,) * max(maps, 1)}

    def seconds(gradient: bool) -> float:
        return _seconds_of(loss, lambda: loss.evaluate(image, style, view, [0], gradient=gradient)) / side**2

    seconds(True)
    both = min(seconds(True) for _ in range(_RATE_RUNS))
    forward = min(seconds(False) for _ in range(_RATE_RUNS))
    features = min(_seconds_of(loss, lambda: loss.network.forward(image, cache=False)) for _ in range(_RATE_RUNS))
    return Rate(features / side**2, forward, both, 0.0 if vectors is None else _search_seconds(vectors.units))


def _search_seconds(units: Tensor) -> float:
    """Return the seconds per pair of position and style vector in the nearest-neighbor search."""
    size = SEARCHED[units.device.type]
    vectors = torch.rand((size, units.shape[1]), generator=torch.Generator().manual_seed(0)).to(units)

    def seconds() -> float:
        timer = Timer(units.device)
        with timer("search"):
            search(vectors, vectors)
        return timer.read()["search"] / size**2

    seconds()
    return min(seconds() for _ in range(_RATE_RUNS))


def gradient_error(context: PlanningContext, camera: Camera, side: int) -> Difference | None:
    """Compare the pixel gradient of a view with that of the same network in full float32, for a synthetic style.

    Args:
        context: Objects to measure with.
        camera: View, which is rendered unstylized and then downscaled.
        side: Maximum longer side of the downscaled view in pixels.

    Returns:
        Difference of the gradients; None if the network runs in float32.
    """
    network, rasterizer = context.network, context.rasterizer
    if network.precision == "float32":
        return None
    colors = scene_colors(context.scene, camera)
    image = rasterizer.render(colors.to(rasterizer.device), camera).to(network.device)
    longer, shorter = max(image.shape[:2]), min(image.shape[:2])
    image = downscale(image, min(max(0, math.ceil(math.log2(longer / side))), shorter.bit_length() - 1))
    reference = FeatureNetwork(context.weights, network.layers, torch.float32, network.device)
    memory, gradients = memory_for("activations", context.machine.memory), []
    for each in (network, reference):
        loss = SosLoss(each, content_weight=0, style_loss=context.settings.style_loss, memory=memory)
        style = loss.targets.of_style(Style.of(soft_image(max(image.shape[:2]))), (image.shape[0], image.shape[1]))
        result = loss.evaluate(image, style, loss.targets.of_view(image), [0])
        assert result.image_gradient is not None
        gradients.append(result.image_gradient)
    return Difference.of(*gradients)


def _launch_cost(context: PlanningContext, views: Sequence[Camera]) -> LaunchCost | None:
    """Measure the first view on a GPU, if views of one size are visited often enough to consider graphs."""
    settings, sizes = context.settings, {(camera.height, camera.width) for camera in views}
    visits = (settings.steps_coarse + settings.steps_sos) * settings.views_per_step / len(sizes)
    if context.machine.device == "cpu" or visits < LEAST_GRAPH_VISITS:
        return None
    try:
        return launch_cost(_loss(context, settings.scales), (views[0].height, views[0].width))
    except torch.OutOfMemoryError:
        return LaunchCost(problem="the GPU's memory was not enough to evaluate the first view")


def launch_cost(loss: SosLoss, size: Size) -> LaunchCost:
    """Time the loss of a synthetic view of size (height, width), with its gradient, with and without a graph."""
    problem = graphs_problem(loss.network.device)
    if problem is not None:
        return LaunchCost(problem=problem)
    image = soft_image(max(size))[: size[0], : size[1]].contiguous().to(loss.network.device)
    style, view = loss.targets.of_style(Style.of(image.flip(0)), size), loss.targets.of_view(image)
    scales = loss.tiling.scales(size)
    graphs = LossGraphs(loss)

    def evaluate() -> SosResult:
        return graphs.evaluate(image, style, view, scales)

    evaluate()  # eager first run: warms up the kernels
    seconds = min(_seconds_of(loss, lambda: loss.evaluate(image, style, view, scales)) for _ in range(LAUNCH_RUNS))
    first = _seconds_of(loss, evaluate)
    if graphs.problem is not None:
        return LaunchCost(problem=graphs.problem)
    if not graphs.captured:
        return LaunchCost(problem="a view's activations do not fit the memory twice")
    replayed = min(_seconds_of(loss, evaluate) for _ in range(LAUNCH_RUNS))
    return LaunchCost(seconds, replayed, max(first - replayed, 0.0))


def _seconds_of(loss: SosLoss, evaluate: Callable[[], object]) -> float:
    """Return the time in seconds of an evaluation on the loss's device."""
    timer = Timer(loss.network.device)
    with timer("evaluation"):
        evaluate()
    return timer.read()["evaluation"]


def soft_image(side: int) -> Tensor:
    """Return a smooth synthetic image [side, side, 3] in 0..1: fixed random colors 16 pixels apart, interpolated."""
    cells = torch.rand((1, 3, side // 16 + 1, side // 16 + 1), generator=torch.Generator().manual_seed(0))
    image = torch.nn.functional.interpolate(cells, size=(side, side), mode="bilinear")[0]
    return image.permute(1, 2, 0).contiguous()


# --- the rasterizer ------------------------------------------------------------------------------------------------


def _raster_cost(context: PlanningContext, cameras: Sequence[Camera]) -> RasterCost:
    """Count and time blend weights on a few evenly spread views."""
    scene, rasterizer, settings = context.scene, context.rasterizer, context.settings
    budget = memory_for("rasterizer", context.machine.memory)
    sample = spread(cameras, SAMPLED_VIEWS)
    count, middle = len(sample), len(sample) // 2
    cost = rasterizer.probe_cost(sample)
    mean = sum(cost.seconds) / count
    known: dict[str, Any] = {
        "first_seconds": cost.preparation_seconds,
        "intersection_bytes": cost.preparation_bytes,
        "max_pairs": cost.max_pairs,
        "colors_seconds": _colors_seconds(scene, sample[middle], rasterizer.device),
    }
    if context.machine.ranks > 1:
        tile = rasterizer.probe_cost([_central_tile(sample[middle])])
        known |= {
            "fixed": min(*tile.seconds, mean),
            "first_fixed": min(tile.preparation_seconds, cost.preparation_seconds),
        }
    if not rasterizer.can_cache:
        return RasterCost(mean, **known)
    if not rasterizer.on_gpu and _is_too_rare(settings, len(cameras)):
        counted = rasterizer.count_weights(sample[middle])
        total, half = (counted.nbytes(format_) * len(cameras) for format_ in _FORMATS)
        return RasterCost(mean, None, total, half, **known)
    sizes = [[counted.nbytes(format_) for format_ in _FORMATS] for counted in map(rasterizer.count_weights, sample)]
    total, half = (sum(column) * len(cameras) // count for column in zip(*sizes, strict=True))
    fitting = [format_ for format_, size in zip(_FORMATS, sizes[middle], strict=True) if size <= budget]
    if not fitting:
        return RasterCost(mean, None, total, half, **known)
    caching = None
    if rasterizer.on_gpu:  # known on the CPU: see `LEAST_VISITS`
        caching = _caching_seconds(rasterizer, sample[middle], fitting[0])
    cached = CachedRasterizer(scene, precision=fitting[0], uncached=rasterizer)
    reused = cached.step_seconds(sample[middle], visits=2)[1]
    # Scaled to the mean view, like the seconds that it is compared with.
    return RasterCost(mean, reused * mean / cost.seconds[middle], total, half, caching, **known)


def _central_tile(camera: Camera) -> Camera:
    """Return the camera of one raster tile in the middle of a view."""
    top, left = camera.height // 2 // RASTER_TILE * RASTER_TILE, camera.width // 2 // RASTER_TILE * RASTER_TILE
    return camera.cropped(top, left, min(top + RASTER_TILE, camera.height), min(left + RASTER_TILE, camera.width))


def _is_too_rare(settings: Settings, views: int) -> bool:
    """Return whether views are visited too few times for caching to pay off on a CPU, and it was not requested."""
    visits = (settings.steps_coarse + settings.steps_sos) * settings.views_per_step / views
    return settings.cached_weights == "auto" and visits < LEAST_VISITS


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


def _caching_seconds(rasterizer: Rasterizer, camera: Camera, format_: WeightPrecision) -> float:
    """Return the time in seconds to compute a view's cached weights on the second run; the first one compiles."""
    seconds = 0.0
    for _ in range(2):
        started = time.perf_counter()
        rasterizer.count_weights(camera).store(format_)
        wait_for(rasterizer.device)
        seconds = time.perf_counter() - started
    return seconds


# --- the link between ranks ---------------------------------------------------------------------------------------


def probe_link(collectives: Collectives, device: torch.device) -> Link:
    """Time all-reduces over all ranks; the result is identical on all ranks.

    If there is only one rank, the link is infinitely fast.
    """
    if collectives.size == 1:
        return Link(math.inf, 0.0)
    largest = _PROBE_BYTES[device.type]
    short, long = (_slowest_sum(collectives, device, size) for size in (8, largest))
    steps = 2 * (collectives.size - 1)
    moved = steps * largest / collectives.size
    return Link(moved / max(long - short, 1e-9), short / steps)


def _slowest_sum(collectives: Collectives, device: torch.device, size: int) -> float:
    """Return the time in seconds of an all-reduce of this many bytes on the slowest rank.

    The last of three runs counts.
    """
    tensor = torch.zeros(size // 4, device=device)
    seconds = 0.0
    for _ in range(3):  # the first run opens the connections
        wait_for(device)
        collectives.all_gather(None)
        started = time.perf_counter()
        collectives.all_reduce(tensor)
        wait_for(device)
        seconds = time.perf_counter() - started
    return max(collectives.all_gather(seconds))
