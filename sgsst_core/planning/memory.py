"""Prediction of a rank's peak memory: what it holds until the end, plus the largest of its temporary allocations."""

from __future__ import annotations

from dataclasses import dataclass

from sgsst_core.budget import least_intersection_memory, measuring_memory, memory_for
from sgsst_core.planning.cost import OPTIMIZER_BYTES, STEP_BYTES, gaussian_bytes, image_bytes
from sgsst_core.planning.measuring import LEVELS, RENDERED
from sgsst_core.planning.plan import Plan
from sgsst_core.planning.probe import Probe
from sgsst_core.planning.visits import COLOR_BYTES, Visits
from sgsst_core.settings import Settings

#: Memory of measurements and report, apart from iterations and tile intersections: libraries, LPIPS, images.
MEASURING_BYTES = 100 << 20
#: Bytes per Gaussian of a projected scene: for its shape, cached between views, and for its projection, depth and order
#: while the tile intersections of a view are computed.
SHAPE_BYTES, BUILDING_BYTES = 32, 104
#: Bytes per Gaussian during the neighbor search for unseen ones: result, its difference, positions, and search tree.
SEARCH_BYTES = 120
#: Memory for the gradient of each tile intersection in a rasterizer's backward pass, as a fraction of a view's tile
#: intersections.
SLOTS_SHARE = 0.25
#: Bytes per pixel of a novel view: its coverage, and its two warps.
_COVERAGE_BYTES, _WARP_BYTES = 4, 2 * 40


@dataclass(frozen=True)
class PeakMemory:
    """Peak memory of a rank, predicted from a plan under construction.

    Attributes:
        plan: Plan under construction.
        probe: Measured facts.
        settings: Settings of the job.
        visits: Predicted data that are computed per view.
        level: Level of measurements as an index into `LEVELS`; None if nothing is measured.
        loss_views: Number of views on which the loss is evaluated before and after.
        activations: Peak size of activations in an iteration in bytes.
        matching: Memory for matching features with the style's, in bytes.
    """

    plan: Plan
    probe: Probe
    settings: Settings
    visits: Visits
    level: int | None
    loss_views: int
    activations: int
    matching: int

    def bytes(self) -> tuple[int, int | None]:
        """Return the peak memory in bytes of a rank's process, and of its GPU (None on a CPU).

        With a GPU, computed data are in GPU memory. Some data that grow with the number of Gaussians are counted only
        on a CPU, because they are small compared to other tensors on a GPU.
        """
        probe, gaussians = self.probe, int(self.plan.seen.sum())
        measuring = 0 if self.level is None else MEASURING_BYTES
        # A CUDA graph does not share its memory: evaluating the loss without the graph needs the same amount again.
        passing = image_bytes(probe.sizes) + self.activations * (2 if self.plan.graphs else 1) + self.matching
        if probe.machine.device != "cpu":
            computing = passing + self._content() + self._weights()
            return probe.process_bytes + measuring, probe.device_bytes + computing + gaussians * OPTIMIZER_BYTES
        everything = probe.scene.gaussians
        building = everything * BUILDING_BYTES
        kept = (
            self._scene() + self._intersections_and_weights() + self._content() + self._colors() + self._novel_views()
        )
        kept += gaussians * OPTIMIZER_BYTES + measuring
        searching = everything * SEARCH_BYTES if self._unseen_are_searched() else 0
        rastering = gaussians * STEP_BYTES + int(SLOTS_SHARE * probe.raster.intersection_bytes)
        passing = max(passing + self._exact_activations() + gaussians * COLOR_BYTES, rastering, searching)
        return probe.process_bytes + max(building, kept + passing), None

    @property
    def _ranks(self) -> int:
        return self.probe.machine.ranks

    def _visited(self, steps: int) -> float:
        """Return the fraction of views visited by this many steps and by the loss before and after."""
        evaluated = self.loss_views if self.level is not None else 0
        return min((steps * self.settings.views_per_step + evaluated) / len(self.plan.covered), 1.0)

    @property
    def _all_visited(self) -> float:
        return self._visited(self.plan.steps_coarse + self.settings.steps_sos)

    def _content(self) -> int:
        """Return the size in bytes of content features: those of the coarsest scale in phase 1, all of them in phase 2.

        Content images, if they are cached instead, and maps of regions are included.
        """
        content, coarse = self.visits.content, self.visits.content_coarse
        whole = self._visited(self.settings.steps_sos)
        taken = whole * content.bytes + (self._all_visited - whole) * coarse.bytes
        images = min(self._all_visited * self.visits.images.bytes, self.visits.images.room)
        maps = min(self._all_visited * self.visits.maps.bytes, self.visits.maps.room)
        return int(min(taken / self._ranks, content.room) + images + maps)

    def _weights(self) -> int:
        weights = self.visits.weights
        ranks = self._ranks
        return int(min(self._all_visited * weights.bytes / ranks, weights.fitting(ranks))) if weights else 0

    def _colors(self) -> int:
        colors = self.visits.colors
        return int(min(self._all_visited * colors.bytes, colors.room))

    def _intersections_and_weights(self) -> int:
        """Return the size in bytes of weights and tile intersections, which share a budget.

        Tile intersections that the survey has already cached are not included.
        """
        memory, weights, visits = self.probe.machine.memory, self._weights(), self.visits
        room = memory_for("rasterizer", memory) - weights
        intersections = visits.intersections.bytes + self._other_intersections()
        if visits.weights is not None:  # the tile intersections of a view are dropped once its weights are cached
            room = max(room, least_intersection_memory(memory))
            intersections -= visits.weights.kept * self._all_visited * visits.intersections.bytes
        return max(int(min(intersections, room)) + weights - visits.surveyed.cached_bytes, 0)

    def _other_intersections(self) -> int:
        """Return the size in bytes of tile intersections for novel views, and for the reference of a pruned scene."""
        views = RENDERED * LEVELS[self.level].views if self.level is not None else 0
        if self.level is not None and self._pruned():
            views += self.loss_views
        return views * self.probe.raster.intersection_bytes

    def _scene(self) -> int:
        """Return the size in bytes of partial copies of the scene, and of shapes for computing tile intersections."""
        probe, gaussians, everything = self.probe, int(self.plan.seen.sum()), self.probe.scene.gaussians
        each = gaussian_bytes(probe.scene.held_degree)
        copies = 0
        if gaussians < everything:
            copies = gaussians * each - everything * SHAPE_BYTES
            if self.visits.intersections.kept < 1 or self.visits.weights is not None:
                copies += gaussians * SHAPE_BYTES
        if self.level is not None and self._pruned():
            copies += int((self.plan.survey.total_blend_weights > 0).sum()) * (each + SHAPE_BYTES)
        return copies

    def _novel_views(self) -> int:
        """Return the size in bytes of the caches for novel views and for the reference, except tile intersections."""
        if self.level is None:
            return 0
        memory, kept = measuring_memory(self.probe.machine.memory), 0
        gaussians, pixels = self.probe.scene.gaussians, max(height * width for height, width in self.probe.sizes)
        views = LEVELS[self.level].views
        if views:
            colors = RENDERED * views * gaussians * COLOR_BYTES if self.probe.scene.used_degree else 0
            coverage = views * pixels * _COVERAGE_BYTES if self.plan.weighted else 0
            kept += gaussians * SHAPE_BYTES + min(colors, memory // 8) + min(coverage, memory // 8)
            kept += min(views * pixels * _WARP_BYTES, memory // 2)
        if self._approximated():
            share = self.loss_views / len(self.plan.covered)
            kept += int(min(share * self._exact_size() * self.visits.content.bytes, memory // 2))
            kept += int(min(share * self.visits.colors.bytes, memory // 4))
        return kept

    def _exact_activations(self) -> int:
        """Return by how many bytes the activations of the float32 reference exceed the job's."""
        if self.level is None or not self._approximated():
            return 0
        budget = memory_for("activations", self.probe.machine.memory)
        return max(min(int(self.activations * self._exact_size()), budget) - self.activations, 0)

    def _exact_size(self) -> float:
        """Return the size of a feature value in the float32 reference, relative to the job's network."""
        return 2.0 if self.plan.precision == "bfloat16" else 1.0

    def _pruned(self) -> bool:
        return bool((self.plan.survey.total_blend_weights[~self.plan.seen] > 0).any())

    def _approximated(self) -> bool:
        return self.plan.precision != "float32" or self.plan.cached_weights == "half" or self._pruned()

    def _unseen_are_searched(self) -> bool:
        return self.settings.unseen == "neighbors" and not bool(self.plan.seen.all())
