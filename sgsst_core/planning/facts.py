"""Facts about machine, scene, views and network that a plan depends on. No clock is read to find them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal

import torch
from torch import Tensor

from sgsst_core.budget import default_memory_limit, memory_for
from sgsst_core.errors import SettingsError
from sgsst_core.features.network_weights import BackboneWeights
from sgsst_core.features.partition import computed_twice, scaled_region
from sgsst_core.features.vgg import (
    FeatureNetwork,
    has_bfloat16,
    has_matrix_units,
    has_tf32,
    use_whole_float32,
)
from sgsst_core.loss.graphs import can_use_graphs
from sgsst_core.loss.terms import layers_of
from sgsst_core.parallel import Collectives, Size, Tiling
from sgsst_core.planning.survey import Survey
from sgsst_core.rasterizer import Rasterizer, drawing_problem, make_rasterizer, rasterizer_for
from sgsst_core.rasterizer.base import Precision as WeightPrecision
from sgsst_core.rasterizer.triton import TritonRasterizer
from sgsst_core.scales import ScaleWeights, scale_count
from sgsst_core.scene.camera import Camera, spread
from sgsst_core.scene.gaussians import Scene
from sgsst_core.settings import PlannedPrecision, Settings

Device = Literal["cpu", "cuda"]

DTYPES: dict[PlannedPrecision, torch.dtype] = {
    "float32": torch.float32,
    "winograd": torch.float32,
    "tf32": torch.float32,
    "bfloat16": torch.bfloat16,
    "float16": torch.float16,
}
#: Precisions of cached blend weights, the exact one first, and number of views whose weights are counted.
_FORMATS: tuple[WeightPrecision, ...] = ("float32", "half")
_SAMPLED_VIEWS = 3


@dataclass(frozen=True)
class Machine:
    """Description of the machine and its ranks.

    Attributes:
        device: Device of the feature network.
        memory_limit: Memory budget in bytes of all ranks on one machine together, or on one GPU.
        sharing: Maximum number of ranks that share one machine's memory, or that of a GPU.
        precisions: Precisions other than float32 that the processors of all ranks compute without emulation.
        graphs: Whether CUDA graphs can be used: on NVIDIA GPUs, with a PyTorch that survives a failed capture.
        problems: Reason by name for each GPU rasterizer that does not work; empty on the CPU.
    """

    device: Device
    memory_limit: int
    sharing: int = 1
    ranks: int = 1
    precisions: tuple[PlannedPrecision, ...] = ()
    graphs: bool = False
    problems: Mapping[str, str] = field(default_factory=dict)

    @property
    def memory(self) -> int:
        """Memory budget of one rank in bytes."""
        return self.memory_limit // self.sharing


@dataclass(frozen=True)
class Facts:
    """All facts that a plan follows from, apart from the settings.

    Attributes:
        gaussians: Number N of Gaussians.
        sh_degree: SH degree of the scene's file.
        used_degree: Highest SH degree with a non-zero coefficient after SH attenuation, among the rendered Gaussians.
        harmonics_energy: See `spherical_harmonics.harmonics_energy`, with the views' blend weights.
        sizes: (height, width) of each view.
        rasterizer: Rasterizer that computes blend weights.
        precision: Precision of the network (`plan.choose_precision`).
        tiling: Partition of views that the network's activations need.
        pixel_bytes: Bytes of the network's activations per pixel.
        weight_bytes: Bytes of the blend weights of all views in float32 and in half precision; None if the rasterizer
            cannot cache them.
        intersection_bytes: Bytes of the tile intersections of all views.
        frozen: [N] bool, frozen Gaussians; None if there are none.
        deepest: Name of the deepest layer in use.
    """

    gaussians: int
    sh_degree: int
    used_degree: int
    harmonics_energy: float
    sizes: tuple[Size, ...]
    survey: Survey
    machine: Machine
    rasterizer: str
    precision: PlannedPrecision
    tiling: Tiling
    pixel_bytes: float
    weight_bytes: tuple[int, int] | None = None
    intersection_bytes: int = 0
    frozen: Tensor | None = None
    deepest: str = "relu5_1"


@dataclass(frozen=True)
class NetworkPixels:
    """Pixels through the network in one iteration on a single rank, mean over views.

    Attributes:
        all: Pixels through the forward and the backward pass, including halos.
        sampled: The same with the scales that a mean step of phase 2 evaluates (`Settings.scale_sampling`).
        coarse: The same with the coarsest scale alone.
        again: Pixels through a second forward pass, because their activations do not fit in memory.
        without_region: Value of `all` if uncovered pixels were processed too.
        tiles: Maximum number of tiles of a view at one scale.
        held: Maximum number of pixels in memory at a time, including the temporary memory of a pass in units of pixels.
    """

    all: float = 0.0
    sampled: float = 0.0
    coarse: float = 0.0
    again: float = 0.0
    without_region: float = 0.0
    tiles: int = 0
    held: float = 0.0

    @staticmethod
    def of(facts: Facts, settings: Settings, *, weighted: bool) -> NetworkPixels:
        """Count the pixels of the views that see anything."""
        total, sampled, coarse, again, without, held, tiles = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0
        tiling, views = facts.tiling, facts.survey.covered
        for index in views:
            size, passed = facts.sizes[index], list[int]()
            for scale in reversed(tiling.scales(size)):  # coarsest first
                own = (size[0] >> scale, size[1] >> scale)
                region = scaled_region(facts.survey.regions[index], scale, own) if weighted else None
                areas, whole = ([t.outer.pixels for t in tiling.tiles(own, each)] for each in (region, None))
                flags = tiling.cached(areas)
                twice, largest = computed_twice(areas, flags), max(areas, default=0)
                passed.append(sum(areas))
                again, without, tiles = again + twice, without + sum(whole), max(tiles, len(areas))
                once = max((area for area, flag in zip(areas, flags, strict=True) if not flag), default=0)
                held = max(held, sum(areas) - twice + tiling.working * largest, (1 + tiling.working) * once)
            total, coarse = total + sum(passed), coarse + passed[0]
            sampled += sum(own * float(settings.scale_sampling) ** -place for place, own in enumerate(passed))
        total, sampled, coarse, again, without = (
            each / len(views) for each in (total, sampled, coarse, again, without)
        )
        return NetworkPixels(total, sampled, coarse, again, without, tiles, held)


@dataclass(frozen=True)
class PlanningContext:
    """Objects that are created for planning, and that the job continues to use.

    Attributes:
        scene: Whole scene, with the SH attenuation of the settings applied.
        cameras: Cameras at the size used for stylization.
        rasterizer: Rasterizer of the whole scene that computes blend weights.
        sh_degree: SH degree of the original scene.
        networks: Networks created so far, by precision.
    """

    scene: Scene
    cameras: tuple[Camera, ...]
    settings: Settings
    machine: Machine
    weights: BackboneWeights
    rasterizer: Rasterizer
    sh_degree: int
    networks: dict[PlannedPrecision, FeatureNetwork] = field(default_factory=dict)

    def network(self, precision: PlannedPrecision = "float32") -> FeatureNetwork:
        """Return the feature network of the job in a precision, created at the first call."""
        if precision not in self.networks:
            self.networks[precision] = make_network(self.weights, self.settings, precision, self.machine.device)
        return self.networks[precision]


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
        rasterizer: Rasterizer that computes blend weights; None to choose one.
    """
    sh_degree, scene = scene.sh_degree, scene.attenuated(settings.sh_attenuation)
    machine = describe_machine(settings, collectives)
    name = rasterizer or rasterizer_for(machine.device, machine.problems)
    memory = memory_for("rasterizer", machine.memory)
    of_scene = make_rasterizer(name, scene, background=settings.background, near=settings.near, memory=memory)
    return PlanningContext(scene, tuple(cameras), settings, machine, weights, of_scene, sh_degree)


def describe_machine(settings: Settings, collectives: Collectives) -> Machine:
    """Describe what all ranks can use. Every rank must call this, and gets the same result."""
    device = common_device(collectives)
    # The partition, and thereby rounding, depends on the limit, so it must be identical on all ranks.
    limit = settings.memory_limit or default_memory_limit(torch.device(device))
    has: dict[PlannedPrecision, bool] = {
        "float16": has_tf32(device),
        "bfloat16": has_matrix_units() if device == "cpu" else has_bfloat16(device),
        "tf32": has_tf32(device),
        "winograd": device == "cpu",
    }
    everywhere = collectives.all_gather((limit, has, can_use_graphs(device)))
    return Machine(
        device,
        memory_limit=min(own for own, _, _ in everywhere),
        sharing=sharing_memory(collectives, device),
        ranks=collectives.size,
        precisions=tuple(name for name in has if all(own[name] for _, own, _ in everywhere)),
        graphs=all(own for _, _, own in everywhere),
        problems=gpu_problems(collectives) if device == "cuda" else {},
    )


def count_weights(rasterizer: Rasterizer, cameras: Sequence[Camera]) -> tuple[int, int] | None:
    """Return the bytes of the blend weights of all views in float32 and in half precision, from a few spread views.

    Args:
        cameras: Cameras of the views that see anything.

    Returns:
        The bytes; None if the rasterizer cannot cache blend weights.
    """
    if not rasterizer.can_cache:
        return None
    sample = spread(cameras, _SAMPLED_VIEWS)
    counted = [rasterizer.count_weights(camera) for camera in sample]
    whole, half = (sum(each.nbytes(form) for each in counted) * len(cameras) // len(sample) for form in _FORMATS)
    return whole, half


def count_intersections(rasterizer: Rasterizer, views: int) -> int:
    """Return the bytes of the tile intersections of all views, from those that the survey has computed."""
    cache = rasterizer.caches.get("intersections")
    sizes = list(cache.sizes.values()) if cache is not None else []
    return sum(sizes) * views // max(len(sizes), 1)


def common_device(collectives: Collectives) -> Device:
    """Return the device that is available on all ranks."""
    return "cuda" if all(collectives.all_gather(torch.cuda.is_available())) else "cpu"


def gpu_problems(collectives: Collectives) -> dict[str, str]:
    """Return the problem of the GPU rasterizer by its name, if it does not work on some rank."""
    problem = rasterizer_problem(collectives, TritonRasterizer.name)
    return {} if problem is None else {TritonRasterizer.name: problem}


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
    layers = layers_of(settings.style_loss, weights, content=settings.content_weight > 0)
    use_whole_float32()
    ways = {"tf32": precision == "tf32", "winograd": precision == "winograd"}
    return FeatureNetwork(weights, layers, DTYPES[precision], device, **ways)


def evaluated_pixels(cameras: Sequence[Camera], settings: Settings) -> tuple[float, int]:
    """Return the pixels of a view that a mean step of phase 2 evaluates on all its scales, and the most scales."""
    pixels, most = 0.0, 1
    for camera in cameras:
        scales = scale_count(camera.height, camera.width, settings.coarsest_side)
        evaluated = ScaleWeights(settings.scales).evaluated(scales, settings.scale_sampling)
        pixels += camera.width * camera.height * evaluated
        most = max(most, scales)
    return pixels / len(cameras), most


def check_scales(weights: Sequence[float], cameras: Sequence[Camera], coarsest: int) -> None:
    """Check that every scale with a positive weight exists, and that every view has at least one such scale.

    Args:
        weights: Weights from the finest scale to coarser ones, at least one of them positive; empty for equal weights.
        coarsest: Maximum shorter side of the coarsest scale in pixels.

    Raises:
        SettingsError: If a scale with a positive weight exists in no view, or a view has no scale with a positive
            weight.
    """
    requested = ScaleWeights(tuple(weights))
    if not requested.values:
        return
    counts = {camera.name: scale_count(camera.height, camera.width, coarsest) for camera in cameras}
    most, last = max(counts.values()), max(scale for scale, weight in enumerate(weights) if weight > 0)
    if last >= most:
        have = "one scale, 0" if most == 1 else f"{most} scales, 0 to {most - 1}"
        raise SettingsError(
            f"--scales gives scale {last} a weight, but the views have {have} (full size): leave it out, or give "
            "larger views or a smaller --coarsest-side."
        )
    for name, count in counts.items():
        if not requested.chosen(count):
            raise SettingsError(
                f"--scales gives no weight to the {count} of {most} scales that view {name!r} has. Give one of them a "
                "weight, or use views of one size."
            )
