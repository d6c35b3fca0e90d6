"""Numba kernels of the CPU rasterizers.

All kernels traverse the Gaussians of one raster tile front to back, and compute the blend weights of one Gaussian in a
16 x 16 block that stays in the L1 cache (`_blend`). They differ only in how they use this block: they add its product
with a color to the image, or multiply it by dL/dimage. All kernels therefore use bit-identical weights.

Accuracy: the offset between a pixel and a Gaussian is computed in float64 once per row, and rounded to float32 after
large terms have canceled. Within the row, offsets of up to 15 pixels are added in float32. This preserves accuracy for
distant centers and needle-shaped Gaussians.

Determinism: each tile is processed by one thread. The gradient of each (Gaussian, tile) pair is written to a separate
slot. The slots of a Gaussian are contiguous, and are then added in order.
"""

# Arguments are untyped: Numba compiles one version per argument type.
# mypy: disable-error-code="no-untyped-def"

from __future__ import annotations

import numba
import numpy as np

from sgsst_core.compiled import compiled
from sgsst_core.constants import LOG2_ALPHA_MIN, RASTER_TILE
from sgsst_core.rasterizer.vectors import (
    LANES,
    add_scaled,
    blend_row,
    dot_pixels,
    prefetch,
    sum_weights,
)

_ONE = np.float32(1.0)
_ZERO = np.float32(0.0)
_TILE = RASTER_TILE
_LAST = RASTER_TILE - 1
_PIXELS = RASTER_TILE**2
_COLUMNS = 8
#: Prefetch distance in entries; blending this many entries takes about 100 ns.
_AHEAD = 8
#: Number of neighboring tiles that form a block, and a prime stride that scatters such blocks over the image. The prime
#: is larger than the number of blocks.
_BLOCK_TILES, _STRIDE = 8, 1_000_003
#: Strips of `LANES` columns in a raster tile, whose weights fill the registers.
_STRIPS = RASTER_TILE // LANES


@compiled()
def _blend(block, alive, value, x, y, high, alpha_max):
    """Blend one Gaussian into the first `high` rows of the tile at pixel (x, y).

    The weights are written to block[1, first:stop]. alive[row] is non-zero if the row has unfinished pixels; alive[16]
    is the number of such rows.

    Returns:
        Range (first, stop) of the rows that the Gaussian reaches.
    """
    dx = x + 0.5 - value[0]
    top = y + 0.5 - value[1]
    skew, u_scale, w_scale, log2_opacity, extent_y = value[2], value[3], value[4], value[5], value[7]
    # Use np.ceil: in compiled code, math.ceil returns int64, which overflows for extents above 9e18 pixels.
    begin = max(0.0, np.ceil(-extent_y - top))
    end = min(np.float64(high), np.floor(extent_y - top) + 1.0)
    first, stop = 0, 0
    for row in range(int(begin), int(end)):
        if alive[row] == 0:
            continue
        dy = top + row
        w = dy * w_scale
        rest = log2_opacity - LOG2_ALPHA_MIN - w * w
        u = (dx - skew * dy) * u_scale
        u_end = u + _LAST * u_scale
        nearest = max(u, -u_end)
        if rest < 0 or (nearest > 0 and nearest * nearest > rest):
            continue
        if stop == 0:
            first = row
            stop = row
        for gap in range(stop, row):
            for i in range(_TILE):
                block[1, gap, i] = _ZERO
        unfinished = blend_row(block, row, u, u_scale, log2_opacity - w * w, alpha_max)
        stop = row + 1
        if unfinished == 0:
            alive[_TILE] -= 1
        alive[row] = unfinished
    return first, stop


@compiled()
def _tile_at(tile, height, width):
    """Return left and top edge, rows and columns of a tile in the image, and its state before the first Gaussian.

    The state is `block`, with transmittances of 1, and `alive`; see `_blend`. Pixels outside the image are finished.
    """
    across = (width + _LAST) // _TILE
    x, y = tile % across * _TILE, tile // across * _TILE
    high, columns = min(height - y, _TILE), min(width - x, _TILE)
    block = np.empty((2, _TILE, _TILE), dtype=np.float32)
    alive = np.zeros(_TILE + 1, dtype=np.int32)
    for row in range(_TILE):
        for i in range(_TILE):
            inside = row < high and i < columns
            block[0, row, i] = _ONE if inside else -_ONE
    for row in range(high):
        alive[row] = 1
    alive[_TILE] = high
    return x, y, high, columns, block, alive


@compiled()
def _store_transmittance(block, y, x, high, columns, transmittance):
    """Store the final transmittances of a tile in the rows and columns of an image at (y, x)."""
    for row in range(high):
        for i in range(columns):
            transmittance[y + row, x + i] = abs(block[0, row, i])


@compiled()
def _load_pixels(image, y, x, high, columns, pixels):
    """Load the first `high` rows of an image patch at (y, x) into `pixels` [P, 3, 8]; zero outside the patch."""
    pixels[:] = _ZERO
    across = pixels.shape[0] // _TILE
    for row in range(high):
        line = image[y + row, x : x + columns]
        for i in range(columns):
            vector, lane = row * across + i // LANES, i % LANES
            pixels[vector, 0, lane] = line[i, 0]
            pixels[vector, 1, lane] = line[i, 1]
            pixels[vector, 2, lane] = line[i, 2]


@compiled()
def _store_pixels(pixels, transmittance, background, y, x, high, columns, image):
    """Store `pixels` [P, 3, 8] in the first `high` rows of an image patch at (y, x), over the background."""
    red, green, blue = background[0], background[1], background[2]
    across = pixels.shape[0] // _TILE
    for row in range(high):
        line, left = image[y + row, x : x + columns], transmittance[y + row, x : x + columns]
        for i in range(columns):
            vector, lane = row * across + i // LANES, i % LANES
            line[i, 0] = pixels[vector, 0, lane] + left[i] * red
            line[i, 1] = pixels[vector, 1, lane] + left[i] * green
            line[i, 2] = pixels[vector, 2, lane] + left[i] * blue


@compiled()
def _blocks(tiles):
    """Return the number of blocks of neighboring tiles."""
    return (tiles + _BLOCK_TILES - 1) // _BLOCK_TILES


@compiled()
def _scattered(step, tiles):
    """Return the tile at a step of a parallel loop over `_blocks(tiles) * _BLOCK_TILES` steps.

    Steps whose result is not below `tiles` have no tile and must be skipped.

    Each thread gets a range of steps. Consecutive blocks are scattered over the image to balance the load: no thread
    gets only sky while another gets only dense areas. Tiles within a block are neighbors, which share Gaussians.
    """
    return step // _BLOCK_TILES * _STRIDE % _blocks(tiles) * _BLOCK_TILES + step % _BLOCK_TILES


@compiled(parallel=True)
def render(entries, starts, values, gaussians, colors, background, alpha_max, image, transmittance):
    """Render the image [h, w, 3] and the final transmittance [h, w] of a view."""
    height, width = transmittance.shape
    flat = values.reshape(values.size)
    tiles = starts.size - 1
    for step in numba.prange(_blocks(tiles) * _BLOCK_TILES):
        tile = _scattered(step, tiles)
        if tile >= tiles:
            continue
        x, y, high, columns, block, alive = _tile_at(tile, height, width)
        pixels = np.zeros((_PIXELS // LANES, 3, LANES), dtype=np.float32)
        weights = block.reshape(2 * _PIXELS)
        end = starts[tile + 1]
        for position in range(starts[tile], end):
            if alive[_TILE] == 0:
                break
            prefetch(flat, np.int64(entries[min(position + _AHEAD, end - 1)]) * _COLUMNS)
            rank = entries[position]
            first, stop = _blend(block, alive, values[rank], x, y, high, alpha_max)
            color = colors[gaussians[rank]]
            begin, vectors = first * _STRIPS, (stop - first) * _STRIPS
            add_scaled(weights, _PIXELS + begin * LANES, vectors, pixels, begin, color[0], color[1], color[2])
        _store_transmittance(block, y, x, high, columns, transmittance)
        _store_pixels(pixels, transmittance, background, y, x, high, columns, image)


@compiled(parallel=True)
def color_gradient(entries, slots, starts, values, image_gradient, alpha_max, slot_gradients):
    """Write dL/dcolor of every (Gaussian, tile) pair to its slot [E, 3]."""
    height, width = image_gradient.shape[0], image_gradient.shape[1]
    flat = values.reshape(values.size)
    tiles = starts.size - 1
    for step in numba.prange(_blocks(tiles) * _BLOCK_TILES):
        tile = _scattered(step, tiles)
        if tile >= tiles:
            continue
        x, y, high, columns, block, alive = _tile_at(tile, height, width)
        pixels = np.empty((_PIXELS // LANES, 3, LANES), dtype=np.float32)
        weights = block.reshape(2 * _PIXELS)
        _load_pixels(image_gradient, y, x, high, columns, pixels)
        end = starts[tile + 1]
        for position in range(starts[tile], end):
            first, stop = 0, 0
            if alive[_TILE] > 0:
                prefetch(flat, np.int64(entries[min(position + _AHEAD, end - 1)]) * _COLUMNS)
                first, stop = _blend(block, alive, values[entries[position]], x, y, high, alpha_max)
            begin, vectors = first * _STRIPS, (stop - first) * _STRIPS
            total = dot_pixels(weights, _PIXELS + begin * LANES, vectors, pixels, begin)
            slot_gradients[slots[position], 0] = total[0]
            slot_gradients[slots[position], 1] = total[1]
            slot_gradients[slots[position], 2] = total[2]


@compiled(parallel=True)
def add_slots(slot_gradients, first_slots, gaussians, gradient):
    """Sum each Gaussian's slots, in order and in float64, into its row of `gradient` [N, 3]."""
    for rank in numba.prange(gaussians.size):
        red, green, blue = 0.0, 0.0, 0.0
        for slot in range(first_slots[rank], first_slots[rank + 1]):
            red += slot_gradients[slot, 0]
            green += slot_gradients[slot, 1]
            blue += slot_gradients[slot, 2]
        gaussian = gaussians[rank]
        gradient[gaussian, 0], gradient[gaussian, 1], gradient[gaussian, 2] = red, green, blue


@compiled(parallel=True)
def survey(entries, slots, starts, values, alpha_max, slot_weights, transmittance):
    """Compute the final transmittance [h, w] of a whole view, and the sum of weights of each (Gaussian, tile) pair [E].

    Bit-identical to `render`, and to `color_gradient` for an image gradient of ones, but in one pass.
    """
    height, width = transmittance.shape
    flat = values.reshape(values.size)
    tiles = starts.size - 1
    for step in numba.prange(_blocks(tiles) * _BLOCK_TILES):
        tile = _scattered(step, tiles)
        if tile >= tiles:
            continue
        x, y, high, columns, block, alive = _tile_at(tile, height, width)
        weights = block.reshape(2 * _PIXELS)
        position, end = starts[tile], starts[tile + 1]
        while position < end and alive[_TILE] > 0:
            prefetch(flat, np.int64(entries[min(position + _AHEAD, end - 1)]) * _COLUMNS)
            first, stop = _blend(block, alive, values[entries[position]], x, y, high, alpha_max)
            begin, vectors = first * _STRIPS, (stop - first) * _STRIPS
            slot_weights[slots[position]] = sum_weights(weights, _PIXELS + begin * LANES, vectors)
            position += 1
        for rest in range(position, end):
            slot_weights[slots[rest]] = _ZERO
        _store_transmittance(block, y, x, high, columns, transmittance)


@compiled(parallel=True)
def add_slot_weights(slot_weights, first_slots, gaussians, weights):
    """Sum each Gaussian's slots [E], in order and in float64, into `weights` [N], as `add_slots` does."""
    for rank in numba.prange(gaussians.size):
        total = 0.0
        for slot in range(first_slots[rank], first_slots[rank + 1]):
            total += slot_weights[slot]
        weights[gaussians[rank]] = total
