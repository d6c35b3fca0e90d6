"""Interpreter of PTX programs on arrays: all threads of several program instances advance together.

Threads that diverge have program counters of their own; the lowest one is executed first. A barrier must be reached by
all threads of a program instance. The tensor-core instructions of sm_90 and newer (`wgmma`, `tcgen05`) are unsupported.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from tests.ptx.copies import AsyncCopies
from tests.ptx.memory import FaultError, GlobalMemory, SharedMemory
from tests.ptx.operations import (
    UNSIGNED,
    UnsupportedError,
    arithmetic,
    comparison,
    conversion,
    dtype_of,
    from_bfloat16,
    select,
    to_bfloat16,
)
from tests.ptx.program import Instruction, Program

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

    @contextmanager
    def changed(self, number: int, instruction: Instruction) -> Iterator[None]:
        """Replace one instruction within this block, to test that a defect is reported."""
        program, code = self.program, self.code
        instructions = [*program.instructions]
        instructions[number] = instruction
        self.program = replace(program, instructions=tuple(instructions))
        self.code = [*code]
        self.code[number] = None if instruction.opcode[0] in _CONTROL else compile_instruction(instruction)
        try:
            yield
        finally:
            self.program, self.code = program, code

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
