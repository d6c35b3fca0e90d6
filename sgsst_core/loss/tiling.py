"""How scaled views are cut into partition tiles under a memory budget: the loss does it, the planner foresees it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from sgsst_core.features.partition import PartitionTile, Rectangle, choose_tile_size, kept_tiles, partition
from sgsst_core.loss.scale_weights import EVEN, ScaleWeights
from sgsst_core.parallel.division import Size
from sgsst_core.scene.pyramid import scale_count


@dataclass(frozen=True)
class Tiling:
    """The rules by which views are cut.

    Attributes:
        halo: pixels around a partition tile.
        held: pixels whose activations the memory holds.
        working: memory that a tile needs in a pass beside its activations, as a share of them.
        coarsest: pixels of the coarsest scale's shorter side at most.
        tile_size: side of partition tiles, a multiple of 16; None lets the memory decide.
        keep_activations: as many as fit between the two passes; False computes each tile twice.
        weights: of the scales that count.
    """

    halo: int
    held: float
    working: float
    coarsest: int
    tile_size: int | None = None
    keep_activations: bool = True
    weights: ScaleWeights = EVEN

    def scale_count(self, size: Size) -> int:
        """n_s of views of a size (height, width)."""
        return scale_count(*size, self.coarsest)

    def scales(self, size: Size) -> list[int]:
        """The scales that count of views of a size (height, width), the finest first."""
        return self.weights.chosen(self.scale_count(size))

    def tiles(self, size: Size, region: Rectangle | None = None) -> list[PartitionTile]:
        """The tiles of a region of a scaled view of size (height, width), as large as the memory allows."""
        tile_size = self.tile_size
        if tile_size is None:
            tile_size = choose_tile_size(*size, self.halo, held=self.held, working=self.working, region=region)
        return partition(*size, tile_size, self.halo, region)

    def kept(self, areas: Sequence[int]) -> list[bool]:
        """Which of the tiles with so many pixels keep their activations, if they are in memory at the same time."""
        if not self.keep_activations:
            return [False] * len(areas)
        return kept_tiles(areas, self.held, self.working)
