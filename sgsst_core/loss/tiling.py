"""Partitioning of scaled views into tiles under a memory budget, for the loss and for the planner's predictions."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from sgsst_core.features.partition import PartitionTile, Rectangle, choose_tile_size, kept_tiles, partition
from sgsst_core.loss.scale_weights import EVEN, ScaleWeights
from sgsst_core.parallel.division import Size
from sgsst_core.scene.pyramid import scale_count


@dataclass(frozen=True)
class Tiling:
    """Rules for partitioning views.

    Attributes:
        halo: Width in pixels of the halo around a partition tile.
        held: Number of pixels whose activations fit in memory.
        working: Additional memory that a tile needs during a pass, as a fraction of the memory of its activations.
        coarsest: Maximum shorter side of the coarsest scale in pixels.
        tile_size: Side of partition tiles, a multiple of 16; None to choose it from the memory budget.
        keep_activations: Whether to cache as many activations as fit between the two passes; False computes each tile
            twice.
        weights: Weights of the scales.
    """

    halo: int
    held: float
    working: float
    coarsest: int
    tile_size: int | None = None
    keep_activations: bool = True
    weights: ScaleWeights = EVEN

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
            tile_size = choose_tile_size(*size, self.halo, held=self.held, working=self.working, region=region)
        return partition(*size, tile_size, self.halo, region)

    def kept(self, areas: Sequence[int]) -> list[bool]:
        """Return which of the tiles with these pixel counts cache their activations.

        The memory budget applies to the sum over all given tiles.
        """
        if not self.keep_activations:
            return [False] * len(areas)
        return kept_tiles(areas, self.held, self.working)
