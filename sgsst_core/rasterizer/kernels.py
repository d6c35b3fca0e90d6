"""Numba kernels of the CPU rasterizers.

All kernels traverse the Gaussians of one raster tile front to back, and compute the blend weights of one Gaussian in a
16 x 16 block that stays in the L1 cache (`_blend`). They differ only in how they use this block: they add its product
with a color to the image, or multiply it by dL/dimage. All kernels therefore use bit-identical weights.

Accuracy: the offset between a pixel and a Gaussian is computed in float64 once per row, and rounded to float32 after
large terms have canceled. Within the row, offsets of up to 15 pixels are added in float32. This preserves accuracy for
distant centers and needle-shaped Gaussians.

Determinism: each tile is processed by one thread. The gradient of each (Gaussian, tile) pair is written to a separate
slot. The slots of a Gaussian are contiguous, and are then added in order.

SIMD: LLVM would optimize plain loops for long arrays: four vectors at a time, with a scalar remainder. The weights of a
Gaussian in a raster tile are only some twenty vectors, so remainders would take much of the time. The explicit vector
types used instead are lowered by LLVM to the processor's registers (one of 256 bits, two of 128 bits, ...). Array
bounds are not checked.
"""

# Arguments are untyped: Numba compiles one version per argument type.
# mypy: disable-error-code="no-untyped-def"

from collections.abc import Iterable
from typing import Any

import numba
import numpy as np
from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

from sgsst_core.compiled import compiled
from sgsst_core.constants import LOG2_ALPHA_MIN, RASTER_TILE, TRANSMITTANCE_MIN

LANES = 8
_FLOAT = ir.FloatType()
_VECTOR = ir.VectorType(_FLOAT, LANES)
_CHANNELS = 3
_ROW = ir.VectorType(_FLOAT, RASTER_TILE)
_ROW_BITS = ir.VectorType(ir.IntType(32), RASTER_TILE)
#: 2^f on [-0.5, 0.5] by interpolation at Chebyshev points; its relative error of 3e-9 is below float32 precision.
_EXP2_SERIES = (
    np.polynomial.Chebyshev.interpolate(np.exp2, 6, domain=[-0.5, 0.5]).convert(kind=np.polynomial.Polynomial).coef
)
#: Adding 1.5 * 2^23 to a small float32 rounds it to an integer, which is then in the low bits of the sum.
_ROUNDER = 12582912.0
#: Only permitted relaxation of floating-point rules: a product and a sum may be fused, with a single rounding.
_FUSED = ("contract",)


def _splat(builder: Any, value: Any, vector: Any = _VECTOR) -> Any:
    """Broadcast a scalar to all lanes."""
    one = builder.insert_element(ir.Constant(vector, ir.Undefined), value, ir.Constant(ir.IntType(32), 0))
    lanes = ir.Constant(ir.VectorType(ir.IntType(32), vector.count), [0] * vector.count)
    return builder.shuffle_vector(one, ir.Constant(vector, ir.Undefined), lanes)


def _number(value: int) -> Any:
    return ir.Constant(ir.IntType(64), value)


def _lane_sum(builder: Any, lanes: Any) -> Any:
    """Sum the lanes: add the upper half to the lower half until one lane is left."""
    half = LANES // 2
    while half:
        order = [(lane + half) % LANES for lane in range(LANES)]
        swap = ir.Constant(ir.VectorType(ir.IntType(32), LANES), order)
        lanes = builder.fadd(lanes, builder.shuffle_vector(lanes, lanes, swap))
        half //= 2
    return builder.extract_element(lanes, ir.Constant(ir.IntType(32), 0))


def _data(context: Any, builder: Any, array_type: types.Array, array: Any, offset: Any) -> Any:
    """Return a pointer to an element of a contiguous array."""
    return builder.gep(context.make_array(array_type)(context, builder, array).data, [offset])


def _load(builder: Any, pointer: Any, vector_type: Any = _VECTOR, align: int = 4) -> Any:
    return builder.load(builder.bitcast(pointer, vector_type.as_pointer()), align=align)


@intrinsic
def blend_row(typingctx, block, row, u, u_scale, log2_alpha, alpha_max):
    """Blend one Gaussian into a row of 16 pixels. block [2, 16, 16] holds transmittances and receives weights.

    Pixel i: alpha = min(2^(log2_alpha - (u + i u_scale)^2), alpha_max), or 0 below ALPHA_MIN; weight = alpha T; T
    becomes T (1 - alpha). If T would fall to TRANSMITTANCE_MIN, the Gaussian is not blended and the pixel is finished:
    its T is stored negated, so a single comparison rejects both this Gaussian and all later ones.

    Returns 1 if some pixel of the row is unfinished, else 0.
    """
    scalars = (types.float32,) * 4
    signature = types.int64(block, types.int64, *scalars)

    def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        block_, row_, *numbers = args
        start, scale, log2_alpha_, alpha_max_ = (_splat(builder, n, _ROW) for n in numbers)
        transmittances = _data(context, builder, sig.args[0], block_, builder.mul(row_, _number(RASTER_TILE)))
        output = builder.gep(transmittances, [_number(RASTER_TILE**2)])

        offset = builder.fadd(start, builder.fmul(scale, _row(range(RASTER_TILE)), flags=_FUSED), flags=_FUSED)
        power = builder.fsub(log2_alpha_, builder.fmul(offset, offset, flags=_FUSED), flags=_FUSED)
        alpha = _exp2(builder, power)
        alpha = builder.select(builder.fcmp_ordered("<", alpha, alpha_max_), alpha, alpha_max_)
        seen = builder.fcmp_ordered(">=", power, _row([LOG2_ALPHA_MIN]))
        alpha = builder.select(seen, alpha, _row([0.0]))  # also discards invalid results of `_exp2` for low powers

        before = _load(builder, transmittances, _ROW)
        after = builder.fmul(before, builder.fsub(_row([1.0]), alpha))
        passes = builder.fcmp_ordered(">", after, _row([TRANSMITTANCE_MIN]))
        sign = ir.Constant(_ROW_BITS, [-(2**31)] * RASTER_TILE)
        finished = builder.bitcast(builder.or_(builder.bitcast(before, _ROW_BITS), sign), _ROW)
        weights = builder.select(passes, builder.fmul(alpha, before), _row([0.0]))
        builder.store(weights, builder.bitcast(output, _ROW.as_pointer()), align=4)
        left = builder.select(passes, after, finished)
        builder.store(left, builder.bitcast(transmittances, _ROW.as_pointer()), align=4)
        some = builder.bitcast(passes, ir.IntType(RASTER_TILE))
        return builder.zext(builder.icmp_unsigned("!=", some, some.type(0)), ir.IntType(64))

    return signature, generate


def _row(values: Iterable[float]) -> Any:
    """Return a constant row of 16 floats; a single value fills it."""
    numbers = [float(np.float32(v)) for v in values]
    return ir.Constant(_ROW, numbers * (RASTER_TILE // len(numbers)))


def _exp2(builder: Any, power: Any) -> Any:
    """Return 2^power of a row, for powers in float32's normal range.

    The integer part becomes the exponent; the rest goes through a polynomial.
    """
    rounded = builder.fadd(power, _row([_ROUNDER]))
    rest = builder.fsub(power, builder.fsub(rounded, _row([_ROUNDER])))
    series = _row([_EXP2_SERIES[-1]])
    for coefficient in _EXP2_SERIES[-2::-1]:
        series = builder.fadd(builder.fmul(series, rest, flags=_FUSED), _row([coefficient]), flags=_FUSED)
    biased = builder.add(builder.bitcast(rounded, _ROW_BITS), ir.Constant(_ROW_BITS, [127] * RASTER_TILE))
    exponent = builder.shl(biased, ir.Constant(_ROW_BITS, [23] * RASTER_TILE))
    return builder.fmul(series, builder.bitcast(exponent, _ROW))


@intrinsic
def add_scaled(typingctx, weights, begin, vectors, pixels, offset, red, green, blue):
    """Compute pixels[offset + v, c, i] += weights[begin + 8 v + i] * color[c] for v < vectors, 3 channels, 8 lanes.

    `weights` is flat, float32; `pixels` is [P, 3, 8] float32. Bounds are not checked.
    """
    scalars = (types.float32,) * _CHANNELS
    signature = types.void(weights, types.int64, types.int64, pixels, types.int64, *scalars)

    def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        weights_, begin_, vectors_, pixels_, offset_, *color = args
        source = _data(context, builder, sig.args[0], weights_, begin_)
        target = _data(context, builder, sig.args[3], pixels_, builder.mul(offset_, _number(_CHANNELS * LANES)))
        colors = [_splat(builder, c) for c in color]
        with cgutils.for_range(builder, vectors_) as loop:
            position = builder.mul(loop.index, _number(LANES))
            w = _load(builder, builder.gep(source, [position]))
            position = builder.mul(position, _number(_CHANNELS))
            for channel, c in enumerate(colors):
                pointer = builder.gep(target, [builder.add(position, _number(channel * LANES))])
                total = builder.fadd(_load(builder, pointer), builder.fmul(w, c, flags=_FUSED), flags=_FUSED)
                builder.store(total, builder.bitcast(pointer, _VECTOR.as_pointer()), align=4)
        return context.get_dummy_value()

    return signature, generate


@intrinsic
def dot_pixels(typingctx, weights, begin, vectors, pixels, offset):
    """Return the three sums over v < vectors and lanes i of weights[begin + 8 v + i] * pixels[offset + v, c, i].

    Each lane is summed in order, then the lanes are added pairwise, so the result is deterministic. Arrays are as in
    `add_scaled`.
    """
    signature = types.UniTuple(types.float32, _CHANNELS)(weights, types.int64, types.int64, pixels, types.int64)

    def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        weights_, begin_, vectors_, pixels_, offset_ = args
        source = _data(context, builder, sig.args[0], weights_, begin_)
        other = _data(context, builder, sig.args[3], pixels_, builder.mul(offset_, _number(_CHANNELS * LANES)))
        zero = ir.Constant(_VECTOR, [0.0] * LANES)
        sums = [cgutils.alloca_once(builder, _VECTOR) for _ in range(_CHANNELS)]
        for total in sums:
            builder.store(zero, total)
        with cgutils.for_range(builder, vectors_) as loop:
            position = builder.mul(loop.index, _number(LANES))
            w = _load(builder, builder.gep(source, [position]))
            position = builder.mul(position, _number(_CHANNELS))
            for channel, total in enumerate(sums):
                pointer = builder.gep(other, [builder.add(position, _number(channel * LANES))])
                product = builder.fmul(w, _load(builder, pointer), flags=_FUSED)
                builder.store(builder.fadd(builder.load(total), product, flags=_FUSED), total)
        return context.make_tuple(builder, sig.return_type, [_lane_sum(builder, builder.load(s)) for s in sums])

    return signature, generate


@intrinsic
def sum_weights(typingctx, weights, begin, vectors):
    """Return the sum over v < vectors and lanes i of weights[begin + 8 v + i].

    Bit-identical to `dot_pixels` with pixels of 1. `weights` is flat, float32. Bounds are not checked.
    """
    signature = types.float32(weights, types.int64, types.int64)

    def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        weights_, begin_, vectors_ = args
        source = _data(context, builder, sig.args[0], weights_, begin_)
        total = cgutils.alloca_once(builder, _VECTOR)
        builder.store(ir.Constant(_VECTOR, [0.0] * LANES), total)
        with cgutils.for_range(builder, vectors_) as loop:
            w = _load(builder, builder.gep(source, [builder.mul(loop.index, _number(LANES))]))
            builder.store(builder.fadd(builder.load(total), w), total)
        return _lane_sum(builder, builder.load(total))

    return signature, generate


@intrinsic
def prefetch(typingctx, values, index):
    """Prefetch the cache line of an element of the flat array `values`. This is only a hint and cannot fail."""
    signature = types.void(values, types.int64)

    def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        pointer = _data(context, builder, sig.args[0], args[0], args[1])
        byte = ir.IntType(8).as_pointer()
        hint = [byte, *[ir.IntType(32)] * 3]
        function = cgutils.get_or_insert_function(
            builder.module, ir.FunctionType(ir.VoidType(), hint), "llvm.prefetch.p0"
        )
        flags = [ir.Constant(ir.IntType(32), flag) for flag in (0, 3, 1)]  # read, high locality, data cache
        builder.call(function, [builder.bitcast(pointer, byte), *flags])
        return context.get_dummy_value()

    return signature, generate


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
