"""What a view costs beside an iteration's passes: what is made at its first visit, and made anew where it is not kept.

Lists of Gaussians, colors of spherical harmonics, blend weights and content features of a view are made when it is
first visited, and kept as far as each of them fits its share of the memory. What fits costs seconds once; what does not
costs them at every visit.
"""

from __future__ import annotations

from dataclasses import dataclass

from sgsst_core.budget import LISTS_BESIDE_WEIGHTS, MEMORY_SHARES
from sgsst_core.planning.cost import Work
from sgsst_core.planning.plan import Plan
from sgsst_core.planning.probe import Probe
from sgsst_core.settings import Settings

#: Making a view's kept weights on the CPU, in renders with gradient.
KEEPING_RENDERS = 3
#: A render without its gradient, in renders with it.
RENDER = 0.5
#: Bytes of the colors of a Gaussian in a view: what its spherical harmonics add.
COLOR_BYTES = 12
#: Of a pixel of the content image at all scales, float32, which is kept where steps have different colors behind it.
_IMAGE_BYTES = 16
#: Of a pixel of a region's map at all scales, float32.
MAP_BYTES = 16 / 3
#: Regions whose maps come with one render.
MAPS_OF_A_RENDER = 3
#: Cutting the survey's lists of a view down to the Gaussians of the job, in making them.
_CUT = 0.25


@dataclass(frozen=True)
class Made:
    """Something that is made for each view.

    Attributes:
        seconds: of making it.
        bytes: of all views together.
        room: bytes that there are for them.
        views: how many, where a view's is kept whole or not at all; None where any share of it is.
    """

    seconds: float
    bytes: float = 0.0
    room: float = float("inf")
    views: int | None = None

    @property
    def kept(self) -> float:
        """The share of the views for which it is kept."""
        return self.fitting() / self.bytes if self.bytes else 1.0

    @property
    def once(self) -> float:
        """Seconds at a view's first visit beside those of every visit, mean over views."""
        return self.kept * self.seconds

    @property
    def always(self) -> float:
        """Seconds at every visit of a view, mean over views."""
        return (1 - self.kept) * self.seconds

    @property
    def kept_bytes(self) -> int:
        """Memory that it takes at last."""
        return int(self.fitting())

    def fitting(self, ranks: int = 1) -> float:
        """Bytes that are kept on each of some ranks, among which every view is divided."""
        own = self.bytes / ranks
        if own <= self.room:
            return own
        return self.room if self.views is None else self.room // (own / self.views) * (own / self.views)


@dataclass(frozen=True)
class Visits:
    """Everything that is made for the views of a job.

    Attributes:
        lists: of the rasterizer that computes weights anew.
        surveyed: lists that the survey has made, of all views.
        handed: share of the seconds of lists that are kept which the survey's save the job.
        colors: of spherical harmonics.
        weights: kept ones; None where none are.
        content: features at all scales, with the render that they are of; `content_coarse`: of the coarsest alone.
        maps: of the regions' shares.
        images: of the content, which features with another color behind them are computed from.
        raster: seconds of a render and its gradient, weights computed anew; `raster_kept`: with kept ones.
        in_coarse: phase 1 makes lists, colors and weights, so that phase 2 finds them.
        coarse_weights: phase 1 makes weights of its own.
    """

    lists: Made
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
    coarse_weights: bool

    @staticmethod
    def of(plan: Plan, probe: Probe, settings: Settings, work: Work, coarse: Work, content: int) -> Visits:
        """Of a plan, as far as it is made.

        Args:
            work: of an iteration on all scales, and `coarse` on the coarsest alone.
            content: bytes of the content features of all views.
        """
        raster, memory, views = probe.raster, probe.machine.memory, len(plan.covered)
        room = memory * MEMORY_SHARES["views"]
        weighed = memory * MEMORY_SHARES["rasterizer"]
        surveyed = Made(0.0, len(probe.sizes) * raster.lists_bytes, weighed)
        room_of_lists = weighed if plan.cached_weights == "none" else memory / LISTS_BESIDE_WEIGHTS
        lists = Made(raster.first_seconds, views * raster.lists_bytes, room_of_lists)
        colors = views * int(plan.seen.sum()) * COLOR_BYTES if probe.scene.used_degree else 0
        weights = None
        if plan.cached_weights != "none":
            size = (raster.bytes if plan.cached_weights == "float32" else raster.half_bytes) or 0
            seconds = KEEPING_RENDERS * raster.seconds if raster.keeping_seconds is None else raster.keeping_seconds
            weights = Made(seconds, size, weighed, views)
        rendered = RENDER * raster.seconds if settings.content_weight else 0.0
        forward = probe.network.rate.forward if settings.content_weight else 0.0
        room_of_content = 0 if "content" in settings.keep else room / (4 if probe.maps else 2)
        share = coarse.pixels / work.pixels  # of the content's bytes, as of its pixels
        images = Made(0.0)
        if (
            plan.training_background != "background" and settings.content_weight
        ):  # features are another color's at every visit
            pixels = sum(height * width for height, width in (probe.sizes[index] for index in plan.covered))
            room_of_images, room_of_content = room_of_content / 2, 0
            images, rendered = Made(rendered, _IMAGE_BYTES * pixels, room_of_images), 0.0
        return Visits(
            maps=_maps(plan, probe, room / 4),
            lists=lists,
            surveyed=surveyed,
            handed=min(surveyed.kept / lists.kept, 1.0) * (1 if plan.seen.all() else 1 - _CUT),
            colors=Made(raster.colors_seconds, colors, room / 4),
            weights=weights,
            content=Made(rendered + work.pixels * forward, content, room_of_content),
            content_coarse=Made(rendered + coarse.pixels * forward, content * share, room_of_content),
            images=images,
            raster=raster.seconds,
            raster_kept=raster.seconds if raster.kept_seconds is None else raster.kept_seconds,
            in_coarse=plan.steps_coarse > 0,
            coarse_weights=plan.coarse_weights,
        )

    def rasterized(self) -> float:
        """Seconds of a render and its gradient at a later visit, mean over views."""
        uncached = self.raster + self.lists.always
        if self.weights is not None:
            uncached = self.weights.kept * self.raster_kept + (1 - self.weights.kept) * uncached
        return uncached + self.colors.always

    def later(self, *, coarse: bool) -> float:
        """Seconds of every visit beside rendering and the network: content that is not kept."""
        return (self.content_coarse if coarse else self.content).always + self.images.always + self.maps.always

    def first(self, *, coarse: bool) -> float:
        """Seconds of a view's first visit in a phase beside those of its later visits."""
        content = (self.content_coarse if coarse else self.content).once + self.images.once
        lists = (1 - self.handed) * self.lists.once + self.colors.once + self.maps.once
        keeping = self.weights.once if self.weights else 0.0
        if coarse:
            return content + lists + (0.0 if self.coarse_weights else keeping)
        if not self.in_coarse:
            return content + lists + keeping
        return content + (keeping if self.coarse_weights else 0.0)


def _maps(plan: Plan, probe: Probe, room: float) -> Made:
    """Of the regions' shares in all views."""
    if not probe.maps:
        return Made(0.0)
    pixels = sum(height * width for height, width in (probe.sizes[index] for index in plan.covered))
    renders = 1 + -(-probe.maps // MAPS_OF_A_RENDER)  # and one of what lies behind
    return Made(RENDER * renders * probe.raster.seconds, MAP_BYTES * probe.maps * pixels, room)
