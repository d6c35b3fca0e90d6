"""Interpreter of PTX, which checks accesses: parser, memory, operations, and a machine that runs kernels."""

from __future__ import annotations

import ctypes
import re
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from functools import reduce
from typing import Any

import numpy as np
import torch

_GUARDED = re.compile(r"@(!?)(%\w+)\s+(.*)", re.DOTALL)
_LABEL = re.compile(r"(\$\w+):$")


@dataclass(frozen=True)
class Instruction:
    """One PTX instruction.

    Attributes:
        opcode: Parts of the opcode, as in ("ld", "global", "v4", "b32").
        operands: Operands as written; a vector in braces is one operand.
        guard: Predicate register that enables the instruction in each thread; None if it always executes.
        negated: Whether the guard enables the instruction where it is false.
    """

    opcode: tuple[str, ...]
    operands: tuple[str, ...]
    guard: str | None
    negated: bool

    def __str__(self) -> str:
        guard = f"@{'!' * self.negated}{self.guard} " if self.guard else ""
        return f"{guard}{'.'.join(self.opcode)} {', '.join(self.operands)}"


@dataclass(frozen=True)
class Program:
    """Parsed kernel.

    Attributes:
        name: Name of the kernel.
        threads: Threads per program instance (CTA).
        parameters: Names of the parameters, in order.
        instructions: Instructions in the order of the text.
        labels: Index of the instruction after each label.
    """

    name: str
    threads: int
    parameters: tuple[str, ...]
    instructions: tuple[Instruction, ...]
    labels: dict[str, int]


def parse(ptx: str) -> Program:
    """Parse the only kernel of a PTX module."""
    ptx = re.sub(r"//.*", "", ptx)
    entry = re.search(r"\.visible \.entry (\w+)\((.*?)\)\s*\.reqntid (\d+)(.*?)\{(.*)\}", ptx, re.DOTALL)
    if entry is None:
        raise ValueError("no kernel with `.reqntid` in the PTX")
    name, parameters, threads, _, body = entry.groups()
    instructions: list[Instruction] = []
    labels: dict[str, int] = {}
    statement = ""
    # A scope with a register of its own, as in `{ .reg .b32 tmp; mov.b64 {%r5, tmp}, %rd99; }`: only its statement.
    body = re.sub(r"\{\s*\.reg[^;]*;([^;]*;)\s*\}", r"\1", body)
    for line in map(str.strip, body.splitlines()):
        if not line or line.startswith("."):
            continue
        label = _LABEL.match(line)
        if label:
            labels[label[1]] = len(instructions)
            continue
        statement += " " + line
        if line.endswith(";"):
            instructions += [_instruction(part) for part in statement.split(";") if part.strip()]
            statement = ""
    if statement.strip(" {}"):
        raise ValueError(f"unterminated statement: {statement}")
    return Program(name, int(threads), tuple(re.findall(r"\w+_param_\d+", parameters)), tuple(instructions), labels)


def _instruction(text: str) -> Instruction:
    guarded = _GUARDED.match(text.strip())
    opcode, _, operands = re.sub(r"\s", " ", guarded[3] if guarded else text.strip()).partition(" ")
    guard, negated = (guarded[2], bool(guarded[1])) if guarded else (None, False)
    return Instruction(tuple(opcode.split(".")), tuple(_operands(operands)), guard, negated)


def _operands(text: str) -> list[str]:
    """Split operands at commas outside braces and brackets."""
    return [part.strip() for part in re.split(r",(?![^{\[]*[}\]])", text) if part.strip()]


#: Tensors above this size are not checked for races: the trackers take eight times their size.
MAX_TRACKED_BYTES = 1 << 28


class FaultError(Exception):
    """Access that a GPU would refuse, or whose result depends on the order of threads."""


class Region:
    """Memory of one tensor, with the last program that wrote each byte and the programs that read it.

    Trackers hold 0 for "none", otherwise the program's number plus 1; `SEVERAL` stands for more than one reader.
    """

    SEVERAL = -1

    def __init__(self, tensor: torch.Tensor) -> None:
        storage = tensor.untyped_storage()
        self.start, self.size = storage.data_ptr(), storage.nbytes()
        self.bytes = np.ctypeslib.as_array(
            ctypes.cast(self.start, ctypes.POINTER(ctypes.c_uint8)), (max(self.size, 1),)
        )
        self.tracked = self.size <= MAX_TRACKED_BYTES
        size = self.size if self.tracked else 0
        self.writer, self.reader = np.zeros(size, np.int32), np.zeros(size, np.int32)


class GlobalMemory:
    """Memory of all tensors that a launch may access.

    Args:
        tensors: Tensors on the CPU. Views of one storage are one region, as on a GPU.
    """

    def __init__(self, tensors: Iterable[torch.Tensor]) -> None:
        regions = {tensor.untyped_storage().data_ptr(): Region(tensor) for tensor in tensors if tensor.numel()}
        self.regions = [regions[start] for start in sorted(regions)]
        self.starts = np.array([region.start for region in self.regions], np.uint64)

    def load(self, addresses: np.ndarray, width: int, programs: np.ndarray) -> np.ndarray:
        """Return bytes [n, width] at addresses [n] uint64, read by programs [n] int32 (number plus 1)."""
        result = np.empty((len(addresses), width), np.uint8)
        for region, lanes, index in self._locate(addresses, width):
            result[lanes] = region.bytes[index]
            if region.tracked:
                reader, program = region.reader[index], programs[lanes, None]
                if ((region.writer[index] != 0) & (region.writer[index] != program)).any():
                    raise FaultError("race: a program reads what another one wrote")
                region.reader[index] = np.where((reader == 0) | (reader == program), program, Region.SEVERAL)
                if (region.reader[index] != program).any():  # several programs in this instruction
                    shared = index[(region.reader[index] != program).any(axis=1)]
                    region.reader[shared] = Region.SEVERAL
        return result

    def store(self, addresses: np.ndarray, width: int, values: np.ndarray, programs: np.ndarray) -> None:
        """Store bytes [n, width] at addresses [n] uint64, written by programs [n] int32 (number plus 1)."""
        for region, lanes, index in self._locate(addresses, width):
            region.bytes[index] = values[lanes]
            if (region.bytes[index] != values[lanes]).any():
                raise FaultError("race: threads write different values to one address at once")
            if region.tracked:
                program = programs[lanes, None]
                writer, reader = region.writer[index], region.reader[index]
                region.writer[index] = program
                if ((writer != 0) & (writer != program)).any() or (region.writer[index] != program).any():
                    raise FaultError("race: two programs write to one address")
                if ((reader != 0) & (reader != program)).any():
                    raise FaultError("race: a program writes what another one read")

    def _locate(self, addresses: np.ndarray, width: int) -> Iterable[tuple[Region, np.ndarray, np.ndarray]]:
        """Yield region, lanes and byte index [lanes, width] of each tensor accessed by an instruction."""
        if (addresses % np.uint64(width)).any():
            raise FaultError(f"misaligned access of {width} bytes")
        index = np.searchsorted(self.starts, addresses, side="right") - 1
        for number in np.unique(index):
            lanes = np.nonzero(index == number)[0]
            region = self.regions[number]
            offset = (addresses[lanes] - np.uint64(region.start)).astype(np.int64)
            if number < 0 or int(offset.max()) + width > region.size:
                raise FaultError(
                    f"access outside of all tensors, {int(offset.max()) - region.size} bytes after the end"
                )
            yield region, lanes, offset[:, None] + np.arange(width)


class SharedMemory:
    """Shared memory of several programs, with each byte's last writer and its readers since the last barrier.

    Args:
        programs: Number of programs.
        size: Shared memory per program in bytes.
        threads: Threads per program.
    """

    def __init__(self, programs: int, size: int, threads: int) -> None:
        self.size = size
        self.warp = np.tile(np.arange(threads) // 32, programs).astype(np.int32)
        self.program = np.repeat(np.arange(programs), threads)
        self.bytes = np.zeros(programs * size, np.uint8)
        self.barriers = np.zeros(programs, np.int32)
        self.writer = np.zeros(programs * size, np.int32)
        self.readers = np.zeros(programs * size, np.uint32)
        # Number of the barrier after which the last write and the last reads happened.
        self.written = np.full(programs * size, -1, np.int32)
        self.read = np.full(programs * size, -1, np.int32)

    def load(self, addresses: np.ndarray, width: int, lanes: np.ndarray) -> np.ndarray:
        """Return bytes [n, width] at addresses [n] int64, read by threads `lanes` [n]."""
        index, barrier = self._locate(addresses, width, lanes)
        fresh = self.read[index] == barrier
        self.readers[index[~fresh]] = 0
        self.read[index] = barrier
        bits = np.broadcast_to(np.uint32(1) << self.warp[lanes].astype(np.uint32)[:, None], index.shape)
        np.bitwise_or.at(self.readers, index, bits)
        return self.bytes[index]

    def store(self, addresses: np.ndarray, width: int, values: np.ndarray, lanes: np.ndarray) -> None:
        """Store bytes [n, width] at addresses [n] int64, written by threads `lanes` [n]."""
        index, barrier = self._locate(addresses, width, lanes)
        warp = self.warp[lanes, None]
        others = self.readers[index] & ~(np.uint32(1) << warp.astype(np.uint32))
        if ((self.read[index] == barrier) & (others != 0)).any():
            raise FaultError("race in shared memory: a warp writes what another one read, without a barrier in between")
        self.writer[index], self.written[index] = warp, barrier
        self.bytes[index] = values
        # Replicated data are written by several warps at once.
        if (self.bytes[index] != values).any():
            raise FaultError("race in shared memory: threads write different values to one address at once")

    def _locate(self, addresses: np.ndarray, width: int, lanes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return byte index [n, width], and each thread's barrier count [n, 1]; check earlier writes."""
        if (addresses % width).any():
            raise FaultError(f"misaligned access of {width} bytes to shared memory")
        if addresses.min() < 0 or addresses.max() + width > self.size:
            raise FaultError(f"access to byte {addresses.max() + width - 1} of {self.size} bytes of shared memory")
        program = self.program[lanes]
        index = (addresses + program * self.size)[:, None] + np.arange(width)
        barrier = self.barriers[program][:, None]
        if ((self.written[index] == barrier) & (self.writer[index] != self.warp[lanes, None])).any():
            raise FaultError(
                "race in shared memory: a warp accesses what another one wrote, without a barrier in between"
            )
        return index, barrier


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


@dataclass(frozen=True)
class _Copy:
    """Data of one instruction that has not arrived: threads, their current groups, addresses and bytes."""

    lanes: np.ndarray
    groups: np.ndarray
    addresses: np.ndarray
    values: np.ndarray

    def where(self, chosen: np.ndarray) -> _Copy:
        return _Copy(self.lanes[chosen], self.groups[chosen], self.addresses[chosen], self.values[chosen])


class AsyncCopies:
    """Copies of all threads. Data may arrive at any time until the thread waits for its group.

    The addresses are therefore written twice: by undefined bytes when the copy starts, by the data when the thread
    waits. Accesses by other threads in between are races, unless barriers separate them.

    Args:
        threads: Number of threads of all program instances.
    """

    def __init__(self, threads: int) -> None:
        self._groups = np.zeros(threads, np.int64)
        self._pending: list[_Copy] = []

    def start(self, shared: SharedMemory, lanes: np.ndarray, addresses: np.ndarray, values: np.ndarray) -> None:
        """Start copies of some threads: bytes [threads, width] to addresses [threads]."""
        shared.store(addresses, values.shape[1], np.full_like(values, 0xFF), lanes)
        self._pending.append(_Copy(lanes, self._groups[lanes], addresses, values))

    def commit(self, lanes: np.ndarray) -> None:
        """End the current group of some threads."""
        self._groups[lanes] += 1

    def wait(self, shared: SharedMemory, lanes: np.ndarray, latest: int) -> None:
        """Let some threads wait for all of their groups except the latest ones."""
        waits = np.zeros(len(self._groups), bool)
        waits[lanes] = True
        pending, self._pending = self._pending, []
        for copy in pending:
            due = waits[copy.lanes] & (copy.groups < self._groups[copy.lanes] - latest)
            arrived, left = copy.where(due), copy.where(~due)
            if len(arrived.lanes):
                shared.store(arrived.addresses, arrived.values.shape[1], arrived.values, arrived.lanes)
            if len(left.lanes):
                self._pending.append(left)


WARP = 32
#: Threads that advance together: operations on arrays of this size take little longer than on smaller ones.
MAX_THREADS = 1 << 14
_ADDRESS = re.compile(r"\[\s*(%?\w+)\s*(?:\+\s*(-?\d+)\s*)?\]")
_CONTROL = ("bra", "ret", "bar")


@dataclass
class State:
    """Registers and memory of the program instances that advance together.

    Attributes:
        blocks: Grid index (x, y, z) of each program instance, [programs, 3].
        threads: Threads per program instance.
        arguments: Values of the kernel's parameters, as unsigned integers.
        registers: Value of each register in each thread, as unsigned integers; predicates as bool.
    """

    blocks: np.ndarray
    threads: int
    arguments: Sequence[int]
    global_memory: GlobalMemory
    shared: SharedMemory
    numbers: np.ndarray
    copies: AsyncCopies
    registers: dict[str, np.ndarray] = field(default_factory=dict)

    @property
    def count(self) -> int:
        """Number of threads of all program instances."""
        return len(self.blocks) * self.threads

    def special(self, name: str) -> np.ndarray:
        """Return the value of a special register."""
        thread = np.tile(np.arange(self.threads, dtype=np.uint32), len(self.blocks))
        axis = "xyz".index(name[-1])
        if name.startswith("%tid."):
            return thread if axis == 0 else np.zeros_like(thread)
        if name.startswith("%ctaid."):
            return np.repeat(self.blocks[:, axis].astype(np.uint32), self.threads)
        raise UnsupportedError(name)


Read = Callable[[State], np.ndarray]
Execute = Callable[[State, np.ndarray | None], None]


def reader(operand: str, type_: str) -> Read:
    """Return a function that reads an operand in each thread as a type."""
    dtype = np.dtype(dtype_of(type_))
    if operand.startswith(("%tid", "%ctaid", "%ntid")):
        return lambda state: state.special(operand).view(dtype)
    if operand.startswith("%"):
        if type_ == "pred":
            return lambda state: state.registers[operand]
        unsigned = UNSIGNED[8 * dtype.itemsize]

        def read(state: State) -> np.ndarray:
            value = state.registers.get(operand)
            if value is None:  # the compiler fills unused parts of vectors with undefined registers
                value = np.full(state.count, unsigned(-1 % (1 << 8 * dtype.itemsize)))
            return value.astype(unsigned, copy=False).view(dtype)

        return read
    if operand == "global_smem":
        value = 0
    elif re.match(r"0[fFdD]", operand):
        value = int(operand[2:], 16)
    else:
        value = int(operand.rstrip("U"), 0)
    if type_ == "pred":
        return lambda state: np.full(state.count, bool(value))
    bits = 8 * dtype.itemsize
    constant = np.array(value & ((1 << bits) - 1), UNSIGNED[bits]).view(dtype)
    return lambda state: np.full(state.count, constant)


def write(state: State, register: str, value: np.ndarray, mask: np.ndarray | None) -> None:
    """Write a register in the threads of a mask; None stands for all threads."""
    if register in ("_", "tmp"):
        return
    if value.dtype != np.bool_:
        value = np.ascontiguousarray(value).view(UNSIGNED[8 * value.dtype.itemsize])
    if mask is not None:
        before = state.registers.get(register)
        value = np.where(mask, value, np.zeros_like(value) if before is None else before)
    state.registers[register] = value


def _vector(operand: str) -> list[str]:
    return [part.strip() for part in operand.strip("{} ").split(",")]


def compile_instruction(instruction: Instruction) -> Execute:
    """Return the function that executes an instruction other than a jump or barrier.

    Raises:
        UnsupportedError: If the interpreter does not know the instruction.
    """
    opcode, operands = instruction.opcode, instruction.operands
    name = opcode[0]
    if opcode[:2] in (("ld", "global"), ("ld", "shared"), ("st", "global"), ("st", "shared")):
        return _memory_access(instruction)
    special = {"shfl": _shuffle, "redux": _redux, "ldmatrix": _load_matrix, "stmatrix": _store_matrix, "mma": _mma}
    special["cp"] = _async_copy
    if name in special:
        return special[name](instruction)
    if opcode[:2] == ("ld", "param"):
        return _parameter(instruction)
    if name == "mov" and "{" in instruction.operands[0] + instruction.operands[1]:
        return _pack(instruction)
    type_ = opcode[-1]
    if name == "cvt" and opcode[-2] in ("f16x2", "bf16x2"):
        return _convert_pair(instruction)
    if name == "setp" and type_ in ("f16x2", "bf16x2"):
        return _compare_pairs(instruction)
    if name == "cvt":
        function, types = conversion(opcode), [type_]
    elif name == "setp":
        function, types = comparison(opcode), [type_, type_]
    elif name == "selp":
        function, types = select, [type_, type_, "pred"]
    elif name == "mov":
        function, types = np.copy, [type_]
    else:
        function, types = arithmetic(opcode), ["u32" if type_.endswith("x2") else type_] * (len(operands) - 1)
        if name in ("shl", "shr"):
            types[1] = "u32"
        if name == "bfe":
            types[1:] = ["u32", "u32"]
        if name == "mad" and "wide" in opcode:
            types[2] = f"{type_[0]}{2 * int(type_[1:])}"
    reads = [reader(operand, type_) for operand, type_ in zip(operands[1:], types, strict=True)]
    return lambda state, mask: write(state, operands[0], function(*(read(state) for read in reads)), mask)


def _parameter(instruction: Instruction) -> Execute:
    register, source = instruction.operands
    bits = int(instruction.opcode[-1][1:])
    match = re.fullmatch(r"\[(\w+_param_(\d+))\]", source)
    if match is None:
        raise UnsupportedError(str(instruction))
    position = int(match[2])

    def execute(state: State, mask: np.ndarray | None) -> None:
        value = UNSIGNED[bits](state.arguments[position] & ((1 << bits) - 1))
        write(state, register, np.full(state.count, value), mask)

    return execute


def _pack(instruction: Instruction) -> Execute:
    """Return the execution of a `mov` that splits a register into a vector, or joins a vector into a register."""
    target, source = instruction.operands
    bits = int(instruction.opcode[-1][1:])
    if target.startswith("{"):
        parts, read = _vector(target), reader(source, f"b{bits}")

        def split(state: State, mask: np.ndarray | None) -> None:
            pieces = read(state).view(UNSIGNED[bits // len(parts)]).reshape(-1, len(parts))
            for number, part in enumerate(parts):
                write(state, part, pieces[:, number], mask)

        return split
    parts = _vector(source)
    reads = [reader(part, f"b{bits // len(parts)}") for part in parts]

    def join(state: State, mask: np.ndarray | None) -> None:
        joined = np.stack([read(state) for read in reads], axis=1)
        write(state, target, joined.view(UNSIGNED[bits]).reshape(-1), mask)

    return join


def _compare_pairs(instruction: Instruction) -> Execute:
    targets, *operands = instruction.operands
    compare = comparison((*instruction.opcode[:-1], "f32"))
    wide = from_bfloat16 if instruction.opcode[-1] == "bf16x2" else _from_float16
    reads = [reader(operand, "u32") for operand in operands]

    def execute(state: State, mask: np.ndarray | None) -> None:
        pairs = [read(state) for read in reads]
        for target, shift in zip(targets.split("|"), (0, 16), strict=True):
            halves = (wide((pair >> np.uint32(shift)).astype(np.uint16)) for pair in pairs)
            write(state, target, compare(*halves), mask)

    return execute


def _from_float16(bits: np.ndarray) -> np.ndarray:
    """Return float16 values, given by their bits, as float32."""
    return bits.view(np.float16).astype(np.float32)


def _convert_pair(instruction: Instruction) -> Execute:
    target, *sources = instruction.operands
    high, low = (reader(source, "f32") for source in sources)
    half = instruction.opcode[-2] == "f16x2"

    def bits(values: np.ndarray) -> np.ndarray:
        return values.astype(np.float16).view(np.uint16) if half else to_bfloat16(values)

    def execute(state: State, mask: np.ndarray | None) -> None:
        pair = np.stack([bits(low(state)), bits(high(state))], axis=1)
        write(state, target, pair.view(np.uint32).reshape(-1), mask)

    return execute


def _address(operand: str, type_: str) -> Read:
    match = _ADDRESS.fullmatch(operand)
    if match is None:
        raise UnsupportedError(f"address {operand}")
    read, offset = reader(match[1], type_), int(match[2] or 0)
    return lambda state: read(state) + np.array(offset).astype(np.dtype(dtype_of(type_)))


def _memory_access(instruction: Instruction) -> Execute:
    opcode, operands = instruction.opcode, instruction.operands
    loads, in_global = opcode[0] == "ld", "global" in opcode
    data, target = operands if loads else reversed(operands)
    parts, bits = _vector(data), int(opcode[-1][1:])
    width, address = len(parts) * bits // 8, _address(target, "u64" if in_global else "s32")
    reads = [] if loads else [reader(part, f"b{bits}") for part in parts]

    def execute(state: State, mask: np.ndarray | None) -> None:
        lanes = np.arange(state.count) if mask is None else np.nonzero(mask)[0]
        if not len(lanes):
            return
        addresses, memory = address(state)[lanes], state.shared
        if not loads:
            values = np.stack([read(state) for read in reads], axis=1).view(np.uint8)[lanes]
            if in_global:
                state.global_memory.store(addresses, width, values, state.numbers[lanes])
            else:
                memory.store(addresses.astype(np.int64), width, values, lanes)
            return
        loaded = np.zeros((state.count, width), np.uint8)
        loaded[lanes] = (
            state.global_memory.load(addresses, width, state.numbers[lanes])
            if in_global
            else memory.load(addresses.astype(np.int64), width, lanes)
        )
        values = loaded.view(UNSIGNED[bits])
        for number, part in enumerate(parts):
            write(state, part, values[:, number], mask)

    return execute


def _async_copy(instruction: Instruction) -> Execute:
    """Return the execution of `cp.async` and of the instructions that end its groups and wait for them."""
    opcode, operands = instruction.opcode, instruction.operands

    def lanes_of(state: State, mask: np.ndarray | None) -> np.ndarray:
        return np.arange(state.count) if mask is None else np.nonzero(mask)[0]

    if opcode[2] == "commit_group":
        return lambda state, mask: state.copies.commit(lanes_of(state, mask))
    if opcode[2] == "wait_group":
        latest = int(operands[0], 0)
        return lambda state, mask: state.copies.wait(state.shared, lanes_of(state, mask), latest)
    target, source, width = _address(operands[0], "s32"), _address(operands[1], "u64"), int(operands[2], 0)
    read = reader(operands[3] if len(operands) > 3 else operands[2], "u32")  # bytes to read; the rest is 0

    def execute(state: State, mask: np.ndarray | None) -> None:
        lanes = lanes_of(state, mask)
        if not len(lanes):
            return
        size, values = read(state)[lanes], np.zeros((len(lanes), width), np.uint8)
        if not np.isin(size, (0, width)).all():
            raise UnsupportedError(f"partly filled copy: {instruction}")
        there = size == width
        if there.any():
            values[there] = state.global_memory.load(source(state)[lanes][there], width, state.numbers[lanes][there])
        state.copies.start(state.shared, lanes, target(state)[lanes].astype(np.int64), values)

    return execute


def _shuffle(instruction: Instruction) -> Execute:
    target = instruction.operands[0].split("|")[0]
    value, amount = reader(instruction.operands[1], "b32"), reader(instruction.operands[2], "b32")
    mode = instruction.opcode[2]

    def execute(state: State, mask: np.ndarray | None) -> None:
        lane, step = np.arange(state.count) % WARP, amount(state).astype(np.int64)
        source = {
            "bfly": lane ^ step,
            "up": np.where(lane >= step, lane - step, lane),
            "down": np.where(lane + step < WARP, lane + step, lane),
            "idx": step % WARP,
        }[mode]
        source = np.arange(state.count) - lane + source
        if mask is not None and not mask[source[mask]].all():
            raise FaultError("a shuffle reads from a thread that does not take part in it")
        write(state, target, value(state)[source], mask)

    return execute


def _redux(instruction: Instruction) -> Execute:
    target, source, _ = instruction.operands
    reduces: dict[str, Any] = {"max": np.max, "min": np.min, "add": np.sum}
    reduce = reduces[instruction.opcode[2]]
    value = reader(source, instruction.opcode[-1])

    def execute(state: State, mask: np.ndarray | None) -> None:
        _check_whole_warps(mask)
        values = value(state)
        reduced = reduce(values.reshape(-1, WARP), axis=1).astype(values.dtype)
        write(state, target, np.repeat(reduced, WARP), mask)

    return execute


def _check_whole_warps(mask: np.ndarray | None) -> None:
    if mask is not None and (mask.reshape(-1, WARP).any(axis=1) != mask.reshape(-1, WARP).all(axis=1)).any():
        raise FaultError("a warp executes a collective instruction with some of its threads only")


def _matrix_rows(state: State, address: Read, number: int, lanes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return addresses of the 8 rows of each warp's matrix `number`, and the threads that hold them."""
    holders = (lanes[::WARP, None] + 8 * number + np.arange(8)).reshape(-1)
    return address(state)[holders].astype(np.int64), holders


def _load_matrix(instruction: Instruction) -> Execute:
    """Return the execution of `ldmatrix`: 8x8 matrices of 16 bits, spread over each warp (PTX ISA, "ldmatrix")."""
    parts, address = _vector(instruction.operands[0]), _address(instruction.operands[1], "s32")
    transposed, lane = "trans" in instruction.opcode, np.arange(WARP)

    def execute(state: State, mask: np.ndarray | None) -> None:
        _check_whole_warps(mask)
        lanes = np.arange(state.count) if mask is None else np.nonzero(mask)[0]
        for number, part in enumerate(parts):
            addresses, holders = _matrix_rows(state, address, number, lanes)
            rows = state.shared.load(addresses, 16, holders).view(np.uint16).reshape(-1, 8, 8)
            if transposed:
                rows = rows.transpose(0, 2, 1)
            pairs = np.stack([rows[:, lane // 4, 2 * (lane % 4)], rows[:, lane // 4, 2 * (lane % 4) + 1]], axis=2)
            value = np.zeros(state.count, np.uint32)
            value[lanes] = np.ascontiguousarray(pairs).view(np.uint32).reshape(-1)
            write(state, part, value, mask)

    return execute


def _store_matrix(instruction: Instruction) -> Execute:
    """Return the execution of `stmatrix`, the reverse of `ldmatrix`."""
    if "trans" in instruction.opcode:
        raise UnsupportedError("transposed stmatrix")
    address, parts = _address(instruction.operands[0], "s32"), _vector(instruction.operands[1])
    reads = [reader(part, "b32") for part in parts]

    def execute(state: State, mask: np.ndarray | None) -> None:
        _check_whole_warps(mask)
        lanes = np.arange(state.count) if mask is None else np.nonzero(mask)[0]
        for number, read in enumerate(reads):
            addresses, holders = _matrix_rows(state, address, number, lanes)
            rows = np.ascontiguousarray(read(state)[lanes]).view(np.uint8).reshape(-1, 16)
            state.shared.store(addresses, 16, rows, holders)

    return execute


def _mma(instruction: Instruction) -> Execute:
    """Return the execution of `mma.m16n8k8` in TF32 and `mma.m16n8k16` in 16 bits (PTX ISA, "Matrix Fragments").

    A register of a factor holds a row's part of 32 bits: one value of TF32, to which it is truncated, or two of
    bfloat16 or float16. Products are summed in float64 and rounded once.
    """
    opcode = instruction.opcode
    if {"m16n8k8", "tf32"} <= set(opcode):
        packed, significant = 1, np.uint32(0xFFFFE000)
    elif "m16n8k16" in opcode and {"bf16", "f16"} & set(opcode):
        packed, significant = 2, np.uint32(0xFFFF0000)
    else:
        raise UnsupportedError(str(instruction))
    targets = _vector(instruction.operands[0])
    a, b, c = (
        [reader(part, type_) for part in _vector(operand)]
        for operand, type_ in zip(instruction.operands[1:], ("b32", "b32", "f32"), strict=True)
    )
    group, thread = np.arange(WARP) // 4, np.arange(WARP) % 4

    def execute(state: State, mask: np.ndarray | None) -> None:
        _check_whole_warps(mask)
        warps = state.count // WARP

        def fragments(reads: list[Read]) -> list[np.ndarray]:
            return [read(state).reshape(warps, WARP) for read in reads]

        def values_of(bits: np.ndarray) -> np.ndarray:
            """Return the values in the high bits of registers."""
            if "f16" in opcode:
                return (bits >> np.uint32(16)).astype(np.uint16).view(np.float16).astype(np.float32)
            return (bits & significant).view(np.float32)

        def factors(reads: list[Read]) -> list[tuple[int, int, np.ndarray]]:
            """Return the values of each register, with its number and the place of the value in it."""
            shifts = (0,) if packed == 1 else (16, 0)
            return [
                (number, place, values_of(bits << np.uint32(shift)))
                for number, bits in enumerate(fragments(reads))
                for place, shift in enumerate(shifts)
            ]

        left, right = np.zeros((warps, 16, 8 * packed)), np.zeros((warps, 8 * packed, 8))
        for number, place, values in factors(a):
            left[:, group + 8 * (number % 2), packed * (thread + 4 * (number // 2)) + place] = values
        for number, place, values in factors(b):
            right[:, packed * (thread + 4 * number) + place, group] = values
        product = left @ right
        for number, (target, before) in enumerate(zip(targets, fragments(c), strict=True)):
            values = product[:, group + 8 * (number // 2), 2 * thread + number % 2] + before
            write(state, target, values.astype(np.float32).reshape(-1), mask)

    return execute


class Kernel:
    """Kernel that can be executed.

    Attributes:
        program: Parsed PTX.
        code: Function of each instruction; None for jumps and barriers.
    """

    def __init__(self, program: Program, shared_bytes: int) -> None:
        self.program, self.shared_bytes = program, shared_bytes
        for instruction in program.instructions:
            if instruction.opcode[0] in ("wgmma", "tcgen05"):
                raise UnsupportedError(str(instruction))
        self.code = [
            None if instruction.opcode[0] in _CONTROL else compile_instruction(instruction)
            for instruction in program.instructions
        ]

    def launch(self, grid: tuple[int, int, int], arguments: Sequence[int], memory: GlobalMemory) -> None:
        """Execute all program instances of a grid.

        Raises:
            FaultError: If an access is out of bounds, misaligned, or in a race with another one.
        """
        blocks = np.stack(np.meshgrid(*map(np.arange, grid), indexing="ij"), axis=-1).reshape(-1, 3)
        threads = self.program.threads
        step = max(1, MAX_THREADS // threads)
        for start in range(0, len(blocks), step):
            some = blocks[start : start + step]
            shared = SharedMemory(len(some), self.shared_bytes, threads)
            numbers = np.repeat(np.arange(start, start + len(some)) + 1, threads).astype(np.int32)
            with np.errstate(all="ignore"):
                copies = AsyncCopies(len(numbers))
                self._run(State(some, threads, arguments, memory, shared, numbers, copies))

    def _run(self, state: State) -> None:
        """Execute until all threads have returned."""
        instructions, end = self.program.instructions, len(self.code)
        counters = np.zeros(state.count, np.int64)  # of each thread; only valid while threads diverge
        counter, diverged = 0, False
        while True:
            active = None
            if diverged:
                counter = int(counters.min())
                active = counters == counter
                if active.all():
                    active, diverged = None, False
            if counter >= end:
                return
            instruction = instructions[counter]
            mask = active
            if instruction.guard:
                guard = state.registers[instruction.guard] ^ instruction.negated
                mask = guard if active is None else guard & active
            following = counter + 1
            try:
                if instruction.opcode[0] in ("bra", "ret"):
                    target = end if instruction.opcode[0] == "ret" else self.program.labels[instruction.operands[0]]
                    taken = np.ones(state.count, bool) if mask is None else mask
                    if not diverged and taken.all():
                        following = target
                    elif taken.any():
                        counters = counters if diverged else np.full(state.count, counter)
                        stays = counters == counter
                        counters = np.where(taken, target, np.where(stays, following, counters))
                        diverged = True
                        continue
                elif instruction.opcode[0] == "bar":
                    self._pass_barrier(state, instruction, mask)
                else:
                    execute = self.code[counter]
                    assert execute is not None
                    execute(state, mask)
            except FaultError as fault:
                raise FaultError(f"{self.program.name}: {fault}, at {counter}: {instruction}") from None
            if active is not None:
                counters = np.where(active, following, counters)
            counter = following

    def _pass_barrier(self, state: State, instruction: Instruction, mask: np.ndarray | None) -> None:
        if instruction.opcode[1] == "warp":
            return
        arrived = np.ones(state.count, bool) if mask is None else mask
        arrived = arrived.reshape(-1, state.threads)
        if (arrived.any(axis=1) != arrived.all(axis=1)).any():
            raise FaultError("a barrier is reached by some threads of a program only")
        state.shared.barriers += arrived.all(axis=1)
