"""The inner loops over weights in explicit vectors of 8 floats, for the compiled kernels.

Written as plain loops they are compiled for long arrays: four vectors at a time, and what remains one number at a time.
A Gaussian's weights in a strip are about ten vectors, so that most of the time went into remainders. LLVM lowers the
vector type to what the processor has (one 256-bit register, two of 128 bits, ...).
"""

# The types of compiled functions are those of their arguments.
# mypy: disable-error-code="no-untyped-def"

from __future__ import annotations

from typing import Any

import numpy as np
from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic
from numpy.typing import NDArray

LANES = 8
_FLOAT = ir.FloatType()
_VECTOR = ir.VectorType(_FLOAT, LANES)
_CHANNELS = 3
#: The only liberty taken with the arithmetic: a product and a sum may be rounded once.
_FUSED = ("contract",)

#: Half precision keeps weight * 2^HALF_EXPONENT: the smallest weight, ALPHA_MIN * TRANSMITTANCE_MIN, and the largest,
#: ALPHA_MAX, then both are normal numbers of float16 (relative error 2^-11), and no conversion meets a denormal.
HALF_EXPONENT = 14
#: float16 has 13 bits less of mantissa than float32, and an exponent bias that is 112 smaller.
HALF_SHIFT, HALF_BIAS = 13, 112


def _splat(builder: Any, value: Any) -> Any:
    """A scalar in every lane."""
    one = builder.insert_element(ir.Constant(_VECTOR, ir.Undefined), value, ir.Constant(ir.IntType(32), 0))
    lanes = ir.Constant(ir.VectorType(ir.IntType(32), LANES), [0] * LANES)
    return builder.shuffle_vector(one, ir.Constant(_VECTOR, ir.Undefined), lanes)


def _number(value: int) -> Any:
    return ir.Constant(ir.IntType(64), value)


def _lane_sum(builder: Any, lanes: Any) -> Any:
    """Sum of the lanes, the upper half folded onto the lower one until one is left."""
    half = LANES // 2
    while half:
        order = [(lane + half) % LANES for lane in range(LANES)]
        swap = ir.Constant(ir.VectorType(ir.IntType(32), LANES), order)
        lanes = builder.fadd(lanes, builder.shuffle_vector(lanes, lanes, swap))
        half //= 2
    return builder.extract_element(lanes, ir.Constant(ir.IntType(32), 0))


def _data(context: Any, builder: Any, array_type: types.Array, array: Any, offset: Any) -> Any:
    """Pointer to an element of a contiguous array."""
    return builder.gep(context.make_array(array_type)(context, builder, array).data, [offset])


def _load(builder: Any, pointer: Any, vector_type: Any = _VECTOR, align: int = 4) -> Any:
    return builder.load(builder.bitcast(pointer, vector_type.as_pointer()), align=align)


def _load_weights(builder: Any, array_type: types.Array, pointer: Any) -> Any:
    """8 weights: float32 as they are; half-precision bits shifted into place and their exponent scaled back."""
    if array_type.dtype == types.float32:
        return _load(builder, pointer)
    wide = ir.VectorType(ir.IntType(32), LANES)
    bits = builder.zext(_load(builder, pointer, ir.VectorType(ir.IntType(16), LANES), align=2), wide)
    shifted = builder.shl(bits, ir.Constant(wide, [HALF_SHIFT] * LANES))
    scale = ir.Constant(_VECTOR, [2.0 ** (HALF_BIAS - HALF_EXPONENT)] * LANES)
    return builder.fmul(builder.bitcast(shifted, _VECTOR), scale)


def _is_weights(array: Any) -> bool:
    return isinstance(array, types.Array) and array.layout == "C" and array.dtype in (types.float32, types.uint16)


def as_float(kept: NDArray[Any]) -> NDArray[np.float32]:
    """Weights as kept by `keep_vector` (float32, or half-precision bits in uint16) as float32, in NumPy."""
    if kept.dtype == np.float32:
        return kept
    return (kept.astype(np.uint32) << HALF_SHIFT).view(np.float32) * np.float32(2.0 ** (HALF_BIAS - HALF_EXPONENT))


@intrinsic
def keep_vector(typingctx, source, begin, weights, target):
    """weights[target + i] = source[begin + i] for 8 floats; half precision is rounded to nearest even."""
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

            def every(number: int) -> Any:
                return ir.Constant(wide, [number] * LANES)

            scale = ir.Constant(_VECTOR, [2.0 ** (HALF_EXPONENT - HALF_BIAS)] * LANES)
            bits = builder.bitcast(builder.fmul(values, scale), wide)
            odd = builder.and_(builder.lshr(bits, every(HALF_SHIFT)), every(1))
            bits = builder.add(bits, builder.add(odd, every((1 << (HALF_SHIFT - 1)) - 1)))
            values = builder.trunc(builder.lshr(bits, every(HALF_SHIFT)), ir.VectorType(ir.IntType(16), LANES))
            align = 2
        builder.store(values, builder.bitcast(pointer, values.type.as_pointer()), align=align)
        return context.get_dummy_value()

    return signature, generate


@intrinsic
def add_scaled(typingctx, weights, begin, vectors, pixels, offset, red, green, blue):
    """pixels[offset + v, c, i] += weights[begin + 8 v + i] * colour[c] for v < vectors, three channels, 8 lanes.

    `weights` is flat, float32 or half-precision bits (uint16); `pixels` [P, 3, 8] float32. Nothing is checked.
    """
    if not _is_weights(weights):
        return None
    scalars = (types.float32,) * _CHANNELS
    signature = types.void(weights, types.int64, types.int64, pixels, types.int64, *scalars)

    def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        weights_, begin_, vectors_, pixels_, offset_, *colour = args
        source = _data(context, builder, sig.args[0], weights_, begin_)
        target = _data(context, builder, sig.args[3], pixels_, builder.mul(offset_, _number(_CHANNELS * LANES)))
        colours = [_splat(builder, c) for c in colour]
        with cgutils.for_range(builder, vectors_) as loop:
            place = builder.mul(loop.index, _number(LANES))
            w = _load_weights(builder, sig.args[0], builder.gep(source, [place]))
            place = builder.mul(place, _number(_CHANNELS))
            for channel, c in enumerate(colours):
                pointer = builder.gep(target, [builder.add(place, _number(channel * LANES))])
                total = builder.fadd(_load(builder, pointer), builder.fmul(w, c, flags=_FUSED), flags=_FUSED)
                builder.store(total, builder.bitcast(pointer, _VECTOR.as_pointer()), align=4)
        return context.get_dummy_value()

    return signature, generate


@intrinsic
def dot_pixels(typingctx, weights, begin, vectors, pixels, offset):
    """The three sums over v < vectors and lanes i of weights[begin + 8 v + i] * pixels[offset + v, c, i].

    Each lane is summed in order, then the lanes pairwise: the same bits always. Arrays as in `add_scaled`.
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
            place = builder.mul(loop.index, _number(LANES))
            w = _load_weights(builder, sig.args[0], builder.gep(source, [place]))
            place = builder.mul(place, _number(_CHANNELS))
            for channel, total in enumerate(sums):
                pointer = builder.gep(other, [builder.add(place, _number(channel * LANES))])
                product = builder.fmul(w, _load(builder, pointer), flags=_FUSED)
                builder.store(builder.fadd(builder.load(total), product, flags=_FUSED), total)
        return context.make_tuple(builder, sig.return_type, [_lane_sum(builder, builder.load(s)) for s in sums])

    return signature, generate
