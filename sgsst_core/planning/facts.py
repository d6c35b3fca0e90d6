"""Facts about scene, views, network and machine on which the decisions of a plan depend, apart from the settings."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from torch import Tensor

from sgsst_core.features.partition import Rectangle, computed_twice, scaled_region
from sgsst_core.loss.gradient_error import Difference
from sgsst_core.loss.graphs import FIRST_VISITS
from sgsst_core.loss.tiling import Tiling
from sgsst_core.parallel.division import Size
from sgsst_core.planning.plan import Device
from sgsst_core.planning.survey import Survey
from sgsst_core.rasterizer import Rasterizer
from sgsst_core.rasterizer.base import Precision as WeightPrecision
from sgsst_core.rasterizer.cached import CachedRasterizer
from sgsst_core.scene.camera import Camera, spread
from sgsst_core.settings import Settings
from sgsst_core.timing import wait_for

#: Precisions of cached blend weights, the exact one first, and number of views whose weights are counted.
_FORMATS: tuple[WeightPrecision, ...] = ("float32", "half")
_SAMPLED_VIEWS = 3
#: Minimum fraction of the time of a view's loss that a CUDA graph must save to be worth its memory.
LEAST_SAVING = 0.03


@dataclass(frozen=True)
class WeightCost:
    """Cost of caching the views' blend weights. Times are measured on a GPU only.

    Attributes:
        bytes: Size in bytes of the cached weights of all views, float32; None if the rasterizer cannot cache them.
        half_bytes: Size in bytes of the cached weights of all views in half precision; None as for `bytes`.
        seconds: Time in seconds of a view's render and gradient with recomputed weights.
        cached_seconds: Time in seconds of a view's render and gradient with cached weights; None if the weights of a
            view do not fit in memory.
        caching_seconds: Time in seconds to compute a view's cached weights.
    """

    bytes: int | None = None
    half_bytes: int | None = None
    seconds: float = 0.0
    cached_seconds: float | None = None
    caching_seconds: float = 0.0

    @property
    def least_visits(self) -> float | None:
        """Minimum visits of a view for which cached weights save time; None if they never do, or if not measured."""
        if self.cached_seconds is None or self.cached_seconds >= self.seconds:
            return None
        return self.caching_seconds / (self.seconds - self.cached_seconds)


@dataclass(frozen=True)
class LaunchCost:
    """Time for a view's loss and its gradient, with and without a CUDA graph.

    Attributes:
        seconds: Seconds with kernels launched one by one.
        replayed: Seconds as a graph.
        capture: Seconds to capture the graph, once.
        problem: Reason why a graph cannot be used and nothing was measured; None if it can.
    """

    seconds: float = 0.0
    replayed: float = 0.0
    capture: float = 0.0
    problem: str | None = None

    @property
    def saved(self) -> float:
        """Seconds that a graph saves per visit; 0 if too few to matter."""
        saved = self.seconds - self.replayed
        return saved if self.problem is None and saved > LEAST_SAVING * self.seconds else 0.0

    @property
    def least_visits(self) -> float | None:
        """Minimum visits of views that share a graph for which it saves time; None if it never does."""
        return FIRST_VISITS + self.capture / self.saved if self.saved else None


@dataclass(frozen=True)
class Machine:
    """Facts about the machine and its ranks.

    Attributes:
        device: Device of the feature network.
        memory_limit: Memory budget in bytes of all ranks on one machine together, or on one GPU.
        sharing: Maximum number of ranks that share one machine's memory, or that of a GPU.
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
class Facts:
    """All facts from which the decisions before the trial follow, apart from the settings.

    Attributes:
        gaussians: Number N of Gaussians.
        sh_degree: SH degree of the scene's file.
        used_degree: Highest SH degree with a non-zero coefficient after SH attenuation, among the rendered Gaussians.
        harmonics_energy: See `spherical_harmonics.harmonics_energy`, with the views' blend weights.
        sizes: (height, width) of each view.
        survey: Survey of the views.
        machine: Facts about the machine.
        rasterizer: Rasterizer that computes blend weights.
        weights: Cost of cached blend weights.
        frozen: [N] bool, frozen Gaussians; None if there are none.
        deepest: Name of the deepest layer in use.
        precision_ratio: Ratio of a convolution's time in float32 to that in the requested precision, or in bfloat16 if
            float32 was requested; None if it is unavailable.
        gradient_error: Error of a view's pixel gradient relative to float32; None if the network runs in float32.
    """

    gaussians: int
    sh_degree: int
    used_degree: int
    harmonics_energy: float
    sizes: tuple[Size, ...]
    survey: Survey
    machine: Machine
    rasterizer: str
    weights: WeightCost
    frozen: Tensor | None = None
    deepest: str = "relu5_1"
    precision_ratio: float | None = None
    gradient_error: Difference | None = None


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
    def of(views: Sequence[tuple[Size, Rectangle | None]], tiling: Tiling) -> NetworkPixels:
        """Count the pixels of views of some sizes (height, width), of which only a rectangle may be covered."""
        pixels = again = without = held = 0.0
        tiles = 0
        for size, region in views:
            for scale in tiling.scales(size):
                scaled = (size[0] >> scale, size[1] >> scale)
                areas = _areas(tiling, scaled, region and scaled_region(region, scale, scaled))
                flags = tiling.cached(areas)
                twice = computed_twice(areas, flags)
                pixels, again, tiles = pixels + sum(areas), again + twice, max(tiles, len(areas))
                without += sum(_areas(tiling, scaled))
                once = max((area for area, flag in zip(areas, flags, strict=True) if not flag), default=0)
                passing = sum(areas) - twice + tiling.working * max(areas, default=0)
                held = max(held, passing, (1 + tiling.working) * once)
        return NetworkPixels(pixels / len(views), again / len(views), without / len(views), tiles, held)


def _areas(tiling: Tiling, size: Size, region: Rectangle | None = None) -> list[int]:
    """Return the pixels of each partition tile, with its halo, of a scaled view."""
    return [tile.outer.pixels for tile in tiling.tiles(size, region)]


def weight_cost(
    rasterizer: Rasterizer, cameras: Sequence[Camera], settings: Settings, budget: int, least_visits: float
) -> WeightCost:
    """Count the blend weights of a few evenly spread views; on a GPU, also time a view with and without cached weights.

    Args:
        rasterizer: Rasterizer that computes the weights.
        cameras: Cameras of the views that see anything.
        settings: Settings of the job.
        budget: Memory budget for blend weights in bytes.
        least_visits: Visits of a view below which weights are not cached on a CPU, so that one view is enough.
    """
    if not rasterizer.can_cache:
        return WeightCost()
    sample = spread(cameras, _SAMPLED_VIEWS)
    middle = sample[len(sample) // 2]
    visits = (settings.steps_coarse + settings.steps_sos) * settings.views_per_step / len(cameras)
    if not rasterizer.on_gpu and settings.cached_weights == "auto" and visits < least_visits:
        sample = [middle]
    sizes = [[counted.nbytes(format_) for format_ in _FORMATS] for counted in map(rasterizer.count_weights, sample)]
    total, half = (sum(column) * len(cameras) // len(sample) for column in zip(*sizes, strict=True))
    fitting = [format_ for format_, size in zip(_FORMATS, sizes[len(sample) // 2], strict=True) if size <= budget]
    if not rasterizer.on_gpu or not fitting:
        return WeightCost(total, half)
    caching = 0.0
    for _ in range(2):  # the first run compiles
        started = time.perf_counter()
        rasterizer.count_weights(middle).store(fitting[0])
        wait_for(rasterizer.device)
        caching = time.perf_counter() - started
    cached = CachedRasterizer(rasterizer.scene, precision=fitting[0], uncached=rasterizer)
    recomputed, applied = (each.step_seconds(middle, visits=2)[1] for each in (rasterizer, cached))
    return WeightCost(total, half, recomputed, applied, caching)
