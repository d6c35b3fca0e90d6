"""Early stopping: decide whether the loss is low enough, or has stopped falling.

Losses differ between views. They are therefore compared as geometric means over windows of whole rounds; every round
visits each view once.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

#: Minimum number of steps in a window. If there are fewer views, a window consists of several rounds.
MIN_WINDOW = 24
#: The loss has converged when it falls by less than this fraction from one window to the next.
MIN_FALL = 0.005


def window_length(round_length: int) -> int:
    """Return the length of a window: the smallest number of whole rounds with at least `MIN_WINDOW` steps."""
    return round_length * math.ceil(MIN_WINDOW / round_length)


def smoothed(losses: Sequence[float], window: int) -> float:
    """Return the geometric mean of the last `window` losses, or of all losses if there are fewer."""
    last = losses[-window:]
    return math.exp(sum(map(log_loss, last)) / len(last))


def log_loss(loss: float) -> float:
    """Return the logarithm of a loss; that of the smallest normal numbers for 0."""
    return math.log(max(loss, 1e-300))


def ratio(after: float, before: float) -> float | None:
    """Return a loss relative to an earlier one; None if the earlier one is exactly 0."""
    return after / before if before else None


def has_reached(losses: Sequence[float], target: float, round_length: int) -> bool:
    """Return whether the mean over the last whole round of views is at most `target`."""
    return len(losses) >= round_length and smoothed(losses, round_length) <= target


def has_converged(losses: Sequence[float], round_length: int) -> bool:
    """Return whether the mean loss of the last window is less than 0.5 % below that of the preceding window.

    Return False if there are fewer than two windows.
    """
    window = window_length(round_length)
    if len(losses) < 2 * window:
        return False
    return smoothed(losses, window) > (1 - MIN_FALL) * smoothed(losses[-2 * window : -window], window)
