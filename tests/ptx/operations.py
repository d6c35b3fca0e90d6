"""Arithmetic of PTX instructions on arrays with one element per thread.

Approximate instructions (`ex2.approx`, `rcp.approx`, ...) are computed exactly, and a fused multiply-add of float64
is rounded twice. A float32 one is computed in float64.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from functools import reduce
from typing import Any

import numpy as np

UNSIGNED = {8: np.uint8, 16: np.uint16, 32: np.uint32, 64: np.uint64}
_FLOATS = {16: np.float16, 32: np.float32, 64: np.float64}
_SIGNED = {8: np.int8, 16: np.int16, 32: np.int32, 64: np.int64}
_KINDS: dict[str, Any] = {"b": UNSIGNED, "u": UNSIGNED, "s": _SIGNED, "f": _FLOATS}
_ROUNDINGS = {"rni": np.rint, "rzi": np.trunc, "rmi": np.floor, "rpi": np.ceil}
_COMPARISONS = {
    **{"eq": np.equal, "ne": np.not_equal, "lt": np.less, "le": np.less_equal, "gt": np.greater},
    **{"ge": np.greater_equal, "lo": np.less, "ls": np.less_equal, "hi": np.greater, "hs": np.greater_equal},
}
Operation = Callable[..., np.ndarray]


class UnsupportedError(Exception):
    """Instruction that the interpreter does not know."""


def dtype_of(type_: str) -> type:
    """Return the NumPy dtype of a PTX type such as "s32"; bfloat16 as its bits."""
    if type_ == "pred":
        return np.bool_
    if type_ == "bf16":
        return np.uint16
    match = re.fullmatch(r"([busf])(\d+)", type_)
    if match is None:
        raise UnsupportedError(f"type {type_}")
    return _KINDS[match[1]][int(match[2])]


def from_bfloat16(bits: np.ndarray) -> np.ndarray:
    """Convert the bits of bfloat16 values to float32."""
    return (bits.astype(np.uint32) << np.uint32(16)).view(np.float32)


def to_bfloat16(values: np.ndarray) -> np.ndarray:
    """Round float32 values to bfloat16, to nearest even, and return their bits."""
    bits = values.astype(np.float32).view(np.uint32).astype(np.uint64)
    rounded = ((bits + ((bits >> np.uint64(16)) & np.uint64(1)) + np.uint64(0x7FFF)) >> np.uint64(16)).astype(np.uint16)
    return np.where(np.isnan(values), np.uint16(0x7FFF), rounded)


def flush(values: np.ndarray) -> np.ndarray:
    """Replace subnormal numbers by 0, as opcodes with `.ftz` do."""
    return np.where(np.abs(values) < np.finfo(values.dtype).tiny, values.dtype.type(0), values)


def select(a: np.ndarray, b: np.ndarray, condition: np.ndarray) -> np.ndarray:
    """Compute `selp`: `a` where the condition holds, otherwise `b`."""
    return np.where(condition, a, b)


def conversion(opcode: tuple[str, ...]) -> Operation:
    """Return the function of a `cvt` instruction with one source."""
    to, source, rounding = opcode[-2], opcode[-1], next((_ROUNDINGS[x] for x in opcode if x in _ROUNDINGS), None)

    def convert(value: np.ndarray) -> np.ndarray:
        if source == "bf16":
            value = from_bfloat16(value)
        if rounding is not None:
            value = rounding(value)
        if to == "bf16":
            return to_bfloat16(value)
        if value.dtype.kind == "f" and to[0] in "us":
            limits = np.iinfo(dtype_of(to))
            value = np.clip(np.nan_to_num(value.astype(np.float64), nan=0.0), limits.min, limits.max)
        return value.astype(dtype_of(to))

    return convert


def comparison(opcode: tuple[str, ...]) -> Operation:
    """Return the function of a `setp` instruction; comparisons ending in "u" are true for NaN."""
    if opcode[1] in ("num", "nan"):
        return lambda a, b: (np.isnan(a) | np.isnan(b)) ^ (opcode[1] == "num")
    name, is_float = opcode[1], opcode[-1][0] == "f"
    unordered = is_float and name.endswith("u")
    compare = _COMPARISONS.get(name[:-1] if unordered else name)
    if compare is None:
        raise UnsupportedError(f"comparison {name}")
    if not is_float:
        return compare

    def compare_floats(a: np.ndarray, b: np.ndarray) -> np.ndarray:
        nan = np.isnan(a) | np.isnan(b)
        return compare(a, b) | nan if unordered else compare(a, b) & ~nan

    return compare_floats


def arithmetic(opcode: tuple[str, ...]) -> Operation:
    """Return the function of an arithmetic, logical or bit instruction; it takes operands of the opcode's type."""
    name, type_ = opcode[0], opcode[-1]
    if type_.endswith("x2"):  # two values side by side in 32 bits
        each, half = arithmetic((*opcode[:-1], type_[:-2])), dtype_of(type_[:-2])
        return lambda *v: each(*(np.ascontiguousarray(one).view(half) for one in v)).view(np.uint32)
    dtype = dtype_of(type_)
    if "wide" in opcode:
        wides: dict[Any, Any] = {np.int32: np.int64, np.uint32: np.uint64, np.int16: np.int32, np.uint16: np.uint32}
        wide = wides[dtype]
        return lambda a, b, *c: reduce(np.add, c, a.astype(wide) * b.astype(wide))
    if "hi" in opcode:
        return lambda a, b, *c: reduce(np.add, c, _high(a, b))
    operation = (_FLOAT if type_[0] == "f" else _INTEGER).get(name)
    if operation is None:
        raise UnsupportedError(".".join(opcode))
    if "ftz" in opcode:
        return lambda *v: flush(operation(*map(flush, v)).astype(dtype))
    return lambda *v: operation(*v).astype(dtype, copy=False)


def _high(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    if a.dtype.itemsize != 4:
        raise UnsupportedError("mul.hi of other than 32 bits")
    wide = np.int64 if a.dtype == np.int32 else np.uint64
    return ((a.astype(wide) * b.astype(wide)) >> wide(32)).astype(a.dtype)


def _fused(a: np.ndarray, b: np.ndarray, c: np.ndarray) -> np.ndarray:
    return a.astype(np.float64) * b + c


def _quotient(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Divide integers, rounding toward 0; the quotient by 0 is undefined on a GPU, and 0 here."""
    divisor = np.where(b == 0, b.dtype.type(1), b)
    return np.where(b == 0, b.dtype.type(0), (a - np.fmod(a, divisor)) // divisor)


def _shift_left(value: np.ndarray, count: np.ndarray) -> np.ndarray:
    bits = 8 * value.dtype.itemsize
    return np.where(count < bits, value << (count % bits).astype(value.dtype), value.dtype.type(0))


def _shift_right(value: np.ndarray, count: np.ndarray) -> np.ndarray:
    """Shift right; a count of the width or more leaves only copies of the sign."""
    bits = 8 * value.dtype.itemsize
    last = value >> value.dtype.type(bits - 1) if value.dtype.kind == "i" else np.zeros_like(value)
    return np.where(count < bits, value >> (count % bits).astype(value.dtype), last)


def _bit_field(value: np.ndarray, start: np.ndarray, length: np.ndarray) -> np.ndarray:
    """Extract bits of 32-bit integers; of signed ones, the field's first bit is its sign."""
    wide = value.view(np.uint32).astype(np.uint64)
    one, start, length = np.uint64(1), start.astype(np.uint64), length.astype(np.uint64)
    field = (wide >> start) & ((one << length) - one)
    if value.dtype.kind == "i":
        negative = (length > 0) & ((field >> (np.maximum(length, one) - one)) & one == one)
        field = np.where(negative, field | ~((one << length) - one), field)
    return (field & np.uint64(0xFFFFFFFF)).astype(np.uint32).view(value.dtype)


_COMMON: dict[str, Operation] = {
    "add": np.add,
    "sub": np.subtract,
    "mul": np.multiply,
    "neg": np.negative,
    "abs": np.abs,
}
_FLOAT: dict[str, Operation] = {
    **_COMMON,
    "fma": _fused,
    "div": np.divide,
    "min": lambda *v: reduce(np.fmin, v),
    "max": lambda *v: reduce(np.fmax, v),
    "sqrt": np.sqrt,
    "rsqrt": lambda a: 1 / np.sqrt(a),
    "rcp": lambda a: 1 / a,
    "ex2": np.exp2,
    "lg2": np.log2,
}
_INTEGER: dict[str, Operation] = {
    **_COMMON,
    "mad": lambda a, b, c: a * b + c,
    "div": _quotient,
    "rem": np.fmod,
    "min": lambda *v: reduce(np.minimum, v),
    "max": lambda *v: reduce(np.maximum, v),
    "and": np.bitwise_and,
    "or": np.bitwise_or,
    "xor": np.bitwise_xor,
    "not": np.invert,
    "shl": _shift_left,
    "shr": _shift_right,
    "bfe": _bit_field,
}
