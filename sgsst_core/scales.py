"""Scales of a view with their weights, and the loss over scales and steps: mean, end of a job, prediction.

By default all weights are equal, so E = sum_s w_s E_transfer(s) / sum_s w_s is the mean over scales, as in the paper.
Scales of weight 0 are not computed. Losses differ between views, so they are compared as geometric means over windows
of whole rounds; every round visits each view once. This module imports no PyTorch: the service estimates jobs with it.
"""

import math
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from statistics import fmean

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
        """Return the weights of some scales, one of them positive, normalized to add up to 1."""
        weights = {scale: self.of(scale) for scale in scales}
        total = sum(weights.values())
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
#: Maximum relative standard error of a prediction of the loss.
MAX_ERROR = 0.1


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


#: Step, view and loss of a step.
Visit = tuple[int, int, float]


def predicted_fall(visits: Sequence[Visit], factor: float, round_length: int) -> float | None:
    """Predict the loss of the last round after `factor` times as many steps, relative to that of the last round so far.

    The losses of view v after n steps are taken as c_v n^-b: a power law with a constant for each view, because losses
    of views differ by factors. Its exponent is that of least squares on logarithms, in float64. Where the second half
    of the steps falls significantly more slowly (by two standard errors), its exponent counts: the curve is flattening.

    Args:
        visits: Steps on all scales, in order.
        factor: Number of all steps relative to those so far, at least 1.
        round_length: Number of steps in which every view is visited once.

    Returns:
        Ratio in (0, 1]. None for less than two windows, or if its relative standard error exceeds `MAX_ERROR`.
    """
    if len(visits) < 2 * window_length(round_length):
        return None
    exponent, error = _power_law(visits)
    later, later_error = _power_law(visits[len(visits) // 2 :])
    if later + 2 * later_error < exponent:
        exponent, error = later, later_error
    steps = visits[-1][0]
    longer = fmean(math.log((factor * steps - place) / (steps - place)) for place in range(round_length))
    return math.exp(-max(exponent, 0.0) * longer) if error * longer <= MAX_ERROR else None


def _power_law(visits: Sequence[Visit]) -> tuple[float, float]:
    """Return the exponent b of losses c_v n^-b and its standard error; infinite if too few views were visited twice."""
    views: dict[int, list[tuple[float, float]]] = defaultdict(list)
    for step, view, loss in visits:
        views[view].append((math.log(step), math.log(max(loss, 1e-300))))
    points = []
    for own in views.values():
        x, y = (fmean(column) for column in zip(*own, strict=True))
        points += [(step - x, loss - y) for step, loss in own]
    free, square = len(points) - len(views) - 1, math.fsum(x * x for x, _ in points)
    if free < 1:
        return 0.0, math.inf
    slope = math.fsum(x * y for x, y in points) / square
    return -slope, math.sqrt(math.fsum((y - slope * x) ** 2 for x, y in points) / free / square)
