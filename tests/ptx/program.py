"""Parser of the PTX that Triton generates: one kernel with flat control flow and no calls."""

from __future__ import annotations

import re
from dataclasses import dataclass

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
