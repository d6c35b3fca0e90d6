"""Scales of a view with their weights, and the mean loss over scales and steps, which decides when a job stops.

By default all weights are equal, so E = sum_s w_s E_transfer(s) / sum_s w_s is the mean over scales, as in the paper.
Scales of weight 0 are not computed. Losses differ between views, so they are compared as geometric means over windows
of whole rounds; every round visits each view once. This module imports no PyTorch: the service estimates jobs with it.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

from sgsst_core.constants import COARSEST_SHORTER_SIDE


def scale_count(height: int, width: int, coarsest: int = COARSEST_SHORTER_SIDE) -> int:
    """Return the number of scales n_s: halve the shorter side (integer division) until it is at most `coarsest`.

    Small views have one scale.
    """
    count, side = 1, min(height, width)
    while side > coarsest:
        side //= 2
        count += 1
    return count


@dataclass(frozen=True)
class ScaleWeights:
    """Weights of the scales of a pyramid.

    Attributes:
        values: Weights from the finest scale (full size) to coarser ones, finite and non-negative. Scales beyond the
            last value have weight 0. Empty for equal weights.
    """

    values: tuple[float, ...] = ()

    def of(self, scale: int) -> float:
        """Return the weight of a scale; scale 0 is full size."""
        if not self.values:
            return 1.0
        return self.values[scale] if scale < len(self.values) else 0.0

    def chosen(self, count: int) -> list[int]:
        """Return the scales with a positive weight among the first `count`, finest first."""
        return [scale for scale in range(count) if self.of(scale) > 0]

    def fractions(self, scales: Iterable[int]) -> dict[int, float]:
        """Return the weights of some scales, normalized to add up to 1.

        Raises:
            ValueError: If none of them has a positive weight.
        """
        weights = {scale: self.of(scale) for scale in scales}
        total = sum(weights.values())
        if not total > 0:
            raise ValueError(f"none of the scales {sorted(weights)} has a weight")
        return {scale: weight / total for scale, weight in weights.items()}

    def sampled(self, chosen: Sequence[int], drawn: Iterable[int], period: int) -> dict[int, float]:
        """Return the weights of drawn scales whose mean over all draws (`steps.drawn_scales`) is `fractions`.

        Args:
            chosen: Scales of a view with a positive weight, finest first.
            drawn: Those of them that a step evaluates.
            period: Number of steps with a scale of which one has the next finer scale.
        """
        fractions = self.fractions(chosen)
        return {scale: fractions[scale] * period ** (len(chosen) - 1 - chosen.index(scale)) for scale in drawn}

    def evaluated(self, count: int, period: int = 1) -> float:
        """Return the pixels that a mean step with `sampled` weights evaluates, relative to those of the view.

        Args:
            count: Number of scales of a view.
            period: See `sampled`; 1 for all scales in every step.
        """
        coarsest_first = reversed(self.chosen(count))
        return sum(4.0**-scale * float(period) ** -place for place, scale in enumerate(coarsest_first))

    def sampled_cost(self, count: int, period: int) -> float:
        """Return the cost of all scales but the coarsest in a mean step, relative to a step with all scales."""
        *finer, coarsest = self.chosen(count)
        always = 4.0**-coarsest
        return (self.evaluated(count, period) - always) / (self.evaluated(count) - always) if finer else 1.0

    def mean(self, losses: Mapping[int, float]) -> float:
        """Return E, the weighted mean of losses by scale. Every scale in `losses` must have a positive weight."""
        total = sum(self.of(scale) for scale in losses)
        return sum(self.of(scale) * loss for scale, loss in losses.items()) / total


#: Equal weights, as in the paper's loss.
EVEN = ScaleWeights()


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
    # The logarithm of 0 is that of the smallest normal numbers.
    return math.exp(sum(math.log(max(loss, 1e-300)) for loss in last) / len(last))


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
