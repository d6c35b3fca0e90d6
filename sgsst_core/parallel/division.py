"""Division of work among ranks: the pixels of a view at all of its scales, by estimated cost.

Every rank computes the whole division from the same numbers, so no messages are needed. The division affects only the
rounding of results, because partition tiles give exact gradients for any division.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass

from torch import Tensor

from sgsst_core.features.partition import PartitionTile, Rectangle, partition
from sgsst_core.features.vgg import ALIGNMENT

Size = tuple[int, int]  # height, width in pixels


@dataclass(frozen=True)
class Piece:
    """Rectangle of one scale of a view, as a unit of work: one rank owns it and computes its features.

    Attributes:
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
class ImageExchange:
    """Rectangles of an image that ranks have and need.

    Attributes:
        parts: Rectangle of each rank's part; they are disjoint.
        windows: Rectangle that each rank needs; may be empty.
    """

    parts: Sequence[Rectangle]
    windows: Sequence[Rectangle]

    def in_part(self, part: Tensor, rank: int, other: int) -> Tensor:
        """Return the pixels [h, w, ...] of a rank's part that are in another rank's window."""
        return part[self.parts[rank].intersection(self.windows[other]).within(self.parts[rank]).slices]

    def in_window(self, window: Tensor, rank: int, other: int) -> Tensor:
        """Return the pixels [h, w, ...] of a rank's window that are in another rank's part."""
        return window[self.windows[rank].intersection(self.parts[other]).within(self.windows[rank]).slices]


@dataclass(frozen=True)
class Shares:
    """Rectangles of a view, at full size, that the ranks render. Those of a rank without pixels are empty.

    Attributes:
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

    def exchanged_scale(self, scale: int) -> int:
        """Return the scale of the exchanged image from which ranks compute their pixels of a coarser scale.

        It is the scale itself, unless its pixels are too large for the edges of parts to lie between them.
        """
        return min(scale, self.scale + ALIGNMENT.bit_length() - 1)

    def exchanges(self, by_rank: Sequence[Sequence[Piece]], halo: int) -> dict[int, ImageExchange]:
        """Return the exchange of each image, by its scale, that gives ranks their pieces of coarser scales."""
        coarser = [[piece for piece in pieces if piece.scale != self.scale] for pieces in by_rank]
        scales = sorted({self.exchanged_scale(piece.scale) for pieces in coarser for piece in pieces})
        return {
            scale: ImageExchange(
                tuple(part.at_scale(scale) for part in self.parts),
                tuple(
                    self._window([p for p in pieces if self.exchanged_scale(p.scale) == scale], halo, scale)
                    for pieces in coarser
                ),
            )
            for scale in scales
        }

    def _window(self, pieces: Sequence[Piece], halo: int, scale: int) -> Rectangle:
        """Return the rectangle of an exchanged image that contains the pixels of some pieces and of their halos."""
        pieces = [piece for piece in pieces if piece.region.pixels]
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


def divide(pieces: tuple[Piece, ...], halo: int, ranks: int, rendering: float = 0.0) -> tuple[tuple[Piece, ...], ...]:
    """Divide pieces among ranks, in equal portions of their cost.

    The ranks are recursively split into two halves, and the pieces are divided between the halves. Only pieces that
    cost more than a rank's average are split, because each split adds two halos; smaller pieces go to the half with
    less work. The largest piece is split last, so that the costs, including halos, are alike. Coarse scales are
    thereby spread over the ranks: each rank has few pieces, and no rank receives most of the exchanged images.

    Args:
        pieces: One piece per scale.
        rendering: Cost of a rendered pixel, relative to that of a pixel in the network. A rank renders its piece of the
            finest scale; 0 if what it renders does not depend on this division.

    Returns:
        Pieces of each rank, scale 0 first. A rank may get none if there are fewer than 16 x 16 pixels per rank.
    """
    finest = min((piece.scale for piece in pieces), default=0)
    return _divide(pieces, ranks, _Costs(halo, finest, rendering))


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
def _divide(pieces: tuple[Piece, ...], ranks: int, costs: _Costs) -> tuple[tuple[Piece, ...], ...]:
    if ranks == 1:
        return (tuple(sorted(pieces, key=lambda piece: piece.scale)),)
    half = ranks // 2
    first, second = _halves(pieces, half / ranks, ranks, costs)
    return _divide(first, half, costs) + _divide(second, ranks - half, costs)


def _halves(
    pieces: tuple[Piece, ...], fraction: float, ranks: int, costs: _Costs
) -> tuple[tuple[Piece, ...], tuple[Piece, ...]]:
    """Divide the pieces of some ranks into two sets; the first set has a given fraction of the cost."""
    total = sum(map(costs.of, pieces))
    if not total:
        return pieces, ()
    largest, *others = sorted(pieces, key=lambda piece: -costs.of(piece))
    halves: tuple[list[Piece], list[Piece]] = [], []
    loads = [0.0, 0.0]

    def load(parts: tuple[Piece | None, Piece | None]) -> float:
        own, other = (costs.of(part) if part else 0 for part in parts)
        return max((loads[0] + own) / fraction, (loads[1] + other) / (1 - fraction))

    for piece in [*others, largest]:
        is_split = piece is largest or costs.of(piece) > total / ranks
        parts = min(_splits(piece) if is_split else _whole(piece), key=load)
        for side, part in enumerate(parts):
            if part is not None:
                halves[side].append(part)
                loads[side] += costs.of(part)
    return tuple(halves[0]), tuple(halves[1])


def _whole(piece: Piece) -> list[tuple[Piece | None, Piece | None]]:
    """Return both ways to divide a piece without splitting it."""
    return [(piece, None), (None, piece)]


def _splits(piece: Piece) -> list[tuple[Piece | None, Piece | None]]:
    """Return all ways to split a piece in two: at every 16th row or column, or not at all."""
    area = piece.region
    splits = _whole(piece)

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
