"""Cost of an iteration, from measured rates: pixels through the network, seconds, and stored bytes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from sgsst_core.features.partition import Rectangle, computed_twice, scaled_region
from sgsst_core.features.vgg import layer_stride
from sgsst_core.loss.graphs import FIRST_VISITS
from sgsst_core.loss.nearest import MATCH_BYTES, MOST_VECTORS, working_bytes
from sgsst_core.loss.tiling import Tiling
from sgsst_core.parallel.division import Piece, Size

#: One of the layers whose features are matched with the style's; all these layers have the same resolution.
_MATCHED = "relu3_1"

#: Additional bytes per optimized Gaussian: color, gradient and two moments, float32.
OPTIMIZER_BYTES = 4 * 3 * 4

#: Additional bytes per Gaussian allocated in each step on the CPU: for a view's colors, and for their gradients in
#: total and per raster tile.
STEP_BYTES = 4 * 3 * 4


def gaussian_bytes(sh_degree: int) -> int:
    """Return the size in bytes of a float32 Gaussian.

    It consists of position, rotation, scale, opacity, and coefficients of three color channels.
    """
    return 4 * (3 + 4 + 3 + 1 + 3 * (sh_degree + 1) ** 2)


@dataclass(frozen=True)
class Rate:
    """Seconds per pixel of the feature network, including statistics.

    Attributes:
        forward: Seconds per pixel of the forward pass alone.
        both: Seconds per pixel of both passes.
        search: Seconds per pair of position and style vector in the nearest-neighbor search; 0 if features are not
            matched.
    """

    forward: float
    both: float
    search: float = 0.0


@dataclass(frozen=True)
class RasterCost:
    """Cost of the views' blend weights.

    Attributes:
        seconds: Time in seconds of a render and its gradient with recomputed weights, mean over some views.
        kept_seconds: Time in seconds of a render and its gradient with cached weights; None if not measured, for
            example because not even one view's weights fit in memory.
        bytes: Size in bytes of the cached weights of all views, float32; None if the rasterizer cannot cache them.
        half_bytes: Size in bytes of the cached weights of all views in half precision; None as for `bytes`.
        keeping_seconds: Time in seconds to compute a view's cached weights; None on the CPU, where it is not measured.
        first_seconds: Additional time in seconds of a view's first render, which computes its tile intersections.
        intersection_bytes: Mean size in bytes of a view's tile intersections; 0 if unknown.
        colors_seconds: Time in seconds for the contribution of spherical harmonics to the colors of a view.
    """

    seconds: float
    kept_seconds: float | None = None
    bytes: int | None = None
    half_bytes: int | None = None
    keeping_seconds: float | None = None
    first_seconds: float = 0.0
    intersection_bytes: int = 0
    colors_seconds: float = 0.0

    @property
    def least_visits(self) -> float | None:
        """Minimum visits of a view for which cached weights save time; None if they never do, or if not measured."""
        if self.kept_seconds is None or self.keeping_seconds is None or self.kept_seconds >= self.seconds:
            return None
        return self.keeping_seconds / (self.seconds - self.kept_seconds)


#: Minimum fraction of the time of a view's loss that a CUDA graph must save to be worth its memory.
LEAST_SAVING = 0.03


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
    part = Rectangle(0, 0, *scaled) if region is None else scaled_region(region, scale, scaled)
    return Piece(scale, scaled, part)


#: Temporary memory that a pass on a CPU uses if all activations are cached, as a fraction of `Tiling.working`
#: (measured: 0.4 at 512x384, where it is 40 MB, and at most 0.15 at 990x742).
WORKING_SHARE = 0.25


@dataclass(frozen=True)
class Work:
    """Pixels through the network in one iteration, mean over views.

    Attributes:
        pixels: Pixels through the forward and the backward pass, including halos.
        again: Pixels through a second forward pass, because their activations do not fit in memory.
        without_region: Value of `pixels` if uncovered pixels were processed too.
        tiles: Maximum number of tiles of a view at one scale.
        peak: Maximum number of pixels in memory at a time, including the temporary memory of a pass in units of pixels.
        pairs: Pairs of position and style vector compared by the nearest-neighbor search.
    """

    pixels: float
    again: float
    without_region: float
    tiles: int
    peak: float
    pairs: float = 0.0

    @staticmethod
    def of(
        sizes: Sequence[Size],
        tiling: Tiling,
        regions: Sequence[Rectangle] | None,
        *,
        coarsest: bool = False,
        working_share: float = 1.0,
    ) -> Work:
        """Count the work of all scales, or of the coarsest alone.

        Args:
            sizes: (height, width) of each view.
            tiling: Partitioning rules.
            regions: Rectangle of each view that contains all covered pixels; None if uncovered pixels are processed
                too.
            coarsest: Whether to count only the coarsest scale.
            working_share: See `WORKING_SHARE`; 1 if unknown.
        """
        pixels = again = without = pairs = 0.0
        tiles = 0
        peak = 0.0
        for index, size in enumerate(sizes):
            for piece in pieces_of(size, tiling, regions[index] if regions else None, coarsest=coarsest):
                areas = [tile.outer.pixels for tile in tiling.tiles(piece.size, piece.region)]
                flags = tiling.kept(areas)
                twice = computed_twice(areas, flags)
                pixels += sum(areas)
                again += twice
                pairs += pairs_of(piece)
                without += sum(tile.outer.pixels for tile in tiling.tiles(piece.size))
                tiles = max(tiles, len(areas))
                once = max((area for area, flag in zip(areas, flags, strict=True) if not flag), default=0)
                # If all activations are cached, a pass needs its temporary memory while some activations are not
                # computed yet, or already freed.
                working = tiling.working * (1.0 if twice else working_share)
                held = sum(areas) - twice + working * max(areas, default=0)
                peak = max(peak, held, (1 + tiling.working) * once)
        views = len(sizes)
        return Work(pixels / views, again / views, without / views, tiles, peak, pairs / views)

    def seconds(self, rate: Rate) -> float:
        """Return the time in seconds of feature network and statistics in one iteration."""
        return self.pixels * rate.both + self.again * rate.forward + self.pairs * rate.search

    def evaluation(self, rate: Rate) -> float:
        """Return the time in seconds of the loss without its gradient."""
        return self.pixels * rate.forward + self.pairs * rate.search


def pairs_of(piece: Piece) -> int:
    """Return the number of pairs of a piece's positions with the vectors of a style as large as the view."""
    return piece.cells(_MATCHED) * _vectors(piece.size)


def _vectors(size: Size) -> int:
    """Return the number of vectors of a style as large as a scaled view of size (height, width)."""
    stride = layer_stride(_MATCHED)
    return min((size[0] // stride) * (size[1] // stride), MOST_VECTORS)


def nearest_bytes(sizes: Sequence[Size], tiling: Tiling, channels: int, value: int, device: str) -> int:
    """Return the memory in bytes for matching features.

    This includes style vectors for all view sizes at all scales, matches, and search buffers.

    Args:
        sizes: (height, width) of each view.
        tiling: Partitioning rules.
        channels: Length of a vector; 0 if nothing is matched.
        value: Bytes per value.
        device: "cpu" or "cuda".
    """
    if not channels:
        return 0
    scaled = {size: [(size[0] >> s, size[1] >> s) for s in tiling.scales(size)] for size in set(sizes)}
    vectors = sum(_vectors(part) for parts in scaled.values() for part in parts)
    positions = (
        max(sum(part[0] * part[1] for part in parts) for parts in scaled.values()) // layer_stride(_MATCHED) ** 2
    )
    return vectors * channels * value + positions * MATCH_BYTES + working_bytes(channels, value, device)


def content_bytes(sizes: Sequence[Size], tiling: Tiling, cell: int) -> int:
    """Return the size in bytes of the content features of views at all scales, given the bytes per cell."""
    cells = sum(
        (height >> scale + 3) * (width >> scale + 3)
        for height, width in sizes
        for scale in tiling.scales((height, width))
    )
    return cells * cell


def image_bytes(sizes: Sequence[Size]) -> int:
    """Return the size in bytes of the images of one iteration: render, gradient, and their temporary float32 copies."""
    return max(height * width for height, width in sizes) * 3 * 4 * 6
