"""Decisions of a plan, with their reasons."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

#: Subject of the decision about views that see nothing.
VIEWS = "views"
#: Cost in accuracy of a decision that changes what is minimized.
ANOTHER_LOSS = "differs from the paper's loss"


@dataclass(frozen=True)
class Decision:
    """One line of a plan.

    Attributes:
        bytes: Memory saved in bytes; None if unknown.
        error: Possible cost in accuracy; "none" if results change only by rounding.
    """

    item: str
    decision: str
    reason: str
    bytes: int | None = None
    error: str = "none"


#: Beginning of decisions that need the user's attention.
_WARNING = "warning: "


def warnings_of(decisions: Sequence[Decision]) -> list[str]:
    """Return decisions that need the user's attention as sentences: warnings, and views that are skipped."""
    return [
        f"{each.item}: {each.decision.removeprefix(_WARNING)}: {each.reason}"
        for each in decisions
        if each.decision.startswith(_WARNING) or each.item == VIEWS
    ]
