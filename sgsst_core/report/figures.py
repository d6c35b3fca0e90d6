"""A report's curves as SVG, against seconds and against steps, to be put into its page.

Colours are written as CSS variables with the printed colour as fallback (`var(--c-222222, #222222)`), so that a page
can give others to a dark screen; text takes the page's font.
"""

from __future__ import annotations

import io
import math
import re
import xml.etree.ElementTree as ElementTree
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import groupby
from typing import Any, Literal

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.axis import Axis as MatplotlibAxis
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, MaxNLocator, NullFormatter, NullLocator
from numpy.typing import NDArray

from sgsst_core.report.document import running_mean

Against = Literal["seconds", "steps"]
AGAINST: tuple[Against, ...] = ("seconds", "steps")
#: An axis has so many places for points, less than a point of print apart; steps that share one are drawn as one.
PLACES = 300
#: What a scale's loss is the sum of.
TERMS = ("gram", "mean", "std", "content")

INK, GRID = "#222222", "#888888"
COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9")
#: Inches; at this width the text is legible on a phone, and two figures stand side by side on a desk.
_WIDTH, _HEIGHT = 5.6, 3.5
#: What logarithmic axes can show; ticks are sought some decades beyond, and float64 must hold those too.
_LEAST, _MOST = 1e-200, 1e200
#: Of the x axis: factor between its ends and the first and last step.
_MARGIN = 1.05
_STYLE: dict[Any, Any] = {
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


@dataclass(frozen=True)
class PageFigure:
    """One figure of the page.

    Attributes:
        name: for identifiers; lower-case letters.
        title, caption: text, not HTML.
        svg: an <svg> element for each x axis.
    """

    name: str
    title: str
    caption: str
    svg: dict[Against, str]


@dataclass(frozen=True)
class Thinned:
    """Steps gathered into places of an axis, each array [places] float64.

    Attributes:
        x: geometric mean of the place's steps.
        mean: geometric mean of their running means.
        low, high: least and most of their values.
    """

    x: NDArray[np.float64]
    mean: NDArray[np.float64]
    low: NDArray[np.float64]
    high: NDArray[np.float64]


@dataclass(frozen=True)
class Columns:
    """A report's history by column, each array [steps] float64, NaN where there is no value.

    Attributes:
        x: seconds and steps so far.
        limits: first and last place of either axis, those of the held-out moments included.
        phases: runs of equal stages, by name.
        terms: what the loss of a scale is the sum of.
        relative: loss of a scale over that of the unstylized scene.
        mean_relative: the same of the mean of the scales; NaN where a step is on one scale alone.
        memory: bytes.
        round_length: steps in which every view comes once.
    """

    x: dict[Against, NDArray[np.float64]]
    limits: dict[Against, tuple[float, float]]
    phases: list[tuple[str, slice]]
    terms: dict[int, dict[str, NDArray[np.float64]]]
    relative: dict[int, NDArray[np.float64]]
    mean_relative: NDArray[np.float64]
    memory: NDArray[np.float64]
    round_length: int


def draw_figures(report: dict[str, Any]) -> list[PageFigure]:
    """The figures for which a report has values; none where no step was made."""
    if not report["history"]:
        return []
    columns = _columns(report)
    moments = (report.get("held_out") or {}).get("moments") or []
    probes = (report.get("approximations") or {}).get("moments") or []
    figures = [
        _figure(
            "loss",
            "Loss, relative to the start",
            "Loss over that of the unstylized scene." + _undrawn(report),
            partial(_draw_loss, columns=columns, moments=moments),
        ),
        _figure(
            "split",
            "What the loss is made of",
            "Style (Gram matrix, mean, standard deviation) and content, at each scale.",
            partial(_draw_split, columns=columns),
            rows=math.ceil(len(columns.terms) / 2),
        ),
    ]
    if any(_known(_consistency(moments, reach, metric)[1:]) for reach in _REACHES for metric in _METRICS):
        caption = (
            "What a view and another one, warped into it, differ by. Dashed: the unstylized scene, "
            "whose views differ by highlights, too."
        )
        draw = partial(_draw_consistency, columns=columns, moments=moments)
        figures.append(_figure("consistency", "Consistency of held-out views", caption, draw))
    if _drawable(_column([probe.get("relative_error") for probe in probes])).any():
        caption = "Norm of the difference of the gradients over that of the exact one, on a sampled view."
        draw = partial(_draw_approximations, columns=columns, probes=probes)
        figures.append(_figure("approximations", "Error of the approximated gradient", caption, draw))
    if np.isfinite(columns.memory).any():
        predicted = ((report.get("plan") or {}).get("prediction") or {}).get("peak_bytes")
        draw = partial(_draw_memory, columns=columns, predicted=predicted)
        figures.append(_figure("memory", "Memory", "Held by the process.", draw))
    return figures


def thinned(x: NDArray[np.float64], values: NDArray[np.float64], window: int, width: float) -> Thinned:
    """Gather steps into places that are equally wide on a logarithmic axis; what such an axis cannot show is left out.

    Args:
        x: [n] in ascending order.
        values: [n].
        window: steps of the running mean.
        width: of a place, as a difference of natural logarithms.
    """
    shown = _drawable(x) & _drawable(values)
    x, values = x[shown], values[shown]
    if not len(x):
        return Thinned(x, values, values, values)
    places = np.floor(np.log(x / x[0]) / width)
    first = np.flatnonzero(np.diff(places, prepend=-1.0))
    count = np.diff(first, append=len(x))

    def mean(numbers: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.exp(np.add.reduceat(np.log(numbers), first) / count)

    low, high = np.minimum.reduceat(values, first), np.maximum.reduceat(values, first)
    return Thinned(mean(x), mean(running_mean(values.tolist(), window)), low, high)


# --- the report's values -------------------------------------------------------------------------------------------

_REACHES = {"short": COLOURS[0], "long": COLOURS[1]}
_METRICS = {"rmse": "RMSE", "lpips": "LPIPS"}


def _columns(report: dict[str, Any]) -> Columns:
    history = report["history"]
    scales = sorted({int(scale) for record in history for scale in record["scales"]})
    before = report["loss"]["before"]["scales"]
    x = {"seconds": _column([record["seconds"] for record in history])}
    x["steps"] = _column([record["step"] for record in history])
    starts = {scale: _column([(before.get(str(scale)) or {}).get("total")]) for scale in scales}
    several = [len(record["scales"]) > 1 for record in history]
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        relative = {scale: _of_scale(history, scale, "total") / starts[scale] for scale in scales}
    moments = (report.get("held_out") or {}).get("moments") or []
    return Columns(
        x={against: x[against] for against in AGAINST},
        limits={
            against: _limits(np.append(x[against], _moment_places(moments, against)), _MARGIN) for against in AGAINST
        },
        phases=_phases([record["stage"] for record in history]),
        terms={scale: {term: _of_scale(history, scale, term) for term in TERMS} for scale in scales},
        relative=relative,
        mean_relative=np.where(several, _column([record["relative"] for record in history]), math.nan),
        memory=_column([record.get("memory_bytes") for record in history]),
        round_length=max(1, report["cameras"]["count"] - len(report["cameras"]["seeing_nothing"])),
    )


def _column(values: Sequence[float | None]) -> NDArray[np.float64]:
    return np.array([math.nan if value is None else value for value in values], dtype=np.float64)


def _of_scale(history: Sequence[dict[str, Any]], scale: int, term: str) -> NDArray[np.float64]:
    return _column([record["scales"].get(str(scale), {}).get(term) for record in history])


def _phases(stages: Sequence[str]) -> list[tuple[str, slice]]:
    phases, start = [], 0
    for stage, run in groupby(stages):
        end = start + sum(1 for _ in run)
        phases.append((stage, slice(start, end)))
        start = end
    return phases


def _moment_places(moments: Sequence[dict[str, Any]], against: Against) -> NDArray[np.float64]:
    return _column([moment.get("seconds" if against == "seconds" else "step") for moment in moments])


def _consistency(moments: Sequence[dict[str, Any]], reach: str, metric: str) -> list[float | None]:
    found = [((moment.get("consistency") or {}).get(reach) or {}).get(metric) for moment in moments]
    return [value if value is None or math.isfinite(value) else None for value in found]


def _known(values: Sequence[float | None]) -> bool:
    return any(value is not None for value in values)


def _drawable(values: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Where a logarithmic axis has a place for a value."""
    return np.isfinite(values) & (values >= _LEAST) & (values <= _MOST)


def _limits(values: NDArray[np.float64], margin: float) -> tuple[float, float]:
    """Ends of a logarithmic axis that shows the values; any two where there is nothing to show."""
    shown = values[_drawable(values)]
    if not len(shown):
        return 0.1, 1.0
    low, high = float(shown.min()), float(shown.max())
    margin = 2.0 if high < 1.0001 * low else margin
    return low / margin, high * margin


def _undrawn(report: dict[str, Any]) -> str:
    """A sentence about losses that a logarithmic axis cannot show."""
    losses = _column([terms["total"] for record in report["history"] for terms in record["scales"].values()])
    count = int((~_drawable(losses)).sum())
    return f" Not drawn: {count:,} of {len(losses):,} values, which are zero or not finite." if count else ""


# --- drawing -------------------------------------------------------------------------------------------------------


def _figure(name: str, title: str, caption: str, draw: Callable[[Figure, Against], None], rows: int = 1) -> PageFigure:
    """Draw a figure once for each x axis, at one size: the page does not move when one takes the other's place."""
    svg = {}
    for against in AGAINST:
        with matplotlib.rc_context(_STYLE):
            figure = Figure(figsize=(_WIDTH, _HEIGHT + 2.0 * (rows - 1)), layout="constrained")
            draw(figure, against)
            label = f"{title}, against {against}"
            svg[against] = _inline(figure, f"{name}-{against}", label)
    return PageFigure(name, title, caption, svg)


def _draw_loss(figure: Figure, against: Against, columns: Columns, moments: Sequence[dict[str, Any]]) -> None:
    axes = figure.subplots()
    _mark_phases(axes, columns, against)
    lines = [(_scale_name(scale), values, COLOURS[scale % len(COLOURS)]) for scale, values in columns.relative.items()]
    if len(lines) > 1:
        lines.append(("mean", columns.mean_relative, INK))
    for label, values, colour in lines:
        _draw_line(axes, columns, against, values, colour, label)
    x, gram = _moment_places(moments, against), _column([moment.get("gram_relative") for moment in moments])
    shown = _drawable(x) & _drawable(gram)
    if shown.any():
        axes.plot(
            x[shown],
            gram[shown],
            "D",
            color=INK,
            markerfacecolor="none",
            clip_on=False,
            label="Gram distance, held-out views",
        )
    _finish_x(axes, columns, against)
    _finish_log_y(axes, [*(values for _, values, _ in lines), gram[shown]])
    _legend(figure, axes)


def _draw_split(figure: Figure, against: Against, columns: Columns) -> None:
    count = len(columns.terms)
    grid = list(figure.subplots(math.ceil(count / 2), min(count, 2), sharey=True, squeeze=False).flat)
    everything = [values for terms in columns.terms.values() for values in terms.values()]
    for axes, (scale, terms) in zip(grid, columns.terms.items(), strict=False):
        # Where the coarsest scale went first, the others would be a sliver at the end of its axis.
        there = columns.x[against][~np.isnan(terms["gram"])]
        own = replace(columns, limits={**columns.limits, against: _limits(there, _MARGIN)})
        for (term, values), colour in zip(terms.items(), COLOURS, strict=False):
            _draw_line(axes, own, against, values, colour, term)
        axes.set_title(_scale_name(scale))
        _finish_x(axes, own, against)
        _finish_log_y(axes, everything)
    for axes in grid[: max(count - 2, 0)]:  # another panel stands below
        axes.set_xlabel("")
    for axes in grid[count:]:
        axes.set_visible(False)
    _legend(figure, grid[0], in_row=len(TERMS))


def _draw_consistency(figure: Figure, against: Against, columns: Columns, moments: Sequence[dict[str, Any]]) -> None:
    metrics = [metric for metric in _METRICS if any(_known(_consistency(moments, reach, metric)) for reach in _REACHES)]
    x = _moment_places(moments, against)
    panels = figure.subplots(1, len(metrics), squeeze=False)[0]
    for axes, metric in zip(panels, metrics, strict=True):
        for reach, colour in _REACHES.items():
            values = _column(_consistency(moments, reach, metric))
            shown = _drawable(x) & np.isfinite(values)
            label = _reach_name(moments, reach)
            axes.plot(x[shown], values[shown], "o-", markersize=4, color=colour, clip_on=False, label=label)
            if moments[0].get("step") == 0 and np.isfinite(values[0]):
                axes.axhline(values[0], color=colour, linestyle="--", linewidth=1)
        axes.set_title(_METRICS[metric])
        axes.set_ylim(bottom=0)
        _finish_x(axes, columns, against)
    _legend(figure, panels[0])


def _draw_approximations(figure: Figure, against: Against, columns: Columns, probes: Sequence[dict[str, Any]]) -> None:
    axes = figure.subplots()
    steps = _column([probe.get("step") for probe in probes])
    # The probes' own seconds are those of one gradient: when they were made is known from their steps.
    x = steps if against == "steps" else np.interp(steps, columns.x["steps"], columns.x["seconds"])
    errors = _column([probe.get("relative_error") for probe in probes])
    shown = _drawable(x) & _drawable(errors)
    axes.plot(x[shown], errors[shown], "o-", markersize=4, color=COLOURS[0], clip_on=False)
    _finish_x(axes, columns, against)
    _finish_log_y(axes, [errors])
    axes.set_ylabel("relative error")


def _draw_memory(figure: Figure, against: Against, columns: Columns, predicted: float | None) -> None:
    axes = figure.subplots()
    # Every step stands alone: of memory, the most in a place is what matters, not a mean over a round.
    line = thinned(columns.x[against], columns.memory / 1e9, 1, _place_width(columns, against))
    axes.plot(line.x, line.high, color=COLOURS[0], marker="o" if len(line.x) == 1 else None, label="measured")
    if predicted is not None and math.isfinite(predicted):
        axes.axhline(predicted / 1e9, color=INK, linestyle="--", linewidth=1, label="peak that the plan predicted")
    axes.set_ylim(bottom=0)
    axes.set_ylabel("GB")
    _mark_phases(axes, columns, against)
    _finish_x(axes, columns, against)
    _legend(figure, axes)


def _draw_line(
    axes: Axes, columns: Columns, against: Against, values: NDArray[np.float64], colour: str, label: str
) -> None:
    """A running mean over one round of views, phase by phase, and behind it the range of the values."""
    for _, part in columns.phases:
        line = thinned(columns.x[against][part], values[part], columns.round_length, _place_width(columns, against))
        if not len(line.x):
            continue
        axes.fill_between(line.x, line.low, line.high, color=colour, alpha=0.18, linewidth=0.7)
        axes.plot(line.x, line.mean, color=colour, label=label, marker="o" if len(line.x) == 1 else None)
        label = "_"  # one legend entry for all phases; matplotlib leaves out names that begin so


def _scale_name(scale: int) -> str:
    return f"scale {scale} (1/{1 << scale})" if scale else "scale 0 (full size)"


def _reach_name(moments: Sequence[dict[str, Any]], reach: str) -> str:
    gaps = [((moment.get("consistency") or {}).get(reach) or {}).get("gap") for moment in moments]
    gap = next((gap for gap in gaps if gap is not None), None)
    return f"{reach} range" if gap is None else f"{reach} range ({gap} view{'s' if gap > 1 else ''} apart)"


def _place_width(columns: Columns, against: Against) -> float:
    low, high = columns.limits[against]
    return (math.log(high) - math.log(low)) / PLACES


_PHASE_NAMES = {"coarse": "coarsest scale", "sos": "all scales"}


def _mark_phases(axes: Axes, columns: Columns, against: Against) -> None:
    """Name the phases above the axes, the first from its start and the last to its end, and divide them by lines."""
    transform = axes.get_xaxis_transform()
    borders = [columns.limits[against][0]]
    for _, part in columns.phases[1:]:
        borders.append(max(float(columns.x[against][part.start - 1]), borders[0]))
        axes.axvline(borders[-1], color=INK, linewidth=0.8, linestyle=":")
    borders.append(columns.limits[against][1])
    last = len(columns.phases) - 1
    for index, (stage, _) in enumerate(columns.phases):
        start, end = borders[index], borders[index + 1]
        place, side = (start, "left") if index == 0 else (end, "right")
        if 0 < index < last:
            place, side = math.sqrt(start) * math.sqrt(end), "center"
        name = _PHASE_NAMES.get(stage, stage)
        axes.text(place, 1.02, name, transform=transform, ha=side, fontsize=8.5, parse_math=False)


def _finish_x(axes: Axes, columns: Columns, against: Against) -> None:
    axes.set_xscale("log")
    axes.set_xlim(*columns.limits[against])
    axes.set_xlabel(against)
    _set_ticks(axes.xaxis, columns.limits[against])


def _finish_log_y(axes: Axes, drawn: Sequence[NDArray[np.float64]]) -> None:
    limits = _limits(np.concatenate(drawn), 1.2)
    axes.set_yscale("log")
    axes.set_ylim(*limits)
    _set_ticks(axes.yaxis, limits)


def _set_ticks(axis: MatplotlibAxis, limits: tuple[float, float]) -> None:
    """Plain numbers: decades, with 2 and 5 between them where there are few, and a linear choice within a decade."""
    decades = math.log10(limits[1]) - math.log10(limits[0])
    axis.set_minor_locator(NullLocator())
    if decades < 0.8:
        axis.set_major_locator(MaxNLocator(4))
    else:
        axis.set_major_locator(LogLocator(subs=(1, 2, 5) if decades < 2.2 else (1,), numticks=8))
        axis.set_minor_locator(LogLocator(subs="auto", numticks=8))
    axis.set_major_formatter(FuncFormatter(lambda value, _: re.sub(r"e\+?(-?)0*", r"e\1", f"{value:g}")))
    axis.set_minor_formatter(NullFormatter())


def _legend(figure: Figure, axes: Axes, in_row: int = 3) -> None:
    handles, labels = axes.get_legend_handles_labels()
    if handles:
        figure.legend(handles, labels, loc="outside lower center", ncols=min(len(handles), in_row))


# --- SVG -----------------------------------------------------------------------------------------------------------

_NAMESPACE = re.compile(r"\{[^}]*\}")
_COLOUR = re.compile(r"(fill|stroke): #([0-9a-f]{6})")
_REFERENCE = re.compile(r"url\(#([^)]+)\)")
_FAMILY = re.compile(r"font-family: [^;]*;?")
_LONG_DECIMAL = re.compile(r"(\.\d\d)\d+")


def _inline(figure: Figure, name: str, label: str) -> str:
    """A figure as an <svg> element that shares a page with others: identifiers are its own, styles do not leak."""
    file = io.BytesIO()
    metadata = dict.fromkeys(("Date", "Creator", "Format", "Type"))  # of no use here, and it names other servers
    figure.savefig(file, format="svg", transparent=True, metadata=metadata)
    root = ElementTree.fromstring(file.getvalue())
    for parent in root.iter():
        for child in list(parent):
            if _NAMESPACE.sub("", child.tag) == "style":  # it would hold for the whole page
                parent.remove(child)
    used = _references(root)
    for element in root.iter():
        element.tag = _NAMESPACE.sub("", element.tag)
        element.attrib = {
            key: value
            for key, value in (_rewritten(*item, name) for item in element.attrib.items())
            if key != "id" or value.removeprefix(f"{name}-") in used
        }
    root.attrib = {"viewBox": root.attrib["viewBox"], "role": "img", "aria-label": label}
    return ElementTree.tostring(root, encoding="unicode")


def _references(root: ElementTree.Element) -> set[str]:
    used = set()
    for element in root.iter():
        for key, value in element.attrib.items():
            if _NAMESPACE.sub("", key) == "href":
                used.add(value.removeprefix("#"))
            used.update(_REFERENCE.findall(value))
    return used


def _rewritten(key: str, value: str, name: str) -> tuple[str, str]:
    """An attribute without its namespace; identifiers with the figure's name, coordinates to hundredths of a point."""
    key = _NAMESPACE.sub("", key)
    if key == "id":
        return key, f"{name}-{value}"
    if key == "href":
        return key, f"#{name}-{value.removeprefix('#')}"
    value = _REFERENCE.sub(rf"url(#{name}-\1)", value)
    if key == "style":
        return key, _FAMILY.sub("", _COLOUR.sub(r"\1: var(--c-\2, #\2)", value))
    if key in ("d", "points"):
        value = " ".join(value.split())
    return key, _LONG_DECIMAL.sub(r"\1", value) if key in ("d", "points", "x", "y", "transform") else value
