"""Facts about scene, views, network and machine on which the decisions of a plan depend, apart from the settings."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from torch import Tensor

from sgsst_core.loss.gradient_error import Difference
from sgsst_core.loss.graphs import FIRST_VISITS
from sgsst_core.parallel.division import Size
from sgsst_core.planning.plan import Device
from sgsst_core.planning.survey import Survey

#: Minimum visits of a view for which caching its blend weights pays off on a CPU. Computing them takes as long as about
#: three renders with gradient, and each use saves two thirds of a render. On GPUs, both times are measured
#: (`RasterCost.least_visits`).
LEAST_VISITS = 5
#: Minimum fraction of the time of a view's loss that a CUDA graph must save to be worth its memory.
LEAST_SAVING = 0.03


@dataclass(frozen=True)
class SceneFacts:
    """Facts about the scene.

    Attributes:
        gaussians: Number N of Gaussians.
        sh_degree: SH degree of its file.
        used_degree: Highest SH degree with a non-zero coefficient after SH attenuation, among the rendered Gaussians.
        held_degree: SH degree in memory; 0 if coefficients stay in the file.
        harmonics_energy: See `spherical_harmonics.harmonics_energy`, with the views' blend weights.
    """

    gaussians: int
    sh_degree: int
    used_degree: int
    held_degree: int
    harmonics_energy: float = 0.0


@dataclass(frozen=True)
class Rate:
    """Seconds per pixel of the loss of an image, or per partition tile.

    Attributes:
        features: Seconds of the feature network's forward pass alone.
        forward: Seconds of the loss, which includes statistics.
        both: Seconds of the loss and its gradient.
        search: Seconds per pair of position and style vector in the nearest-neighbor search; 0 if features are not
            matched.
    """

    features: float
    forward: float
    both: float
    search: float = 0.0

    def times(self, pixels: int) -> Rate:
        """Return the time of a number of pixels."""
        return Rate(pixels * self.features, pixels * self.forward, pixels * self.both, self.search)


@dataclass(frozen=True)
class NetworkFacts:
    """Facts about the feature network, in the precision in which it will run.

    Attributes:
        halo: Pixels around a partition tile.
        held_bytes: Bytes per pixel stored by a forward pass for the backward pass.
        working_bytes: Additional bytes per pixel needed by a pass.
        content_bytes: Bytes per cell of the content layer.
        rate: Time per pixel.
        fixed: Constant time of a partition tile, measured on one with almost no pixels. On a GPU, it is the time to
            launch its kernels. Not measured, and 0, for a single rank on a CPU.
        precision_ratio: Ratio of a convolution's time in float32 to that in the requested precision, or in bfloat16 if
            float32 was requested; None if it is unavailable.
        gradient_error: Error of a view's pixel gradient relative to float32; None if the network runs in float32.
        vector_channels: Length of a vector that is matched with the style's; 0 if nothing is matched.
        deepest: Name of the deepest layer in use.
        largest_tile: Maximum pixels of a partition tile; None for no limit.
    """

    halo: int
    held_bytes: float
    working_bytes: float
    content_bytes: int
    rate: Rate
    fixed: Rate = Rate(0.0, 0.0, 0.0)
    precision_ratio: float | None = None
    gradient_error: Difference | None = None
    vector_channels: int = 0
    deepest: str = "relu5_1"
    largest_tile: int | None = None


@dataclass(frozen=True)
class RasterCost:
    """Cost of the views' blend weights.

    Attributes:
        seconds: Time in seconds of a render and its gradient with recomputed weights, mean over some views.
        cached_seconds: Time in seconds of a render and its gradient with cached weights; None if not measured, for
            example because not even one view's weights fit in memory.
        bytes: Size in bytes of the cached weights of all views, float32; None if the rasterizer cannot cache them.
        half_bytes: Size in bytes of the cached weights of all views in half precision; None as for `bytes`.
        caching_seconds: Time in seconds to compute a view's cached weights; None on the CPU, where it is not measured.
        first_seconds: Additional time in seconds of a view's first render, which computes its tile intersections.
        intersection_bytes: Mean size in bytes of a view's tile intersections; 0 if unknown.
        max_pairs: Largest number of pairs of Gaussian and raster tile that a GPU sorts for a view; 0 if unknown.
        colors_seconds: Time in seconds for the contribution of spherical harmonics to the colors of a view.
        fixed: Portion of `seconds` that does not depend on the number of pixels. It is measured on a single raster tile
            if there are several ranks, each of which renders a part of a view; 0 otherwise.
        first_fixed: Such a portion of `first_seconds`.
    """

    seconds: float
    cached_seconds: float | None = None
    bytes: int | None = None
    half_bytes: int | None = None
    caching_seconds: float | None = None
    first_seconds: float = 0.0
    intersection_bytes: int = 0
    max_pairs: int = 0
    colors_seconds: float = 0.0
    fixed: float = 0.0
    first_fixed: float = 0.0

    @property
    def least_visits(self) -> float | None:
        """Minimum visits of a view for which cached weights save time; None if they never do, or if not measured."""
        if self.cached_seconds is None or self.caching_seconds is None or self.cached_seconds >= self.seconds:
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
class Link:
    """Connection between ranks.

    Attributes:
        bandwidth: Bytes per second that a rank sends while receiving as many.
        latency: Time in seconds of the shortest message from one rank to the next.
    """

    bandwidth: float
    latency: float

    def all_gather(self, size: int, ranks: int) -> float:
        """Return the time in seconds of an all-gather of `size` bytes in total; a reduce-scatter takes as long."""
        return (ranks - 1) * (self.latency + size / ranks / self.bandwidth)

    def all_reduce(self, size: int, ranks: int) -> float:
        """Return the time in seconds of an all-reduce of `size` bytes per rank."""
        return 2 * self.all_gather(size, ranks)


@dataclass(frozen=True)
class Probe:
    """All facts from which decisions follow, apart from the settings.

    Attributes:
        scene: Facts about the scene.
        sizes: (height, width) of each view.
        survey: Survey of the views.
        network: Facts about the feature network.
        rasterizer: Timed rasterizer, which computes blend weights.
        raster: Cost of rendering with recomputed and with cached weights.
        machine: Facts about the machine.
        link: Connection between ranks.
        process_bytes: Physical memory of the process in bytes, with scene and network loaded.
        device_bytes: GPU memory in bytes, with scene and network loaded; 0 on a CPU.
        launches: Cost of launching a view's loss on a GPU; None on a CPU, or if no decision depends on it.
        styles: Number of images in the style mixture.
        style_bytes: Size of the largest style image in bytes, which is copied while it is resized.
        frozen: [N] bool, frozen Gaussians; None if there are none.
        maps: Number of maps of regions, and of content weights, that are rendered in each view.
    """

    scene: SceneFacts
    sizes: tuple[Size, ...]
    survey: Survey
    network: NetworkFacts
    rasterizer: str
    raster: RasterCost
    machine: Machine
    link: Link
    process_bytes: int
    device_bytes: int = 0
    launches: LaunchCost | None = None
    styles: int = 1
    style_bytes: int = 0
    frozen: Tensor | None = None
    maps: int = 0
