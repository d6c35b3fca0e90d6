"""SPST partition: a scaled view cut into tiles that go through VGG one at a time, exactly.

Each tile owns the features whose cells lie in its inner rectangle. Back-propagation starts from owned features
only, and pixel gradients are added over the overlaps, so a halo of one receptive field is enough. (The published
SPST keeps the inner part of each block's pixel gradient instead, which takes a margin several times as wide.)
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from sgsst_core.vgg import ALIGNMENT, layer_stride


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


def partition(height: int, width: int, tile_size: int | None, halo: int) -> list[PartitionTile]:
    """Cut a view of height x width into partition tiles, row by row.

    Args:
        tile_size: side of the inner rectangles, a multiple of 16; None for one tile that is the whole view.
        halo: pixels around the inner rectangle, a multiple of 16 no smaller than the receptive field's radius.
    """
    if tile_size is None:
        whole = Rectangle(0, 0, height, width)
        return [PartitionTile(whole, whole)]
    if tile_size < ALIGNMENT or tile_size % ALIGNMENT or halo % ALIGNMENT:
        raise ValueError(f"tile_size {tile_size} and halo {halo} must be multiples of {ALIGNMENT}")
    return [
        PartitionTile(
            Rectangle(top, left, bottom, right),
            Rectangle(max(top - halo, 0), max(left - halo, 0), min(bottom + halo, height), min(right + halo, width)),
        )
        for top, bottom in _spans(height, tile_size)
        for left, right in _spans(width, tile_size)
    ]


def _spans(length: int, tile_size: int) -> list[tuple[int, int]]:
    """Equal spans of at most tile_size, at multiples of 16: equal ones balance better than a narrow last one."""
    count = math.ceil(length / tile_size)
    step = math.ceil(length / count / ALIGNMENT) * ALIGNMENT
    return [(start, min(start + step, length)) for start in range(0, length, step)]


#: Tile sizes that are weighed against each other; below 64, the halo costs more than any memory saved is worth.
TILE_SIZES = (64, 128, 256, 384, 512, 768, 1024, 1536, 2048, 3072, 4096)


def choose_tile_size(height: int, width: int, halo: int, *, held: float, working: float) -> int | None:
    """The tile size with the least work for a view under a memory budget; None where the whole view fits.

    Work is counted in pixels through the network: forward and backward over every outer rectangle, and a second
    forward over those whose activations do not stay in memory. Small tiles pay for their halo, large ones leave
    no room to keep anything.

    Args:
        held: pixels whose activations the budget holds.
        working: memory that a tile needs beside its activations while it is back-propagated, as a share of them.
    """
    if height * width * (1 + working) <= held:
        return None

    def work(size: int) -> float:
        tiles = partition(height, width, size, halo)
        total = sum(tile.outer.pixels for tile in tiles)
        largest = max(tile.outer.pixels for tile in tiles) * (1 + working)
        if largest > held and size > TILE_SIZES[0]:
            return math.inf
        return 2 * total + max(total - max(held - largest, 0), 0)

    return min(TILE_SIZES, key=work)
