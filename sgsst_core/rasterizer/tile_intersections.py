"""Tile intersections on the CPU: the depth-sorted Gaussians of each raster tile.

They are built once per camera, because geometry is frozen.
"""

# Arguments are untyped: Numba compiles one version per argument type.
# mypy: disable-error-code="no-untyped-def"

from __future__ import annotations

import math
from dataclasses import dataclass

import numba
import numpy as np
from numpy.typing import NDArray

from sgsst_core import container
from sgsst_core.compiled import compiled, kernel_threads
from sgsst_core.constants import LOG2_ALPHA_MIN, NEAR, RASTER_TILE
from sgsst_core.errors import TooManyIntersectionsError
from sgsst_core.rasterizer.depth_order import take_elements
from sgsst_core.rasterizer.projection import Projection, Shapes, project, take_rows
from sgsst_core.scene.camera import Camera
from sgsst_core.scene.gaussians import Scene

#: Maximum number of pairs of Gaussian and raster tile, since their positions are 32-bit integers.
MAX_INTERSECTIONS = 2**31 - 1
#: Bytes per pair of Gaussian and raster tile: rank, slot, and the slot's gradient in the backward pass.
_PAIR_BYTES = 4 + 4 + 12
#: Number of chunks of the scene that each thread processes, one after the other.
_CHUNKS = 4
_TILE = RASTER_TILE


@dataclass(frozen=True)
class TileIntersections:
    """Tile intersections of a view.

    A Gaussian intersects a raster tile if its support overlaps a pixel row of the tile within the tile's columns. Every
    pair of Gaussian and tile has an *entry*, its index in tile order, and a *slot*, its index in Gaussian order: the
    slots of one Gaussian are contiguous.

    Attributes:
        projection: V Gaussians, front to back. The index of a Gaussian in this depth order is its *rank*.
        starts: [tiles + 1] int64, first entry of each tile; tiles are in row-major order.
        ranks: [E] int32, rank of each entry's Gaussian, front to back within a tile.
        slots: [E] int32, slot of each entry.
        first_slots: [V + 1] int64, first slot of each rank.
    """

    projection: Projection
    starts: NDArray[np.int64]
    ranks: NDArray[np.int32]
    slots: NDArray[np.int32]
    first_slots: NDArray[np.int64]

    @property
    def nbytes(self) -> int:
        """Memory use in bytes, including the projection."""
        projection = self.projection.gaussians, self.projection.values
        return sum(array.nbytes for array in (*projection, self.starts, self.ranks, self.slots, self.first_slots))


def tile_grid(camera: Camera) -> tuple[int, int]:
    """Return the number of raster tiles of a view as (across, down)."""
    return -(-camera.width // RASTER_TILE), -(-camera.height // RASTER_TILE)


def build_tile_intersections(
    scene: Scene, camera: Camera, *, near: float = NEAR, shapes: Shapes | None = None
) -> TileIntersections:
    """Project a scene, sort its Gaussians by depth, and compute the tile intersections.

    Args:
        shapes: Shapes of the scene from an earlier view; None to compute them.

    Raises:
        TooManyIntersectionsError: If there are more pairs of Gaussian and tile than 32-bit positions can address or
            free memory can hold. The pairs are counted before memory for them is allocated.
    """
    projection = project(scene, camera, near=near, shapes=shapes)
    values, size = projection.values, (camera.width, camera.height)
    across, down = tile_grid(camera)
    counts = np.empty(len(values), dtype=np.int64)
    with kernel_threads():
        threads = numba.get_num_threads()
        chunks = np.linspace(0, len(values), threads * _CHUNKS + 1).astype(np.int64)
        positions = np.zeros((len(chunks) - 1, across * down), dtype=np.int64)
        _count_tiles(values, *size, chunks, threads, counts, positions)
    first_slots = run_starts(counts)
    total = int(first_slots[-1])
    check_intersections(total, len(counts), camera, free=container.memory().available)
    starts = run_starts(positions.sum(axis=0))
    # First position that each chunk writes to in each tile: after the entries of all preceding chunks.
    positions = starts[:-1] + np.cumsum(positions, axis=0) - positions
    ranks, slots = np.empty(total, dtype=np.int32), np.empty(total, dtype=np.int32)
    with kernel_threads():
        _fill_tiles(values, *size, chunks, threads, first_slots, positions, ranks, slots)
    return TileIntersections(projection, starts, ranks, slots, first_slots)


def intersections_of_subset(isects: TileIntersections, indices: NDArray[np.int32]) -> TileIntersections:
    """Restrict tile intersections to a subset of the Gaussians.

    The arrays are the same as those of `build_tile_intersections` for the subset.

    Args:
        indices: [N] int32, each Gaussian's index in the subset, in unchanged order; -1 if it is not in the subset.
    """
    projection = isects.projection
    with kernel_threads():
        gaussians = np.empty(len(projection.gaussians), dtype=np.int32)
        take_elements(indices, projection.gaussians, gaussians)
        remains = gaussians >= 0
        # For each Gaussian in depth order: its new rank (-1 if removed), and by how much its slots move down.
        ranks = np.where(remains, np.cumsum(remains, dtype=np.int32) - np.int32(1), np.int32(-1))
        first_slots = run_starts(np.where(remains, np.diff(isects.first_slots), 0))
        shifts = (isects.first_slots - first_slots)[:-1]
        counts = np.empty(len(isects.starts) - 1, dtype=np.int64)
        _count_remaining(isects.ranks, isects.starts, ranks, counts)
        starts = run_starts(counts)
        values = np.empty((int(remains.sum()), projection.values.shape[1]))
        take_rows(projection.values, np.flatnonzero(remains), values)
        subset_ranks, subset_slots = np.empty(starts[-1], dtype=np.int32), np.empty(starts[-1], dtype=np.int32)
        _copy_remaining(isects.ranks, isects.slots, isects.starts, ranks, shifts, starts, subset_ranks, subset_slots)
    subset = Projection(gaussians[remains], values)
    return TileIntersections(
        subset, starts, subset_ranks, subset_slots, np.append(first_slots[:-1][remains], first_slots[-1])
    )


def run_starts(counts: NDArray[np.int64] | NDArray[np.bool_]) -> NDArray[np.int64]:
    """Return the start offsets of consecutive runs with these lengths, and the end of the last one."""
    return np.concatenate([np.zeros(1, dtype=np.int64), np.cumsum(counts, dtype=np.int64)])


def check_intersections(total: int, gaussians: int, camera: Camera, *, free: int | None = None) -> None:
    """Raise TooManyIntersectionsError if `total` pairs of Gaussian and raster tile cannot be addressed.

    If the number of free bytes is given, raise it also if they do not fit. Without this check, the allocation would
    succeed, and the process would be killed when it writes to the memory.
    """
    needed = total * _PAIR_BYTES
    if total > MAX_INTERSECTIONS:
        reason = f"more than the {MAX_INTERSECTIONS:,} that can be addressed"
    elif free is not None and needed > free:
        reason = f"which takes {needed / 1e9:.1f} GB where {free / 1e9:.1f} GB are free"
    else:
        return
    raise TooManyIntersectionsError(
        f"view {camera.name!r} ({camera.width}x{camera.height}): its {gaussians:,} visible Gaussians touch raster "
        f"tiles {total:,} times, {reason}. Render at a lower resolution, or remove Gaussians so large that they cover "
        "much of the view."
    )


@compiled()
def _tile_rows(value, height):
    """Return the pixel rows (first, last) of the image within a Gaussian's extents; last < first if there are none."""
    # Use np.ceil: in compiled code, math.ceil returns int64, which overflows for extents above 9e18 pixels.
    first = max(0.0, np.ceil(value[1] - value[7] - 0.5))
    last = min(height - 1.0, np.floor(value[1] + value[7] - 0.5))
    return int(first), int(max(last, -1.0))


@compiled()
def _tile_span(value, first, last, width):
    """Return the range (begin, end) of tile columns that a Gaussian's support reaches in pixel rows first..last.

    These rows must be within the Gaussian's extents. The right edge of an ellipse is concave in y, with its maximum at
    dy = SKEW * EXTENT_Y^2 / EXTENT_X; the left edge is its point reflection. In an interval of rows, an edge is extreme
    at this point or, if it is outside the interval, at the nearer end.
    """
    top, bottom = first + 0.5 - value[1], last + 0.5 - value[1]
    widest = value[2] * value[7] * (value[7] / value[6]) if value[6] > 0 else 0.0
    support = value[5] - LOG2_ALPHA_MIN
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
def _chunk_of(step, threads):
    """Return the chunk of the Gaussians for a step of a parallel loop.

    Every thread gets chunks from all depths, because nearer chunks take more work.
    """
    return step % _CHUNKS * threads + step // _CHUNKS


@compiled(parallel=True)
def _count_tiles(values, width, height, chunks, threads, counts, positions):
    """Count the tiles that each Gaussian intersects, and the Gaussians of each chunk that intersect each tile."""
    across = (width + _TILE - 1) // _TILE
    for step in numba.prange(chunks.size - 1):
        chunk = _chunk_of(step, threads)
        for rank in range(chunks[chunk], chunks[chunk + 1]):
            first, last = _tile_rows(values[rank], height)
            total = 0
            for down in range(first // _TILE, last // _TILE + 1):
                top, bottom = max(first, down * _TILE), min(last, down * _TILE + _TILE - 1)
                begin, end = _tile_span(values[rank], top, bottom, width)
                total += end - begin
                for tile in range(down * across + begin, down * across + end):
                    positions[chunk, tile] += 1
            counts[rank] = total


@compiled(parallel=True)
def _fill_tiles(values, width, height, chunks, threads, first_slots, positions, ranks, slots):
    """Sort all pairs of Gaussian and tile by tile (counting sort).

    Gaussians are processed in depth order, so the entries of every tile are sorted by depth.
    """
    across = (width + _TILE - 1) // _TILE
    for step in numba.prange(chunks.size - 1):
        chunk = _chunk_of(step, threads)
        for rank in range(chunks[chunk], chunks[chunk + 1]):
            first, last = _tile_rows(values[rank], height)
            slot = first_slots[rank]
            for down in range(first // _TILE, last // _TILE + 1):
                top, bottom = max(first, down * _TILE), min(last, down * _TILE + _TILE - 1)
                begin, end = _tile_span(values[rank], top, bottom, width)
                for tile in range(down * across + begin, down * across + end):
                    position = positions[chunk, tile]
                    ranks[position], slots[position] = rank, slot
                    positions[chunk, tile] = position + 1
                    slot += 1


@compiled(parallel=True)
def _count_remaining(ranks, starts, new_ranks, counts):
    """Count the remaining entries of each tile."""
    for tile in numba.prange(starts.size - 1):
        total = 0
        for position in range(starts[tile], starts[tile + 1]):
            total += new_ranks[ranks[position]] >= 0
        counts[tile] = total


@compiled(parallel=True)
def _copy_remaining(ranks, slots, starts, new_ranks, shifts, new_starts, out_ranks, out_slots):
    """Copy the remaining entries of each tile with their new ranks and slots."""
    for tile in numba.prange(starts.size - 1):
        target = new_starts[tile]
        for position in range(starts[tile], starts[tile + 1]):
            rank = ranks[position]
            if new_ranks[rank] >= 0:
                out_ranks[target], out_slots[target] = new_ranks[rank], slots[position] - shifts[rank]
                target += 1
