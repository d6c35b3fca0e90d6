"""SPST partition: a scaled view cut into tiles that go through VGG one at a time, exactly.

Each tile owns the features whose cells lie in its inner rectangle. Back-propagation starts from owned features
only, and pixel gradients are added over the overlaps, so a halo of one receptive field is enough. (The published
SPST keeps the inner part of each block's pixel gradient instead, which takes a margin several times as wide.)
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from torch import Tensor

from sgsst_core.features.vgg import ALIGNMENT, layer_stride


@dataclass(frozen=True)
class Rectangle:
    """Half-open rectangle in pixels (or cells): rows top..bottom, columns left..right."""

    top: int
    left: int
    bottom: int
    right: int

    @property
    def pixels(self) -> int:
        """Area."""
        return (self.bottom - self.top) * (self.right - self.left)

    @property
    def slices(self) -> tuple[slice, slice]:
        """Index of the rectangle in an [H, W, ...] tensor."""
        return slice(self.top, self.bottom), slice(self.left, self.right)


@dataclass(frozen=True)
class PartitionTile:
    """A partition tile: `inner` is what it owns, `outer` is inner and halo, clipped to the view."""

    inner: Rectangle
    outer: Rectangle

    def owned_cells(self, layer: str, size: tuple[int, int]) -> tuple[Rectangle, Rectangle]:
        """The layer's cells that the tile owns: (in the view's feature map, in the tile's feature map).

        Args:
            layer: such as "relu3_1".
            size: (height, width) of the scaled view; cells that its border cuts off do not exist.
        """
        stride = layer_stride(layer)
        height, width = size[0] // stride, size[1] // stride
        view = Rectangle(
            self.inner.top // stride,
            self.inner.left // stride,
            min(math.ceil(self.inner.bottom / stride), height),
            min(math.ceil(self.inner.right / stride), width),
        )
        top, left = self.outer.top // stride, self.outer.left // stride
        return view, Rectangle(view.top - top, view.left - left, view.bottom - top, view.right - left)


def partition(
    height: int, width: int, tile_size: int | None, halo: int, region: Rectangle | None = None
) -> list[PartitionTile]:
    """Cut a view of height x width, or a region of it, into partition tiles, row by row.

    Args:
        tile_size: side of the inner rectangles, a multiple of 16; None for one tile that is the whole region.
        halo: pixels around the inner rectangle, a multiple of 16 no smaller than the receptive field's radius.
        region: from `covered_region`; None for the whole view.
    """
    region = region or Rectangle(0, 0, height, width)
    if tile_size is None:
        tile_size = max(height, width, 1) + ALIGNMENT
        tile_size -= tile_size % ALIGNMENT
    if tile_size < ALIGNMENT or tile_size % ALIGNMENT or halo % ALIGNMENT:
        raise ValueError(f"tile_size {tile_size} and halo {halo} must be multiples of {ALIGNMENT}")
    return [
        PartitionTile(
            Rectangle(top, left, bottom, right),
            Rectangle(max(top - halo, 0), max(left - halo, 0), min(bottom + halo, height), min(right + halo, width)),
        )
        for top, bottom in _spans(region.top, region.bottom, tile_size)
        for left, right in _spans(region.left, region.right, tile_size)
    ]


def covered_region(coverage: Tensor) -> Rectangle:
    """The smallest rectangle at multiples of 16 that holds every pixel with coverage [H, W] above 0; may be empty."""
    height, width = coverage.shape
    rows, columns = (coverage > 0).any(dim=1).nonzero(), (coverage > 0).any(dim=0).nonzero()
    if not len(rows):
        return Rectangle(0, 0, 0, 0)
    top, bottom, left, right = (int(t) for t in (rows[0], rows[-1] + 1, columns[0], columns[-1] + 1))
    return _aligned(Rectangle(top, left, bottom, right), (height, width))


def scaled_region(region: Rectangle, scale: int, size: tuple[int, int]) -> Rectangle:
    """`covered_region` at a scale of size (height, width), of a view whose covered pixels at full size are a region."""
    side = 1 << scale
    bottom, right = min(-(-region.bottom // side), size[0]), min(-(-region.right // side), size[1])
    scaled = Rectangle(region.top // side, region.left // side, bottom, right)
    if scaled.top >= scaled.bottom or scaled.left >= scaled.right:
        return Rectangle(0, 0, 0, 0)
    return _aligned(scaled, size)


def _aligned(region: Rectangle, size: tuple[int, int]) -> Rectangle:
    """The smallest rectangle at multiples of 16, within a view of size (height, width), that holds a region."""
    return Rectangle(
        region.top // ALIGNMENT * ALIGNMENT,
        region.left // ALIGNMENT * ALIGNMENT,
        min(-(-region.bottom // ALIGNMENT) * ALIGNMENT, size[0]),
        min(-(-region.right // ALIGNMENT) * ALIGNMENT, size[1]),
    )


def _spans(first: int, last: int, tile_size: int) -> list[tuple[int, int]]:
    """Equal spans of at most tile_size, at multiples of 16: equal ones balance better than a narrow last one."""
    if first >= last:
        return []
    count = math.ceil((last - first) / tile_size)
    step = math.ceil((last - first) / count / ALIGNMENT) * ALIGNMENT
    return [(start, min(start + step, last)) for start in range(first, last, step)]


def kept_tiles(areas: Sequence[int], held: float, working: float) -> list[bool]:
    """Which tiles' activations stay in memory from the forward to the backward pass: the largest that fit.

    They must be back-propagated before the others, which find their memory free when they are computed again.

    Args:
        areas: pixels of the tiles that wait for each other.
        held, working: as for `choose_tile_size`.
    """
    kept = [False] * len(areas)
    room = held - working * max(areas, default=0)
    for place in sorted(range(len(areas)), key=lambda place: -areas[place]):
        if areas[place] <= room:
            kept[place] = True
            room -= areas[place]
    return kept


def computed_twice(areas: Sequence[int], kept: Sequence[bool]) -> int:
    """Pixels of the tiles that are not kept: they go forward a second time."""
    return sum(area for area, flag in zip(areas, kept, strict=True) if not flag)


#: Tile sizes that are weighed against each other; below 64, the halo costs more than any memory saved is worth.
TILE_SIZES = (64, 128, 256, 384, 512, 768, 1024, 1536, 2048, 3072, 4096)


def choose_tile_size(
    height: int, width: int, halo: int, *, held: float, working: float, region: Rectangle | None = None
) -> int | None:
    """The tile size with the least work for a view under a memory budget; None where it fits as one tile.

    Work is counted in pixels through the network: forward and backward over every outer rectangle, and a second
    forward over those whose activations do not stay in memory. Small tiles pay for their halo, large ones leave
    no room to keep anything.

    Args:
        held: pixels whose activations the budget holds.
        working: memory that a tile needs beside its activations while it is back-propagated, as a share of them.
        region: as for `partition`.
    """

    def work(size: int | None) -> float:
        areas = [tile.outer.pixels for tile in partition(height, width, size, halo, region)]
        if max(areas, default=0) * (1 + working) > held and size != TILE_SIZES[0]:
            return math.inf
        return 2 * sum(areas) + computed_twice(areas, kept_tiles(areas, held, working))

    return min((None, *TILE_SIZES), key=work)
