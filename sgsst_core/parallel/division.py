"""Division of work among ranks: rows of a view, and pixels of its scales, by estimated cost.

Every rank computes the whole division from the same numbers, so no messages are needed. The division affects only the
rounding of results, because partition tiles give exact gradients for any division.
"""

from __future__ import annotations

import functools
import itertools
from collections.abc import Sequence
from dataclasses import dataclass

from sgsst_core.constants import RASTER_TILE
from sgsst_core.features.partition import PartitionTile, Rectangle, partition
from sgsst_core.features.vgg import ALIGNMENT
from sgsst_core.rasterizer.base import Rows

Size = tuple[int, int]  # height, width in pixels


@dataclass(frozen=True)
class Piece:
    """Rectangle of one scale of a view, as a unit of work: one rank owns it and computes its features.

    Attributes:
        scale: Scale; 0 is full size.
        size: Size of the whole scaled view.
        region: Rectangle; its edges are at multiples of 16 or at the border of the view.
    """

    scale: int
    size: Size
    region: Rectangle

    def cost(self, halo: int) -> int:
        """Return the number of pixels, including the halo, that the network processes if the piece is one tile."""
        return self.tile(halo).outer.pixels if self.region.pixels else 0

    def cells(self, layer: str) -> int:
        """Return the number of cells of a layer that the piece owns."""
        return self.tile(0).owned_cells(layer, self.size)[0].pixels if self.region.pixels else 0

    def tile(self, halo: int) -> PartitionTile:
        """Return the piece as one partition tile."""
        return partition(*self.size, None, halo, self.region)[0]


@functools.lru_cache(maxsize=1024)
def divide(pieces: tuple[Piece, ...], halo: int, speeds: tuple[float, ...]) -> tuple[tuple[Piece, ...], ...]:
    """Divide pieces among ranks in proportion to their speeds.

    The ranks are recursively split into two halves, and the pieces are divided between the halves: larger pieces go to
    one half, smaller pieces to the other, and the piece in between is split so that the costs, including halos, match
    the speeds. Each split therefore adds two halos in total, instead of two per scale.

    Args:
        pieces: One piece per scale.
        halo: Width in pixels of the halo around a tile.
        speeds: Relative speeds of the ranks.

    Returns:
        Pieces of each rank, scale 0 first. A rank may get none if there are fewer than 16 x 16 pixels per rank.
    """
    if len(speeds) == 1:
        return (tuple(sorted(pieces, key=lambda piece: piece.scale)),)
    half = len(speeds) // 2
    fraction = sum(speeds[:half]) / sum(speeds)
    first, second = _halves(pieces, fraction, halo)
    return divide(first, halo, speeds[:half]) + divide(second, halo, speeds[half:])


def _halves(pieces: tuple[Piece, ...], fraction: float, halo: int) -> tuple[tuple[Piece, ...], tuple[Piece, ...]]:
    """Divide pieces into two sets; the first set has a given fraction of the cost."""
    ordered = sorted(pieces, key=lambda piece: -piece.cost(halo))
    costs = [piece.cost(halo) for piece in ordered]
    total = sum(costs)
    before = 0
    index = 0  # index of the piece to split
    while index < len(ordered) - 1 and before + costs[index] < fraction * total:
        before += costs[index]
        index += 1
    if not total:
        return tuple(ordered), ()
    after = total - before - costs[index]

    def load(parts: tuple[Piece | None, Piece | None]) -> float:
        own, other = (part.cost(halo) if part else 0 for part in parts)
        return max((before + own) / fraction, (after + other) / (1 - fraction))

    left, right = min(_splits(ordered[index]), key=load)
    first = (*ordered[:index], *((left,) if left else ()))
    return first, (*((right,) if right else ()), *ordered[index + 1 :])


def _splits(piece: Piece) -> list[tuple[Piece | None, Piece | None]]:
    """Return all ways to split a piece in two: at every 16th row or column, or not at all."""
    area = piece.region
    splits: list[tuple[Piece | None, Piece | None]] = [(piece, None), (None, piece)]

    def part(region: Rectangle) -> Piece:
        return Piece(piece.scale, piece.size, region)

    for row in range(area.top + ALIGNMENT, area.bottom, ALIGNMENT):  # rows first, because they are contiguous in memory
        upper = part(Rectangle(area.top, area.left, row, area.right))
        splits.append((upper, part(Rectangle(row, area.left, area.bottom, area.right))))
    for column in range(area.left + ALIGNMENT, area.right, ALIGNMENT):
        left = part(Rectangle(area.top, area.left, area.bottom, column))
        splits.append((left, part(Rectangle(area.top, column, area.bottom, area.right))))
    return splits


def divide_rows(height: int, count: int, covered: Rows | None = None) -> list[Rows]:
    """Divide the rows of an image into one band per rank, in order. Bands may be empty.

    Bands start at raster tile boundaries, because two ranks would have to process the Gaussians of a divided tile. The
    covered rows are divided equally. Empty rows above and below them cost nothing, and belong to the first and last
    band.
    """
    top, bottom = covered or (0, height)
    first, last = top // RASTER_TILE, -(-bottom // RASTER_TILE)
    edges = [min((first + (last - first) * part // count) * RASTER_TILE, height) for part in range(count + 1)]
    edges[0], edges[-1] = 0, height
    return list(itertools.pairwise(edges))


def rounds(scales: Sequence[int], ranks: int) -> list[list[int]]:
    """Return groups of scales whose activations are in memory at the same time.

    A single rank processes one scale at a time, to store the activations of only one scale. Several ranks process all
    scales together: work is balanced over all scales, not within each scale, so ranks that process one scale at a time
    would wait for each other.
    """
    return [[scale] for scale in scales] if ranks == 1 else [list(scales)]


def loads(fractions: Sequence[Sequence[Piece]], halo: int) -> list[int]:
    """Return the number of pixels that each rank passes through the network."""
    return [sum(piece.cost(halo) for piece in fraction) for fraction in fractions]
