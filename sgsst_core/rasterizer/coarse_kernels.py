"""Numba kernels of `coarse`: blend weights averaged over squares of 2^scale pixels, stored and applied.

For scales 1 to 4, a square of 2^scale pixels lies in one raster tile. A piece is one Gaussian in one raster tile: all
its (16 >> scale)^2 averaged weights in row-major order, including zeros. It therefore needs only the indices of its
Gaussian and slot, and all pieces that fill whole vectors take the same instructions. The weights before averaging are
bit-identical to those of `kernels`. As in `kernels`, slots make gradients independent of the number of threads.

Accuracy: averages are computed in float64 and rounded once. An image sums up to `_RUN` pieces in float32, and these
partial sums in float64, because a coarse pixel may see thousands of Gaussians.
"""

# Arguments are untyped: Numba compiles one version per argument type.
# mypy: disable-error-code="no-untyped-def"

from __future__ import annotations

from typing import NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray

from sgsst_core.compiled import compiled
from sgsst_core.constants import RASTER_TILE
from sgsst_core.rasterizer.kernels import _blend, _start_tile
from sgsst_core.rasterizer.vectors import LANES, add_scaled, dot_pixels

_ZERO = np.float32(0.0)
_TILE = RASTER_TILE
_RUN = 64


class Pieces(NamedTuple):
    """Averaged weights of a view at one scale, with P pieces. Pieces of a raster tile are contiguous, front to back.

    Kernels unpack this tuple before their parallel loop, because Numba's parallel loops do not support tuple fields.
    """

    starts: NDArray[np.int64]  # [raster tiles + 1]
    gaussians: NDArray[np.int32]  # [P], indices into the scene
    slots: NDArray[np.int32]  # [P]; the slots of one Gaussian are contiguous
    weights: NDArray[np.float32]  # [(16 >> scale)^2 P]


@compiled()
def _has_weight(block, first, stop):
    """Return whether rows first..stop of block[1] contain any weight."""
    largest = _ZERO
    for row in range(first, stop):
        for i in range(_TILE):
            largest = max(largest, block[1, row, i])
    return largest > _ZERO


@compiled()
def _average(values, first, stop, scale, averages):
    """Compute averages [16 >> scale, 16 >> scale] of |values| [16, 16]. Values outside rows first..stop count as 0.

    Absolute values are needed because the transmittance of finished pixels is stored negated.
    """
    averages[:] = 0.0
    for row in range(first, stop):
        for i in range(averages.shape[1]):
            total = 0.0
            for column in range(i << scale, (i + 1) << scale):
                total += abs(values[row, column])
            averages[row >> scale, i] += total
    averages *= 1.0 / (1 << 2 * scale)


@compiled(parallel=True)
def count_pieces(entries, slots, starts, values, size, across, alpha_max, tile_pieces, slot_used):
    """Count the pieces of every raster tile, and mark the slots that have one.

    Only pixels within size = (height, width), the area of complete squares, are considered. `tile_pieces` [tiles] and
    `slot_used` [E] must be zero on entry.
    """
    height, width = size
    for tile in numba.prange(starts.size - 1):
        x, y = tile % across * _TILE, tile // across * _TILE
        high, columns = min(height - y, _TILE), min(width - x, _TILE)
        if high <= 0 or columns <= 0:
            continue
        block = np.empty((2, _TILE, _TILE), dtype=np.float32)
        alive = np.empty(_TILE + 1, dtype=np.int32)
        _start_tile(block, alive, columns, 0, high)
        for position in range(starts[tile], starts[tile + 1]):
            if alive[_TILE] == 0:
                break
            first, stop = _blend(block, alive, values[entries[position]], x, y, 0, high, alpha_max)
            if _has_weight(block, first, stop):
                slot_used[slots[position]] = True
                tile_pieces[tile] += 1


@compiled(parallel=True)
def keep_pieces(
    entries, slots, starts, values, gaussians, size, across, scale, alpha_max, slot_starts, pieces, transmittance
):
    """Store the pieces counted by `count_pieces`, and the averaged final transmittance [height >> scale, ...]."""
    piece_starts, piece_gaussians, piece_slots, weights = pieces
    height, width = size
    side = _TILE >> scale
    for tile in numba.prange(starts.size - 1):
        x, y = tile % across * _TILE, tile // across * _TILE
        high, columns = min(height - y, _TILE), min(width - x, _TILE)
        if high <= 0 or columns <= 0:
            continue
        block = np.empty((2, _TILE, _TILE), dtype=np.float32)
        alive = np.empty(_TILE + 1, dtype=np.int32)
        averages = np.empty((side, side), dtype=np.float64)
        _start_tile(block, alive, columns, 0, high)
        piece = piece_starts[tile]
        for position in range(starts[tile], starts[tile + 1]):
            if alive[_TILE] == 0:
                break
            rank, slot = entries[position], slots[position]
            first, stop = _blend(block, alive, values[rank], x, y, 0, high, alpha_max)
            if slot_starts[slot] == slot_starts[slot + 1]:
                continue
            _average(block[1], first, stop, scale, averages)
            weights[piece * side * side : (piece + 1) * side * side] = averages.reshape(side * side)
            piece_gaussians[piece], piece_slots[piece] = gaussians[rank], slot_starts[slot]
            piece += 1
        _average(block[0], 0, high, scale, averages)
        for row in range(high >> scale):
            for i in range(columns >> scale):
                transmittance[(y >> scale) + row, (x >> scale) + i] = averages[row, i]


@compiled()
def _add_piece(weights, begin, count, pixels, red, green, blue):
    """Compute pixels[v, c, i] += weights[begin + 8 v + i] * color c for a piece of `count` weights."""
    if count >= LANES:
        add_scaled(weights, begin, count // LANES, pixels, 0, red, green, blue)
        return
    for i in range(count):
        pixels[0, 0, i] += weights[begin + i] * red
        pixels[0, 1, i] += weights[begin + i] * green
        pixels[0, 2, i] += weights[begin + i] * blue


@compiled()
def _dot_piece(weights, begin, count, pixels):
    """Return the three sums of weights[begin + 8 v + i] * pixels[v, c, i] over a piece of `count` weights."""
    if count >= LANES:
        return dot_pixels(weights, begin, count // LANES, pixels, 0)
    red, green, blue = _ZERO, _ZERO, _ZERO
    for i in range(count):
        red += weights[begin + i] * pixels[0, 0, i]
        green += weights[begin + i] * pixels[0, 1, i]
        blue += weights[begin + i] * pixels[0, 2, i]
    return red, green, blue


@compiled(parallel=True)
def apply_pieces(pieces, colors, background, transmittance, across, scale, image):
    """Render the image [h, w, 3] of colors [N, 3] over the background: the box average of `kernels.render`."""
    starts, gaussians, _, weights = pieces
    height, width = transmittance.shape
    side = _TILE >> scale
    count = side * side
    for tile in numba.prange(starts.size - 1):
        x, y = tile % across * side, tile // across * side
        totals = np.zeros((max(count // LANES, 1), 3, LANES), dtype=np.float64)
        pixels = np.empty(totals.shape, dtype=np.float32)
        for run in range(starts[tile], starts[tile + 1], _RUN):
            pixels[:] = _ZERO
            for piece in range(run, min(run + _RUN, starts[tile + 1])):
                gaussian = gaussians[piece]
                red, green, blue = colors[gaussian, 0], colors[gaussian, 1], colors[gaussian, 2]
                _add_piece(weights, piece * count, count, pixels, red, green, blue)
            totals += pixels
        for row in range(min(height - y, side)):
            for i in range(min(width - x, side)):
                vector, lane = (row * side + i) // LANES, (row * side + i) % LANES
                left = transmittance[y + row, x + i]
                for channel in range(3):
                    image[y + row, x + i, channel] = totals[vector, channel, lane] + left * background[channel]


@compiled(parallel=True)
def apply_transposed_pieces(pieces, image_gradient, across, scale, slot_gradients):
    """Write dL/dcolor of every piece to its slot in `slot_gradients` [P, 3].

    `image_gradient` [h, w, 3] is the gradient of the averaged image.
    """
    starts, _, slots, weights = pieces
    height, width = image_gradient.shape[0], image_gradient.shape[1]
    side = _TILE >> scale
    count = side * side
    for tile in numba.prange(starts.size - 1):
        x, y = tile % across * side, tile // across * side
        pixels = np.zeros((max(count // LANES, 1), 3, LANES), dtype=np.float32)
        for row in range(min(height - y, side)):
            for i in range(min(width - x, side)):
                vector, lane = (row * side + i) // LANES, (row * side + i) % LANES
                for channel in range(3):
                    pixels[vector, channel, lane] = image_gradient[y + row, x + i, channel]
        for piece in range(starts[tile], starts[tile + 1]):
            slot = slots[piece]
            red, green, blue = _dot_piece(weights, piece * count, count, pixels)
            slot_gradients[slot, 0], slot_gradients[slot, 1], slot_gradients[slot, 2] = red, green, blue
