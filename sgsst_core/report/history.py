"""A report's history as columns of numbers, and what charts make of them: running means, places of an axis."""

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
#: An axis has so many places for points, less than a point of print apart; steps that share one are drawn as one.
PLACES = 300
#: What logarithmic axes can show; ticks are sought some decades beyond, and float64 must hold those too.
_LEAST, _MOST = 1e-200, 1e200
#: Of the x axis: factor between its ends and the first and last step.
X_MARGIN = 1.05


@dataclass(frozen=True)
class Thinned:
    """Steps gathered into places of an axis, each array [places] float64.

    Attributes:
        x: geometric mean of the place's steps.
        mean: geometric mean of their running means.
        low, high: least and most of their values.
    """

    x: Floats
    mean: Floats
    low: Floats
    high: Floats


@dataclass(frozen=True)
class History:
    """A report's history by column, each array [steps] float64, NaN where there is no value.

    Attributes:
        x: seconds and steps so far.
        limits: first and last place of either axis, those of the novel moments included.
        phases: runs of equal stages, by name.
        terms: what the loss of a scale is the sum of.
        relative: loss of a scale over that of the unstylized scene.
        mean_relative: the same of the mean of the scales; NaN where a step is on one scale alone.
        memory: bytes that the process held.
        device_memory: most bytes that its tensors had held on the GPU.
        round_length: steps in which every view comes once.
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

    def place_width(self, against: Against) -> float:
        """Of one of an axis's places, as a difference of natural logarithms."""
        low, high = self.limits[against]
        return (math.log(high) - math.log(low)) / PLACES


def history_of(report: dict[str, Any]) -> History:
    """The history of a report, which may be empty."""
    records = report["history"]
    scales = sorted({int(scale) for record in records for scale in record["scales"]})
    before = report["loss"]["before"]["scales"]
    x: dict[Against, Floats] = {"seconds": column([record["seconds"] for record in records])}
    x["steps"] = column([record["step"] for record in records])
    starts = {scale: column([(before.get(str(scale)) or {}).get("total")]) for scale in scales}
    several = [len(record["scales"]) > 1 for record in records]
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        relative = {scale: _of_scale(records, scale, "total") / starts[scale] for scale in scales}
    moments = novel_view_moments(report)
    terms = _terms_there(records)
    return History(
        x=x,
        limits={
            against: log_limits(np.append(x[against], moment_places(moments, against)), X_MARGIN) for against in AGAINST
        },
        phases=_phases([record["stage"] for record in records]),
        terms={scale: {term: _of_scale(records, scale, term) for term in terms} for scale in scales},
        relative=relative,
        mean_relative=np.where(several, column([record["relative"] for record in records]), math.nan),
        memory=column([record.get("memory_bytes") for record in records]),
        device_memory=column([record.get("device_memory_bytes") for record in records]),
        round_length=max(1, report["cameras"]["count"] - len(report["cameras"]["seeing_nothing"])),
    )


def column(values: Sequence[float | None]) -> Floats:
    """Values as an array [n], NaN where there is none."""
    return np.array([math.nan if value is None else value for value in values], dtype=np.float64)


def joined(columns: Sequence[Floats]) -> Floats:
    """All values of some columns, of which there may be none."""
    return np.concatenate([np.empty(0), *columns])


def novel_view_moments(report: dict[str, Any]) -> list[dict[str, Any]]:
    """The report's measurements of novel views; none where there are none."""
    return (report.get("novel_views") or {}).get("moments") or []


def moment_places(moments: Sequence[dict[str, Any]], against: Against) -> Floats:
    """Where moments lie on an x axis, [n]."""
    return column([moment.get("seconds" if against == "seconds" else "step") for moment in moments])


def _terms_there(records: Sequence[dict[str, Any]]) -> list[str]:
    """Terms of which a record's loss has any; all where none has."""
    split = [terms for record in records for terms in record["scales"].values()]
    return [term for term in TERMS if any(terms.get(term) for terms in split)] or list(TERMS)


def _of_scale(records: Sequence[dict[str, Any]], scale: int, term: str) -> Floats:
    return column([record["scales"].get(str(scale), {}).get(term) for record in records])


def _phases(stages: Sequence[str]) -> list[tuple[str, slice]]:
    phases, start = [], 0
    for stage, run in groupby(stages):
        end = start + sum(1 for _ in run)
        phases.append((stage, slice(start, end)))
        start = end
    return phases


# --- logarithmic axes ----------------------------------------------------------------------------------------------


def drawable(values: Floats) -> NDArray[np.bool_]:
    """Where a logarithmic axis has a place for a value."""
    return np.isfinite(values) & (values >= _LEAST) & (values <= _MOST)


def log_limits(values: Floats, margin: float) -> tuple[float, float]:
    """Ends of a logarithmic axis that shows the values; any two where there is nothing to show."""
    shown = values[drawable(values)]
    if not len(shown):
        return 0.1, 1.0
    low, high = float(shown.min()), float(shown.max())
    margin = 2.0 if high < 1.0001 * low else margin
    return low / margin, high * margin


def thinned(x: Floats, values: Floats, window: int, width: float) -> Thinned:
    """Gather steps into places that are equally wide on a logarithmic axis; what such an axis cannot show is left out.

    Args:
        x: [n] in ascending order.
        values: [n].
        window: steps of the running mean.
        width: of a place, as a difference of natural logarithms.
    """
    shown = drawable(x) & drawable(values)
    x, values = x[shown], values[shown]
    if not len(x):
        return Thinned(x, values, values, values)
    places = np.floor(np.log(x / x[0]) / width)
    first = np.flatnonzero(np.diff(places, prepend=-1.0))
    count = np.diff(first, append=len(x))

    def mean(numbers: Floats) -> Floats:
        return np.exp(np.add.reduceat(np.log(numbers), first) / count)

    low, high = np.minimum.reduceat(values, first), np.maximum.reduceat(values, first)
    return Thinned(mean(x), mean(running_mean(values, window)), low, high)


def running_mean(values: Sequence[float] | Floats, window: int) -> Floats:
    """Geometric mean of the `window` values around each place, of fewer toward the ends."""
    logs = np.log(np.maximum(np.asarray(values, dtype=np.float64), np.finfo(np.float64).tiny))
    sums = np.concatenate([[0.0], np.cumsum(logs)])
    places = np.arange(len(logs))
    reach = np.minimum(np.minimum(places, places[::-1]), window // 2)
    means: Floats = np.exp((sums[places + reach + 1] - sums[places - reach]) / (2 * reach + 1))
    return means
