"""What a device was asked to do, and by which line of the project."""

from __future__ import annotations

import sys
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path

_ROOT = Path(__file__).parents[2]
_WATCHED = tuple(str(_ROOT / folder) + "/" for folder in ("sgsst_core", "worker"))


@dataclass
class Counts:
    """Launches of kernels, waits of the host for the device, bytes copied between the two: by the line that asked.

    Lines are "sgsst_core/loss/sos.py:310"; work that no line of the project asked for stands under "?".
    """

    launches: Counter[str] = field(default_factory=Counter)
    waits: Counter[str] = field(default_factory=Counter)
    copies: Counter[str] = field(default_factory=Counter)

    def clear(self) -> None:
        """Count from nothing."""
        for counter in (self.launches, self.waits, self.copies):
            counter.clear()

    def copy(self) -> Counts:
        """What was counted until now."""
        return Counts(Counter(self.launches), Counter(self.waits), Counter(self.copies))


def calling_line() -> str:
    """The innermost line of the project on the stack."""
    frame = sys._getframe(1)
    while frame is not None:
        name = frame.f_code.co_filename
        if name.startswith(_WATCHED):
            return f"{Path(name).relative_to(_ROOT)}:{frame.f_lineno}"
        frame = frame.f_back  # type: ignore[assignment]
    return "?"
