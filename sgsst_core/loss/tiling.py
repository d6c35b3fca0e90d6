"""Partitioning of scaled views into tiles under a memory budget, and division of the tiles among ranks."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

from torch import Tensor

from sgsst_core.features.partition import (
    PartitionTile,
    Rectangle,
    cached_tiles,
    choose_tile_size,
    covered_region,
    partition,
    scaled_region,
)
from sgsst_core.loss.scale_weights import EVEN, ScaleWeights, scale_count
from sgsst_core.parallel.collectives import ALONE, Collectives
from sgsst_core.parallel.division import Piece, Shares, Size, divide

#: Cost of rendering a pixel and its gradient, relative to that of a pixel in the network, by device. It is a constant,
#: so that the division of work, and with it the rounding, does not depend on timings. On a CPU it was measured as 0.004
#: with cached weights at 1280x720; on GPUs, for which meta tensors stand in a forecast, it is an estimate.
RENDERING = {"cpu": 0.0, "cuda": 0.125, "meta": 0.125}


@dataclass(frozen=True)
class Tiling:
    """Rules for partitioning views.

    Attributes:
        halo: Width in pixels of the halo around a partition tile.
        held: Number of pixels whose activations fit in memory.
        working: Additional memory that a tile needs during a pass, as a fraction of the memory of its activations.
        coarsest: Maximum shorter side of the coarsest scale in pixels.
        tile_size: Side of partition tiles, a multiple of 16; None to choose it from the memory budget.
        largest: Maximum pixels of a partition tile whose size is chosen; None for no limit.
        rendering: Cost of rendering a pixel, relative to that of a pixel in the network (`RENDERING`).
    """

    halo: int
    held: float
    working: float
    coarsest: int
    tile_size: int | None = None
    weights: ScaleWeights = EVEN
    largest: int | None = None
    rendering: float = 0.0

    def scale_count(self, size: Size) -> int:
        """Return n_s for views of a size (height, width)."""
        return scale_count(*size, self.coarsest)

    def scales(self, size: Size) -> list[int]:
        """Return the scales with a positive weight for views of a size (height, width), finest first."""
        return self.weights.chosen(self.scale_count(size))

    def tiles(self, size: Size, region: Rectangle | None = None) -> list[PartitionTile]:
        """Return the tiles of a region of a scaled view of size (height, width).

        Tiles are as large as the memory budget allows.
        """
        tile_size = self.tile_size
        if tile_size is None:
            tile_size = choose_tile_size(
                *size, self.halo, held=self.held, working=self.working, region=region, largest=self.largest
            )
        return partition(*size, tile_size, self.halo, region)

    def cached(self, areas: Sequence[int]) -> list[bool]:
        """Return which of the tiles with these pixel counts cache their activations.

        The memory budget applies to the sum over all given tiles.
        """
        return cached_tiles(areas, self.held, self.working)


@dataclass(frozen=True)
class Division:
    """Division of the work on some scales of a view among ranks.

    Attributes:
        pieces: For each scale, the pieces of every rank; identical on all ranks.
        tiles: Partition tiles of this rank by scale.
        shares: Rectangles that the ranks render; None if every rank has the whole image.
        halo: Width in pixels of the halo around a tile; only used with `shares`.
    """

    pieces: dict[int, tuple[tuple[Piece, ...], ...]]
    tiles: dict[int, list[PartitionTile]]
    shares: Shares | None = None
    halo: int = 0

    def cost(self, rank: int, halo: int) -> int:
        """Return the number of pixels that a rank passes through the network."""
        return sum(piece.cost(halo) for every in self.pieces.values() for piece in every[rank])


class Divider:
    """Divider of the work on views among ranks.

    Args:
        collectives: Collectives of the ranks that evaluate each view together.
    """

    def __init__(self, tiling: Tiling, collectives: Collectives = ALONE) -> None:
        self.tiling = tiling
        self.collectives = collectives

    def divide(
        self, sizes: Mapping[int, Size], coverage: Sequence[Tensor] | None = None, region: Rectangle | None = None
    ) -> Division:
        """Divide the work on some scales of a view.

        Args:
            coverage: Position weights in the format of `ViewTarget.coverage`; None for equal weights.
            region: Rectangle of the full-size view that contains every covered pixel. If it is given, `coverage` is not
                read, which avoids synchronizing with the device. The pieces of coarser scales may then be a few cells
                larger.
        """
        read = coverage if region is None else None
        weights = {scale: read[scale] if read else None for scale in sizes}
        if region is None:
            pieces = tuple(self._piece(scale, size, weights[scale]) for scale, size in sizes.items())
        else:
            pieces = tuple(Piece(scale, size, scaled_region(region, scale, size)) for scale, size in sizes.items())
        return self._division(divide(pieces, self.tiling.halo, self.collectives.size), sizes, weights)

    def divide_view(
        self, size: Size, scales: Sequence[int], coverage: Sequence[Tensor] | None, region: Rectangle | None
    ) -> Division:
        """Divide the work on some scales of a view if each rank renders only a part of it.

        The parts do not depend on the scales. If the finest computed scale is among them, each rank's piece of it is
        the part that the rank renders.

        Args:
            coverage: Position weights in the format of `ViewTarget.coverage`; None for equal weights.
            region: Rectangle of the view that contains every covered pixel; None for the whole view.
        """
        by_rank = self._divided(size, self.tiling.scales(size), region)
        shares = Shares.of(size, by_rank, self.tiling.halo)
        if shares.scale not in scales:
            by_rank = self._divided(size, scales, region, rendered=False)
        sizes = {scale: (size[0] >> scale, size[1] >> scale) for scale in scales}
        weights = {scale: coverage[scale] if coverage else None for scale in scales}
        return replace(self._division(by_rank, sizes, weights), shares=shares, halo=self.tiling.halo)

    def shares(self, size: Size, region: Rectangle | None) -> Shares:
        """Return the rectangles that the ranks render of a view; see `divide_view`."""
        return Shares.of(size, self._divided(size, self.tiling.scales(size), region), self.tiling.halo)

    def _divided(
        self, size: Size, scales: Sequence[int], region: Rectangle | None, *, rendered: bool = True
    ) -> tuple[tuple[Piece, ...], ...]:
        whole = Rectangle(0, 0, *size) if region is None else region
        sizes = [(size[0] >> scale, size[1] >> scale) for scale in scales]
        pieces = [
            Piece(scale, each, scaled_region(whole, scale, each)) for scale, each in zip(scales, sizes, strict=True)
        ]
        rendering = self.tiling.rendering if rendered else 0.0
        return divide(tuple(pieces), self.tiling.halo, self.collectives.size, rendering)

    def _division(
        self,
        by_rank: Sequence[Sequence[Piece]],
        sizes: Mapping[int, Size],
        weights: Mapping[int, Tensor | None],
    ) -> Division:
        own = by_rank[self.collectives.rank]
        return Division(
            {scale: tuple(tuple(p for p in each if p.scale == scale) for each in by_rank) for scale in sizes},
            {
                scale: [tile for p in own if p.scale == scale for tile in self._partition(p, weights[scale])]
                for scale in sizes
            },
        )

    def tiles(self, size: Size, coverage: Tensor | None = None) -> list[PartitionTile]:
        """Return the partition tiles of a scaled view of size (height, width).

        If `coverage` [h, w] is given, pixels with coverage 0 may not belong to any tile.
        """
        return self._partition(self._piece(0, size, coverage), coverage)

    def _piece(self, scale: int, size: Size, coverage: Tensor | None) -> Piece:
        """Return the piece of one scale that contains all pixels that the network has to process."""
        if coverage is None:
            return Piece(scale, size, Rectangle(0, 0, *size))
        return Piece(scale, size, covered_region(coverage))

    def _partition(self, piece: Piece, coverage: Tensor | None) -> list[PartitionTile]:
        """Return the covered partition tiles of a piece, as large as the memory budget allows."""
        tiles = self.tiling.tiles(piece.size, piece.region)
        if coverage is None:
            return tiles
        return [tile for tile in tiles if coverage[tile.inner.slices].any()]
