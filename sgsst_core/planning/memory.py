"""Peak memory of a rank, predicted from the data that its views need."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from sgsst_core.budget import least_intersection_memory, measuring_memory, memory_for
from sgsst_core.loss.tiling import Tiling
from sgsst_core.parallel.division import Size
from sgsst_core.planning.facts import Probe
from sgsst_core.planning.measurement_choice import LEVELS, RENDERED
from sgsst_core.planning.plan import Plan
from sgsst_core.planning.view_costs import COLOR_BYTES, RankPart, ViewCosts
from sgsst_core.planning.work import matching_bytes
from sgsst_core.settings import Settings

#: Additional bytes per optimized Gaussian: color, gradient and two moments, float32.
OPTIMIZER_BYTES = 4 * 3 * 4
#: Additional bytes per Gaussian allocated in each step on the CPU: for a view's colors, and for their gradients in
#: total and per raster tile.
_STEP_BYTES = 4 * 3 * 4
#: Memory of measurements and report, apart from iterations and tile intersections: libraries, LPIPS, images.
MEASURING_BYTES = 100 << 20
#: Bytes per Gaussian of a projected scene: for its shape, cached between views, and for its projection, depth and order
#: while the tile intersections of a view are computed.
SHAPE_BYTES, BUILDING_BYTES = 32, 104
#: Bytes per Gaussian of the neighbor search for unseen Gaussians: result, color change, positions, and search tree.
SEARCH_BYTES = 120
#: Memory for the gradient of each tile intersection in a rasterizer's backward pass, as a fraction of a view's tile
#: intersections.
_SLOTS_FRACTION = 0.25
#: Bytes per pair of Gaussian and raster tile on a GPU: while the pairs of a view are sorted (keys, values and the
#: sort's own buffers), and for its slot in the color gradient.
SORTING_BYTES, _SLOT_BYTES = 36, 12
#: Estimated workspace of cuDNN, and buffers of NCCL, in bytes. Steps in bfloat16 and TF32 took 0.73 to 1.07 times
#: the planned memory of an H200; in float32 at 980x545, cuDNN took 4 GB more, which were free. NCCL was not measured.
CUDNN_BYTES, NCCL_BYTES = 512 << 20, 512 << 20
#: Bytes per pixel of a novel view: its coverage, and its two warps.
_COVERAGE_BYTES, _WARP_BYTES = 4, 2 * 40


@dataclass(frozen=True)
class PeakMemory:
    """Peak memory of a rank: what it holds until the end, plus the largest of its temporary allocations.

    Attributes:
        tiling: Partitioning rules.
        sizes: (height, width) of each view of the job.
        views: Data that the rank computes for the views.
        part: Part of each view that the rank processes.
        plan: Plan under construction.
        probe: Measured facts.
        settings: Settings of the job.
        level: Level of measurements as an index into `LEVELS`.
        loss_views: Number of views on which the loss is evaluated before and after.
        activations: Peak size of activations in an iteration in bytes.
    """

    tiling: Tiling
    sizes: Sequence[Size]
    views: ViewCosts
    part: RankPart
    plan: Plan
    probe: Probe
    settings: Settings
    level: int
    loss_views: int
    activations: int

    def bytes(self) -> tuple[int, int | None]:
        """Return the peak memory in bytes of a rank's process, and of its GPU (None on a CPU).

        With a GPU, computed data are in GPU memory. The copy of the scene is counted only on a CPU, because it is small
        compared to other tensors on a GPU.
        """
        probe, plan, gaussians = self.probe, self.plan, int(self.plan.seen.sum())
        measuring, everything = MEASURING_BYTES if plan.measured else 0, probe.scene.gaussians
        held = self._intersections_and_weights() + self._content() + self._colors() + self._novel_views()
        held += gaussians * OPTIMIZER_BYTES
        pairs = int(probe.raster.max_pairs * self.part.window)
        building = everything * BUILDING_BYTES + pairs * SORTING_BYTES
        if probe.machine.device != "cpu":
            rastering = pairs * _SLOT_BYTES
            # A CUDA graph does not share its memory.
            graphs = self.activations if plan.graphs else 0
            passing = graphs + max(self._passing() + CUDNN_BYTES, rastering, building)
            messages = NCCL_BYTES if probe.machine.ranks > 1 else 0
            return probe.process_bytes + measuring, probe.device_bytes + held + passing + messages
        held += self._scene() + measuring
        searching = everything * SEARCH_BYTES if neighbors_are_searched(plan, self.settings) else 0
        slots = int(_SLOTS_FRACTION * probe.raster.intersection_bytes * self.part.window)
        rastering = gaussians * _STEP_BYTES + slots
        return probe.process_bytes + max(building, held + max(self._passing(), rastering, searching)), None

    def _passing(self) -> int:
        """Return the bytes that the loss of a view and its gradient take, without a graph."""
        probe = self.probe
        # render, gradient, and their temporary float32 copies
        image = int(max(height * width for height, width in probe.sizes) * self.part.window) * 3 * 4 * 6
        matching = matching_bytes(self.sizes, self.tiling, probe.network.vector_channels, probe.machine.device)
        budget = memory_for("activations", self._memory)
        colors = int(self.plan.seen.sum()) * COLOR_BYTES
        return (
            image + matching + colors + probe.style_bytes + reference_activations(self.plan, self.activations, budget)
        )

    @property
    def _memory(self) -> int:
        """Memory budget of the rank in bytes."""
        return int(self.probe.machine.memory * self.part.memory)

    def _visited(self, steps: int) -> float:
        """Return the fraction of views visited by this many steps and by the initial loss."""
        evaluated = self.loss_views if self.plan.measured else 0
        return min((steps * self.settings.views_per_step + evaluated) / len(self.plan.covered), 1.0)

    @property
    def _all_visited(self) -> float:
        return self._visited(self.plan.steps_coarse + self.settings.steps_sos)

    def _content(self) -> int:
        """Return the bytes of cached content features, content images, coverage and region maps.

        Phase 1 needs the content features of the coarsest scale only.
        """
        views = self.views
        content, coarse = views.content, views.content_coarse
        in_sos = self._visited(self.settings.steps_sos)
        features = in_sos * content.bytes + (self._all_visited - in_sos) * coarse.bytes
        others = views.images, views.coverage, views.maps
        beside = sum(min(self._all_visited * data.bytes, data.budget) for data in others)
        return int(min(features, content.budget) + beside)

    def _weights(self) -> int:
        weights = self.views.weights
        return int(min(self._all_visited * weights.bytes, weights.cached_bytes())) if weights else 0

    def _colors(self) -> int:
        colors = self.views.colors
        return int(min(self._all_visited * colors.bytes, colors.budget))

    def _intersections_and_weights(self) -> int:
        """Return the size in bytes of weights and tile intersections, which share a budget.

        Tile intersections that the survey has already cached are not included. Those of whole views are dropped if
        ranks divide the views.
        """
        memory, weights, views = self._memory, self._weights(), self.views
        budget = memory_for("rasterizer", memory) - weights
        novel = RENDERED * LEVELS[self.level].views if self.plan.measured else 0
        intersections = views.intersections.bytes + novel * self.probe.raster.intersection_bytes
        if views.weights is not None:  # the tile intersections of a view are dropped once its weights are cached
            budget = max(budget, least_intersection_memory(memory))
            intersections -= views.weights.cached * self._all_visited * views.intersections.bytes
        further = int(min(intersections, budget)) + weights - int(views.surveyed.cached_bytes())
        return further if self.part.ranks > 1 else max(further, 0)

    def _scene(self) -> int:
        """Return the size in bytes of a partial copy of the scene, and of shapes for computing tile intersections."""
        gaussians, everything, views = int(self.plan.seen.sum()), self.probe.scene.gaussians, self.views
        if gaussians == everything:
            return 0
        copy = gaussians * gaussian_bytes(self.probe.scene.held_degree) - everything * SHAPE_BYTES
        if views.intersections.cached < 1 or views.weights is not None:
            copy += gaussians * SHAPE_BYTES
        return copy

    def _novel_views(self) -> int:
        """Return the size in bytes of the caches for novel views and for the reference, except tile intersections."""
        if not self.plan.measured:
            return 0
        memory, held = measuring_memory(self._memory), 0
        gaussians, pixels = self.probe.scene.gaussians, max(height * width for height, width in self.probe.sizes)
        views = LEVELS[self.level].views
        if views:
            colors = RENDERED * views * gaussians * COLOR_BYTES if self.probe.scene.used_degree else 0
            coverage = views * pixels * _COVERAGE_BYTES if self.plan.weighted else 0
            held += gaussians * SHAPE_BYTES + min(colors, memory // 8) + min(coverage, memory // 8)
            held += min(views * pixels * _WARP_BYTES, memory // 2)
        if self.plan.is_approximated:
            evaluated, data = self.loss_views / len(self.plan.covered), self.views
            held += int(min(evaluated * reference_size(self.plan) * data.content.bytes, memory // 2))
            held += int(min(evaluated * data.colors.bytes, memory // 4))
        return held


def gaussian_bytes(sh_degree: int) -> int:
    """Return the size in bytes of a float32 Gaussian.

    It consists of position, rotation, scale, opacity, and coefficients of three color channels.
    """
    return 4 * (3 + 4 + 3 + 1 + 3 * (sh_degree + 1) ** 2)


def reference_activations(plan: Plan, activations: int, budget: int) -> int:
    """Return the activations in bytes of a pass of the job, or of the float32 reference if it needs more.

    Args:
        plan: Plan of the job.
        activations: Activations of the job in bytes.
        budget: Budget for activations in bytes, which limits those of the reference.
    """
    if not plan.measured or not plan.is_approximated:
        return activations
    return max(min(int(activations * reference_size(plan)), budget), activations)


def reference_size(plan: Plan) -> float:
    """Return the size of a feature value in the float32 reference, relative to the job's network."""
    return 2.0 if plan.precision == "bfloat16" else 1.0


def neighbors_are_searched(plan: Plan, settings: Settings) -> bool:
    """Return whether unseen Gaussians follow their neighbors' color change."""
    return settings.unseen == "neighbors" and not bool(plan.seen.all())
