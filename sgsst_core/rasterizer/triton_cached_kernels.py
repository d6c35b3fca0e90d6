"""GPU kernels for cached blend weights: count, store, apply, transpose.

A raster tile is divided into 16 blocks of 4 x 4 pixels. A piece is one Gaussian in one block: 16 weights in row-major
order, and two indices. The pieces of a block are contiguous, front to back, so a program reads only the pieces that it
needs, as one stream, and accumulates in registers. Blocks of 4 x 4 have the least overhead of padding and indices: on
trained scenes, larger blocks take up to a third more memory, and smaller blocks do not take less.

Weights are those of `triton_kernels.blend`. They are computed twice, by two kernels whose rounding may differ
after compilation. Therefore only `count_pieces` decides which blocks have a weight, and `store_pieces` uses its masks.
In float16, weights are multiplied by `HALF_SCALE`, which makes even the smallest weight (4e-7) a normal number, with a
relative error of at most 2^-11.

There are no atomics, so results are reproducible bit for bit.
"""

# Arguments are untyped: Triton compiles one version per argument type.
# mypy: disable-error-code="no-untyped-def, no-untyped-call, untyped-decorator"

from __future__ import annotations

import triton
import triton.language as tl

from sgsst_core.rasterizer.triton_kernels import PAIRS, blend, load_pairs, tile_pixels

#: Blocks per raster tile, weights per piece, and pieces that a program reads per step.
BLOCKS, PIECE, PIECES = tl.constexpr(16), tl.constexpr(16), tl.constexpr(16)
#: Factor of weights stored in float16. Products with the largest weight (0.99) are in the range of float16, and those
#: with the smallest weight are normal numbers.
HALF_SCALE = 2.0**14
_TILE: tl.constexpr = tl.constexpr(16)
_PIXELS: tl.constexpr = tl.constexpr(256)
_SIDE: tl.constexpr = tl.constexpr(4)


@triton.jit
def _block_pixels(block, width, height, across):
    """Return which of a block's 16 pixels are in the image, and their indices in it."""
    tile = block // BLOCKS
    pixel = tl.arange(0, PIECE)
    x = tile % across * _TILE + block % _SIDE * _SIDE + pixel % _SIDE
    y = tile // across * _TILE + block % BLOCKS // _SIDE * _SIDE + pixel // _SIDE
    inside = (x < width) & (y < height)
    return inside, y.to(tl.int64) * width + x


@triton.jit
def _cells():
    """Return the block of each of a tile's pixels [8, 32], and the index of the pixel within its block."""
    pixel = tl.arange(0, _PIXELS // PAIRS)[:, None] * PAIRS + tl.arange(0, PAIRS)[None, :]
    column, row = pixel % _TILE, pixel // _TILE
    return row // _SIDE * _SIDE + column // _SIDE, row % _SIDE * _SIDE + column % _SIDE


@triton.jit
def _present_blocks(weight):
    """Return a bit mask of the blocks in which a pair has weights [8, 32]."""
    rows = tl.max(tl.reshape(weight, [_SIDE, _SIDE, _SIDE, _SIDE]), 3)  # block row, row, block column
    block = tl.arange(0, _SIDE)[:, None] * _SIDE + tl.arange(0, _SIDE)[None, :]
    return tl.sum(tl.where(tl.max(rows, 1) > 0, 1 << block, 0))


@triton.jit
def count_pieces(
    ranks, slots, starts, values, masks, slot_pieces, block_pieces, ends, width, height, across,
    ALPHA_MAX: tl.constexpr, ALPHA_MIN: tl.constexpr, STOP: tl.constexpr,
):  # fmt: skip
    """Find the blocks in which each (Gaussian, raster tile) pair has weights; one program per raster tile.

    Args:
        masks: Output [E] int32, one bit per block; zeros on entry.
        slot_pieces: Output [E] int32, pieces by the pair's slot; zeros on entry.
        block_pieces: Output [16 tiles] int32, pieces of every block.
        ends: Output [tiles] int64, entry of each tile after which all pixels are finished.
    """
    tile = tl.program_id(0)
    x, y, _pixel, inside = tile_pixels(tile, across, width, height)
    left = tl.where(inside, 1.0, 0.0)
    block, pair = tl.arange(0, BLOCKS), tl.arange(0, PAIRS)
    pieces = tl.zeros([BLOCKS], tl.int32)
    k, end = tl.load(starts + tile), tl.load(starts + tile + 1)
    while (k < end) & (tl.max(left) > 0):
        there = k + pair < end
        pairs = load_pairs(ranks, values, k + pair, there, tile, across)
        bits = tl.zeros([PAIRS], tl.int32)
        for i in range(tl.minimum(end - k, PAIRS).to(tl.int32)):
            lane = tl.full([PAIRS], i, tl.int32)
            weight, left, _final = blend(pairs, lane, x, y, left, left, ALPHA_MAX, ALPHA_MIN, STOP)
            bits = tl.where(pair == lane, _present_blocks(weight), bits)
        present = (bits[:, None] >> block[None, :]) & 1  # [32, 16]
        tl.store(masks + k + pair, bits, mask=there)
        tl.store(slot_pieces + tl.load(slots + k + pair, mask=there, other=0), tl.sum(present, 1), mask=there)
        pieces += tl.sum(present, 0)
        k += PAIRS
    tl.store(block_pieces + tl.program_id(0) * BLOCKS + block, pieces)
    tl.store(ends + tl.program_id(0), tl.minimum(k, end))


@triton.jit
def store_pieces(
    ranks, slots, starts, values, gaussians, masks, ends, slot_starts, block_starts, piece_gaussians, piece_slots,
    weights, transmittances, width, height, across,
    ALPHA_MAX: tl.constexpr, ALPHA_MIN: tl.constexpr, STOP: tl.constexpr, SCALE: tl.constexpr,
):  # fmt: skip
    """Store the pieces counted by `count_pieces`, and the final transmittance [h, width].

    Args:
        slot_starts: [E + 1], first piece slot of each pair; the piece slots of one Gaussian are contiguous.
        block_starts: [16 tiles + 1], first piece of each block.
        piece_gaussians: Output [P] int32, indices into the scene.
        piece_slots: Output [P], slot of each piece's gradient.
        weights: Output [16 P] float32, or float16 multiplied by SCALE.
    """
    tile = tl.program_id(0)
    x, y, pixel, inside = tile_pixels(tile, across, width, height)
    left = tl.where(inside, 1.0, 0.0)
    final = left
    block, pair = tl.arange(0, BLOCKS), tl.arange(0, PAIRS)
    own_block, cell = _cells()
    tile_starts = block_starts + tl.program_id(0) * BLOCKS
    piece, own_piece = tl.load(tile_starts + block).to(tl.int64), tl.load(tile_starts + own_block).to(tl.int64)
    k, end = tl.load(starts + tile), tl.load(ends + tl.program_id(0))
    while k < end:
        j = k + pair
        there = j < end
        pairs = load_pairs(ranks, values, j, there, tile, across)
        bits = tl.load(masks + j, mask=there, other=0)
        for i in range(tl.minimum(end - k, PAIRS).to(tl.int32)):
            lane = tl.full([PAIRS], i, tl.int32)
            weight, left, final = blend(pairs, lane, x, y, left, final, ALPHA_MAX, ALPHA_MIN, STOP)
            has_own = (tl.gather(bits, lane, 0) >> own_block) & 1
            scaled = (weight * SCALE).to(weights.dtype.element_ty)
            tl.store(weights + PIECE * own_piece + cell, scaled, mask=has_own > 0)
            own_piece += has_own
        present = (bits[:, None] >> block[None, :]) & 1  # [32, 16]
        has_piece = present > 0
        target = piece[None, :] + tl.cumsum(present, 0) - present
        gaussian = tl.load(gaussians + tl.load(ranks + j, mask=there, other=0), mask=there, other=0)
        first_slot = tl.load(slot_starts + tl.load(slots + j, mask=there, other=0), mask=there, other=0)
        slot = first_slot[:, None] + tl.cumsum(present, 1) - present
        owners = tl.broadcast_to(gaussian[:, None], [PAIRS, BLOCKS]).to(tl.int32)
        tl.store(piece_gaussians + target, owners, mask=has_piece)
        tl.store(piece_slots + target, slot.to(piece_slots.dtype.element_ty), mask=has_piece)
        piece += tl.sum(present, 0)
        k += PAIRS
    tl.store(transmittances + pixel, final, mask=inside)


@triton.jit
def _load_pieces(weights, k, end, P: tl.constexpr):
    """Return the weights [P, 16] of the next P pieces of a block, their indices [P], and which of them exist [P]."""
    j = k.to(tl.int64) + tl.arange(0, P)
    there = j < end
    cells = weights + PIECE * j[:, None] + tl.arange(0, PIECE)[None, :]
    return tl.load(cells, mask=there[:, None], other=0.0).to(tl.float32), j, there


@triton.jit
def apply_pieces(
    block_starts, gaussians, weights, colors, background, transmittances, image, width, height, across,
    SCALE: tl.constexpr, P: tl.constexpr,
):  # fmt: skip
    """Render the image [h, width, 3] from cached weights; one program per block."""
    inside, pixel = _block_pixels(tl.program_id(0), width, height, across)
    k, end = tl.load(block_starts + tl.program_id(0)), tl.load(block_starts + tl.program_id(0) + 1)
    red, green, blue = (
        tl.zeros([P, PIECE], tl.float32),
        tl.zeros([P, PIECE], tl.float32),
        tl.zeros([P, PIECE], tl.float32),
    )
    while k < end:
        piece_weights, j, there = _load_pieces(weights, k, end, P)
        color = colors + 3 * tl.load(gaussians + j, mask=there, other=0).to(tl.int64)
        red += piece_weights * tl.load(color, mask=there, other=0.0)[:, None]
        green += piece_weights * tl.load(color + 1, mask=there, other=0.0)[:, None]
        blue += piece_weights * tl.load(color + 2, mask=there, other=0.0)[:, None]
        k += P
    left = tl.load(transmittances + pixel, mask=inside, other=0.0)
    tl.store(image + 3 * pixel, tl.sum(red, 0) * (1.0 / SCALE) + left * tl.load(background), mask=inside)
    tl.store(image + 3 * pixel + 1, tl.sum(green, 0) * (1.0 / SCALE) + left * tl.load(background + 1), mask=inside)
    tl.store(image + 3 * pixel + 2, tl.sum(blue, 0) * (1.0 / SCALE) + left * tl.load(background + 2), mask=inside)


@triton.jit
def piece_gradients(
    block_starts, slots, weights, image_gradient, out, width, height, across,
    SCALE: tl.constexpr, P: tl.constexpr,
):  # fmt: skip
    """Write dL/dcolor of every piece to its slot [P, 3]; one program per block."""
    inside, pixel = _block_pixels(tl.program_id(0), width, height, across)
    red = tl.load(image_gradient + 3 * pixel, mask=inside, other=0.0)
    green = tl.load(image_gradient + 3 * pixel + 1, mask=inside, other=0.0)
    blue = tl.load(image_gradient + 3 * pixel + 2, mask=inside, other=0.0)
    k, end = tl.load(block_starts + tl.program_id(0)), tl.load(block_starts + tl.program_id(0) + 1)
    while k < end:
        piece_weights, j, there = _load_pieces(weights, k, end, P)
        slot = out + 3 * tl.load(slots + j, mask=there, other=0).to(tl.int64)
        tl.store(slot, tl.sum(piece_weights * red[None, :], 1) * (1.0 / SCALE), mask=there)
        tl.store(slot + 1, tl.sum(piece_weights * green[None, :], 1) * (1.0 / SCALE), mask=there)
        tl.store(slot + 2, tl.sum(piece_weights * blue[None, :], 1) * (1.0 / SCALE), mask=there)
        k += P
