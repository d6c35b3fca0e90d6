"""Plan of a job: what it leaves out or does differently for its scene, with the reason of each choice.

`make_plan` is a pure function of the facts about machine, scene, views and network, and of the settings. No clock is
read to find the facts. Thresholds were measured once; what they rest on stands beside them.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np
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
from sgsst_core.loss.terms import MAX_VECTORS, NEAREST_WEIGHTS, has_statistics, layers_of
from sgsst_core.parallel import Collectives, Size, Tiling
from sgsst_core.planning.survey import Survey
from sgsst_core.planning.time_budget import TimeChoice
from sgsst_core.progress import ANOTHER_LOSS, VIEWS, Decision
from sgsst_core.rasterizer import RASTERIZERS, Rasterizer, drawing_problem, make_rasterizer, rasterizer_for
from sgsst_core.rasterizer.base import Precision as WeightPrecision
from sgsst_core.rasterizer.triton import TritonRasterizer
from sgsst_core.refine import Refinement
from sgsst_core.scales import MIN_FALL, ScaleWeights, scale_count, window_length
from sgsst_core.scene.camera import Camera, spread
from sgsst_core.scene.gaussians import Scene
from sgsst_core.settings import WHOLE_FLOAT32, CachedWeights, PlannedBackground, PlannedPrecision, Settings

# --- facts ---------------------------------------------------------------------------------------------------------

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
        problem: Reason why the GPU's rasterizer does not work; None if it works, and on the CPU.
    """

    device: Device
    memory_limit: int
    sharing: int = 1
    ranks: int = 1
    precisions: tuple[PlannedPrecision, ...] = ()
    graphs: bool = False
    problem: str | None = None

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


@dataclass(frozen=True)
class NetworkPixels:
    """Pixels through the network in one iteration on a single rank, mean over views.

    Attributes:
        all: Pixels through the forward and the backward pass, including halos.
        sampled: The same with the scales that a mean step of phase 2 evaluates (`Settings.scale_sampling`).
        coarse: The same with the coarsest scale alone.
        again: Pixels through a second forward pass, because their activations do not fit in memory.
        tiles: Maximum number of tiles of a view at one scale.
        held: Maximum number of pixels in memory at a time, including the temporary memory of a pass in units of pixels.
    """

    all: float = 0.0
    sampled: float = 0.0
    coarse: float = 0.0
    again: float = 0.0
    tiles: int = 0
    held: float = 0.0

    @staticmethod
    def of(facts: Facts, settings: Settings, *, weighted: bool) -> "NetworkPixels":
        """Count the pixels of the views that see anything."""
        total, sampled, coarse, again, held, tiles = 0.0, 0.0, 0.0, 0.0, 0.0, 0
        tiling, views = facts.tiling, facts.survey.covered
        for index in views:
            size, passed = facts.sizes[index], list[int]()
            for scale in reversed(tiling.scales(size)):  # coarsest first
                own = (size[0] >> scale, size[1] >> scale)
                region = scaled_region(facts.survey.regions[index], scale, own) if weighted else None
                areas = [tile.outer.pixels for tile in tiling.tiles(own, region)]
                flags = tiling.cached(areas)
                twice, largest = computed_twice(areas, flags), max(areas, default=0)
                passed.append(sum(areas))
                again, tiles = again + twice, max(tiles, len(areas))
                once = max((area for area, flag in zip(areas, flags, strict=True) if not flag), default=0)
                held = max(held, sum(areas) - twice + tiling.working * largest, (1 + tiling.working) * once)
            total, coarse = total + sum(passed), coarse + passed[0]
            sampled += sum(own * float(settings.scale_sampling) ** -place for place, own in enumerate(passed))
        total, sampled, coarse, again = (each / len(views) for each in (total, sampled, coarse, again))
        return NetworkPixels(total, sampled, coarse, again, tiles, held)


@dataclass(frozen=True)
class PlanningContext:
    """Objects that are created for planning, and that the job continues to use.

    Attributes:
        scene: Whole scene, with the SH attenuation of the settings applied.
        cameras: Cameras at the size used for stylization.
        rasterizer: Rasterizer of the whole scene that computes blend weights.
        networks: Networks created so far, by precision.
    """

    scene: Scene
    cameras: tuple[Camera, ...]
    settings: Settings
    machine: Machine
    weights: BackboneWeights
    rasterizer: Rasterizer
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
    scene = scene.attenuated(settings.sh_attenuation)
    machine = describe_machine(settings, collectives)
    name = rasterizer or rasterizer_for(machine.device, machine.problem)
    memory = memory_for("rasterizer", machine.memory)
    of_scene = make_rasterizer(name, scene, background=settings.background, near=settings.near, memory=memory)
    return PlanningContext(scene, tuple(cameras), settings, machine, weights, of_scene)


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
        problem=rasterizer_problem(collectives, TritonRasterizer.name) if device == "cuda" else None,
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


# --- the plan ------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Work:
    """Pixels that a rank passes through the network in a mean step.

    Attributes:
        sos: Pixels in a step of phase 2.
        coarse: Pixels in a step of phase 1.
        measuring: Pixels whose passes take as long as measuring the initial loss and novel views.
    """

    sos: float
    coarse: float
    measuring: float = 0.0


@dataclass(frozen=True)
class Plan:
    """Final decisions for a job.

    Attributes:
        optimized: [N] bool, Gaussians whose colors are determined by the views.
        seen: [N] bool, Gaussians that are rendered: those with a blend weight in a view.
        covered: Indices of the views that are stylized.
        weighted: Whether statistics are weighted by coverage.
        training_background: Background of the Gaussians in a step.
        warm_start: Whether the job starts with the style's colors.
        steps_coarse: Steps of phase 1; 0 if it is skipped.
        memory_limit: Memory budget in bytes of all ranks on one machine together.
        spare: Bytes of the budget for activations that no step needs: half of them for data of the views, and half for
            tile intersections.
        peak_bytes: Upper bound of a rank's memory in bytes: the sum of the budgets that the job can use.
        device_bytes: The same of the GPU's memory; None on a CPU.
        rasterizer: Rasterizer of the job; "cached" stores blend weights in the format `cached_weights`.
        uncached: Rasterizer that computes blend weights, and recomputes those that are not cached.
        graphs: Whether the loss of a view is captured as a CUDA graph where possible (`LossGraphs`).
        cached_weights: Format of blend weights that are cached between iterations.
        measured: Whether quality is measured and a report is written.
        loss_views: Number of views on which the loss is evaluated before the steps.
        novel_views: Number of novel views that are measured before and after the steps.
        ranks: Number of ranks that take part.
        groups: Number of groups of ranks that the plan has formed, each of which evaluates a view of its own in every
            step (`with_groups`); 1 if the settings decide.
        work: Work of the steps and of the measurements.
        refinement: Refinement that produced the scene of the plan from the input scene; None if the input scene is not
            refined.
        time_choice: Choice of the time budget; None without one, or if everything was given.
    """

    survey: Survey
    optimized: Tensor
    seen: Tensor
    covered: tuple[int, ...]
    weighted: bool
    steps_coarse: int
    memory_limit: int
    training_background: PlannedBackground = "background"
    warm_start: bool = False
    spare: int = 0
    peak_bytes: int = 0
    device_bytes: int | None = None
    device: Device = "cpu"
    rasterizer: str = "cpu"
    uncached: str = "cpu"
    precision: PlannedPrecision = "float32"
    graphs: bool = False
    cached_weights: CachedWeights = "none"
    measured: bool = False
    loss_views: int = 4
    novel_views: int = 0
    ranks: int = 1
    groups: int = 1
    work: Work = Work(0.0, 0.0)
    refinement: Refinement | None = None
    time_choice: TimeChoice | None = None
    decisions: tuple[Decision, ...] = ()

    @property
    def is_approximated(self) -> bool:
        """Whether measurements compare the gradient of a step with the float32 reference."""
        return self.precision not in WHOLE_FLOAT32 or self.cached_weights == "half"


#: Fraction of uncovered pixels above which statistics are weighted by coverage, unless the settings say otherwise.
_UNCOVERED = 0.01
#: Above this fraction of uncovered pixels, views are assumed to show an object without background. (Views of a room
#: that was captured from only some places have holes of a few percent.)
_SCAN = 0.2
#: Fraction of the color energy that depends on the view direction, from which on attenuating it is recommended: it
#: then shows beside the style (benchmarks/results/README.md).
_VIEW_DEPENDENT = 0.05
#: Default training background for such an object (docs/quality.md).
_SCAN_BACKGROUND: PlannedBackground = "palette"
#: Precision with "auto" by device: the first one that all ranks compute without emulation. The loss after a job is the
#: same in all of them (benchmarks/results/README.md). float16 continues in bfloat16 if it overflows.
_PREFERRED: dict[str, tuple[PlannedPrecision, ...]] = {
    "cpu": ("bfloat16", "winograd"),
    "cuda": ("float16", "bfloat16", "tf32"),
}
#: What a requested precision needs.
_GPU = "an NVIDIA GPU of compute capability 8.0 or higher"
_NEEDED: dict[PlannedPrecision, str] = {
    "winograd": "a CPU",
    "bfloat16": f"a CPU with matrix units (AMX), an AMD GPU, or {_GPU}",
    "float16": _GPU,
    "tf32": _GPU,
}
#: Text about each precision, and the error of its pixel gradient relative to float32's, at ordinary contrast.
_PRECISIONS: dict[PlannedPrecision, tuple[str, str]] = {
    "float32": ("features in float32", "none"),
    "winograd": ("convolutions by Winograd's algorithm", "a relative error of the pixel gradient of about 3e-3"),
    "tf32": ("convolutions in TF32", "a relative error of the pixel gradient of about 1e-2"),
    "float16": ("features in float16", "a relative error of the pixel gradient of about 3e-2"),
    "bfloat16": (
        "features in bfloat16",
        "a relative error of the pixel gradient of about 0.2; up to 0.9 where contrast is low",
    ),
}
#: Minimum visits of each view size for which CUDA graphs of the loss pay off, and maximum pixels of a view: a step of
#: 980x545 takes 19 ms without and 8 ms with a graph, because the GPU waits for 15 ms of launches, which larger views
#: hide (99 ms at 5187x3361, H200 and H100).
_GRAPH_VISITS, _GRAPH_PIXELS = 20, 2_600_000
#: Minimum visits of a view for which caching its blend weights pays off on a GPU: storing them takes 14 to 26 ms, and
#: each visit saves 2.2 (a million Gaussians) to 10 ms (6 million, H200).
_CACHED_VISITS = 8
#: Network pixels of a rank in a step on all scales below which each rank gets a view of its own: two CPU ranks are 1.72
#: times as fast as one on divided views of 1280x720, and worth 1.9 with views of their own. GPUs gain nothing by
#: dividing 980x545, and 8 of them are 6.2 times as fast as one at 5187x3361.
_OWN_VIEW_PIXELS = {"cpu": 500_000, "cuda": 2_000_000}
#: Number of steps with one view that a step with several is worth, by the loss left (benchmarks/results/README.md).
#: More views were not measured.
_WORTH = {1: 1.0, 2: 1.9, 4: 2.6, 8: 3.4}
#: Maximum numbers of views on which the loss is evaluated before the steps, and of novel views.
LOSS_VIEWS, NOVEL_VIEWS = 4, 4
#: Forward passes of a novel view: for the Gram distance before and after the steps, each beside its renders.
_NOVEL_PASSES = 2
#: Forward passes that take as long as a novel view with its renders and judgments: 9 to 14 on three scenes.
_NOVEL_COST = 10
#: Bytes per optimized Gaussian: color, gradient and two moments, float32.
OPTIMIZER_BYTES = 4 * 3 * 4
#: Bytes of a process before it reads a scene: libraries, compiled kernels and the network.
_PROCESS_BYTES = 900_000_000
#: Bytes per Gaussian beside its stored values: the file's, those of the rendered scene, and the neighbor search.
_GAUSSIAN_BYTES = 400
#: Bytes per pixel and scale of a view's targets: content features (relu4_2), coverage, and its image.
_TARGET_BYTES = 32
#: Bytes per pixel of a view in a step: image, coverage, their gradients, and those at the other scales. A step at
#: 5187x3361 took 64 bytes per pixel more than everything else.
_STEP_BYTES = 80


# --- choices -------------------------------------------------------------------------------------------------------


def make_plan(
    facts: Facts,
    settings: Settings,
    *,
    groups: int | None = None,
    measured: bool = False,
    about: Sequence[Decision] = (),
) -> Plan:
    """Decide everything about a job.

    Args:
        groups: `Plan.groups` of an earlier plan of the same job; None to choose them.
        measured: Whether quality is measured and a report is written, as in `sgsst stylize`.
        about: Decisions about the inputs, which come first.
    """
    survey, machine = facts.survey, facts.machine
    weighted = is_weighted(survey, settings)
    scan = weighted and survey.uncovered_fraction > _SCAN
    background, warm = settings.training_background, settings.warm_start
    seen = survey.total_blend_weights > 0
    pixels = NetworkPixels.of(facts, settings, weighted=weighted)
    plan = Plan(
        survey=survey,
        optimized=seen if facts.frozen is None else seen & ~facts.frozen,
        seen=seen,
        covered=tuple(survey.covered),
        weighted=weighted,
        # Optimization changes the overall color of a scene only slowly (docs/quality.md). If only luminance is
        # stylized, a warm start pays off only for scans, because nothing around the object determines its brightness.
        warm_start=scan or settings.preserve_colors != "luminance" if warm is None else warm,
        training_background=(_SCAN_BACKGROUND if scan else "background") if background == "auto" else background,
        steps_coarse=0 if _has_one_phase(facts, settings) else settings.steps_coarse,
        memory_limit=machine.memory_limit,
        device=machine.device,
        rasterizer=facts.rasterizer,
        uncached=facts.rasterizer,
        precision=facts.precision,
        measured=measured,
        ranks=machine.ranks,
        loss_views=min(LOSS_VIEWS, len(survey.covered)),
    )
    plan = replace(plan, groups=groups or _groups(plan, facts, settings, pixels))
    settings = with_groups(settings, plan.groups)
    plan = replace(plan, steps_coarse=min(plan.steps_coarse, settings.steps_coarse))
    cached, about_weights = _blend_weights(plan, facts, settings)
    if cached != "none":
        plan = replace(plan, rasterizer="cached", cached_weights=cached)
    plan = replace(plan, graphs=_has_graphs(plan, facts, settings), novel_views=_novel_views(plan, settings))
    plan = _with_memory(plan, facts, pixels)
    per_rank = settings.views_per_step / plan.ranks
    passes = (plan.loss_views + _NOVEL_COST * plan.novel_views) / 3 if measured else 0.0
    work = Work(per_rank * pixels.sampled, per_rank * pixels.coarse, passes * pixels.all / plan.ranks)
    lines = (
        *about,
        *_about_gaussians(plan, facts, settings),
        *_about_coverage(plan, facts, settings),
        *_about_network(facts, settings, pixels),
        *_about_rasterizer(plan, facts),
        about_weights,
        *_about_schedule(plan, facts, settings),
        *_about_ranks(plan, facts, settings),
        *_about_precision(plan, settings),
        *_about_measuring(plan, settings),
    )
    return replace(plan, work=work, decisions=lines)


def is_weighted(survey: Survey, settings: Settings) -> bool:
    """Return whether statistics are weighted by coverage."""
    requested = settings.position_weights
    return requested == "on" or (requested == "auto" and survey.uncovered_fraction > _UNCOVERED)


def choose_precision(settings: Settings, machine: Machine) -> PlannedPrecision:
    """Return the requested precision of the network; with "auto", the fastest that the processors have.

    Raises:
        SettingsError: If the requested precision cannot be computed here.
    """
    wanted = settings.precision
    if wanted == "auto":
        return next((name for name in _PREFERRED[machine.device] if name in machine.precisions), "float32")
    if wanted != "float32" and wanted not in machine.precisions:
        where = "this GPU" if machine.device == "cuda" else "this CPU"
        raise SettingsError(
            f"--precision {wanted} needs {_NEEDED[wanted]}, which {where} is not. Give another one, or none for the "
            "fastest one here."
        )
    return wanted


def _has_one_phase(facts: Facts, settings: Settings) -> bool:
    """Return whether phase 1 is skipped, because every view has a single scale with a weight."""
    weights = ScaleWeights(settings.scales)
    counts = [len(weights.chosen(scale_count(*size, settings.coarsest_side))) for size in facts.sizes]
    return max(counts) <= 1 and settings.preset != "paper"


def ends_with_transfer(settings: Settings, *, warm: bool) -> bool:
    """Return whether a job with a warm start transfers the style's colors once more after the last step.

    A loss without statistics lets colors drift from the style's during the steps; ARF (Zhang et al. 2022) transfers
    them twice too. With statistics, a second transfer would undo what the steps have achieved.
    """
    return warm and not has_statistics(settings.style_loss)


def worth(views: int) -> float:
    """Return how many steps with one view leave as little of the loss as a step with several views."""
    return float(np.interp(math.log2(views), [math.log2(known) for known in _WORTH], list(_WORTH.values())))


def _groups(plan: Plan, facts: Facts, settings: Settings, pixels: NetworkPixels) -> int:
    """Choose the number of groups of ranks, each with a view of its own in every step; 1 leaves it to the settings.

    Steps that were given, and those of the published schedule, remain as they are.
    """
    ranks = plan.ranks
    given = {"views_per_step", "steps_coarse", "steps_sos"} & {*settings.fixed}
    if ranks == 1 or settings.preset == "paper" or given or settings.within or len(plan.covered) < 2 * ranks:
        return 1
    return ranks if pixels.all / ranks < _OWN_VIEW_PIXELS[facts.machine.device] else 1


def with_groups(settings: Settings, groups: int) -> Settings:
    """Return the settings of a job whose plan has formed groups of ranks: one view for each in fewer steps."""
    if groups == 1:
        return settings
    steps = {name: math.ceil(getattr(settings, name) / worth(groups)) for name in ("steps_coarse", "steps_sos")}
    return settings.model_copy(update={**steps, "views_per_step": groups})


def _visits(plan: Plan, settings: Settings) -> int:
    return (plan.steps_coarse + settings.steps_sos) * settings.views_per_step


def _blend_weights(plan: Plan, facts: Facts, settings: Settings) -> tuple[CachedWeights, Decision]:
    """Choose the format of cached blend weights: float32 or half precision, as fits; none if it saves no time."""
    item, why_not = "blend weights", _why_not_cached(plan, facts, settings)
    whole, halved = facts.weight_bytes or (0, 0)
    if why_not is not None:
        return "none", Decision(item, "recomputed in every step", why_not, bytes=whole or None)
    budget, cached = memory_for("rasterizer", facts.machine.memory), settings.cached_weights
    if cached == "auto":
        cached = "float32" if whole <= budget or settings.preset == "paper" else "half"
    half = "half precision", halved, "each weight is off by at most 1/2048 of its value: 0.12 of 255 levels per pixel"
    name, size, error = half if cached == "half" else ("float32", whole, "none")
    of_a_view = size / len(plan.covered)
    portion = "all" if size <= budget else f"{budget // of_a_view * of_a_view / size:.0%} of the views'"
    reason = f"they take {size / 1e9:.2f} GB for all views; {budget / 1e9:.1f} GB are available for blend weights"
    return cached, Decision(item, f"{portion} cached in {name}", reason, error=error)


def _why_not_cached(plan: Plan, facts: Facts, settings: Settings) -> str | None:
    """Return the reason why blend weights are not cached; None if they are."""
    visits = _visits(plan, settings) / len(plan.covered)
    if settings.cached_weights == "none":
        return "requested"
    if facts.weight_bytes is None:
        return f"{RASTERIZERS[facts.rasterizer].title} does not cache them"
    if settings.cached_weights != "auto":
        return None
    if facts.weight_bytes[1] / len(plan.covered) > memory_for("rasterizer", facts.machine.memory):
        return "the weights of one view do not fit"
    return f"a view is visited only {visits:.1f} times" if visits < _CACHED_VISITS else None


def _has_graphs(plan: Plan, facts: Facts, settings: Settings) -> bool:
    """Return whether the loss of a view is captured as a CUDA graph. A graph cannot contain communication."""
    alone = plan.ranks == math.gcd(settings.views_per_step, plan.ranks)  # no two ranks work on the same view
    small = max(height * width for height, width in facts.sizes) <= _GRAPH_PIXELS
    # With weighted statistics, every view has its own size, because it is cropped to its covered pixels.
    sizes = len(plan.covered) if plan.weighted else len({facts.sizes[index] for index in plan.covered})
    return facts.machine.graphs and alone and small and _visits(plan, settings) // sizes >= _GRAPH_VISITS


def _novel_views(plan: Plan, settings: Settings) -> int:
    """Choose how many novel views are measured: passes outside of the steps are at most a fraction of those in them."""
    passes = int(settings.measure * _visits(plan, settings)) - plan.loss_views
    return max(min(NOVEL_VIEWS, passes // _NOVEL_PASSES), 0) if plan.measured else 0


def _with_memory(plan: Plan, facts: Facts, pixels: NetworkPixels) -> Plan:
    """Add to a plan the bound on its memory, and what a single rank on a GPU can spare of that for activations."""
    memory, budget = facts.machine.memory, memory_for("activations", facts.machine.memory)
    needed = activations = min(int(pixels.held * facts.pixel_bytes), budget)
    if plan.measured and plan.is_approximated:  # features of the float32 reference are larger
        size = 2 if plan.precision in ("bfloat16", "float16") else 1
        needed = min(size * activations, budget)
    # A CUDA graph does not share its memory: evaluating the loss without the graph needs the same amount again.
    needed += activations * plan.graphs
    spare = max(budget - needed, 0) if plan.device == "cuda" and facts.machine.ranks == 1 else 0
    sizes = [facts.sizes[index][0] * facts.sizes[index][1] for index in plan.covered]
    areas = sum(sizes)
    of_views = int(4 / 3 * _TARGET_BYTES * areas) + 12 * facts.gaussians * len(plan.covered) * bool(facts.used_degree)
    cached = 0 if plan.cached_weights == "none" else (facts.weight_bytes or (0, 0))[plan.cached_weights == "half"]
    of_novel_views = 4 * plan.novel_views * _TARGET_BYTES * areas // len(plan.covered)
    used = (
        needed
        + _STEP_BYTES * max(sizes, default=0)
        + min(of_views, memory_for("views", memory) + spare // 2)
        + min(facts.intersection_bytes + cached, memory_for("rasterizer", memory) + spare // 2)
        + min(of_novel_views, memory_for("measuring", memory))
    )
    of_scene = facts.gaussians * (_GAUSSIAN_BYTES + 24 * (facts.sh_degree + 1) ** 2)
    process = _PROCESS_BYTES + of_scene + (used if plan.device == "cpu" else 0)
    device = used + of_scene if plan.device == "cuda" else None
    return replace(plan, spare=spare, peak_bytes=process, device_bytes=device)


# --- plan lines ----------------------------------------------------------------------------------------------------


def _about_gaussians(plan: Plan, facts: Facts, settings: Settings) -> Iterator[Decision]:
    """Yield the decisions about Gaussians that are not rendered, and about spherical harmonics."""
    unseen, count = int((~plan.seen).sum()), facts.gaussians
    if unseen:
        frozen = settings.unseen == "freeze"
        change = "keep their colors" if frozen else "follow their neighbors' color change at the end"
        unused = f"{unseen:,} of {count:,} are neither rendered nor optimized; they {change}"
        yield Decision("unseen Gaussians", unused, "no pixel of any view shows them", bytes=unseen * OPTIMIZER_BYTES)
    degree, used, attenuation = facts.sh_degree, facts.used_degree, settings.sh_attenuation
    saved = count * 3 * ((degree + 1) ** 2 - (used + 1) ** 2) * 4 or None
    if attenuation and degree:
        less = f"coefficients of degrees 1 to {degree} are multiplied by {1 - attenuation:.3g}, in the result too"
        error = "colors depend less on the view direction"
        yield Decision("spherical harmonics", less, "requested", bytes=saved, error=error)
    elif used < degree:
        zeros = f"all coefficients of degrees {used + 1} to {degree} are 0"
        yield Decision("spherical harmonics", f"evaluated up to degree {used}", zeros, bytes=saved)
    if not attenuation and facts.harmonics_energy >= _VIEW_DEPENDENT:
        advice = "unchanged, so highlights keep their tint; --sh-attenuation 1 removes it"
        reason = f"{facts.harmonics_energy:.0%} of the color variance depends on the view direction"
        yield Decision("view-dependent color", advice, reason)


def _about_coverage(plan: Plan, facts: Facts, settings: Settings) -> Iterator[Decision]:
    """Yield the decisions about empty views, uncovered pixels, backgrounds, and the colors at the start."""
    uncovered = f"{plan.survey.uncovered_fraction:.1%} of the views' pixels are uncovered"
    total, blind = len(facts.sizes), len(facts.sizes) - len(plan.covered)
    if blind:
        yield Decision(VIEWS, f"{blind} of {total} are skipped", "they see no Gaussian")
    if plan.weighted:
        yield Decision("uncovered pixels", "tiles and borders without covered pixels skip the network", uncovered)
        yield Decision("position weights", "statistics are weighted by coverage", uncovered, error=ANOTHER_LOSS)
    if plan.training_background != "background":
        random, requested = plan.training_background == "random", settings.training_background != "auto"
        color = "a random color each time" if random else "the color of a random pixel of the style each time"
        reason = "requested" if requested else f"{uncovered}: colors would be fitted to a fixed background"
        yield Decision("training background", color, reason, error=ANOTHER_LOSS)
    by_luminance = settings.preserve_colors == "luminance"
    if plan.warm_start:
        luminance = "luminance starts with the style's mean and standard deviation"
        start = luminance if by_luminance else "colors start with the style's distribution"
        if ends_with_transfer(settings, warm=True):
            start += f"; they are reset to it after the last step, because {settings.style_loss} lets them drift"
        reason = "steps change the overall color only slowly" if settings.warm_start is None else "requested"
        yield Decision("start", start, reason, error="differs from the paper's start")
    if by_luminance:
        line = "only luminance is compared and optimized; each Gaussian keeps its chroma"
        yield Decision("colors", line, "requested", error=ANOTHER_LOSS)


def _about_network(facts: Facts, settings: Settings, pixels: NetworkPixels) -> Iterator[Decision]:
    """Yield the decisions about style loss, partition and forward passes."""
    if settings.style_loss != "sos":
        what = "replaces the statistics" if settings.style_loss == "nnfm" else "is added to the statistics"
        distance = (
            f"the distance of relu3 features to the nearest of at most {MAX_VECTORS:,} style features {what}, with "
            f"weight {NEAREST_WEIGHTS[settings.style_loss]:.3g}"
        )
        yield Decision("style loss", distance, f"{settings.style_loss} was requested", error=ANOTHER_LOSS)
    memory = f"the {memory_for('activations', facts.machine.memory) / 1e9:.1f} GB for activations"
    whole = "none: the network takes each view as a whole"
    tiles = whole if pixels.tiles <= 1 else f"up to {pixels.tiles} tiles per view"
    yield Decision("partition", tiles, f"tiles are as large as fit in {memory}")
    again = pixels.again / pixels.all
    reason = f"activations of {1 - again:.0%} of the pixels fit in {memory}"
    yield Decision("second forward", f"for {again:.0%} of the pixels", reason)


def _about_rasterizer(plan: Plan, facts: Facts) -> Iterator[Decision]:
    """Yield the decisions about the rasterizer and kernel launches on a GPU; on the CPU there is no choice."""
    if plan.device != "cuda":
        return
    problem, used = facts.machine.problem, RASTERIZERS[facts.rasterizer]
    device = "GPU" if used.on_gpu else "CPU"
    why = f"{TritonRasterizer.title} cannot be used: {problem}" if problem else "it works here"
    yield Decision("rasterizer", f"{used.title} on the {device}", why)
    launches = "the loss of a view is captured as a CUDA graph" if plan.graphs else "kernel by kernel"
    reason = (
        f"graphs, with NVIDIA GPUs and PyTorch 2.13, are for views of at most {_GRAPH_PIXELS / 1e6:.1f} megapixels, "
        f"visited at least {_GRAPH_VISITS} times, and not divided among workers"
    )
    yield Decision("launches", launches, reason)


def _about_schedule(plan: Plan, facts: Facts, settings: Settings) -> Iterator[Decision]:
    """Yield the decisions about scales and their weights, phases, and stopping early."""
    counts = [scale_count(*facts.sizes[index], settings.coarsest_side) for index in plan.covered]
    scales = f"{min(counts)} to {max(counts)}" if min(counts) < max(counts) else f"{counts[0]}"
    halved = f"the shorter side is halved until it is at most {settings.coarsest_side} pixels"
    yield Decision("scales", scales, halved)
    if settings.scales:
        weights = ScaleWeights(settings.scales)
        text = ", ".join(f"scale {scale} {weights.of(scale):g}" for scale in weights.chosen(max(counts)))
        yield Decision("weights of scales", f"{text}; others are not computed", "requested", error=ANOTHER_LOSS)
    if settings.scale_sampling > 1 and not _has_one_phase(facts, settings):
        text = f"of {settings.scale_sampling} visits of a view, drawn at random, one evaluates the next finer scale too"
        reason = "gradients are the same on average, and finer scales cost most"
        yield Decision("scale sampling", text, reason, error="more noise in single gradients")
    if plan.steps_coarse < settings.steps_coarse:
        skipped = f"its {settings.steps_coarse} steps are skipped"
        reason, error = (
            "with one scale, it would be the same as phase 2",
            "these steps, which would reduce the same loss",
        )
        yield Decision("phase 1", skipped, reason, error=error)
    if settings.early_stop and plan.training_background == "background":
        when = (
            f"when the mean loss of {window_length(len(plan.covered))} steps is less than {MIN_FALL:.1%} below that of "
            "the same number of steps before"
        )
        yield Decision("early stop", when, "later steps would gain little", error="the remaining decrease of the loss")


def _about_ranks(plan: Plan, facts: Facts, settings: Settings) -> Iterator[Decision]:
    """Yield the decisions about ranks that share a GPU, and about views that ranks divide or have for themselves."""
    if plan.device != "cpu" and facts.machine.sharing > 1:
        reason = f"{facts.machine.sharing} of them share a GPU, which NCCL does not support; give each a GPU of its own"
        yield Decision("communication", "ranks exchange data over the CPU (gloo)", reason)
    if plan.groups > 1:
        each = f"all {plan.ranks} take part, each with a view of its own in fewer steps"
        error = "steps average the gradients of several views"
        yield Decision("ranks", each, "views are too small to divide among so many", error=error)
    elif plan.ranks > 1:
        groups = math.gcd(settings.views_per_step, plan.ranks)
        how = f"{plan.ranks // groups} divide each view" if groups < plan.ranks else "each has a view of its own"
        yield Decision("ranks", f"all {plan.ranks} take part", how)


def _about_precision(plan: Plan, settings: Settings) -> Iterator[Decision]:
    """Yield the decision about the network's precision; none if float32 was requested."""
    if settings.precision != "float32":
        what, error = _PRECISIONS[plan.precision]
        reason = "requested" if settings.precision != "auto" else "the fastest that the processor computes"
        yield Decision("precision", what, reason, error=error)


def _about_measuring(plan: Plan, settings: Settings) -> Iterator[Decision]:
    """Yield the decision about measurements outside of the steps."""
    if plan.measured:
        loss = f"the loss before the steps on {_count(plan.loss_views, 'view')}"
        what = f"{loss}, and {_count(plan.novel_views, 'novel view')} before and after"
        reason = f"at most {settings.measure:.0%} of the {_visits(plan, settings):,} passes in the steps"
        yield Decision("measuring", what, reason)


def _count(number: int, what: str) -> str:
    return f"{number} {what}{'' if number == 1 else 's'}"
