"""Charts of the report's page as inline SVG, each against seconds and against steps.

Colors are CSS variables with the printed color as fallback (`var(--c-222222, #222222)`), so a page can replace them on
dark screens. Text uses the page's font.
"""

from __future__ import annotations

import io
import math
import re
import xml.etree.ElementTree as ElementTree
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import matplotlib
import numpy as np
from matplotlib.figure import Figure

from sgsst_core.loss.terms import TERMS
from sgsst_core.report.charts import (
    STYLE,
    draw_legend,
    draw_line,
    draw_loss,
    draw_points,
    mark_phases,
    scale_name,
    set_log_x,
    set_log_y,
)
from sgsst_core.report.history import (
    AGAINST,
    X_MARGIN,
    Against,
    Floats,
    History,
    column,
    consistency_at,
    drawable,
    history_of,
    log_limits,
    moment_positions,
    novel_view_moments,
    thinned,
)
from sgsst_core.report.palette import INK, color_of

#: Size in inches. At this width, text is legible on a phone, and two charts fit side by side on a desktop screen.
_WIDTH, _HEIGHT = 5.6, 3.5
_REACHES = {"short": color_of(0), "long": color_of(1)}
#: Labels of the y axes of consistency; both have no unit.
_METRICS = {"rmse": "RMSE of colors, 0 to 1", "lpips": "LPIPS"}


@dataclass(frozen=True)
class PageFigure:
    """Chart of the page.

    Attributes:
        name: Prefix of element IDs in the SVG, in lower-case letters.
        svg: <svg> element by quantity of the x axis.
    """

    name: str
    title: str
    caption: str
    svg: dict[Against, str]


def draw_figures(report: dict[str, Any]) -> list[PageFigure]:
    """Draw the charts that a report has values for; return an empty list if no step was made."""
    if not report["history"]:
        return []
    history = history_of(report)
    moments = novel_view_moments(report)
    probes = (report.get("approximations") or {}).get("moments") or []
    losses = column([terms["total"] for record in report["history"] for terms in record["scales"].values()])
    undrawn, caption = int((~drawable(losses)).sum()), "Loss, divided by that of the unstylized scene."
    if undrawn:  # a logarithmic axis cannot show them
        caption += f" Not shown: {undrawn:,} of {len(losses):,} values, which are zero or not finite."
    draw: Callable[[Figure, Against], None] = partial(draw_loss, history=history, moments=moments)
    figures = [_figure("loss", "Loss, relative to the start", caption, draw)]
    caption, draw = "The loss of a scale is the sum of these terms.", partial(_draw_split, history=history)
    figures.append(_figure("split", "Terms of the loss", caption, draw, rows=math.ceil(len(history.terms) / 2)))
    if any(np.isfinite(_consistency(moments, reach, metric)[1:]).any() for reach in _REACHES for metric in _METRICS):
        caption = (
            "Difference between a view and another one that is warped into it. Dashed: the unstylized scene, "
            "whose views also differ, by highlights."
        )
        draw = partial(_draw_consistency, history=history, moments=moments)
        figures.append(_figure("consistency", "Consistency of novel views", caption, draw))
    if drawable(column([probe.get("relative_error") for probe in probes])).any():
        caption = "Norm of the error, relative to the norm of the exact gradient, on a sampled view."
        draw = partial(_draw_approximations, history=history, probes=probes)
        figures.append(_figure("approximations", "Error of the approximated gradient", caption, draw))
    if np.isfinite(history.memory).any():
        predicted = (report.get("plan") or {}).get("prediction") or {}
        draw = partial(_draw_memory, history=history, predicted=predicted)
        caption = "Memory of the process"
        caption += "; on the GPU, the peak so far." if np.isfinite(history.device_memory).any() else "."
        figures.append(_figure("memory", "Memory", caption, draw))
    return figures


def _consistency(moments: Sequence[dict[str, Any]], reach: str, metric: str) -> Floats:
    """Return a metric at each moment [n], with NaN for missing and infinite values."""
    values = column([consistency_at(moment, reach).get(metric) for moment in moments])
    return np.where(np.isfinite(values), values, math.nan)


def _figure(name: str, title: str, caption: str, draw: Callable[[Figure, Against], None], rows: int = 1) -> PageFigure:
    """Draw a chart for each x axis at the same size, so that switching between them does not shift the page."""
    svg = {}
    for against in AGAINST:
        with matplotlib.rc_context(STYLE):
            figure = Figure(figsize=(_WIDTH, _HEIGHT + 2.0 * (rows - 1)), layout="constrained")
            draw(figure, against)
            label = f"{title}, against {against}"
            svg[against] = inline(figure, f"{name}-{against}", label)
    return PageFigure(name, title, caption, svg)


def _draw_split(figure: Figure, against: Against, history: History) -> None:
    count = len(history.terms)
    grid = list(figure.subplots(math.ceil(count / 2), min(count, 2), sharey=True, squeeze=False).flat)
    everything = [values for terms in history.terms.values() for values in terms.values()]
    for axes, (scale, terms) in zip(grid, history.terms.items(), strict=False):
        # Each panel has its own x limits. With shared limits, a first phase on the coarsest scale would squeeze the
        # curves of all other scales into the end of the axis.
        there = history.x[against][np.any([~np.isnan(values) for values in terms.values()], axis=0)]
        own = replace(history, limits={**history.limits, against: log_limits(there, X_MARGIN)})
        for term, values in terms.items():
            draw_line(axes, own, against, values, color_of(list(TERMS).index(term)), TERMS[term])
        axes.set_title(scale_name(scale))
        set_log_x(axes, own.limits[against], against)
        set_log_y(axes, everything)
    for axes in grid[: max(count - 2, 0)]:  # another panel is below
        axes.set_xlabel("")
    for axes in grid[::2]:
        axes.set_ylabel("loss")
    for axes in grid[count:]:
        axes.set_visible(False)
    draw_legend(figure, in_row=4)


def _draw_consistency(figure: Figure, against: Against, history: History, moments: Sequence[dict[str, Any]]) -> None:
    known = {name: [np.isfinite(_consistency(moments, reach, name)).any() for reach in _REACHES] for name in _METRICS}
    metrics = [metric for metric in _METRICS if any(known[metric])]
    x = moment_positions(moments, against)
    panels = figure.subplots(1, len(metrics), squeeze=False)[0]
    for axes, metric in zip(panels, metrics, strict=True):
        for reach, color in _REACHES.items():
            values = _consistency(moments, reach, metric)
            shown = drawable(x) & np.isfinite(values)
            gap = next(filter(None, (consistency_at(moment, reach).get("gap") for moment in moments)), None)
            label = f"{reach} range" if gap is None else f"{reach} range ({gap} view{'s' if gap > 1 else ''} apart)"
            options = {"marker": "o", "markersize": 4, "color": color, "label": label}
            draw_points(axes, x[shown], values[shown], **options)
            if moments[0].get("step") == 0 and np.isfinite(values[0]):
                axes.axhline(values[0], color=color, linestyle="--", linewidth=1)
        axes.set_ylabel(_METRICS[metric])
        axes.set_ylim(bottom=0)
        set_log_x(axes, history.limits[against], against)
    draw_legend(figure)


def _draw_approximations(figure: Figure, against: Against, history: History, probes: Sequence[dict[str, Any]]) -> None:
    axes = figure.subplots()
    steps = column([probe.get("step") for probe in probes])
    # A probe's `seconds` is the duration of one gradient. Its position on the time axis is interpolated from its step.
    x = steps if against == "steps" else np.interp(steps, history.x["steps"], history.x["seconds"])
    errors = column([probe.get("relative_error") for probe in probes])
    shown = drawable(x) & drawable(errors)
    draw_points(axes, x[shown], errors[shown], marker="o", markersize=4, color=color_of(0))
    set_log_x(axes, history.limits[against], against)
    set_log_y(axes, [errors])
    axes.set_ylabel("relative error")


def _draw_memory(figure: Figure, against: Against, history: History, predicted: dict[str, Any]) -> None:
    axes = figure.subplots()
    on_device = bool(np.isfinite(history.device_memory).any())
    shown = [(history.memory, predicted.get("peak_bytes"), "", color_of(0), INK)]
    if on_device:
        shown.append((history.device_memory, predicted.get("device_bytes"), " on the GPU", color_of(1), color_of(1)))
    for memory, peak, where, color, dashed in shown:
        # Memory is not averaged over a round: what matters is the maximum in each bin.
        line = thinned(history.x[against], memory / 1e9, 1, history.bin_width(against))
        marker = "o" if len(line.x) == 1 else None
        axes.plot(line.x, line.high, color=color, marker=marker, label=f"measured{where}")
        if peak is not None and math.isfinite(peak):
            label = f"peak{where}, predicted by the plan"
            axes.axhline(peak / 1e9, color=dashed, linestyle="--", linewidth=1, label=label)
    axes.set_ylim(bottom=0)
    axes.set_ylabel("memory in GB")
    mark_phases(axes, history, against)
    set_log_x(axes, history.limits[against], against)
    draw_legend(figure)


# --- SVG that can share a page with other figures ------------------------------------------------------------------

_NAMESPACE = re.compile(r"\{[^}]*\}")
_COLOR = re.compile(r"(fill|stroke): #([0-9a-f]{6})")
_REFERENCE = re.compile(r"url\(#([^)]+)\)")
_FAMILY = re.compile(r"font-family: [^;]*;?")
_LONG_DECIMAL = re.compile(r"(\.\d\d)\d+")


def inline(figure: Figure, name: str, label: str) -> str:
    """Return a figure as an <svg> element that can share a page with other figures.

    Its element IDs are prefixed with `name`, and it contains no style sheet.
    """
    file = io.BytesIO()
    metadata = dict.fromkeys(("Date", "Creator", "Format", "Type"))  # not needed, and has URLs of other servers
    figure.savefig(file, format="svg", transparent=True, metadata=metadata)
    root = ElementTree.fromstring(file.getvalue())
    for parent in root.iter():
        for child in list(parent):
            if _NAMESPACE.sub("", child.tag) == "style":  # it would apply to the whole page
                parent.remove(child)
    links = [(key, value) for element in root.iter() for key, value in element.attrib.items()]
    used = {value.removeprefix("#") for key, value in links if _NAMESPACE.sub("", key) == "href"}
    used.update(reference for _, value in links for reference in _REFERENCE.findall(value))
    for element in root.iter():
        element.tag = _NAMESPACE.sub("", element.tag)
        element.attrib = {
            key: value
            for key, value in (_rewritten(*item, name) for item in element.attrib.items())
            if key != "id" or value.removeprefix(f"{name}-") in used
        }
    root.attrib = {"viewBox": root.attrib["viewBox"], "role": "img", "aria-label": label}
    return ElementTree.tostring(root, encoding="unicode")


def _rewritten(key: str, value: str, name: str) -> tuple[str, str]:
    """Return an attribute as it appears on the page.

    Its XML namespace is removed, IDs are prefixed with the figure's name, and coordinates are truncated to hundredths
    of a point.
    """
    key = _NAMESPACE.sub("", key)
    if key == "id":
        return key, f"{name}-{value}"
    if key == "href":
        return key, f"#{name}-{value.removeprefix('#')}"
    value = _REFERENCE.sub(rf"url(#{name}-\1)", value)
    if key == "style":
        return key, _FAMILY.sub("", _COLOR.sub(r"\1: var(--c-\2, #\2)", value))
    if key in ("d", "points"):
        value = " ".join(value.split())
    return key, _LONG_DECIMAL.sub(r"\1", value) if key in ("d", "points", "x", "y", "transform") else value
