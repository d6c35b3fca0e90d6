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


def _is_weights(array: Any) -> bool:
    return isinstance(array, types.Array) and array.layout == "C" and array.dtype == types.float32


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
    if not _is_weights(weights):
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
