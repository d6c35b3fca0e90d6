"""Chart of a report: its losses as columns, with running means on logarithmic axes, as PNG and as SVG."""

from __future__ import annotations

import io
import math
import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import matplotlib
import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, MaxNLocator, NullFormatter, NullLocator
from numpy.typing import NDArray

from sgsst_core.files.atomic import atomic_path
from sgsst_core.report.images import GRID, INK, color_of

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
#: Style of all charts, for `matplotlib.rc_context`.
STYLE: dict[Any, Any] = {
    "svg.fonttype": "none",
    "svg.hashsalt": "report",
    "font.sans-serif": ["DejaVu Sans"],
    "font.size": 9.5,
    "text.color": INK,
    "axes.labelcolor": INK,
    "axes.edgecolor": INK,
    "axes.titlesize": 9.5,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "grid.color": GRID,
    "grid.alpha": 0.25,
    "grid.linewidth": 0.6,
    "xtick.color": INK,
    "ytick.color": INK,
    "legend.frameon": False,
}
#: Label of the y axis of loss charts.
RELATIVE_LOSS = "loss, relative to the unstylized scene"
#: Size in inches. At this width, text is legible on a phone.
_SIZE = (5.6, 3.5)


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
        limits: Limits of each x axis.
        phases: Title and slice of the steps of both phases, which may be empty.
        relative: Loss by scale, relative to the unstylized scene.
        mean_relative: Mean over scales, relative to the unstylized scene; NaN for steps on a single scale.
        round_length: Number of steps in which every view occurs once.
    """

    x: dict[Against, Floats]
    limits: dict[Against, tuple[float, float]]
    phases: list[tuple[str, slice]]
    relative: dict[int, Floats]
    mean_relative: Floats
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
    coarse = sum(record["stage"] == "coarse" for record in records)
    losses = {
        scale: column([record["scales"].get(str(scale), {}).get("total") for record in records]) for scale in scales
    }
    several = [len(record["scales"]) > 1 for record in records]
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        relative = {scale: losses[scale] / starts[scale] for scale in scales}
    return History(
        x=x,
        limits={against: log_limits(x[against], X_MARGIN) for against in AGAINST},
        phases=[("coarsest scale", slice(0, coarse)), ("all scales", slice(coarse, len(records)))],
        relative=relative,
        mean_relative=np.where(several, column([record["relative"] for record in records]), math.nan),
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


def _drawable(values: Floats) -> NDArray[np.bool_]:
    """Return the mask [n] bool of the values that a logarithmic axis can show."""
    return np.isfinite(values) & (values >= _MIN) & (values <= _MAX)


def log_limits(values: Floats, margin: float) -> tuple[float, float]:
    """Return the limits of a logarithmic axis that shows the values; arbitrary limits if there is nothing to show."""
    shown = values[_drawable(values)]
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
    shown = _drawable(x) & _drawable(values)
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

    The last mean is that of the last window, as in `scales.smoothed`.
    """
    logs = np.log(np.maximum(np.asarray(values, dtype=np.float64), np.finfo(np.float64).tiny))
    sums = np.concatenate([[0.0], np.cumsum(logs)])
    end = np.arange(1, len(logs) + 1)
    start = np.maximum(end - window, 0)
    means: Floats = np.exp((sums[end] - sums[start]) / (end - start))
    return means


def _draw_loss(figure: Figure, against: Against, history: History) -> None:
    """Draw the loss of each scale and their mean, relative to the start.

    Lines are running means over one round of views, with the range of the values shaded behind.
    """
    axes = figure.subplots()
    _mark_phases(axes, history, against)
    lines = [(scale_name(scale), values, color_of(scale)) for scale, values in history.relative.items()]
    if len(lines) > 1:
        lines.append(("mean", history.mean_relative, INK))
    for label, values, color in lines:
        _draw_line(axes, history, against, values, color, label)
    set_log_x(axes, history.limits[against], against)
    set_log_y(axes, [values for _, values, _ in lines])
    axes.set_ylabel(RELATIVE_LOSS)
    draw_legend(figure)


def write_loss_chart(path: Path, report: dict[str, Any]) -> None:
    """Write the chart of the loss against seconds as a PNG.

    Args:
        report: Report from `build_report`; its history may be empty.
    """
    with png_chart(path, (8, 4.8), dpi=120) as figure:
        _draw_loss(figure, "seconds", history_of(report))


@contextmanager
def png_chart(path: Path, size: tuple[float, float], dpi: int = 110) -> Iterator[Figure]:
    """Provide a figure of a size in inches to a `with` block, and write it as a PNG afterwards."""
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=size, dpi=dpi, layout="constrained")
        yield figure
        with atomic_path(path) as temporary:
            figure.savefig(temporary, format="png")


def scale_name(scale: int) -> str:
    """Return the display name of a scale."""
    return f"scale {scale} (1/{1 << scale})" if scale else "scale 0 (full size)"


def _draw_line(axes: Axes, history: History, against: Against, values: Floats, color: str, label: str) -> None:
    """Draw the running mean of values [steps] over one round of views, phase by phase, with their range shaded."""
    for _, part in history.phases:
        line = thinned(history.x[against][part], values[part], history.round_length, history.bin_width(against))
        if not len(line.x):
            continue
        axes.fill_between(line.x, line.low, line.high, color=color, alpha=0.18, linewidth=0.7)
        axes.plot(line.x, line.mean, color=color, label=label, marker="o" if len(line.x) == 1 else None)
        label = "_"  # one legend entry for all phases: matplotlib skips labels that start with an underscore


def draw_points(axes: Axes, x: Floats, values: Floats, **options: Any) -> None:
    """Draw points [n] that may lie on the border of the axes; do nothing if `x` is empty.

    matplotlib's layout would extend an empty, unclipped line to the corner of the figure.
    """
    if len(x):
        axes.plot(x, values, clip_on=False, **options)


def _mark_phases(axes: Axes, history: History, against: Against) -> None:
    """Label the first phase above the start of the axes and the second one above the end, with a line between them."""
    low, _ = history.limits[against]
    sides: tuple[Literal["left", "right"], ...] = ("left", "right")
    for (title, part), side in zip(history.phases, sides, strict=True):
        if part.start < part.stop:
            axes.set_title(title, loc=side)
            if part.start:
                end = max(float(history.x[against][part.start - 1]), low)
                axes.axvline(end, color=INK, linewidth=0.8, linestyle=":")


def set_log_x(axes: Axes, limits: tuple[float, float], label: str) -> None:
    """Make the x axis logarithmic."""
    axes.set_xscale("log")
    axes.set_xlim(*limits)
    axes.set_xlabel(label)
    _set_ticks(axes.xaxis, limits)


def set_log_y(axes: Axes, drawn: Sequence[Floats]) -> None:
    """Make the y axis logarithmic, with limits that include all drawn arrays [n]."""
    limits = log_limits(joined(drawn), 1.2)
    axes.set_yscale("log")
    axes.set_ylim(*limits)
    _set_ticks(axes.yaxis, limits)


def _set_ticks(axis: Axis, limits: tuple[float, float]) -> None:
    """Set ticks with plain numbers: at decades, also at 2 and 5 if decades are few, and linearly within one decade."""
    decades = math.log10(limits[1]) - math.log10(limits[0])
    axis.set_minor_locator(NullLocator())
    if decades < 0.8:
        axis.set_major_locator(MaxNLocator(4))
    else:
        axis.set_major_locator(LogLocator(subs=(1, 2, 5) if decades < 2.2 else (1,), numticks=8))
        axis.set_minor_locator(LogLocator(subs="auto", numticks=8))
    axis.set_major_formatter(FuncFormatter(lambda value, _: re.sub(r"e\+?(-?)0*", r"e\1", f"{value:g}")))
    axis.set_minor_formatter(NullFormatter())


def draw_legend(figure: Figure, in_row: int = 3) -> None:
    """Draw a legend below the figure, with each label once; do nothing if there are no labels."""
    named: dict[str, Artist] = {}
    for axes in figure.axes:
        for handle, label in zip(*axes.get_legend_handles_labels(), strict=True):
            named.setdefault(label, handle)
    if named:
        figure.legend(named.values(), named.keys(), loc="outside lower center", ncols=min(len(named), in_row))


def draw_figure(report: dict[str, Any]) -> tuple[str, dict[Against, bytes]]:
    """Draw the chart of a report.

    Returns:
        Caption, and an SVG image by quantity of the x axis, all of the same size; none if no step was made.
    """
    if not report["history"]:
        return "", {}
    history = history_of(report)
    losses = column([terms["total"] for record in report["history"] for terms in record["scales"].values()])
    undrawn, caption = int((~_drawable(losses)).sum()), "Loss, divided by that of the unstylized scene."
    if undrawn:  # a logarithmic axis cannot show them
        caption += f" Not shown: {undrawn:,} of {len(losses):,} values, which are zero or not finite."
    svg = {}
    for against in AGAINST:
        with matplotlib.rc_context(STYLE):
            figure = Figure(figsize=_SIZE, layout="constrained")
            _draw_loss(figure, against, history)
            file = io.BytesIO()
            figure.savefig(file, format="svg", transparent=True, metadata={"Date": None})
            svg[against] = file.getvalue()
    return caption, svg
