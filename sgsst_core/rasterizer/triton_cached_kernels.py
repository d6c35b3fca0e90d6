"""GPU kernels for cached blend weights: count, store, apply, transpose.

A raster tile is divided into 16 blocks of 4 x 4 pixels. A piece is one Gaussian in one block: 16 weights in row-major
order, and two indices. The pieces of a block are contiguous, front to back, so a program reads only the pieces that it
needs, as one stream, and accumulates in registers. Blocks of 4 x 4 have the least overhead of padding and indices: on
trained scenes, larger blocks take up to a third more memory, and smaller blocks do not take less.

Weights are those of `triton_kernels.blend_weights`. They are computed twice, by two kernels whose rounding may differ
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

from sgsst_core.rasterizer.triton_kernels import blend_weights

#: Blocks per raster tile, weights per piece, and pieces that a program reads per step.
BLOCKS, PIECE, PIECES = tl.constexpr(16), tl.constexpr(16), tl.constexpr(16)
#: Factor of weights stored in float16. Products with the largest weight (0.99) are in the range of float16, and those
#: with the smallest weight are normal numbers.
HALF_SCALE = 2.0**14
_TILE: tl.constexpr = tl.constexpr(16)
_PIXELS: tl.constexpr = tl.constexpr(256)
_SIDE: tl.constexpr = tl.constexpr(4)


@triton.jit
def _tile_pixels(tile, width, first_row, last_row, across):
    """Return the corner of a raster tile, which of its 256 pixels are in the band, and their indices in it."""
    x0, y0 = tile % across * _TILE, tile // across * _TILE
    pixel = tl.arange(0, _PIXELS)
    x, y = x0 + pixel % _TILE, y0 + pixel // _TILE
    inside = (x < width) & (y >= first_row) & (y < last_row)
    return x0, y0, inside, (y - first_row).to(tl.int64) * width + x


@triton.jit
def _block_pixels(block, width, first_row, last_row, across):
    """Return which of a block's 16 pixels are in the band, and their indices in it."""
    tile = first_row // _TILE * across + block // BLOCKS
    pixel = tl.arange(0, PIECE)
    x = tile % across * _TILE + block % _SIDE * _SIDE + pixel % _SIDE
    y = tile // across * _TILE + block % BLOCKS // _SIDE * _SIDE + pixel // _SIDE
    inside = (x < width) & (y >= first_row) & (y < last_row)
    return inside, (y - first_row).to(tl.int64) * width + x


@triton.jit
def _by_block(weights, K: tl.constexpr):
    """Reshape the weights [K, 256] of a tile's pixels to [K, 16, 16]: block, pixel within the block."""
    split = tl.reshape(weights, [K, _SIDE, _SIDE, _SIDE, _SIDE])  # block row, row, block column, column
    return tl.reshape(tl.permute(split, (0, 1, 3, 2, 4)), [K, BLOCKS, PIECE])


@triton.jit
def count_pieces(
    ranks, slots, starts, values, masks, slot_pieces, block_pieces, ends, width, first_row, last_row, across,
    ALPHA_MAX: tl.constexpr, ALPHA_MIN: tl.constexpr, STOP: tl.constexpr, K: tl.constexpr,
):  # fmt: skip
    """Find the blocks in which each (Gaussian, raster tile) pair has weights; one program per raster tile of the band.

    Args:
        masks: Output [E] int32, one bit per block; zeros on entry.
        slot_pieces: Output [E] int32, pieces by the pair's slot; zeros on entry.
        block_pieces: Output [16 tiles] int32, pieces of every block in the band's tiles.
        ends: Output [tiles] int64, entry of each of the band's tiles after which all pixels are finished.
    """
    tile = first_row // _TILE * across + tl.program_id(0)
    x0, y0, inside, _ = _tile_pixels(tile, width, first_row, last_row, across)
    block = tl.arange(0, BLOCKS)
    left = tl.where(inside, 1.0, 0.0)
    pieces = tl.zeros([BLOCKS], tl.int32)
    k, end = tl.load(starts + tile), tl.load(starts + tile + 1)
    going = tl.max(left, 0)
    while (k < end) & (going > 0):
        weights, left = blend_weights(ranks, values, k, end, x0, y0, left, ALPHA_MAX, ALPHA_MIN, STOP, K)
        present = (tl.max(_by_block(weights, K), 2) > 0).to(tl.int32)  # [K, 16]
        j = k + tl.arange(0, K)
        there = j < end
        tl.store(masks + j, tl.sum(present << block[None, :], 1), mask=there)
        tl.store(slot_pieces + tl.load(slots + j, mask=there, other=0), tl.sum(present, 1), mask=there)
        pieces += tl.sum(present, 0)
        going = tl.max(left, 0)
        k += K
    tl.store(block_pieces + tl.program_id(0) * BLOCKS + block, pieces)
    tl.store(ends + tl.program_id(0), tl.minimum(k, end))


@triton.jit
def store_pieces(
    ranks, slots, starts, values, gaussians, masks, ends, slot_starts, block_starts, piece_gaussians, piece_slots,
    weights, transmittances, width, first_row, last_row, across,
    ALPHA_MAX: tl.constexpr, ALPHA_MIN: tl.constexpr, STOP: tl.constexpr, K: tl.constexpr, SCALE: tl.constexpr,
):  # fmt: skip
    """Store the pieces counted by `count_pieces`, and the final transmittance [h, width] of the band.

    Args:
        slot_starts: [E + 1], first piece slot of each pair; the piece slots of one Gaussian are contiguous.
        block_starts: [16 tiles + 1], first piece of each block of the band.
        piece_gaussians: Output [P] int32, indices into the scene.
        piece_slots: Output [P], slot of each piece's gradient.
        weights: Output [16 P] float32, or float16 multiplied by SCALE.
    """
    tile = first_row // _TILE * across + tl.program_id(0)
    x0, y0, inside, pixel = _tile_pixels(tile, width, first_row, last_row, across)
    block = tl.arange(0, BLOCKS)
    left = tl.where(inside, 1.0, 0.0)
    piece = tl.load(block_starts + tl.program_id(0) * BLOCKS + block).to(tl.int64)
    k, end = tl.load(starts + tile), tl.load(ends + tl.program_id(0))
    while k < end:
        blended, left = blend_weights(ranks, values, k, end, x0, y0, left, ALPHA_MAX, ALPHA_MIN, STOP, K)
        j = k + tl.arange(0, K)
        there = j < end
        present = (tl.load(masks + j, mask=there, other=0)[:, None] >> block[None, :]) & 1  # [K, 16]
        has_piece = present > 0
        target = piece[None, :] + tl.cumsum(present, 0) - present
        gaussian = tl.load(gaussians + tl.load(ranks + j, mask=there, other=0), mask=there, other=0)
        first_slot = tl.load(slot_starts + tl.load(slots + j, mask=there, other=0), mask=there, other=0)
        slot = first_slot[:, None] + tl.cumsum(present, 1) - present
        tl.store(piece_gaussians + target, tl.broadcast_to(gaussian[:, None], [K, BLOCKS]).to(tl.int32), mask=has_piece)
        tl.store(piece_slots + target, slot.to(piece_slots.dtype.element_ty), mask=has_piece)
        cells = weights + PIECE * target[:, :, None] + tl.arange(0, PIECE)[None, None, :]
        scaled = (_by_block(blended, K) * SCALE).to(weights.dtype.element_ty)
        tl.store(cells, scaled, mask=tl.broadcast_to(has_piece[:, :, None], [K, BLOCKS, PIECE]))
        piece += tl.sum(present, 0)
        k += K
    tl.store(transmittances + pixel, tl.abs(left), mask=inside)


@triton.jit
def _load_pieces(weights, k, end, P: tl.constexpr):
    """Return the weights [P, 16] of the next P pieces of a block, their indices [P], and which of them exist [P]."""
    j = k.to(tl.int64) + tl.arange(0, P)
    there = j < end
    cells = weights + PIECE * j[:, None] + tl.arange(0, PIECE)[None, :]
    return tl.load(cells, mask=there[:, None], other=0.0).to(tl.float32), j, there


@triton.jit
def apply_pieces(
    block_starts, gaussians, weights, colors, background, transmittances, image, width, first_row, last_row, across,
    SCALE: tl.constexpr, P: tl.constexpr,
):  # fmt: skip
    """Render the image [h, width, 3] from cached weights; one program per block."""
    inside, pixel = _block_pixels(tl.program_id(0), width, first_row, last_row, across)
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
    block_starts, slots, weights, image_gradient, out, width, first_row, last_row, across,
    SCALE: tl.constexpr, P: tl.constexpr,
):  # fmt: skip
    """Write dL/dcolor of every piece to its slot [P, 3]; one program per block."""
    inside, pixel = _block_pixels(tl.program_id(0), width, first_row, last_row, across)
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
