"""One line of a plan."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Decision:
    """One line of a plan.

    Attributes:
        item: Subject of the decision.
        decision: Decision as text.
        reason: Evidence for it.
        seconds: Estimated seconds saved per iteration; None if unknown.
        bytes: Memory saved in bytes; None if unknown.
        error: Possible cost in accuracy; "none" if results change only by rounding.
    """

    item: str
    decision: str
    reason: str
    seconds: float | None = None
    bytes: int | None = None
    error: str = "none"
