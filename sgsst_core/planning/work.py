"""Pixels that pass through the feature network in one iteration, and sizes of what is computed from them."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from sgsst_core.features.partition import Rectangle, computed_twice, scaled_region
from sgsst_core.features.vgg import layer_stride
from sgsst_core.loss.nearest import MATCH_BYTES, MAX_VECTORS, working_bytes
from sgsst_core.loss.tiling import Tiling
from sgsst_core.parallel.division import Piece, Size
from sgsst_core.planning.facts import NetworkFacts

#: One of the layers whose features are matched with the style's; all these layers have the same resolution.
_MATCHED = "relu3_1"


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
    return min((size[0] // stride) * (size[1] // stride), MAX_VECTORS)


def content_bytes(sizes: Iterable[Size], tiling: Tiling, cell: int) -> int:
    """Return the size in bytes of the content features of views at all scales, given the bytes per cell."""
    cells = sum(
        (height >> scale + 3) * (width >> scale + 3)
        for height, width in sizes
        for scale in tiling.scales((height, width))
    )
    return cells * cell


def matching_bytes(sizes: Sequence[Size], tiling: Tiling, channels: int, device: str) -> int:
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
