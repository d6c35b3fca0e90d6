"""History of a report as columns of numbers, with the running means and logarithmic axes that charts need."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import groupby
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from sgsst_core.loss.terms import TERMS

Floats = NDArray[np.float64]
Against = Literal["seconds", "steps"]
AGAINST: tuple[Against, ...] = ("seconds", "steps")
#: Number of bins of an x axis, each narrower than a typographic point. Steps in the same bin are drawn as one point.
BINS = 300
#: Range of values on logarithmic axes. matplotlib searches for ticks some decades beyond it, which must fit float64
#: too.
_MIN, _MAX = 1e-200, 1e200
#: Factor by which the x axis extends beyond the first and the last step.
X_MARGIN = 1.05


@dataclass(frozen=True)
class Thinned:
    """Steps grouped into bins of an axis, each array [bins] float64.

    Attributes:
        x: Geometric mean of the x positions of a bin's steps.
        mean: Geometric mean of the running means at these steps.
        low, high: Minimum and maximum of the values at these steps.
    """

    x: Floats
    mean: Floats
    low: Floats
    high: Floats


@dataclass(frozen=True)
class History:
    """History of a report by column. Each array is [steps] float64, with NaN for missing values.

    Attributes:
        x: Elapsed seconds, and number of steps.
        limits: Limits of each x axis, which include the measurements of novel views.
        phases: Name of each phase's stage, and slice of its steps.
        terms: Loss terms by scale and name.
        relative: Loss by scale, relative to the unstylized scene.
        mean_relative: Mean over scales, relative to the unstylized scene; NaN for steps on a single scale.
        memory: Memory of the process in bytes.
        device_memory: Peak memory of the process's tensors on the GPU so far, in bytes.
        round_length: Number of steps in which every view occurs once.
    """

    x: dict[Against, Floats]
    limits: dict[Against, tuple[float, float]]
    phases: list[tuple[str, slice]]
    terms: dict[int, dict[str, Floats]]
    relative: dict[int, Floats]
    mean_relative: Floats
    memory: Floats
    device_memory: Floats
    round_length: int

    def bin_width(self, against: Against) -> float:
        """Return the width of an axis's bins, as a difference of natural logarithms."""
        low, high = self.limits[against]
        return (math.log(high) - math.log(low)) / BINS


def history_of(report: dict[str, Any]) -> History:
    """Return the history of a report, which may be empty."""
    records = report["history"]
    scales = sorted({int(scale) for record in records for scale in record["scales"]})
    before = report["loss"]["before"]["scales"]
    x: dict[Against, Floats] = {"seconds": column([record["seconds"] for record in records])}
    x["steps"] = column([record["step"] for record in records])
    starts = {scale: column([(before.get(str(scale)) or {}).get("total")]) for scale in scales}
    phases: list[tuple[str, slice]] = []
    for stage, run in groupby(record["stage"] for record in records):
        start = phases[-1][1].stop if phases else 0
        phases.append((stage, slice(start, start + len(list(run)))))

    def of_scale(scale: int, term: str) -> Floats:
        return column([record["scales"].get(str(scale), {}).get(term) for record in records])

    several = [len(record["scales"]) > 1 for record in records]
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        relative = {scale: of_scale(scale, "total") / starts[scale] for scale in scales}
    moments = novel_view_moments(report)
    split = [terms for record in records for terms in record["scales"].values()]
    terms = [term for term in TERMS if any(own.get(term) for own in split)] or list(TERMS)  # those that are not 0
    return History(
        x=x,
        limits={
            against: log_limits(np.append(x[against], moment_positions(moments, against)), X_MARGIN)
            for against in AGAINST
        },
        phases=phases,
        terms={scale: {term: of_scale(scale, term) for term in terms} for scale in scales},
        relative=relative,
        mean_relative=np.where(several, column([record["relative"] for record in records]), math.nan),
        memory=column([record.get("memory_bytes") for record in records]),
        device_memory=column([record.get("device_memory_bytes") for record in records]),
        round_length=round_length(report),
    )


def round_length(report: dict[str, Any]) -> int:
    """Return the number of steps in which every view is visited once."""
    views: int = report["cameras"]["count"] - len(report["cameras"]["seeing_nothing"])
    views_per_step: int = report["settings"].get("views_per_step", 1)
    return max(1, math.ceil(views / views_per_step))


def column(values: Sequence[float | None]) -> Floats:
    """Return values as an array [n], with NaN for None."""
    return np.array([math.nan if value is None else value for value in values], dtype=np.float64)


def joined(columns: Sequence[Floats]) -> Floats:
    """Concatenate columns; the list may be empty."""
    return np.concatenate([np.empty(0), *columns])


def novel_view_moments(report: dict[str, Any]) -> list[dict[str, Any]]:
    """Return the report's measurements of novel views; empty if there are none."""
    return (report.get("novel_views") or {}).get("moments") or []


def consistency_at(moment: dict[str, Any], reach: str) -> dict[str, Any]:
    """Return a moment's consistency at a range, "short" or "long"; empty if it has none."""
    return (moment.get("consistency") or {}).get(reach) or {}


def moment_positions(moments: Sequence[dict[str, Any]], against: Against) -> Floats:
    """Return the x positions [n] of measurements."""
    return column([moment.get("seconds" if against == "seconds" else "step") for moment in moments])


# --- logarithmic axes ----------------------------------------------------------------------------------------------


def drawable(values: Floats) -> NDArray[np.bool_]:
    """Return the mask [n] bool of the values that a logarithmic axis can show."""
    return np.isfinite(values) & (values >= _MIN) & (values <= _MAX)


def log_limits(values: Floats, margin: float) -> tuple[float, float]:
    """Return the limits of a logarithmic axis that shows the values; arbitrary limits if there is nothing to show."""
    shown = values[drawable(values)]
    if not len(shown):
        return 0.1, 1.0
    low, high = float(shown.min()), float(shown.max())
    margin = 2.0 if high < 1.0001 * low else margin
    return low / margin, high * margin


def thinned(x: Floats, values: Floats, window: int, width: float) -> Thinned:
    """Group steps into bins of equal width on a logarithmic axis, skipping values that such an axis cannot show.

    Args:
        x: Positions [n] in ascending order.
        window: Length of the running mean in steps.
        width: Width of a bin, as a difference of natural logarithms.
    """
    shown = drawable(x) & drawable(values)
    x, values = x[shown], values[shown]
    if not len(x):
        return Thinned(x, values, values, values)
    positions = np.floor(np.log(x / x[0]) / width)
    first = np.flatnonzero(np.diff(positions, prepend=-1.0))
    count = np.diff(first, append=len(x))

    def mean(numbers: Floats) -> Floats:
        return np.exp(np.add.reduceat(np.log(numbers), first) / count)

    low, high = np.minimum.reduceat(values, first), np.maximum.reduceat(values, first)
    return Thinned(mean(x), mean(running_mean(values, window)), low, high)


def running_mean(values: Sequence[float] | Floats, window: int) -> Floats:
    """Return the geometric mean of the last `window` values at each index, or of all values so far if there are fewer.

    The last mean is that of the last window, as in `convergence.smoothed`.
    """
    logs = np.log(np.maximum(np.asarray(values, dtype=np.float64), np.finfo(np.float64).tiny))
    sums = np.concatenate([[0.0], np.cumsum(logs)])
    end = np.arange(1, len(logs) + 1)
    start = np.maximum(end - window, 0)
    means: Floats = np.exp((sums[end] - sums[start]) / (end - start))
    return means
