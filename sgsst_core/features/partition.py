"""SPST partition: split a scaled view into tiles that go through VGG one at a time, with exact gradients.

Each tile owns the features whose cells lie in its inner rectangle. Back-propagation starts from owned features only,
and pixel gradients are added where tiles overlap, so a halo of one receptive field is enough. (The published SPST
instead keeps only the inner part of each block's pixel gradient, which needs a margin several times as wide.)
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

from torch import Tensor

from sgsst_core.features.vgg import ALIGNMENT, layer_stride


@dataclass(frozen=True)
class Rectangle:
    """Half-open rectangle in pixels or cells: rows top..bottom, columns left..right."""

    top: int
    left: int
    bottom: int
    right: int

    @property
    def pixels(self) -> int:
        """Area of the rectangle."""
        return (self.bottom - self.top) * (self.right - self.left)

    @property
    def shape(self) -> tuple[int, int]:
        """(height, width) of the rectangle."""
        return self.bottom - self.top, self.right - self.left

    @property
    def slices(self) -> tuple[slice, slice]:
        """Index of the rectangle in an [H, W, ...] tensor."""
        return slice(self.top, self.bottom), slice(self.left, self.right)

    def intersection(self, other: Rectangle) -> Rectangle:
        """Return the pixels that two rectangles share; a rectangle without pixels if there are none."""
        top, left = max(self.top, other.top), max(self.left, other.left)
        bottom, right = min(self.bottom, other.bottom), min(self.right, other.right)
        if bottom <= top or right <= left:
            bottom, right = top, left
        return Rectangle(top, left, bottom, right)

    def within(self, area: Rectangle) -> Rectangle:
        """Return the rectangle relative to an area that contains it."""
        return Rectangle(self.top - area.top, self.left - area.left, self.bottom - area.top, self.right - area.left)

    def at_scale(self, scale: int) -> Rectangle:
        """Return the complete cells of 2^scale x 2^scale pixels; edges are between cells or at the view's border."""
        return Rectangle(self.top >> scale, self.left >> scale, self.bottom >> scale, self.right >> scale)

    def at_full_size(self, scale: int) -> Rectangle:
        """Return the pixels of a rectangle of cells of 2^scale x 2^scale pixels; inverse of `at_scale`."""
        return Rectangle(self.top << scale, self.left << scale, self.bottom << scale, self.right << scale)


@dataclass(frozen=True)
class PartitionTile:
    """Partition tile, which owns the rectangle `inner`. `outer` is `inner` plus halo, clipped to the view."""

    inner: Rectangle
    outer: Rectangle

    def owned_cells(self, layer: str, size: tuple[int, int]) -> tuple[Rectangle, Rectangle]:
        """Return the cells of a layer that the tile owns.

        Args:
            size: (height, width) of the scaled view. Incomplete cells at its border do not exist.

        Returns:
            Owned cells as a rectangle in the view's feature map, and as a rectangle in the tile's feature map.
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
    """Split a view, or a region of it, into partition tiles, row by row.

    Args:
        tile_size: Side of the inner rectangles, a multiple of 16; None for one tile that covers the whole region.
        halo: Width in pixels of the halo: a multiple of 16, at least the radius of the receptive field.
        region: Result of `covered_region`; None for the whole view.
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
    """Return the smallest 16-aligned rectangle that contains every pixel of coverage [H, W] > 0; may be empty."""
    height, width = coverage.shape
    rows, columns = (coverage > 0).any(dim=1).nonzero(), (coverage > 0).any(dim=0).nonzero()
    if not len(rows):
        return Rectangle(0, 0, 0, 0)
    top, bottom, left, right = (int(t) for t in (rows[0], rows[-1] + 1, columns[0], columns[-1] + 1))
    return _aligned(Rectangle(top, left, bottom, right), (height, width))


def scaled_region(region: Rectangle, scale: int, size: tuple[int, int]) -> Rectangle:
    """Return `covered_region` for a coarser scale, given the region at full size.

    Args:
        region: Covered region of the full-size view.
        scale: Coarser scale; 0 is full size.
        size: (height, width) of the view at that scale.
    """
    side = 1 << scale
    bottom, right = min(-(-region.bottom // side), size[0]), min(-(-region.right // side), size[1])
    scaled = Rectangle(region.top // side, region.left // side, bottom, right)
    if scaled.top >= scaled.bottom or scaled.left >= scaled.right:
        return Rectangle(0, 0, 0, 0)
    return _aligned(scaled, size)


def _aligned(region: Rectangle, size: tuple[int, int]) -> Rectangle:
    """Return the smallest 16-aligned rectangle that contains a region, within a view of size (height, width)."""
    return Rectangle(
        region.top // ALIGNMENT * ALIGNMENT,
        region.left // ALIGNMENT * ALIGNMENT,
        min(-(-region.bottom // ALIGNMENT) * ALIGNMENT, size[0]),
        min(-(-region.right // ALIGNMENT) * ALIGNMENT, size[1]),
    )


def _spans(first: int, last: int, tile_size: int) -> list[tuple[int, int]]:
    """Divide the range first..last into spans of nearly equal length, at most `tile_size`, at multiples of 16.

    Equal spans balance the work better than full spans with a short remainder.
    """
    if first >= last:
        return []
    count = math.ceil((last - first) / tile_size)
    step = math.ceil((last - first) / count / ALIGNMENT) * ALIGNMENT
    return [(start, min(start + step, last)) for start in range(first, last, step)]


def cached_tiles(areas: Sequence[int], held: float, working: float) -> list[bool]:
    """Return which tiles cache their activations between the forward and the backward pass: the largest that fit.

    Cached tiles must be back-propagated first, so that their memory is free when other tiles are recomputed.

    Args:
        areas: Pixel counts of the tiles that share the memory budget.
        held: Number of pixels whose activations fit in the memory budget.
        working: Additional memory of a tile during back-propagation, as a fraction of the memory of its activations.
    """
    cached = [False] * len(areas)
    left = held - working * max(areas, default=0)
    for index in sorted(range(len(areas)), key=lambda index: -areas[index]):
        if areas[index] <= left:
            cached[index] = True
            left -= areas[index]
    return cached


def computed_twice(areas: Sequence[int], cached: Sequence[bool]) -> int:
    """Return the number of pixels in tiles that are not cached, which need a second forward pass."""
    return sum(area for area, flag in zip(areas, cached, strict=True) if not flag)


#: Candidate tile sizes. Below 64, the halo costs more than the saved memory is worth.
TILE_SIZES = (64, 128, 256, 384, 512, 768, 1024, 1536, 2048, 3072, 4096)


@lru_cache(maxsize=1 << 14)  # plans and steps ask for the same views again and again
def choose_tile_size(
    height: int,
    width: int,
    halo: int,
    *,
    held: float,
    working: float,
    region: Rectangle | None = None,
    largest: int | None = None,
) -> int | None:
    """Return the tile size with the least work for a view under a memory budget; None if it fits as one tile.

    Work is the number of pixels that all passes process: a forward and a backward pass over every outer rectangle, and
    a second forward pass if its activations are not cached. Small tiles have relatively large halos; large tiles leave
    less memory for caching.

    Args:
        halo, region: As in `partition`.
        held, working: As in `cached_tiles`.
        largest: Maximum pixels of a tile; None for no limit.
    """

    def areas_of(size: int | None) -> list[int]:
        return [tile.outer.pixels for tile in partition(height, width, size, halo, region)]

    def work(size: int | None) -> float:
        areas = areas_of(size)
        area = max(areas, default=0)
        if size != TILE_SIZES[0] and (area * (1 + working) > held or area > (largest or area)):
            return math.inf
        return 2 * sum(areas) + computed_twice(areas, cached_tiles(areas, held, working))

    if work(None) == 2 * sum(areas_of(None)):  # nothing is computed twice, and several tiles only add halos
        return None
    return min((None, *TILE_SIZES), key=work)
