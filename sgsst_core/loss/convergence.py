"""When a run may end before its schedule: the loss is low enough, or it has stopped falling.

Views differ, so losses are compared as geometric means over windows of whole rounds, in which every view comes equally
often.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

#: Steps that a window has at least: few views come several times in it.
SHORTEST_WINDOW = 24
#: A loss has stopped falling when it has fallen by less than this share from one window to the next.
LEAST_FALL = 0.005


def window_length(round_length: int) -> int:
    """Steps of a window: as many whole rounds as it takes to have at least `SHORTEST_WINDOW`."""
    return round_length * math.ceil(SHORTEST_WINDOW / round_length)


def smoothed(losses: Sequence[float], window: int) -> float:
    """Geometric mean of the last `window` losses, of fewer where there are not as many yet."""
    last = losses[-window:]
    return math.exp(sum(math.log(max(loss, 1e-300)) for loss in last) / len(last))


def has_reached(losses: Sequence[float], target: float, round_length: int) -> bool:
    """Whether the mean over the last whole round of views is at most `target`."""
    return len(losses) >= round_length and smoothed(losses, round_length) <= target


def has_converged(losses: Sequence[float], round_length: int) -> bool:
    """Whether the last window's mean is less than 0.5 % below that of the window before it."""
    window = window_length(round_length)
    if len(losses) < 2 * window:
        return False
    return smoothed(losses, window) > (1 - LEAST_FALL) * smoothed(losses[-2 * window : -window], window)
