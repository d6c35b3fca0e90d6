"""Cost of a view's data: they are computed at its first visit and cached, or recomputed at every visit.

Tile intersections, SH colors, blend weights and content features of a view are computed at its first visit, and cached
as far as they fit their memory budgets. Cached data take time once; other data take time at every visit.
"""

from __future__ import annotations

from dataclasses import dataclass

from sgsst_core.budget import least_intersection_memory, memory_for
from sgsst_core.planning.cost import Work
from sgsst_core.planning.plan import Plan
from sgsst_core.planning.probe import Probe
from sgsst_core.settings import Settings

#: Time to compute a view's cached weights on the CPU, relative to a render with gradient.
KEEPING_RENDERS = 3
#: Time of a render without gradient, relative to a render with gradient.
RENDER = 0.5
#: Bytes per Gaussian of a view's colors: the contribution of spherical harmonics.
COLOR_BYTES = 12
#: Bytes per pixel of the content image at all scales, float32. It is cached if the background changes from step to
#: step.
_IMAGE_BYTES = 16
#: Bytes per pixel of a region's map at all scales, float32.
MAP_BYTES = 16 / 3
#: Number of region maps computed by one render.
MAPS_OF_A_RENDER = 3
#: Cost of restricting the survey's tile intersections to the Gaussians of the job, relative to computing them.
_CUT = 0.25


@dataclass(frozen=True)
class Made:
    """Data that are computed for each view.

    Attributes:
        seconds: Seconds to compute the data of a view.
        bytes: Size of the data of all views.
        room: Memory budget in bytes.
        views: Number of views, if the data of a view are cached completely or not at all; None if any fraction can be.
    """

    seconds: float
    bytes: float = 0.0
    room: float = float("inf")
    views: int | None = None

    @property
    def kept(self) -> float:
        """Fraction of the views whose data are cached."""
        return self.fitting() / self.bytes if self.bytes else 1.0

    @property
    def once(self) -> float:
        """Time in seconds at a view's first visit to compute data that are then cached, mean over views."""
        return self.kept * self.seconds

    @property
    def always(self) -> float:
        """Time in seconds at every visit of a view to recompute uncached data, mean over views."""
        return (1 - self.kept) * self.seconds

    @property
    def cached_bytes(self) -> int:
        """Final size of the cached data in bytes."""
        return int(self.fitting())

    def fitting(self, ranks: int = 1) -> float:
        """Return the bytes that each rank caches if every view is divided among `ranks` ranks."""
        own = self.bytes / ranks
        if own <= self.room:
            return own
        return self.room if self.views is None else self.room // (own / self.views) * (own / self.views)


@dataclass(frozen=True)
class Visits:
    """All data that are computed for the views of a job.

    Attributes:
        intersections: Tile intersections of the rasterizer that computes weights.
        surveyed: Tile intersections cached by the survey, of all views.
        handed: Fraction of the time for cached tile intersections that is saved because the survey already computed
            them.
        colors: SH colors.
        weights: Cached weights; None if there are none.
        content: Content features at all scales, including their render.
        content_coarse: Content features of the coarsest scale alone.
        images: Content images, from which features are computed with another background color.
        maps: Maps of the regions.
        raster: Time in seconds of a render and its gradient with recomputed weights.
        raster_kept: Time in seconds of a render and its gradient with cached weights.
        in_coarse: Whether phase 1 already computes tile intersections, colors and weights for phase 2.
    """

    intersections: Made
    surveyed: Made
    handed: float
    colors: Made
    weights: Made | None
    content: Made
    content_coarse: Made
    images: Made
    maps: Made
    raster: float
    raster_kept: float
    in_coarse: bool

    @staticmethod
    def of(plan: Plan, probe: Probe, settings: Settings, work: Work, coarse: Work, content: int) -> Visits:
        """Predict the data for a plan under construction.

        Args:
            plan: Plan under construction.
            probe: Measured facts.
            settings: Settings of the job.
            work: Work of an iteration on all scales.
            coarse: Work of an iteration on the coarsest scale.
            content: Size in bytes of the content features of all views.
        """
        raster, memory, views = probe.raster, probe.machine.memory, len(plan.covered)
        room = memory_for("views", memory)
        weighed = memory_for("rasterizer", memory)
        surveyed = Made(0.0, len(probe.sizes) * raster.intersection_bytes, weighed)
        room_of_intersections = weighed if plan.cached_weights == "none" else least_intersection_memory(memory)
        intersections = Made(raster.first_seconds, views * raster.intersection_bytes, room_of_intersections)
        colors = views * int(plan.seen.sum()) * COLOR_BYTES if probe.scene.used_degree else 0
        weights = None
        if plan.cached_weights != "none":
            size = (raster.bytes if plan.cached_weights == "float32" else raster.half_bytes) or 0
            seconds = KEEPING_RENDERS * raster.seconds if raster.keeping_seconds is None else raster.keeping_seconds
            weights = Made(seconds, size, weighed, views)
        rendered = RENDER * raster.seconds if settings.content_weight else 0.0
        forward = probe.network.rate.forward if settings.content_weight else 0.0
        room_of_content = 0 if "content" in settings.keep else room / (4 if probe.maps else 2)
        share = coarse.pixels / work.pixels  # fraction of the pixels, and thereby of the content's bytes
        images = Made(0.0)
        if (
            plan.training_background != "background" and settings.content_weight
        ):  # features depend on the step's background color
            pixels = sum(height * width for height, width in (probe.sizes[index] for index in plan.covered))
            room_of_images, room_of_content = room_of_content / 2, 0
            images, rendered = Made(rendered, _IMAGE_BYTES * pixels, room_of_images), 0.0
        return Visits(
            maps=_maps(plan, probe, room / 4),
            intersections=intersections,
            surveyed=surveyed,
            handed=min(surveyed.kept / intersections.kept, 1.0) * (1 if plan.seen.all() else 1 - _CUT),
            colors=Made(raster.colors_seconds, colors, room / 4),
            weights=weights,
            content=Made(rendered + work.pixels * forward, content, room_of_content),
            content_coarse=Made(rendered + coarse.pixels * forward, content * share, room_of_content),
            images=images,
            raster=raster.seconds,
            raster_kept=raster.seconds if raster.kept_seconds is None else raster.kept_seconds,
            in_coarse=plan.steps_coarse > 0,
        )

    def rasterized(self) -> float:
        """Return the time in seconds of a render and its gradient at a later visit, mean over views."""
        uncached = self.raster + self.intersections.always
        if self.weights is not None:
            uncached = self.weights.kept * self.raster_kept + (1 - self.weights.kept) * uncached
        return uncached + self.colors.always

    def later(self, *, coarse: bool) -> float:
        """Return the time in seconds to recompute uncached content and region maps at every visit."""
        return (self.content_coarse if coarse else self.content).always + self.images.always + self.maps.always

    def first(self, *, coarse: bool) -> float:
        """Return the additional time in seconds of a view's first visit in a phase."""
        content = (self.content_coarse if coarse else self.content).once + self.images.once
        if self.in_coarse and not coarse:
            return content
        intersections = (1 - self.handed) * self.intersections.once + self.colors.once + self.maps.once
        return content + intersections + (self.weights.once if self.weights else 0.0)


def _maps(plan: Plan, probe: Probe, room: float) -> Made:
    """Return the cost of the region maps of all views."""
    if not probe.maps:
        return Made(0.0)
    pixels = sum(height * width for height, width in (probe.sizes[index] for index in plan.covered))
    renders = 1 + -(-probe.maps // MAPS_OF_A_RENDER)  # plus one for the background
    return Made(RENDER * renders * probe.raster.seconds, MAP_BYTES * probe.maps * pixels, room)
