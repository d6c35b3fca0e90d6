"""Cost model of a job: its seconds and bytes, predicted from measured facts and from the choices of its plan.

The predicted time of a step consists of

- the pixels that pass through the feature network (`Work`), times its measured rate,
- a render and its gradient, and the data of the view that are not cached (`ViewCosts`),
- with several ranks, each rank's portion of both, and the messages between ranks (`IterationWork`).

A view's first visit takes longer, because its data are then computed. `CostModel` adds this up over all steps and
measurements, and predicts the peak memory of a rank.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace

from sgsst_core.budget import content_fraction, least_intersection_memory, measuring_memory, memory_for
from sgsst_core.features.partition import (
    Rectangle,
    cached_tiles,
    choose_tile_size,
    computed_twice,
    partition,
    scaled_region,
)
from sgsst_core.features.vgg import layer_stride
from sgsst_core.loss.nearest import MATCH_BYTES, MOST_VECTORS, working_bytes
from sgsst_core.loss.scale_weights import ScaleWeights
from sgsst_core.loss.tiling import RENDERING, Tiling
from sgsst_core.parallel.collectives import TRAFFIC, Traffic
from sgsst_core.parallel.division import Piece, Shares, Size, divide, loads, rounds
from sgsst_core.parallel.shown import gaussians_sent
from sgsst_core.planning.facts import Link, NetworkFacts, Probe
from sgsst_core.planning.measuring import (
    LEVELS,
    LOSS_VIEWS,
    RENDERED,
    Prices,
    choose_level,
    choose_loss_views,
    novel_view_seconds,
)
from sgsst_core.planning.plan import Plan, Prediction
from sgsst_core.settings import Settings

#: One of the layers whose features are matched with the style's; all these layers have the same resolution.
_MATCHED = "relu3_1"
#: Temporary memory that a pass on a CPU uses if all activations are cached, as a fraction of `Tiling.working`
#: (measured: 0.4 at 512x384, where it is 40 MB, and at most 0.15 at 990x742).
_WORKING_FRACTION = 0.25
#: Time to compute a view's cached weights on the CPU, relative to a render with gradient.
_CACHING_RENDERS = 3
#: Time of a render without gradient, relative to a render with gradient.
_RENDER = 0.5
#: Cost of restricting the survey's tile intersections to the Gaussians of the job, relative to computing them.
_RESTRICTING = 0.25
#: Number of views that represent all views when the time on several ranks is predicted.
_SAMPLED_VIEWS = 3

#: Channels of the style layers. Ranks exchange their statistics in float64: first the pixel count and the mean, then
#: one half of the symmetric covariance.
_STYLE_CHANNELS = (64, 128, 256, 512, 512)
_FIRST_BYTES = 8 * sum(c + 1 for c in _STYLE_CHANNELS)
_SECOND_BYTES = 8 * sum(c * (c + 1) // 2 for c in _STYLE_CHANNELS)
#: Minimum fraction of an iteration that additional ranks must save.
LEAST_GAIN = 0.03

#: Time from the last step to the last file written: constant seconds for images and report, and seconds per Gaussian
#: for the neighbor search and for writing (measured with 4 million Gaussians on two cores; an estimate elsewhere).
_ENDING_SECONDS = 1.5
_ENDING_SECONDS_A_GAUSSIAN = 4e-6
#: Portion of `_ENDING_SECONDS_A_GAUSSIAN` for the neighbor search. If some Gaussians are unseen, the search is repeated
#: at every measurement.
_NEIGHBORS_SECONDS_A_GAUSSIAN = 1.5e-6
#: Renders needed to compute the depth of a novel view.
_DEPTH_RENDERS = 2

#: Additional bytes per optimized Gaussian: color, gradient and two moments, float32.
OPTIMIZER_BYTES = 4 * 3 * 4
#: Additional bytes per Gaussian allocated in each step on the CPU: for a view's colors, and for their gradients in
#: total and per raster tile.
_STEP_BYTES = 4 * 3 * 4
#: Bytes per Gaussian of a view's colors: the contribution of spherical harmonics.
_COLOR_BYTES = 12
#: Bytes per pixel of the content image at all scales, float32. It is cached if the background changes from step to
#: step.
_IMAGE_BYTES = 16
#: Bytes per pixel of coverage or of a region's map at all scales, float32, and number of maps computed by one render.
MAP_BYTES, MAPS_OF_A_RENDER = 16 / 3, 3
#: Memory of measurements and report, apart from iterations and tile intersections: libraries, LPIPS, images.
MEASURING_BYTES = 100 << 20
#: Bytes per Gaussian of a projected scene: for its shape, cached between views, and for its projection, depth and order
#: while the tile intersections of a view are computed.
SHAPE_BYTES, BUILDING_BYTES = 32, 104
#: Bytes per Gaussian during the neighbor search for unseen ones: result, its difference, positions, and search tree.
SEARCH_BYTES = 120
#: Memory for the gradient of each tile intersection in a rasterizer's backward pass, as a fraction of a view's tile
#: intersections.
_SLOTS_FRACTION = 0.25
#: Bytes per pair of Gaussian and raster tile on a GPU: while the pairs of a view are sorted (keys, values and the
#: sort's own buffers), and for its slot in the color gradient.
SORTING_BYTES, _SLOT_BYTES = 36, 12
#: Estimated workspace of cuDNN, and buffers of NCCL, in bytes. Steps in bfloat16 and TF32 took 0.77 to 1.07 times
#: the planned memory of an H100; in float32 at 980x545, cuDNN took 4 GB more, which were free. NCCL was not measured.
CUDNN_BYTES, NCCL_BYTES = 512 << 20, 512 << 20
#: Bytes per pixel of a novel view: its coverage, and its two warps.
_COVERAGE_BYTES, _WARP_BYTES = 4, 2 * 40


# --- pixels through the network ------------------------------------------------------------------------------------


def pieces_of(size: Size, tiling: Tiling, region: Rectangle | None, *, coarsest: bool = False) -> tuple[Piece, ...]:
    """Return the pieces of a view that go through the network: one per scale, or only the one of the coarsest scale.

    Args:
        size: (height, width) of the view.
        tiling: Partitioning rules.
        region: Rectangle that contains all covered pixels; None if uncovered pixels are processed too.
        coarsest: Whether to return only the coarsest scale.
    """
    scales = tiling.scales(size)
    return tuple(_piece(size, scale, region) for scale in (scales[-1:] if coarsest else scales))


def _piece(size: Size, scale: int, region: Rectangle | None) -> Piece:
    scaled = (size[0] >> scale, size[1] >> scale)
    rectangle = Rectangle(0, 0, *scaled) if region is None else scaled_region(region, scale, scaled)
    return Piece(scale, scaled, rectangle)


@dataclass(frozen=True)
class Work:
    """Pixels through the network in one iteration, mean over views.

    Attributes:
        pixels: Pixels through the forward and the backward pass, including halos.
        again: Pixels through a second forward pass, because their activations do not fit in memory.
        without_region: Value of `pixels` if uncovered pixels were processed too.
        tiles: Maximum number of tiles of a view at one scale.
        passes: Number of tiles of a view at all scales.
        peak: Maximum number of pixels in memory at a time, including the temporary memory of a pass in units of pixels.
        pairs: Pairs of position and style vector compared by the nearest-neighbor search.
    """

    pixels: float
    again: float
    without_region: float
    tiles: int
    passes: float
    peak: float
    pairs: float = 0.0

    @staticmethod
    def of(views: Sequence[tuple[Piece, ...]], tiling: Tiling, *, working_fraction: float = 1.0) -> Work:
        """Count the work of the pieces of each view.

        Args:
            views: Pieces of each view, see `pieces_of`.
            tiling: Partitioning rules.
            working_fraction: See `_WORKING_FRACTION`; 1 if unknown.
        """
        pixels = again = without = pairs = passes = 0.0
        tiles = 0
        peak = 0.0
        for piece in (piece for pieces in views for piece in pieces):
            areas = [tile.outer.pixels for tile in tiling.tiles(piece.size, piece.region)]
            flags = tiling.cached(areas)
            twice = computed_twice(areas, flags)
            pixels += sum(areas)
            again += twice
            pairs += pairs_of(piece)
            without += sum(tile.outer.pixels for tile in tiling.tiles(piece.size))
            tiles = max(tiles, len(areas))
            passes += len(areas)
            once = max((area for area, flag in zip(areas, flags, strict=True) if not flag), default=0)
            # If all activations are cached, a pass needs its temporary memory while some activations are not computed
            # yet, or already freed.
            working = tiling.working * (1.0 if twice else working_fraction)
            held = sum(areas) - twice + working * max(areas, default=0)
            peak = max(peak, held, (1 + tiling.working) * once)
        count = len(views)
        return Work(pixels / count, again / count, without / count, tiles, passes / count, peak, pairs / count)

    def seconds(self, network: NetworkFacts, *, graphs: bool) -> float:
        """Return the time in seconds of the loss and its gradient; a CUDA graph of them is a single launch."""
        rate = network.rate
        both = self.pixels * rate.both if graphs else self._longer(rate.both, network.fixed.both)
        return both + self.again * rate.features + self.pairs * rate.search

    def evaluation(self, network: NetworkFacts) -> float:
        """Return the time in seconds of the loss without its gradient."""
        return self._longer(network.rate.forward, network.fixed.forward) + self.pairs * network.rate.search

    def features(self, network: NetworkFacts) -> float:
        """Return the time in seconds of the feature network's forward pass alone."""
        return self._longer(network.rate.features, network.fixed.features)

    def _longer(self, pixel: float, tile: float) -> float:
        """Return the time of all pixels or of all launches, whichever is longer: a GPU works on during launches."""
        return max(self.pixels * pixel, self.passes * tile)


def pairs_of(piece: Piece) -> int:
    """Return the number of pairs of a piece's positions with the vectors of a style as large as the view."""
    return piece.cells(_MATCHED) * _vectors(piece.size)


def _vectors(size: Size) -> int:
    """Return the number of vectors of a style as large as a scaled view of size (height, width)."""
    stride = layer_stride(_MATCHED)
    return min((size[0] // stride) * (size[1] // stride), MOST_VECTORS)


def gaussian_bytes(sh_degree: int) -> int:
    """Return the size in bytes of a float32 Gaussian.

    It consists of position, rotation, scale, opacity, and coefficients of three color channels.
    """
    return 4 * (3 + 4 + 3 + 1 + 3 * (sh_degree + 1) ** 2)


def content_bytes(sizes: Iterable[Size], tiling: Tiling, cell: int) -> int:
    """Return the size in bytes of the content features of views at all scales, given the bytes per cell."""
    cells = sum(
        (height >> scale + 3) * (width >> scale + 3)
        for height, width in sizes
        for scale in tiling.scales((height, width))
    )
    return cells * cell


def _matching_bytes(sizes: Sequence[Size], tiling: Tiling, channels: int, device: str) -> int:
    """Return the memory in bytes for matching features; every rank stores all of the style's vectors.

    It consists of style vectors for all view sizes at all scales, matches, and search buffers.

    Args:
        sizes: (height, width) of each view.
        tiling: Partitioning rules.
        channels: Length of a vector; 0 if nothing is matched.
        device: "cpu" or "cuda".
    """
    if not channels:
        return 0
    by_size = {size: [(size[0] >> scale, size[1] >> scale) for scale in tiling.scales(size)] for size in set(sizes)}
    vectors = sum(_vectors(scaled) for scales in by_size.values() for scaled in scales)
    largest = max(sum(height * width for height, width in scales) for scales in by_size.values())
    positions = largest // layer_stride(_MATCHED) ** 2
    return vectors * channels * 4 + positions * MATCH_BYTES + working_bytes(channels, 4, device)


# --- data of the views ---------------------------------------------------------------------------------------------


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
        """Return the rank's time in seconds, given that of a whole view, and how much of it is for any window."""
        fixed = min(fixed, whole)
        return fixed + (whole - fixed) * self.window

    def data(self, whole: ViewData, fraction: float, fixed: float = 0.0) -> ViewData:
        """Return the rank's data of the views, a fraction of those of the whole views."""
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
        raster, memory, views = probe.raster, probe.machine.memory, len(plan.covered)
        view_budget, raster_budget = view_memory(plan, memory), memory_for("rasterizer", memory)
        # Ranks have surveyed different views.
        surveyed = ViewData(0.0, len(probe.sizes) * raster.intersection_bytes / probe.machine.ranks, raster_budget)
        budget = raster_budget if plan.cached_weights == "none" else least_intersection_memory(memory)
        intersections = ViewData(raster.first_seconds, views * raster.intersection_bytes, budget)
        colors = views * int(plan.seen.sum()) * _COLOR_BYTES if probe.scene.used_degree else 0
        weights = None
        if plan.cached_weights != "none":
            size = (raster.bytes if plan.cached_weights == "float32" else raster.half_bytes) or 0
            seconds = _CACHING_RENDERS * raster.seconds if raster.caching_seconds is None else raster.caching_seconds
            weights = ViewData(seconds, size, raster_budget, views)
        rendered = _RENDER * raster.seconds if settings.content_weight else 0.0
        features = [each.features(probe.network) if settings.content_weight else 0.0 for each in (work, coarse)]
        fraction = content_fraction(probe.machine.device, weighted=plan.weighted, has_maps=bool(probe.maps))
        content_budget = 0 if "content" in settings.keep else view_budget * fraction
        pixels = sum(height * width for height, width in (probe.sizes[index] for index in plan.covered))
        images = ViewData(0.0)
        if plan.training_background != "background" and settings.content_weight:
            # Features depend on the step's background color, so images are cached in their place.
            images, rendered = ViewData(rendered, _IMAGE_BYTES * pixels, content_budget / 2), 0.0
            content_budget = 0
        coverage = maps = ViewData(0.0)
        if plan.weighted:
            coverage = ViewData(_RENDER * raster.seconds, MAP_BYTES * pixels, view_budget / 4)
        if probe.maps:
            renders = 1 + -(-probe.maps // MAPS_OF_A_RENDER)  # plus one for the background
            maps = ViewData(_RENDER * renders * raster.seconds, MAP_BYTES * probe.maps * pixels, view_budget / 4)
        coarse_content = content * (coarse.pixels / work.pixels)  # bytes are in proportion to pixels
        return ViewCosts(
            coverage=coverage,
            maps=maps,
            intersections=intersections,
            surveyed=surveyed,
            reused=min(surveyed.cached / intersections.cached, 1.0)
            / probe.machine.ranks
            * (1 if plan.seen.all() else 1 - _RESTRICTING),
            colors=ViewData(raster.colors_seconds, colors, view_budget / 4),
            weights=weights,
            content=ViewData(rendered + features[0], content, content_budget),
            content_coarse=ViewData(rendered + features[1], coarse_content, content_budget),
            images=images,
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


def proportional(seconds: float) -> Callable[[RankPart], float]:
    """Return the function of a part for a time in seconds that is in proportion to the rendered pixels."""
    return lambda part: part.seconds(seconds)


# --- several ranks -------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class IterationWork:
    """Work of an iteration on one view, divided among ranks by `division`.

    Communication is counted in bytes and messages, assuming ring algorithms for sums.

    Attributes:
        pieces: One piece for each computed scale.
        halo: Pixels around a partition tile.
        pixel: Seconds per pixel through the network: both passes and statistics.
        raster: Function that returns the time in seconds of render, gradient and uncached data of the view for a part.
        fixed: Seconds that every rank needs regardless of their number, such as those of the optimizer.
        gaussians: Number of optimized Gaussians.
        forward: Seconds per pixel of a forward pass alone, for pixels whose activations are not cached.
        held: Number of pixels whose activations a single rank can hold (see `choose_tile_size`).
        working: Memory of a pass in addition to the activations, as a fraction of them.
        sharing: Number of ranks that divide the memory for activations.
        shown: Number of Gaussians that the view shows, whose gradients are sent; None for all.
        matching: Time in seconds of the nearest-neighbor search on one rank.
        largest_tile: Maximum pixels of a partition tile; None for no limit.
        rendered: One piece for each scale of the job, whose division determines what each rank renders; empty if these
            are `pieces`.
        rendering: Cost of rendering a pixel that the division assumes; see `Tiling`.
        launch: Seconds to launch the kernels of a partition tile, during which a GPU works on; 0 on a CPU.
        graphs: Whether a single rank launches all kernels of the loss as one CUDA graph, in almost no time.
    """

    pieces: tuple[Piece, ...]
    halo: int
    pixel: float
    raster: Callable[[RankPart], float]
    fixed: float
    gaussians: int
    forward: float = 0.0
    held: float = math.inf
    working: float = 0.0
    sharing: int = 1
    shown: float | None = None
    matching: float = 0.0
    largest_tile: int | None = None
    rendered: tuple[Piece, ...] = ()
    rendering: float = 0.0
    launch: float = 0.0
    graphs: bool = False

    def computing(self, ranks: int, groups: int = 1) -> float:
        """Return the computing time in seconds of the rank with most work.

        Args:
            ranks: Number of ranks per group.
            groups: Number of groups, each of which takes a view.
        """
        held = self.held / min(ranks * groups, self.sharing)
        own = (
            self._network(shard, ranks, held) + self.raster(part)
            for shard, part in zip(self.shards(ranks), self.parts(ranks, groups), strict=True)
        )
        return max(own) + self.matching / ranks + self.fixed

    def parts(self, ranks: int, groups: int = 1) -> list[RankPart]:
        """Return the part of the view that each rank of a group renders; see `computing`."""
        memory = self.sharing / min(ranks * groups, self.sharing)
        whole = max(self._shares(1).windows[0].pixels, 1)
        return [RankPart(ranks, window.pixels / whole, memory) for window in self._shares(ranks).windows]

    def _network(self, shard: Sequence[Piece], ranks: int, held: float) -> float:
        """Return the time in seconds of a rank's pieces, split into partition tiles as its memory requires."""
        areas = {piece.scale: self._areas(piece, held) for piece in shard if piece.region.pixels}
        launching = 0.0 if self.graphs and ranks == 1 else self.launch * sum(map(len, areas.values()))
        seconds = 0.0
        for scales in rounds(list(areas), ranks):
            together = [area for scale in scales for area in areas[scale]]
            twice = computed_twice(together, cached_tiles(together, held, self.working))
            seconds += sum(together) * self.pixel + twice * self.forward
        return max(seconds, launching)

    def _areas(self, piece: Piece, held: float) -> list[int]:
        size = choose_tile_size(
            *piece.size, self.halo, held=held, working=self.working, region=piece.region, largest=self.largest_tile
        )
        return [tile.outer.pixels for tile in partition(*piece.size, size, self.halo, piece.region)]

    def communication(self, ranks: int, link: Link) -> float:
        """Return the time in seconds that ranks wait for data."""
        return sum(self.waiting(ranks, link).values())

    def waiting(self, ranks: int, link: Link) -> dict[Traffic, float]:
        """Return the time in seconds that ranks wait for data, by purpose."""
        if ranks == 1:
            return dict.fromkeys(TRAFFIC, 0.0)
        busiest = max(max(sent, received) for sent, received in self._image_bytes(ranks))
        scales = len(self.pieces)
        return {
            "image": 2 * (link.all_gather(0, ranks) + busiest / link.bandwidth),
            "statistics": sum(link.all_reduce(scales * size, ranks) for size in (_FIRST_BYTES, _SECOND_BYTES)),
            "gradient": link.all_reduce(self._gradient_bytes, ranks),
        }

    def sent(self, ranks: int) -> dict[Traffic, int]:
        """Return the bytes that a rank sends for each purpose, at all scales, as counted by `Collectives.sent`.

        Ranks send different parts of the image; the value is that of the rank that sends most.
        """
        twice = 2 * (ranks - 1) / ranks  # once to reduce, once to distribute
        statistics = len(self.pieces) * (_FIRST_BYTES + _SECOND_BYTES)
        return {
            "image": max(sent + received for sent, received in self._image_bytes(ranks)),
            "statistics": int(twice * statistics),
            "gradient": int(twice * self._gradient_bytes),
        }

    def _shares(self, ranks: int) -> Shares:
        pieces = self.rendered or self.pieces
        height, width = max((piece.size[0] << piece.scale, piece.size[1] << piece.scale) for piece in pieces)
        by_rank = divide(pieces, self.halo, (1.0,) * ranks, self.rendering)
        return Shares.of((height, width), by_rank, self.halo)

    def shards(self, ranks: int) -> tuple[tuple[Piece, ...], ...]:
        """Return the pieces that each rank of a group passes through the network."""
        rendering = self.rendering if self.rendered in ((), self.pieces) else 0.0
        return divide(self.pieces, self.halo, (1.0,) * ranks, rendering)

    def _image_bytes(self, ranks: int) -> list[tuple[int, int]]:
        """Return the bytes of the image that each rank sends and receives; those of its gradient go the other way."""
        exchanges = self._shares(ranks).exchanges(self.shards(ranks), self.halo).values()
        moved = [[exchange.moved(rank) for exchange in exchanges] for rank in range(ranks)]
        return [(12 * sum(sent for sent, _ in each), 12 * sum(received for _, received in each)) for each in moved]

    @property
    def _gradient_bytes(self) -> int:
        return int(12 * (self.gaussians if self.shown is None else gaussians_sent(self.shown, self.gaussians)))

    def seconds(self, ranks: int, link: Link, groups: int = 1) -> float:
        """Return the time in seconds of an iteration of one view, including communication.

        Args:
            ranks: Number of ranks per group.
            link: Connection between the ranks.
            groups: Number of groups, each of which takes a view.
        """
        return self.computing(ranks, groups) + self.communication(ranks, link)


@dataclass(frozen=True)
class RanksChoice:
    """Chosen number of ranks.

    Attributes:
        ranks: Number of ranks that take part.
        seconds: Time in seconds of the whole schedule for each number of ranks considered.
    """

    ranks: int
    seconds: dict[int, float]

    @property
    def speed_up(self) -> float:
        """Speed-up over one rank."""
        return self.seconds[1] / self.seconds[self.ranks]


def choose_ranks(
    phases: Sequence[tuple[int, Sequence[IterationWork]]], views_per_step: int, available: int, link: Link
) -> RanksChoice:
    """Choose the smallest number of ranks whose time is within `LEAST_GAIN` of the best.

    Args:
        phases: Number of steps of each phase, and the work of iterations on a sample of views.
        views_per_step: Views per step, which groups of ranks process in parallel.
        available: Number of available ranks.
        link: Connection between the ranks.
    """
    seconds = {ranks: _schedule_seconds(phases, views_per_step, ranks, link) for ranks in _candidates(available)}
    best = min(seconds.values())
    enough = min(ranks for ranks, time_ in seconds.items() if time_ <= best * (1 + LEAST_GAIN))
    return RanksChoice(enough, seconds)


def _candidates(available: int) -> list[int]:
    """Return the numbers of ranks to consider: all up to eight, then increasing by a quarter."""
    candidates, ranks = [], 1
    while ranks < available:
        candidates.append(ranks)
        ranks += max(ranks // 4, 1) if ranks >= 8 else 1
    return [*candidates, available]


def _schedule_seconds(
    phases: Sequence[tuple[int, Sequence[IterationWork]]], views_per_step: int, ranks: int, link: Link
) -> float:
    groups = math.gcd(views_per_step, ranks)
    each = ranks // groups
    total = 0.0
    for steps, works in phases:
        mean = sum(work.seconds(each, link, groups) for work in works) / len(works)
        across = link.all_reduce(works[0].gaussians * 12, ranks) if groups > 1 else 0.0
        total += steps * (mean * views_per_step / groups + across)
    return total


# --- the whole job -------------------------------------------------------------------------------------------------


class CostModel:
    """Predicted seconds and bytes of a job.

    Args:
        plan: Plan under construction: complete except for ranks, measurements, decisions and prediction.
        probe: Measured facts.
        settings: Settings of the job.

    Attributes:
        tiling: Partitioning rules.
        sizes: (height, width) of each view of the job.
        work: Work of an iteration on all scales.
        coarse: Work of an iteration on the coarsest scale.
        views: Data that are computed for the views.
    """

    def __init__(self, plan: Plan, probe: Probe, settings: Settings) -> None:
        self._plan, self._probe, self._settings = plan, probe, settings
        self.tiling = tiling_of(probe, settings)
        self.sizes = [probe.sizes[index] for index in plan.covered]
        skip = plan.weighted and "uncovered" not in settings.keep
        self._regions = [probe.survey.regions[index] if skip else None for index in plan.covered]
        fraction = _WORKING_FRACTION if probe.machine.device == "cpu" else 1.0
        everything = range(len(self.sizes))
        self.work = Work.of(self._pieces(everything), self.tiling, working_fraction=fraction)
        self.coarse = Work.of(self._pieces(everything, coarsest=True), self.tiling)
        content = content_bytes(self.sizes, self.tiling, probe.network.content_bytes)
        self._plan = plan = replace(plan, spare=self.spare())
        self.views = ViewCosts.of(plan, probe, settings, self.work, self.coarse, content)

    def _pieces(self, views: Iterable[int], *, coarsest: bool = False) -> list[tuple[Piece, ...]]:
        """Return the pieces of some views of the job, given by their positions in `sizes`."""
        return [pieces_of(self.sizes[at], self.tiling, self._regions[at], coarsest=coarsest) for at in views]

    def spare(self) -> int:
        """Return the bytes of the budget for activations that the steps of a single rank on a GPU do not need."""
        plan, machine = self._plan, self._probe.machine
        if machine.device == "cpu" or machine.ranks > 1:
            return 0
        budget, once = memory_for("activations", machine.memory), int(self.work.peak * self._probe.network.held_bytes)
        needed = reference_activations(plan, once, budget)
        # A CUDA graph does not share its memory: evaluating the loss without the graph needs the same amount again.
        return max(budget - needed - (once if plan.graphs else 0), 0)

    def on_one_rank(self) -> tuple[Prediction, int]:
        """Return the prediction for the steps on one rank, and the bytes of its activations."""
        network, views, graphs = self._probe.network, self.views, self._plan.graphs
        seconds, seconds_coarse = (
            self._settings.views_per_step
            * (work.seconds(network, graphs=graphs) + views.rasterized() + views.later(coarse=work is self.coarse))
            for work in (self.work, self.coarse)
        )
        return Prediction(seconds, seconds_coarse, 0), int(self.work.peak * network.held_bytes)

    def on_several_ranks(self) -> tuple[RanksChoice, Prediction, int, RankPart]:
        """Choose the number of ranks.

        Returns:
            Choice, prediction for the steps on the chosen ranks, bytes of a rank's activations, and its part of a view;
            both for the rank with most of them.
        """
        available, link = self._probe.machine.ranks, self._probe.link
        coarse, sos = self._sampled(coarsest=True), self._sampled(coarsest=False)
        phases = [(self._plan.steps_coarse, coarse), (self._settings.steps_sos, sos)]
        choice = choose_ranks(phases, self._settings.views_per_step, available, link)
        if "ranks" in self._settings.keep:
            choice = replace(choice, ranks=available)
        return choice, *self._on_ranks(choice.ranks, coarse, sos)

    def _on_ranks(
        self, ranks: int, coarse: list[IterationWork], sos: list[IterationWork]
    ) -> tuple[Prediction, int, RankPart]:
        """Return the prediction for a number of ranks, and a rank's activations in bytes and its part of a view.

        Groups of ranks process views in parallel, one view per group.
        """
        link, network = self._probe.link, self._probe.network
        groups = math.gcd(self._settings.views_per_step, ranks)
        each, turns = ranks // groups, self._settings.views_per_step // groups

        def per_step(seconds: Sequence[float]) -> float:
            return turns * sum(seconds) / len(seconds)

        largest = max(max(loads(work.shards(each), work.halo)) for work in sos)
        parts = [max(work.parts(each, groups), key=lambda part: part.window) for work in sos]
        part = replace(parts[0], window=sum(each.window for each in parts) / len(parts))
        memory = memory_for("activations", self._probe.machine.memory) * part.memory
        activations = int(min(largest * (network.held_bytes + network.working_bytes), memory))
        prediction = Prediction(
            per_step([work.seconds(each, link, groups) for work in sos]),
            per_step([work.seconds(each, link, groups) for work in coarse]),
            0,
            per_step([work.communication(each, link) for work in sos]),
            per_step([work.seconds(1, link) for work in sos]) * groups,
        )
        return prediction, activations, part

    def _sampled(self, *, coarsest: bool) -> list[IterationWork]:
        """Return the work of iterations of a sample of views: of phase 1, or on all scales."""
        network, sharing, plan = self._probe.network, self._probe.machine.sharing, self._plan
        tile = network.fixed.both  # on a GPU, the time to launch its kernels
        fixed, launch = (tile, 0.0) if self._probe.machine.device == "cpu" else (0.0, tile)
        sample = range(0, len(self.sizes), max(1, len(self.sizes) // _SAMPLED_VIEWS))

        def raster(part: RankPart) -> float:
            views = self.views.of_rank(part)
            return views.rasterized() + views.later(coarse=coarsest)

        return [
            IterationWork(
                pieces,
                network.halo,
                network.rate.both,
                raster,
                fixed * len(pieces),
                int(plan.seen.sum()),
                forward=network.rate.features,
                held=self.tiling.held * sharing,
                working=self.tiling.working,
                sharing=sharing,
                shown=plan.survey.shown,
                matching=network.rate.search * sum(map(pairs_of, pieces)),
                largest_tile=network.largest_tile,
                rendered=rendered,
                rendering=self.tiling.rendering,
                launch=launch,
                graphs=plan.graphs,
            )
            for pieces, rendered in zip(self._pieces(sample, coarsest=coarsest), self._pieces(sample), strict=True)
        ]

    def whole_job(
        self, steps: Prediction, activations: int, part: RankPart = RankPart()
    ) -> tuple[Prediction, int, int]:
        """Extend a prediction of the steps to the whole job, and choose its measurements.

        Args:
            steps: Prediction for the steps.
            activations: Peak size of a rank's activations in an iteration, in bytes.
            part: Part of each view that a rank processes.

        Returns:
            Prediction, level of measurements (see `Plan.measuring`), and number of views for the loss.
        """
        plan, settings, network, work = self._plan, self._settings, self._probe.network, self.work
        views = self.views.of_rank(part)
        expected = replace(
            steps,
            first_visit=views.first(coarse=False),
            first_visit_coarse=views.first(coarse=True),
            style=self._probe.styles * work.without_region * network.rate.forward,
        )
        seconds = self._steps_seconds(expected)
        expected = replace(expected, job=seconds)
        count = len(plan.covered)
        level, loss_views = plan.measuring, min(LOSS_VIEWS[0], count)
        if plan.measured:
            once = _RENDER * views.rasterized() + views.later(coarse=False) + part.seconds(work.evaluation(network))
            unvisited = max(1 - settings.steps_sos * settings.views_per_step / count, 0.0)
            price = once + unvisited * expected.first_visit
            # `target_loss` is relative to the initial loss on these views. Their number must not depend on timings, or
            # timings would determine the step at which the job ends.
            if not settings.target_loss:
                loss_views = choose_loss_views(settings.measure, seconds, price, count)
            ending = _ENDING_SECONDS + _ENDING_SECONDS_A_GAUSSIAN * self._probe.scene.gaussians
            expected = replace(expected, evaluation=loss_views * once, losses=loss_views * price, ending=ending)
            prices, total = self._prices(expected), plan.steps_coarse + settings.steps_sos
            level = choose_level(prices, novel_view_seconds(settings.measure, expected), total)
            measuring = expected.losses + prices.of(LEVELS[level], len(LEVELS[level].moments(total)))
            expected = replace(expected, measuring=measuring, job=seconds + measuring)
        memory = _PeakMemory(self, views, part, plan, self._probe, settings, level, loss_views, activations)
        process, device = memory.bytes()
        return replace(expected, peak_bytes=process, device_bytes=device), level, loss_views

    def _steps_seconds(self, expected: Prediction) -> float:
        """Return the time in seconds of all steps, including first visits and style."""
        phases = (
            (self._plan.steps_coarse, expected.seconds_coarse, expected.first_visit_coarse),
            (self._settings.steps_sos, expected.seconds, expected.first_visit),
        )
        views = len(self._plan.covered)
        steps = expected.style + sum(
            count * seconds + min(count * self._settings.views_per_step, views) * first
            for count, seconds, first in phases
        )
        return min(steps, self._settings.max_seconds or steps)

    def _prices(self, expected: Prediction) -> Prices:
        """Return the expected cost of measuring novel views, assuming that one costs as much as a view of the job."""
        raster, gaussians = self._probe.raster, self._probe.scene.gaussians
        render = _RENDER * raster.seconds
        neighbors = (
            _NEIGHBORS_SECONDS_A_GAUSSIAN * gaussians if neighbors_are_searched(self._plan, self._settings) else 0.0
        )
        return Prices(
            setup=RENDERED * (raster.first_seconds + raster.colors_seconds + _DEPTH_RENDERS * render),
            view=RENDERED * render + self.work.pixels * self._probe.network.rate.forward,
            moment=neighbors + (2 * expected.seconds if is_approximated(self._plan) else 0.0),
        )


def tiling_of(probe: Probe, settings: Settings) -> Tiling:
    """Return the partitioning rules of a rank."""
    network = probe.network
    return Tiling(
        network.halo,
        memory_for("activations", probe.machine.memory) / network.held_bytes,
        network.working_bytes / network.held_bytes,
        settings.coarsest_side,
        cache_activations="activations" not in settings.keep,
        weights=ScaleWeights(settings.scales),
        largest=network.largest_tile,
        rendering=RENDERING[probe.machine.device],
    )


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
        left -= (2 if is_approximated(plan) else 1) * measuring_memory(memory)
    return left


def is_approximated(plan: Plan) -> bool:
    """Return whether measurements compare the gradient of a job with the float32 reference."""
    return plan.precision != "float32" or plan.cached_weights == "half"


def reference_activations(plan: Plan, activations: int, budget: int) -> int:
    """Return the activations in bytes of a pass of the job, or of the float32 reference if it needs more.

    Args:
        plan: Plan of the job.
        activations: Activations of the job in bytes.
        budget: Budget for activations in bytes, which limits those of the reference.
    """
    if not plan.measured or not is_approximated(plan):
        return activations
    return max(min(int(activations * reference_size(plan)), budget), activations)


def reference_size(plan: Plan) -> float:
    """Return the size of a feature value in the float32 reference, relative to the job's network."""
    return 2.0 if plan.precision == "bfloat16" else 1.0


def neighbors_are_searched(plan: Plan, settings: Settings) -> bool:
    """Return whether unseen Gaussians follow their neighbors' color change."""
    return settings.unseen == "neighbors" and not bool(plan.seen.all())


@dataclass(frozen=True)
class _PeakMemory:
    """Peak memory of a rank: what it holds until the end, plus the largest of its temporary allocations.

    Attributes:
        model: Cost model of the job.
        views: Data that the rank computes for the views.
        part: Part of each view that the rank processes.
        plan: Plan under construction.
        probe: Measured facts.
        settings: Settings of the job.
        level: Level of measurements as an index into `LEVELS`.
        loss_views: Number of views on which the loss is evaluated before and after.
        activations: Peak size of activations in an iteration in bytes.
    """

    model: CostModel
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
        pairs = int(probe.raster.most_pairs * self.part.window)
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
        device, tiling = probe.machine.device, self.model.tiling
        matching = _matching_bytes(self.model.sizes, tiling, probe.network.vector_channels, device)
        budget = memory_for("activations", self._memory)
        colors = int(self.plan.seen.sum()) * _COLOR_BYTES
        return image + matching + colors + reference_activations(self.plan, self.activations, budget)

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
        """Return the size in bytes of content features: those of the coarsest scale in phase 1, all of them in phase 2.

        Content images, if they are cached instead, coverage and maps of regions are included.
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
            colors = RENDERED * views * gaussians * _COLOR_BYTES if self.probe.scene.used_degree else 0
            coverage = views * pixels * _COVERAGE_BYTES if self.plan.weighted else 0
            held += gaussians * SHAPE_BYTES + min(colors, memory // 8) + min(coverage, memory // 8)
            held += min(views * pixels * _WARP_BYTES, memory // 2)
        if is_approximated(self.plan):
            evaluated, data = self.loss_views / len(self.plan.covered), self.views
            held += int(min(evaluated * reference_size(self.plan) * data.content.bytes, memory // 2))
            held += int(min(evaluated * data.colors.bytes, memory // 4))
        return held
