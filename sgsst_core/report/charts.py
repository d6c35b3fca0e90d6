"""Drawing of charts: common style, logarithmic axes with plain numbers, and the loss chart."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import matplotlib
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, MaxNLocator, NullFormatter, NullLocator

from sgsst_core.files.atomic import atomic_path
from sgsst_core.report.history import (
    Against,
    Floats,
    History,
    column,
    drawable,
    history_of,
    joined,
    log_limits,
    moment_positions,
    novel_view_moments,
    thinned,
)
from sgsst_core.report.palette import GRID, INK, color_of

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
_PHASE_NAMES = {"coarse": "coarsest scale", "sos": "all scales"}


def draw_loss(figure: Figure, against: Against, history: History, moments: Sequence[dict[str, Any]]) -> None:
    """Draw the loss of each scale and their mean, relative to the start, and the Gram distance of novel views.

    Lines are running means over one round of views, with the range of the values shaded behind.
    """
    axes = figure.subplots()
    mark_phases(axes, history, against)
    lines = [(scale_name(scale), values, color_of(scale)) for scale, values in history.relative.items()]
    if len(lines) > 1:
        lines.append(("mean", history.mean_relative, INK))
    for label, values, color in lines:
        draw_line(axes, history, against, values, color, label)
    x, gram = moment_positions(moments, against), column([moment.get("gram_relative") for moment in moments])
    shown = drawable(x) & drawable(gram)
    label = "Gram distance, novel views"
    draw_points(axes, x[shown], gram[shown], marker="D", linestyle="", color=INK, markerfacecolor="none", label=label)
    set_log_x(axes, history.limits[against], against)
    set_log_y(axes, [*(values for _, values, _ in lines), gram[shown]])
    axes.set_ylabel(RELATIVE_LOSS)
    draw_legend(figure)


def write_loss_chart(path: Path, report: dict[str, Any]) -> None:
    """Write the chart of the loss against seconds as a PNG.

    Args:
        report: Report from `build_report`; its history may be empty.
    """
    with png_chart(path, (8, 4.8), dpi=120) as figure:
        draw_loss(figure, "seconds", history_of(report), novel_view_moments(report))


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


def draw_line(axes: Axes, history: History, against: Against, values: Floats, color: str, label: str) -> None:
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


def mark_phases(axes: Axes, history: History, against: Against) -> None:
    """Label the phases above the axes, the first at its start and the last at its end, with lines between them."""
    transform = axes.get_xaxis_transform()
    borders = [history.limits[against][0]]
    for _, part in history.phases[1:]:
        borders.append(max(float(history.x[against][part.start - 1]), borders[0]))
        axes.axvline(borders[-1], color=INK, linewidth=0.8, linestyle=":")
    borders.append(history.limits[against][1])
    last = len(history.phases) - 1
    for index, (stage, _) in enumerate(history.phases):
        start, end = borders[index], borders[index + 1]
        place, side = (start, "left") if index == 0 else (end, "right")
        if 0 < index < last:
            place, side = math.sqrt(start) * math.sqrt(end), "center"
        name = _PHASE_NAMES.get(stage, stage)
        axes.text(place, 1.02, name, transform=transform, ha=side, fontsize=8.5, parse_math=False)


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
