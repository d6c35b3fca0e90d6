"""Counters of the simulated device's work, by the line of the project's code that caused it."""

import sys
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path

_ROOT = Path(__file__).parents[2]
_WATCHED = tuple(str(_ROOT / folder) + "/" for folder in ("sgsst_core", "worker"))


@dataclass
class Counts:
    """Number of kernel launches, host synchronizations and copied bytes by line of the project's code.

    Keys are lines such as "sgsst_core/loss/sos.py:310", or "?" for work that no line of the project caused.
    """

    launches: Counter[str] = field(default_factory=Counter)
    waits: Counter[str] = field(default_factory=Counter)
    copies: Counter[str] = field(default_factory=Counter)

    def clear(self) -> None:
        """Reset all counters."""
        for counter in (self.launches, self.waits, self.copies):
            counter.clear()


def calling_line() -> str:
    """Return the innermost line of the project on the call stack."""
    frame = sys._getframe(1)
    while frame is not None:
        name = frame.f_code.co_filename
        if name.startswith(_WATCHED):
            return f"{Path(name).relative_to(_ROOT)}:{frame.f_lineno}"
        frame = frame.f_back  # type: ignore[assignment]
    return "?"
