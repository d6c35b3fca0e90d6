"""Data that are computed for each view of a job: their seconds and bytes, for whole views or for a rank's parts."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

from sgsst_core.budget import content_fraction, least_intersection_memory, measuring_memory, memory_for
from sgsst_core.planning.facts import Probe
from sgsst_core.planning.plan import Plan
from sgsst_core.planning.work import Work
from sgsst_core.settings import Settings

#: Time to compute a view's cached weights on the CPU, relative to a render with gradient.
_CACHING_RENDERS = 3
#: Time of a render without gradient, relative to a render with gradient.
RENDER = 0.5
#: Cost of restricting the survey's tile intersections to the Gaussians of the job, relative to computing them.
_RESTRICTING = 0.25
#: Bytes per Gaussian of a view's SH contribution to colors: three float32.
COLOR_BYTES = 12
#: Bytes per pixel of the content image at all scales, float32. It is cached if the background changes from step to
#: step.
_IMAGE_BYTES = 16
#: Bytes per pixel of coverage or of a region's map at all scales, float32, and number of maps computed by one render.
MAP_BYTES, MAPS_PER_RENDER = 16 / 3, 3


@dataclass(frozen=True)
class ViewData:
    """Data that are computed for each view: cached as far as they fit a budget, and recomputed at each visit otherwise.

    Attributes:
        seconds: Seconds to compute the data of a view.
        bytes: Size of the data of all views.
        budget: Memory budget in bytes.
        views: Number of views, if the data of a view are cached completely or not at all; None if any fraction can be.
    """

    seconds: float
    bytes: float = 0.0
    budget: float = math.inf
    views: int | None = None

    @property
    def cached(self) -> float:
        """Fraction of the views whose data are cached."""
        return self.cached_bytes() / self.bytes if self.bytes else 1.0

    @property
    def once(self) -> float:
        """Time in seconds at a view's first visit to compute data that are then cached, mean over views."""
        return self.cached * self.seconds

    @property
    def always(self) -> float:
        """Time in seconds at every visit of a view to recompute uncached data, mean over views."""
        return (1 - self.cached) * self.seconds

    def cached_bytes(self) -> float:
        """Return the final size in bytes of the data that are cached."""
        if self.bytes <= self.budget:
            return self.bytes
        return (
            self.budget if self.views is None else self.budget // (self.bytes / self.views) * (self.bytes / self.views)
        )


@dataclass(frozen=True)
class RankPart:
    """Part of the work on each view that a rank does.

    Attributes:
        ranks: Number of ranks that divide a view.
        window: Fraction of a view's covered pixels that the rank renders: its part of the view and the halo.
        memory: Memory budget of the rank, relative to `Machine.memory`; more than 1 if some ranks do not take part.
    """

    ranks: int = 1
    window: float = 1.0
    memory: float = 1.0

    def seconds(self, whole: float, fixed: float = 0.0) -> float:
        """Return the rank's time in seconds; `whole` is that of a whole view, `fixed` its size-independent portion."""
        fixed = min(fixed, whole)
        return fixed + (whole - fixed) * self.window

    def data(self, whole: ViewData, fraction: float, fixed: float = 0.0) -> ViewData:
        """Return the rank's data, given the data of whole views and the fraction of their bytes that the rank holds."""
        seconds = self.seconds(whole.seconds, fixed)
        return replace(whole, seconds=seconds, bytes=whole.bytes * fraction, budget=whole.budget * self.memory)


@dataclass(frozen=True)
class ViewCosts:
    """All data that are computed for the views of a job: for whole views, or for one rank's part of each.

    Attributes:
        intersections: Tile intersections of the rasterizer that computes weights.
        surveyed: Tile intersections cached by the survey, of all views.
        reused: Fraction of the time for cached tile intersections that is saved because the survey already computed
            them.
        colors: SH colors.
        weights: Cached weights; None if there are none.
        content: Content features at all scales, including their render.
        content_coarse: Content features of the coarsest scale alone.
        images: Content images, from which features are computed with another background color.
        coverage: Coverage, if it weights statistics.
        maps: Maps of the regions.
        raster: Time in seconds of a render and its gradient with recomputed weights.
        raster_cached: Time in seconds of a render and its gradient with cached weights.
        fixed: Portions of `raster` and of the time for tile intersections that do not depend on the number of pixels.
        in_coarse: Whether phase 1 already computes tile intersections, colors and weights for phase 2.
    """

    intersections: ViewData
    surveyed: ViewData
    reused: float
    colors: ViewData
    weights: ViewData | None
    content: ViewData
    content_coarse: ViewData
    images: ViewData
    coverage: ViewData
    maps: ViewData
    raster: float
    raster_cached: float
    fixed: tuple[float, float]
    in_coarse: bool

    @staticmethod
    def of(plan: Plan, probe: Probe, settings: Settings, work: Work, coarse: Work, content: int) -> ViewCosts:
        """Predict the data for a plan under construction.

        Args:
            plan: Plan under construction.
            probe: Measured facts.
            settings: Settings of the job.
            work: Work of an iteration on all scales.
            coarse: Work of an iteration on the coarsest scale.
            content: Size in bytes of the content features of all views.
        """
        raster = probe.raster
        budget = view_memory(plan, probe.machine.memory)
        pixels = sum(height * width for height, width in (probe.sizes[index] for index in plan.covered))
        surveyed, intersections, reused = _intersections(plan, probe)
        features, features_coarse, images = _content(plan, probe, settings, (work, coarse), content, pixels, budget)
        coverage = maps = ViewData(0.0)
        if plan.weighted:
            coverage = ViewData(RENDER * raster.seconds, MAP_BYTES * pixels, budget / 4)
        if probe.maps:
            renders = 1 + -(-probe.maps // MAPS_PER_RENDER)  # plus one for the background
            maps = ViewData(RENDER * renders * raster.seconds, MAP_BYTES * probe.maps * pixels, budget / 4)
        colors = len(plan.covered) * int(plan.seen.sum()) * COLOR_BYTES if probe.scene.used_degree else 0
        return ViewCosts(
            intersections=intersections,
            surveyed=surveyed,
            reused=reused,
            colors=ViewData(raster.colors_seconds, colors, budget / 4),
            weights=_weights(plan, probe),
            content=features,
            content_coarse=features_coarse,
            images=images,
            coverage=coverage,
            maps=maps,
            raster=raster.seconds,
            raster_cached=raster.seconds if raster.cached_seconds is None else raster.cached_seconds,
            fixed=(raster.fixed, raster.first_fixed),
            in_coarse=plan.steps_coarse > 0,
        )

    def of_rank(self, part: RankPart) -> ViewCosts:
        """Return the costs of a rank that processes a part of each view, given those of whole views."""
        raster, first = self.fixed
        return replace(
            self,
            intersections=part.data(self.intersections, part.window, first),
            reused=self.reused if part.ranks == 1 else 0.0,  # the survey's tile intersections are of whole views
            colors=replace(self.colors, budget=self.colors.budget * part.memory),
            weights=self.weights and part.data(self.weights, part.window, raster),
            content=part.data(self.content, 1 / part.ranks),
            content_coarse=part.data(self.content_coarse, 1 / part.ranks),
            # Images are counted with their whole sizes, on which all ranks agree.
            images=replace(part.data(self.images, part.window), budget=self.images.budget * part.memory * part.window),
            coverage=part.data(self.coverage, 1.0),  # every rank has the whole coverage, and the whole maps
            maps=part.data(self.maps, 1.0),
            raster=part.seconds(self.raster, raster),
            raster_cached=part.seconds(self.raster_cached, raster),
        )

    def rasterized(self) -> float:
        """Return the time in seconds of a render and its gradient at a later visit, mean over views."""
        uncached = self.raster + self.intersections.always
        if self.weights is not None:
            uncached = self.weights.cached * self.raster_cached + (1 - self.weights.cached) * uncached
        return uncached + self.colors.always

    def later(self, *, coarse: bool) -> float:
        """Return the time in seconds to recompute uncached content, coverage and region maps at every visit."""
        content = (self.content_coarse if coarse else self.content).always
        return content + self.images.always + self.coverage.always + self.maps.always

    def first(self, *, coarse: bool) -> float:
        """Return the additional time in seconds of a view's first visit in a phase."""
        content = (self.content_coarse if coarse else self.content).once + self.images.once
        if self.in_coarse and not coarse:
            return content
        maps = self.coverage.once + self.maps.once
        intersections = (1 - self.reused) * self.intersections.once + self.colors.once
        return content + maps + intersections + (self.weights.once if self.weights else 0.0)


def _intersections(plan: Plan, probe: Probe) -> tuple[ViewData, ViewData, float]:
    """Return `surveyed`, `intersections` and `reused` of `ViewCosts`."""
    raster, memory, views = probe.raster, probe.machine.memory, len(plan.covered)
    most = memory_for("rasterizer", memory)
    # Ranks have surveyed different views.
    surveyed = ViewData(0.0, len(probe.sizes) * raster.intersection_bytes / probe.machine.ranks, most)
    budget = most if plan.cached_weights == "none" else least_intersection_memory(memory)
    intersections = ViewData(raster.first_seconds, views * raster.intersection_bytes, budget)
    reused = min(surveyed.cached / intersections.cached, 1.0) / probe.machine.ranks
    return surveyed, intersections, reused * (1 if plan.seen.all() else 1 - _RESTRICTING)


def _weights(plan: Plan, probe: Probe) -> ViewData | None:
    """Return the cached weights of all views; None if there are none."""
    raster = probe.raster
    if plan.cached_weights == "none":
        return None
    size = (raster.bytes if plan.cached_weights == "float32" else raster.half_bytes) or 0
    seconds = _CACHING_RENDERS * raster.seconds if raster.caching_seconds is None else raster.caching_seconds
    return ViewData(seconds, size, memory_for("rasterizer", probe.machine.memory), len(plan.covered))


def _content(
    plan: Plan, probe: Probe, settings: Settings, works: tuple[Work, Work], size: int, pixels: int, budget: float
) -> tuple[ViewData, ViewData, ViewData]:
    """Return `content`, `content_coarse` and `images` of `ViewCosts`.

    Args:
        plan: Plan under construction.
        probe: Measured facts.
        settings: Settings of the job.
        works: Work of an iteration on all scales, and on the coarsest one.
        size: Size in bytes of the content features of all views.
        pixels: Number of pixels of all views.
        budget: Budget in bytes for data of the views.
    """
    work, coarse = works
    render = RENDER * probe.raster.seconds if settings.content_weight else 0.0
    seconds = [each.features(probe.network) if settings.content_weight else 0.0 for each in works]
    fraction = content_fraction(probe.machine.device, weighted=plan.weighted, has_maps=bool(probe.maps))
    budget *= fraction
    images = ViewData(0.0)
    if plan.training_background != "background" and settings.content_weight:
        # Features depend on the step's background color, so images are cached in their place.
        images, render, budget = ViewData(render, _IMAGE_BYTES * pixels, budget / 2), 0.0, 0
    coarse_size = size * (coarse.pixels / work.pixels)  # bytes are in proportion to pixels
    return ViewData(render + seconds[0], size, budget), ViewData(render + seconds[1], coarse_size, budget), images


def proportional(seconds: float) -> Callable[[RankPart], float]:
    """Return a function that scales `seconds` of a whole view to the pixels that a rank renders."""
    return lambda part: part.seconds(seconds)


def view_memory(plan: Plan, memory: int) -> int:
    """Return the budget in bytes for data of the views: what other caches leave of it, and `Plan.spare`.

    Args:
        plan: Plan of the job.
        memory: Memory limit of a rank in bytes.
    """
    left = memory_for("views", memory) + plan.spare
    if plan.cached_weights != "none":
        left -= least_intersection_memory(memory)
    if plan.measured:
        left -= (2 if plan.is_approximated else 1) * measuring_memory(memory)
    return left
