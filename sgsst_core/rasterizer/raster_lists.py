"""Which Gaussians each raster tile blends, front to back: prepared once a camera, because geometry is frozen."""

# The types of compiled functions are those of their arguments.
# mypy: disable-error-code="no-untyped-def"

from __future__ import annotations

import math
from dataclasses import dataclass

import numba
import numpy as np
import psutil
from numpy.typing import NDArray

from sgsst_core.compiled import compiled, kernel_threads
from sgsst_core.constants import ALPHA_MIN, NEAR, RASTER_TILE
from sgsst_core.errors import TooManyIntersectionsError
from sgsst_core.rasterizer.projection import Outcome, Projection, Shapes, project, take_places, take_rows
from sgsst_core.scene.camera import Camera
from sgsst_core.scene.gaussians import Scene

#: Positions in the lists are 32-bit numbers.
MAX_INTERSECTIONS = 2**31 - 1
#: What a pair of Gaussian and raster tile takes: rank, slot, and the slot's gradient in the backward pass.
_PAIR_BYTES = 4 + 4 + 12
#: Parts of the Gaussians that a thread lists, one after the other.
_PARTS = 4
_TILE = RASTER_TILE
_SUPPORT_BITS = -math.log2(ALPHA_MIN)


@dataclass(frozen=True)
class RasterLists:
    """A view's Gaussians and the raster tiles they touch.

    A Gaussian touches a tile when its support covers a pixel row of the tile somewhere between two of the tile's
    columns. Every pair has a *slot*; the slots of one Gaussian lie side by side.

    Attributes:
        projection: V Gaussians, front to back; the lists name them by their place in it, their *rank*.
        starts: [tiles + 1] int64, where each tile's entries begin; tiles run row by row.
        ranks: [E] int32, entry -> rank, front to back within a tile.
        slots: [E] int32, entry -> slot.
        first_slots: [V + 1] int64, rank -> first slot.
    """

    projection: Projection
    starts: NDArray[np.int64]
    ranks: NDArray[np.int32]
    slots: NDArray[np.int32]
    first_slots: NDArray[np.int64]

    @property
    def nbytes(self) -> int:
        """Bytes that the lists and the projection keep in memory."""
        arrays = (
            self.projection.gaussians,
            self.projection.values,
            self.starts,
            self.ranks,
            self.slots,
            self.first_slots,
        )
        return sum(a.nbytes for a in arrays)


def tile_grid(camera: Camera) -> tuple[int, int]:
    """How many raster tiles a view has across and down."""
    return -(-camera.width // RASTER_TILE), -(-camera.height // RASTER_TILE)


def build_raster_lists(
    scene: Scene, camera: Camera, *, near: float = NEAR, shapes: Shapes | None = None
) -> RasterLists:
    """Project, sort by depth, and list the Gaussians of every raster tile.

    Args:
        shapes: of the scene, from an earlier view.

    Raises:
        TooManyIntersectionsError: more pairs of Gaussian and tile than 32-bit positions can address or the free memory
            can hold; counted before anything of that size is allocated.
    """
    projection = project(scene, camera, near=near, shapes=shapes)
    values, size = projection.values, (camera.width, camera.height)
    across, down = tile_grid(camera)
    counts = np.empty(len(values), dtype=np.int64)
    with kernel_threads():
        threads = numba.get_num_threads()
        parts = np.linspace(0, len(values), threads * _PARTS + 1).astype(np.int64)
        places = np.zeros((len(parts) - 1, across * down), dtype=np.int64)
        _count_tiles(values, *size, parts, threads, counts, places)
    first_slots = _starts(counts)
    total = int(first_slots[-1])
    check_intersections(total, len(counts), camera)
    _check_memory(total, len(counts), camera)
    starts = _starts(places.sum(axis=0))
    # Where each part's first entry of a tile goes: behind those of the parts in front of it.
    places = starts[:-1] + np.cumsum(places, axis=0) - places
    ranks, slots = np.empty(total, dtype=np.int32), np.empty(total, dtype=np.int32)
    with kernel_threads():
        _fill_tiles(values, *size, parts, threads, first_slots, places, ranks, slots)
    return RasterLists(projection, starts, ranks, slots, first_slots)


def lists_of_subset(lists: RasterLists, places: NDArray[np.int32]) -> RasterLists:
    """The lists of some of a scene's Gaussians, from those of all: the same arrays as `build_raster_lists` makes.

    Args:
        places: [N] int32, each Gaussian's index among them; -1 for the others. They keep their order.
    """
    projection = lists.projection
    with kernel_threads():
        gaussians = np.empty(len(projection.gaussians), dtype=np.int32)
        take_places(places, projection.gaussians, gaussians)
        kept = gaussians >= 0
        # Of every rank: its new one, -1 where it goes, and by how much its slots move.
        ranks = np.where(kept, np.cumsum(kept, dtype=np.int32) - np.int32(1), np.int32(-1))
        first_slots = _starts(np.where(kept, np.diff(lists.first_slots), 0))
        moves = (lists.first_slots - first_slots)[:-1]
        counts = np.empty(len(lists.starts) - 1, dtype=np.int64)
        _count_kept(lists.ranks, lists.starts, ranks, counts)
        starts = _starts(counts)
        values = np.empty((int(kept.sum()), projection.values.shape[1]))
        take_rows(projection.values, np.flatnonzero(kept), values)
        own_ranks, own_slots = np.empty(starts[-1], dtype=np.int32), np.empty(starts[-1], dtype=np.int32)
        _take_kept(lists.ranks, lists.slots, lists.starts, ranks, moves, starts, own_ranks, own_slots)
    own = Projection(gaussians[kept], values, {Outcome.VISIBLE: len(values)})
    return RasterLists(own, starts, own_ranks, own_slots, np.append(first_slots[:-1][kept], first_slots[-1]))


def _starts(counts: NDArray[np.int64]) -> NDArray[np.int64]:
    """Where each of some lists begins that lie one behind the other, and the end of the last one."""
    return np.concatenate([np.zeros(1, dtype=np.int64), np.cumsum(counts)])


def check_intersections(total: int, gaussians: int, camera: Camera) -> None:
    """Raise TooManyIntersectionsError when `total` pairs of Gaussian and raster tile cannot be addressed."""
    if total > MAX_INTERSECTIONS:
        raise _refusal(total, gaussians, camera, f"more than the {MAX_INTERSECTIONS:,} that can be addressed")


def _check_memory(total: int, gaussians: int, camera: Camera) -> None:
    """Raise TooManyIntersectionsError when `total` pairs do not fit the memory that is free.

    Allocating them would succeed all the same, and the process be killed when it writes there.
    """
    needed, free = total * _PAIR_BYTES, psutil.virtual_memory().available
    if needed > free:
        raise _refusal(
            total, gaussians, camera, f"which takes {needed / 1e9:.1f} GB where {free / 1e9:.1f} GB are free"
        )


def _refusal(total: int, gaussians: int, camera: Camera, reason: str) -> TooManyIntersectionsError:
    return TooManyIntersectionsError(
        f"view {camera.name!r} ({camera.width}x{camera.height}): its {gaussians:,} visible Gaussians touch raster "
        f"tiles {total:,} times, {reason}. Render at a lower resolution, or remove Gaussians so large that they cover "
        "much of the view."
    )


@compiled()
def _tile_rows(value, height):
    """Pixel rows (first, last) of the image inside a Gaussian's extents; last < first where there are none."""
    # np, not math: in compiled code math.ceil gives an int64, which overflows for extents beyond 9e18 pixels
    first = max(0.0, np.ceil(value[1] - value[7] - 0.5))
    last = min(height - 1.0, np.floor(value[1] + value[7] - 0.5))
    return int(first), int(max(last, -1.0))


@compiled()
def _tile_span(value, first, last, width):
    """Tiles (begin, end) that a Gaussian's support reaches in pixel rows first..last, all inside its extents.

    The right edge of an ellipse is concave in y and highest at dy = SKEW * EXTENT_Y^2 / EXTENT_X, the left one its
    mirror image; over an interval each takes its extreme there or at the nearer end.
    """
    top, bottom = first + 0.5 - value[1], last + 0.5 - value[1]
    widest = value[2] * value[7] * (value[7] / value[6]) if value[6] > 0 else 0.0
    support = value[5] + _SUPPORT_BITS
    right = min(max(widest, top), bottom)
    left = min(max(-widest, top), bottom)
    half_right = math.sqrt(max(support - (right * value[4]) ** 2, 0.0)) / value[3]
    half_left = math.sqrt(max(support - (left * value[4]) ** 2, 0.0)) / value[3]
    begin = max(0.0, np.ceil(value[0] + value[2] * left - half_left - 0.5))
    end = min(width - 1.0, np.floor(value[0] + value[2] * right + half_right - 0.5))
    if end < begin:
        return 0, 0
    return int(begin) // _TILE, int(end) // _TILE + 1


@compiled()
def _own_part(step, threads):
    """The part that comes `step`th, so that every thread gets parts from front to back: nearer ones have more work."""
    return step % _PARTS * threads + step // _PARTS


@compiled(parallel=True)
def _count_tiles(values, width, height, parts, threads, counts, places):
    """How many tiles each Gaussian touches, and how many Gaussians of each part touch each tile."""
    across = (width + _TILE - 1) // _TILE
    for step in numba.prange(parts.size - 1):
        part = _own_part(step, threads)
        for rank in range(parts[part], parts[part + 1]):
            first, last = _tile_rows(values[rank], height)
            total = 0
            for down in range(first // _TILE, last // _TILE + 1):
                top, bottom = max(first, down * _TILE), min(last, down * _TILE + _TILE - 1)
                begin, end = _tile_span(values[rank], top, bottom, width)
                total += end - begin
                for tile in range(down * across + begin, down * across + end):
                    places[part, tile] += 1
            counts[rank] = total


@compiled(parallel=True)
def _fill_tiles(values, width, height, parts, threads, first_slots, places, ranks, slots):
    """Counting sort of all pairs by tile; Gaussians come in order of depth, so every tile's list does too."""
    across = (width + _TILE - 1) // _TILE
    for step in numba.prange(parts.size - 1):
        part = _own_part(step, threads)
        for rank in range(parts[part], parts[part + 1]):
            first, last = _tile_rows(values[rank], height)
            slot = first_slots[rank]
            for down in range(first // _TILE, last // _TILE + 1):
                top, bottom = max(first, down * _TILE), min(last, down * _TILE + _TILE - 1)
                begin, end = _tile_span(values[rank], top, bottom, width)
                for tile in range(down * across + begin, down * across + end):
                    place = places[part, tile]
                    ranks[place], slots[place] = rank, slot
                    places[part, tile] = place + 1
                    slot += 1


@compiled(parallel=True)
def _count_kept(ranks, starts, new_ranks, counts):
    """How many entries each tile keeps."""
    for tile in numba.prange(starts.size - 1):
        total = 0
        for position in range(starts[tile], starts[tile + 1]):
            total += new_ranks[ranks[position]] >= 0
        counts[tile] = total


@compiled(parallel=True)
def _take_kept(ranks, slots, starts, new_ranks, moves, new_starts, out_ranks, out_slots):
    """The entries that each tile keeps, with their new ranks and slots."""
    for tile in numba.prange(starts.size - 1):
        place = new_starts[tile]
        for position in range(starts[tile], starts[tile + 1]):
            rank = ranks[position]
            if new_ranks[rank] >= 0:
                out_ranks[place], out_slots[place] = new_ranks[rank], slots[position] - moves[rank]
                place += 1
