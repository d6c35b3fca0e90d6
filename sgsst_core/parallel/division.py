"""Division of work among ranks: the pixels of a view at all of its scales, by estimated cost.

Every rank computes the whole division from the same numbers, so no messages are needed. The division affects only the
rounding of results, because partition tiles give exact gradients for any division.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

from sgsst_core.features.partition import PartitionTile, Rectangle, partition
from sgsst_core.features.vgg import ALIGNMENT

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


@dataclass(frozen=True)
class Shares:
    """Rectangles of a view, at full size, that the ranks render. Those of a rank without pixels are empty.

    Attributes:
        size: (height, width) of the view.
        scale: Finest computed scale; no rank needs pixels of its pieces of it from another rank.
        parts: Each rank's piece of the finest scale. They are disjoint and contain every covered pixel.
        windows: Each rank's part and its halo, which the rank renders.
    """

    size: Size
    scale: int
    parts: tuple[Rectangle, ...]
    windows: tuple[Rectangle, ...]

    @staticmethod
    def of(size: Size, by_rank: Sequence[Sequence[Piece]], halo: int) -> Shares:
        """Return the rectangles that follow from a division of all computed scales of a view (`divide`)."""
        scale = min(piece.scale for pieces in by_rank for piece in pieces)
        own = [next((p for p in pieces if p.scale == scale and p.region.pixels), None) for pieces in by_rank]
        return Shares(
            size,
            scale,
            tuple(piece.region.at_full_size(scale) if piece else _NOTHING for piece in own),
            tuple(piece.tile(halo).outer.at_full_size(scale) if piece else _NOTHING for piece in own),
        )

    def exchanged_scale(self, scales: Iterable[int]) -> int | None:
        """Return the scale of the image that ranks exchange to compute some scales; None if they need none.

        Coarser scales are computed from it. The edges of parts are between its pixels.
        """
        coarser = [scale for scale in scales if scale != self.scale]
        return min(*coarser, self.scale + ALIGNMENT.bit_length() - 1) if coarser else None

    def coarse_windows(self, by_rank: Sequence[Sequence[Piece]], halo: int, scale: int) -> list[Rectangle]:
        """Return the rectangle of the exchanged image that each rank needs for its pieces of coarser scales.

        Args:
            by_rank: Pieces of each rank.
            halo: Width in pixels of the halo around a tile.
            scale: Scale of the exchanged image.
        """
        return [
            self._coarse_window([p for p in pieces if p.scale != self.scale and p.region.pixels], halo, scale)
            for pieces in by_rank
        ]

    def _coarse_window(self, pieces: Sequence[Piece], halo: int, scale: int) -> Rectangle:
        if not pieces:
            return _NOTHING
        outer = [piece.tile(halo).outer.at_full_size(piece.scale - scale) for piece in pieces]
        # Edges between the pixels of the coarsest of these scales, or at the border of the view.
        step = 1 << max(piece.scale for piece in pieces) - scale
        height, width = self.size[0] >> scale, self.size[1] >> scale
        return Rectangle(
            min(area.top for area in outer) // step * step,
            min(area.left for area in outer) // step * step,
            min(-(-max(area.bottom for area in outer) // step) * step, height),
            min(-(-max(area.right for area in outer) // step) * step, width),
        )


_NOTHING = Rectangle(0, 0, 0, 0)


def divide(
    pieces: tuple[Piece, ...], halo: int, speeds: tuple[float, ...], rendering: float = 0.0
) -> tuple[tuple[Piece, ...], ...]:
    """Divide pieces among ranks in proportion to their speeds.

    The ranks are recursively split into two halves, and the pieces are divided between the halves: larger pieces go to
    one half, smaller pieces to the other, and the piece in between is split so that the costs, including halos, match
    the speeds. Each split therefore adds two halos in total, instead of two per scale.

    Args:
        pieces: One piece per scale.
        halo: Width in pixels of the halo around a tile.
        speeds: Relative speeds of the ranks.
        rendering: Cost of a rendered pixel, relative to that of a pixel in the network. A rank renders its piece of the
            finest scale; 0 if what it renders does not depend on this division.

    Returns:
        Pieces of each rank, scale 0 first. A rank may get none if there are fewer than 16 x 16 pixels per rank.
    """
    finest = min((piece.scale for piece in pieces), default=0)
    return _divide(pieces, speeds, _Costs(halo, finest, rendering))


@dataclass(frozen=True)
class _Costs:
    """Costs of pieces; see `divide`."""

    halo: int
    finest: int
    rendering: float

    def of(self, piece: Piece) -> float:
        """Return the cost of a piece in pixels through the network."""
        rendered = self.rendering * 4**self.finest if piece.scale == self.finest else 0.0
        return piece.cost(self.halo) * (1 + rendered)


@functools.lru_cache(maxsize=1024)
def _divide(pieces: tuple[Piece, ...], speeds: tuple[float, ...], costs: _Costs) -> tuple[tuple[Piece, ...], ...]:
    if len(speeds) == 1:
        return (tuple(sorted(pieces, key=lambda piece: piece.scale)),)
    half = len(speeds) // 2
    fraction = sum(speeds[:half]) / sum(speeds)
    first, second = _halves(pieces, fraction, costs.of)
    return _divide(first, speeds[:half], costs) + _divide(second, speeds[half:], costs)


def _halves(
    pieces: tuple[Piece, ...], fraction: float, cost: Callable[[Piece], float]
) -> tuple[tuple[Piece, ...], tuple[Piece, ...]]:
    """Divide pieces into two sets; the first set has a given fraction of the cost."""
    ordered = sorted(pieces, key=lambda piece: -cost(piece))
    costs = [cost(piece) for piece in ordered]
    total = sum(costs)
    before = 0.0
    index = 0  # index of the piece to split
    while index < len(ordered) - 1 and before + costs[index] < fraction * total:
        before += costs[index]
        index += 1
    if not total:
        return tuple(ordered), ()
    after = total - before - costs[index]

    def load(parts: tuple[Piece | None, Piece | None]) -> float:
        own, other = (cost(part) if part else 0 for part in parts)
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
