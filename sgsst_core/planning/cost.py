"""What an iteration will cost, from what was measured: pixels through the network, seconds, bytes that are kept."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from sgsst_core.features.partition import Rectangle, computed_twice, scaled_region
from sgsst_core.features.vgg import layer_stride
from sgsst_core.loss.graphs import FIRST_VISITS
from sgsst_core.loss.nearest import MATCH_BYTES, MOST_VECTORS, working_bytes
from sgsst_core.loss.tiling import Tiling
from sgsst_core.parallel.division import Piece, Size

#: One of the layers whose features are matched with the style's: they have the same cells.
_MATCHED = "relu3_1"

#: Bytes an optimized Gaussian costs beside the scene: colors, gradient and two moments, float32.
OPTIMIZER_BYTES = 4 * 3 * 4

#: And what a step makes anew on the CPU: a view's colors, their gradients and its parts by raster tile.
STEP_BYTES = 4 * 3 * 4


def gaussian_bytes(sh_degree: int) -> int:
    """Of a Gaussian of a scene in float32: position, rotation, scale, opacity and coefficients of three colors."""
    return 4 * (3 + 4 + 3 + 1 + 3 * (sh_degree + 1) ** 2)


@dataclass(frozen=True)
class Rate:
    """Seconds a pixel: `forward` alone (with statistics), and `both` passes.

    Attributes:
        search: seconds of the search for a position's nearest style vector, for each of them; 0 where none is searched.
    """

    forward: float
    both: float
    search: float = 0.0


@dataclass(frozen=True)
class RasterCost:
    """Of the views' blend weights.

    Attributes:
        seconds: of a render and its gradient with weights computed anew, mean over some views.
        kept_seconds: the same with kept weights; None where not even one view's fit the memory.
        bytes: of the kept weights of all views, float32; None where they would not be kept anyway.
        half_bytes: the same, half precision.
        keeping_seconds: of making a view's kept weights; None where that was not measured, on the CPU.
        first_seconds: that the first render of a view takes beside later ones: its lists of Gaussians are made then.
        lists_bytes: of a view's lists, mean; 0 where that is not known.
        colors_seconds: of what spherical harmonics add to the colors of a view.
    """

    seconds: float
    kept_seconds: float | None = None
    bytes: int | None = None
    half_bytes: int | None = None
    keeping_seconds: float | None = None
    first_seconds: float = 0.0
    lists_bytes: int = 0
    colors_seconds: float = 0.0

    @property
    def least_visits(self) -> float | None:
        """Visits of a view from which on kept weights save time; None where they never do, or it was not measured."""
        if self.kept_seconds is None or self.keeping_seconds is None or self.kept_seconds >= self.seconds:
            return None
        return self.keeping_seconds / (self.seconds - self.kept_seconds)


#: Share of the seconds of a view's loss that a graph must save to be worth its memory.
LEAST_SAVING = 0.03


@dataclass(frozen=True)
class LaunchCost:
    """Of the loss of a view and its gradient.

    Attributes:
        seconds: with its kernels launched one by one.
        replayed: as a graph.
        capture: of capturing the graph, once.
        problem: why there is no graph, and nothing was measured; None where there is one.
    """

    seconds: float = 0.0
    replayed: float = 0.0
    capture: float = 0.0
    problem: str | None = None

    @property
    def saved(self) -> float:
        """Seconds that a graph saves at each visit; 0 where they are too few."""
        saved = self.seconds - self.replayed
        return saved if self.problem is None and saved > LEAST_SAVING * self.seconds else 0.0

    @property
    def least_visits(self) -> float | None:
        """Visits of views that share a graph from which on it saves time; None where it never does."""
        return FIRST_VISITS + self.capture / self.saved if self.saved else None


def pieces_of(size: Size, tiling: Tiling, region: Rectangle | None, *, coarsest: bool = False) -> tuple[Piece, ...]:
    """What of a view goes through the network: one piece for each scale that counts, or for the coarsest alone.

    Args:
        size: (height, width) of the view.
        region: that holds every covered pixel; None where uncovered pixels go through too.
    """
    scales = tiling.scales(size)
    return tuple(_piece(size, scale, region) for scale in (scales[-1:] if coarsest else scales))


def _piece(size: Size, scale: int, region: Rectangle | None) -> Piece:
    scaled = (size[0] >> scale, size[1] >> scale)
    part = Rectangle(0, 0, *scaled) if region is None else scaled_region(region, scale, scaled)
    return Piece(scale, scaled, part)


#: Of what a pass on a CPU needs beside the activations that it keeps, when all of them are held (measured: 0.4 at
#: 512x384, where it is 40 MB, and 0.15 at most at 990x742).
WORKING_SHARE = 0.25


@dataclass(frozen=True)
class Work:
    """Pixels through the network in one iteration, mean over views.

    Attributes:
        pixels: forward and backward, halos included.
        again: forward a second time, because activations do not fit.
        without_region: what `pixels` would be if uncovered pixels were not left out.
        tiles: of the full-size view with most tiles.
        peak: most pixels that are held at a time, and what a pass needs beside them counted as such.
        pairs: of a position and a style vector, which the search for the nearest would compare.
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
        """The work of all scales, or of the coarsest alone.

        Args:
            sizes: (height, width) of each view.
            regions: of each view, that hold every covered pixel; None where uncovered pixels go through too.
            working_share: see `WORKING_SHARE`; 1 where it is not known.
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
                # Where all is held, what a pass needs beside it comes when some of it is not there yet, or gone.
                working = tiling.working * (1.0 if twice else working_share)
                held = sum(areas) - twice + working * max(areas, default=0)
                peak = max(peak, held, (1 + tiling.working) * once)
        views = len(sizes)
        return Work(pixels / views, again / views, without / views, tiles, peak, pairs / views)

    def seconds(self, rate: Rate) -> float:
        """Of the feature network and the statistics in one iteration."""
        return self.pixels * rate.both + self.again * rate.forward + self.pairs * rate.search

    def evaluation(self, rate: Rate) -> float:
        """Of the loss alone, without its gradient."""
        return self.pixels * rate.forward + self.pairs * rate.search


def pairs_of(piece: Piece) -> int:
    """Positions of a piece, each with every vector of a style that is as large as the view."""
    return piece.cells(_MATCHED) * _vectors(piece.size)


def _vectors(size: Size) -> int:
    """Of a style as large as a scaled view of a size (height, width)."""
    stride = layer_stride(_MATCHED)
    return min((size[0] // stride) * (size[1] // stride), MOST_VECTORS)


def nearest_bytes(sizes: Sequence[Size], tiling: Tiling, channels: int, value: int, device: str) -> int:
    """Style vectors of every size of views (height, width) at all scales, matches and buffers of the search.

    Args:
        channels: of a vector; 0 where nothing is matched.
        value: bytes of a value.
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
    """Content features of views of some sizes (height, width) at all scales, of so many bytes a cell."""
    cells = sum(
        (height >> scale + 3) * (width >> scale + 3)
        for height, width in sizes
        for scale in tiling.scales((height, width))
    )
    return cells * cell


def image_bytes(sizes: Sequence[Size]) -> int:
    """Images of one iteration: the render, its gradient, and their float32 copies on the way."""
    return max(height * width for height, width in sizes) * 3 * 4 * 6
