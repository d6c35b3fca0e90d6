"""SIMD inner loops over pixels for the Numba kernels.

LLVM would optimize plain loops for long arrays: four vectors at a time, with a scalar remainder. The weights of a
Gaussian in a raster tile are only some twenty vectors, so remainders would take much of the time. The explicit vector
types used instead are lowered by LLVM to the processor's registers (one of 256 bits, two of 128 bits, ...). Array
bounds are not checked.
"""

# Arguments are untyped: Numba compiles one version per argument type.
# mypy: disable-error-code="no-untyped-def"

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np
from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

from sgsst_core.constants import LOG2_ALPHA_MIN, RASTER_TILE, TRANSMITTANCE_MIN

LANES = 8
#: Rows of a block of cached weights: 4 rows and 3 channels are 12 vectors of sums, which fit in registers.
BLOCK_ROWS = 4
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

#: Half precision stores weight * 2^HALF_EXPONENT. The smallest weight, ALPHA_MIN * TRANSMITTANCE_MIN, and the largest,
#: ALPHA_MAX, are then both normal numbers in float16 (relative error 2^-11), so no conversion meets a denormal.
HALF_EXPONENT = 14
#: float16 has 13 fewer bits of mantissa than float32, and an exponent bias that is 112 smaller.
HALF_SHIFT, HALF_BIAS = 13, 112


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


def _load_weights(builder: Any, array_type: types.Array, pointer: Any) -> Any:
    """Load 8 weights as float32; bits of half-precision weights are shifted, and the exponent is scaled back."""
    if array_type.dtype == types.float32:
        return _load(builder, pointer)
    wide = ir.VectorType(ir.IntType(32), LANES)
    bits = builder.zext(_load(builder, pointer, ir.VectorType(ir.IntType(16), LANES), align=2), wide)
    shifted = builder.shl(bits, ir.Constant(wide, [HALF_SHIFT] * LANES))
    scale = ir.Constant(_VECTOR, [2.0 ** (HALF_BIAS - HALF_EXPONENT)] * LANES)
    return builder.fmul(builder.bitcast(shifted, _VECTOR), scale)


def _is_weights(array: Any) -> bool:
    return isinstance(array, types.Array) and array.layout == "C" and array.dtype in (types.float32, types.uint16)


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
def store_vector(typingctx, source, begin, weights, target):
    """Store weights[target + i] = source[begin + i] for 8 floats, rounded to nearest even in half precision."""
    if not _is_weights(weights):
        return None
    signature = types.void(source, types.int64, weights, types.int64)

    def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        source_, begin_, weights_, target_ = args
        values = _load(builder, _data(context, builder, sig.args[0], source_, begin_))
        pointer = _data(context, builder, sig.args[2], weights_, target_)
        align = 4
        if sig.args[2].dtype == types.uint16:
            wide = ir.VectorType(ir.IntType(32), LANES)

            def constant(number: int) -> Any:
                return ir.Constant(wide, [number] * LANES)

            scale = ir.Constant(_VECTOR, [2.0 ** (HALF_EXPONENT - HALF_BIAS)] * LANES)
            bits = builder.bitcast(builder.fmul(values, scale), wide)
            odd = builder.and_(builder.lshr(bits, constant(HALF_SHIFT)), constant(1))
            bits = builder.add(bits, builder.add(odd, constant((1 << (HALF_SHIFT - 1)) - 1)))
            values = builder.trunc(builder.lshr(bits, constant(HALF_SHIFT)), ir.VectorType(ir.IntType(16), LANES))
            align = 2
        builder.store(values, builder.bitcast(pointer, values.type.as_pointer()), align=align)
        return context.get_dummy_value()

    return signature, generate


@intrinsic
def add_scaled(typingctx, weights, begin, vectors, pixels, offset, red, green, blue):
    """Compute pixels[offset + v, c, i] += weights[begin + 8 v + i] * color[c] for v < vectors, 3 channels, 8 lanes.

    `weights` is flat, float32 or half-precision bits (uint16); `pixels` is [P, 3, 8] float32. Bounds are not checked.
    """
    if not _is_weights(weights):
        return None
    scalars = (types.float32,) * _CHANNELS
    signature = types.void(weights, types.int64, types.int64, pixels, types.int64, *scalars)

    def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        weights_, begin_, vectors_, pixels_, offset_, *color = args
        source = _data(context, builder, sig.args[0], weights_, begin_)
        target = _data(context, builder, sig.args[3], pixels_, builder.mul(offset_, _number(_CHANNELS * LANES)))
        colors = [_splat(builder, c) for c in color]
        with cgutils.for_range(builder, vectors_) as loop:
            position = builder.mul(loop.index, _number(LANES))
            w = _load_weights(builder, sig.args[0], builder.gep(source, [position]))
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
    if not _is_weights(weights):
        return None
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
            w = _load_weights(builder, sig.args[0], builder.gep(source, [position]))
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
    if not _is_weights(weights) or weights.dtype != types.float32:
        return None
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
    if not isinstance(values, types.Array) or values.layout != "C":
        return None
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


@intrinsic
def add_pieces(typingctx, weights, items, first, count, colors, pixels, offset):
    """Compute pixels[offset + row, c, i] += sum of weights[32 piece + 8 row + i] * colors[items[piece], c].

    Sums over pieces first..first + count in order; 4 rows, 3 channels, 8 lanes. `weights` is flat, float32 or
    half-precision bits (uint16); `items` is int32; `colors` [I, 3] and `pixels` [P, 3, 8] are float32. Bounds are not
    checked.
    """
    if not _is_weights(weights):
        return None
    signature = types.void(weights, items, types.int64, types.int64, colors, pixels, types.int64)

    def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        weights_, items_, first_, count_, colors_, pixels_, offset_ = args
        target = _data(context, builder, sig.args[5], pixels_, builder.mul(offset_, _number(_CHANNELS * LANES)))
        cells = [(row, c) for row in range(BLOCK_ROWS) for c in range(_CHANNELS)]
        pointers = {cell: builder.gep(target, [_number((cell[0] * _CHANNELS + cell[1]) * LANES)]) for cell in cells}
        sums = {cell: cgutils.alloca_once(builder, _VECTOR) for cell in cells}
        for cell in cells:
            builder.store(_load(builder, pointers[cell]), sums[cell])
        with cgutils.for_range(builder, count_) as loop:
            piece = builder.add(first_, loop.index)
            item = builder.zext(builder.load(_data(context, builder, sig.args[1], items_, piece)), ir.IntType(64))
            color = _data(context, builder, sig.args[4], colors_, builder.mul(item, _number(_CHANNELS)))
            channels = [_splat(builder, builder.load(builder.gep(color, [_number(c)]))) for c in range(_CHANNELS)]
            source = _data(context, builder, sig.args[0], weights_, builder.mul(piece, _number(BLOCK_ROWS * LANES)))
            for row in range(BLOCK_ROWS):
                w = _load_weights(builder, sig.args[0], builder.gep(source, [_number(row * LANES)]))
                for c in range(_CHANNELS):
                    product = builder.fmul(w, channels[c], flags=_FUSED)
                    builder.store(builder.fadd(builder.load(sums[row, c]), product, flags=_FUSED), sums[row, c])
        for cell in cells:
            builder.store(builder.load(sums[cell]), builder.bitcast(pointers[cell], _VECTOR.as_pointer()), align=4)
        return context.get_dummy_value()

    return signature, generate


@intrinsic
def dot_pieces(typingctx, weights, items, first, count, pixels, offset, sums):
    """Compute sums[items[piece], c, i] += weights[32 piece + 8 row + i] * pixels[offset + row, c, i] for 4 rows.

    Processes pieces first..first + count in order. `sums` is [I, 3, 8] float32; other arrays are as in `add_pieces`.
    """
    if not _is_weights(weights):
        return None
    signature = types.void(weights, items, types.int64, types.int64, pixels, types.int64, sums)

    def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        weights_, items_, first_, count_, pixels_, offset_, sums_ = args
        other = _data(context, builder, sig.args[4], pixels_, builder.mul(offset_, _number(_CHANNELS * LANES)))
        factors = [_load(builder, builder.gep(other, [_number(i * LANES)])) for i in range(BLOCK_ROWS * _CHANNELS)]
        with cgutils.for_range(builder, count_) as loop:
            piece = builder.add(first_, loop.index)
            item = builder.zext(builder.load(_data(context, builder, sig.args[1], items_, piece)), ir.IntType(64))
            target = _data(context, builder, sig.args[6], sums_, builder.mul(item, _number(_CHANNELS * LANES)))
            source = _data(context, builder, sig.args[0], weights_, builder.mul(piece, _number(BLOCK_ROWS * LANES)))
            rows = [builder.gep(source, [_number(row * LANES)]) for row in range(BLOCK_ROWS)]
            weights_of_rows = [_load_weights(builder, sig.args[0], row) for row in rows]
            for c in range(_CHANNELS):
                pointer = builder.gep(target, [_number(c * LANES)])
                total = _load(builder, pointer)
                for row in range(BLOCK_ROWS):
                    product = builder.fmul(weights_of_rows[row], factors[row * _CHANNELS + c], flags=_FUSED)
                    total = builder.fadd(total, product, flags=_FUSED)
                builder.store(total, builder.bitcast(pointer, _VECTOR.as_pointer()), align=4)
        return context.get_dummy_value()

    return signature, generate


@intrinsic
def sum_lanes(typingctx, sums, vector):
    """Return the sum of the 8 lanes of the vector with index `vector` in an array, added as in `_lane_sum`."""
    signature = types.float32(sums, types.int64)

    def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        pointer = _data(context, builder, sig.args[0], args[0], builder.mul(args[1], _number(LANES)))
        return _lane_sum(builder, _load(builder, pointer))

    return signature, generate
