"""Who does what: the rows of a view and the pixels of its scales, shared out among ranks by estimated cost.

Every rank computes the whole division from the same numbers, so that nobody has to be told. It changes nothing but
rounding: partition tiles are exact wherever they are cut.
"""

from __future__ import annotations

import functools
import itertools
from collections.abc import Sequence
from dataclasses import dataclass

from sgsst_core.constants import RASTER_TILE
from sgsst_core.features.partition import PartitionTile, Rectangle, partition
from sgsst_core.features.vgg import ALIGNMENT
from sgsst_core.rasterizer.arguments import Rows

Size = tuple[int, int]  # height, width in pixels


@dataclass(frozen=True)
class Piece:
    """A part of one scale that one rank owns: pixels of `region` go through the network on it, and nowhere else.

    Attributes:
        scale: 0 is full size.
        size: of the whole scaled view.
        region: edges at multiples of 16, but where the view ends.
    """

    scale: int
    size: Size
    region: Rectangle

    def cost(self, halo: int) -> int:
        """Pixels through the network as one tile."""
        return self.tile(halo).outer.pixels if self.region.pixels else 0

    def cells(self, layer: str) -> int:
        """Cells of a layer that the piece owns."""
        return self.tile(0).owned_cells(layer, self.size)[0].pixels if self.region.pixels else 0

    def tile(self, halo: int) -> PartitionTile:
        """The piece as one partition tile."""
        return partition(*self.size, None, halo, self.region)[0]


@functools.lru_cache(maxsize=1024)
def divide(pieces: tuple[Piece, ...], halo: int, speeds: tuple[float, ...]) -> tuple[tuple[Piece, ...], ...]:
    """Share pieces out among ranks in proportion to their speeds, by cutting them.

    Ranks are halved again and again, and the pieces with them: the larger ones go to the one half, the smaller ones to
    the other, and the one in between is cut where the costs, halos included, match the speeds. So every halving makes
    two halos, not two for each scale.

    Args:
        pieces: one for each scale.
        halo: pixels around a tile.
        speeds: of the ranks, in any unit.

    Returns:
        For each rank its pieces, scale 0 first; none where there is less work than 16 x 16 pixels for each rank.
    """
    if len(speeds) == 1:
        return (tuple(sorted(pieces, key=lambda piece: piece.scale)),)
    half = len(speeds) // 2
    share = sum(speeds[:half]) / sum(speeds)
    first, second = _cut(pieces, share, halo)
    return divide(first, halo, speeds[:half]) + divide(second, halo, speeds[half:])


def _cut(pieces: tuple[Piece, ...], share: float, halo: int) -> tuple[tuple[Piece, ...], tuple[Piece, ...]]:
    """Two sets of pieces, the first with that share of the cost."""
    ordered = sorted(pieces, key=lambda piece: -piece.cost(halo))
    costs = [piece.cost(halo) for piece in ordered]
    total = sum(costs)
    before = 0
    place = 0  # of the piece to be cut
    while place < len(ordered) - 1 and before + costs[place] < share * total:
        before += costs[place]
        place += 1
    if not total:
        return tuple(ordered), ()
    after = total - before - costs[place]

    def load(parts: tuple[Piece | None, Piece | None]) -> float:
        own, other = (part.cost(halo) if part else 0 for part in parts)
        return max((before + own) / share, (after + other) / (1 - share))

    left, right = min(_cuts(ordered[place]), key=load)
    first = (*ordered[:place], *((left,) if left else ()))
    return first, (*((right,) if right else ()), *ordered[place + 1 :])


def _cuts(piece: Piece) -> list[tuple[Piece | None, Piece | None]]:
    """All ways to cut a piece in two: across or along at every 16th pixel, or not at all."""
    area = piece.region
    cuts: list[tuple[Piece | None, Piece | None]] = [(piece, None), (None, piece)]

    def part(region: Rectangle) -> Piece:
        return Piece(piece.scale, piece.size, region)

    for row in range(area.top + ALIGNMENT, area.bottom, ALIGNMENT):  # first: rows lie together in memory
        upper = part(Rectangle(area.top, area.left, row, area.right))
        cuts.append((upper, part(Rectangle(row, area.left, area.bottom, area.right))))
    for column in range(area.left + ALIGNMENT, area.right, ALIGNMENT):
        left = part(Rectangle(area.top, area.left, area.bottom, column))
        cuts.append((left, part(Rectangle(area.top, column, area.bottom, area.right))))
    return cuts


def divide_rows(height: int, count: int, covered: Rows | None = None) -> list[Rows]:
    """Bands of rows for `count` ranks, in order; a band may be empty.

    Bands begin at multiples of a raster tile, whose Gaussians would else be looked at twice. They share the covered
    rows equally; the empty ones above and below cost nothing and go to the first and the last band.
    """
    top, bottom = covered or (0, height)
    first, last = top // RASTER_TILE, -(-bottom // RASTER_TILE)
    edges = [min((first + (last - first) * part // count) * RASTER_TILE, height) for part in range(count + 1)]
    edges[0], edges[-1] = 0, height
    return list(itertools.pairwise(edges))


def rounds(scales: Sequence[int], ranks: int) -> list[list[int]]:
    """Scales whose activations are in memory at a time.

    One rank takes them one by one, so that it holds those of one scale only. Several ranks take all at once: they have
    equal work on all scales together, not on each, and would wait for each other in between.
    """
    return [[scale] for scale in scales] if ranks == 1 else [list(scales)]


def loads(shares: Sequence[Sequence[Piece]], halo: int) -> list[int]:
    """Pixels through the network on each rank."""
    return [sum(piece.cost(halo) for piece in share) for share in shares]
