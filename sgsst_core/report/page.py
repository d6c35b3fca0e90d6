"""HTML page of a report: one self-contained file with tables and a chart of the loss, which is written as a PNG too."""

import base64
import io
import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path, PurePath
from typing import Any

import matplotlib
import numpy as np
from jinja2 import Environment, PackageLoader, StrictUndefined
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, MaxNLocator
from numpy.typing import NDArray

from sgsst_core.files.atomic import atomic_path
from sgsst_core.progress import NOTHING, byte_count, duration, number, percent
from sgsst_core.report.images import GRID, INK, PAGE, color_of

_STOPPED = {
    "finished": "all planned steps are done",
    "within": "stopped when its time budget was used up",
    "target-loss": "stopped when the target loss was reached",
    "converged": "stopped when the loss had converged",
    "on-request": "stopped on request, with the colors of that step",
    "interrupted": "interrupted",
}
_PARTS = {
    "vgg_forward": "feature network, forward",
    "vgg_backward": "feature network, backward",
    "statistics": "statistics of the features",
    "matching": "nearest neighbors of the features",
    "network": "feature network and loss, as a graph",
    "render": "rendering",
    "raster_backward": "rendering, backward",
    "optimizer": "optimizer",
    "prepare": "preparing views and style",
    "loss": "loss and pyramid",
    "checkpoint": "checkpoints",
    "preview": "previews",
    "measuring": "measuring, besides the steps",
    "start": "start of the program, before the steps",
    "reading": "reading the inputs, before the steps",
    "refining": "splitting large Gaussians, before the steps",
    "survey": "survey of the views, before the steps",
    "planning": "planning, before the steps",
    "preparing": "preparing the job, before the steps",
    "writing": "writing the results",
    "other": "everything else",
}
_ENVIRONMENT = Environment(
    loader=PackageLoader("sgsst_core.report"),
    autoescape=True,  # names of scenes, views and files are arbitrary user input
    undefined=StrictUndefined,
    trim_blocks=True,
    lstrip_blocks=True,
)
_ENVIRONMENT.filters |= {"number": number, "percent": percent, "duration": duration, "thousands": "{:,}".format}


def render_page(report: dict[str, Any], sheet: bytes | None, views: bytes | None = None) -> str:
    """Render the page as HTML, without external references and without scripts.

    Args:
        sheet: Contact sheet as JPEG; None omits it.
        views: Sheet of all views as JPEG; None omits it.
    """
    return _ENVIRONMENT.get_template("report.html").render(
        report=report,
        scene=PurePath(report["scene"]["path"]).name,
        style=_style_names(report),
        stopped=_STOPPED.get(report["stopped"], report["stopped"]),
        colors=PAGE,
        round_length=round_length(report),
        chart=_base64(_loss_svg(report)) if report["history"] else None,
        tables={name: table(report) for name, table in TABLES.items()},
        parts=_time_split(report),
        sheet=_base64(sheet) if sheet else None,
        views=_base64(views) if views else None,
    )


def _base64(content: bytes) -> str:
    return base64.b64encode(content).decode("ascii")


def _style_names(report: dict[str, Any]) -> str:
    """Return the file names of the style images, with their weights if there are several."""
    names = [PurePath(style["path"]).name for style in report["styles"]]
    weights = [f" ({style['weight']:.0%})" if len(names) > 1 else "" for style in report["styles"]]
    return ", ".join(map("".join, zip(names, weights, strict=True)))


def write_page(path: Path, report: dict[str, Any], sheet_path: Path | None, views_path: Path | None = None) -> None:
    """Write the page atomically.

    Args:
        sheet_path: Contact sheet, JPEG; None omits it.
        views_path: Sheet of all views, JPEG; None omits it.

    Raises:
        OutputError: If the file cannot be written.
    """
    sheets = (each.read_bytes() if each else None for each in (sheet_path, views_path))
    page = render_page(report, *sheets)
    with atomic_path(path) as temporary:
        # Invalid Unicode in file names is shown as question marks instead of raising an error.
        temporary.write_bytes(page.encode("utf-8", errors="replace"))


def _time_split(report: dict[str, Any]) -> list[tuple[str, float, float]]:
    """Return the name, the seconds and the percentage of each kind of time, longest first."""
    by_part = report.get("seconds_by_part") or {}
    total = sum(by_part.values())
    ordered = sorted(by_part.items(), key=lambda part: (part[0] == "other", -part[1]))
    return [(_PARTS.get(name, name), seconds, 100 * seconds / total) for name, seconds in ordered] if total else []


@dataclass(frozen=True)
class Table:
    """Table of text, with one cell per column in each row.

    Attributes:
        texts: Titles of the columns of text; all others hold numbers, which are right-aligned.
    """

    columns: Sequence[str]
    rows: Sequence[Sequence[str]]
    texts: Sequence[str] = ("",)


def _loss_table(report: dict[str, Any]) -> Table:
    """Return the loss before and after the job, as a mean over scales and for each scale."""
    loss = report["loss"]
    rows = [["mean over scales", loss["before"]["total"], loss["after"]["total"], loss["relative"]]]
    for scale, before in loss["before"]["scales"].items():
        after = loss["after"]["scales"].get(scale, {})
        rows.append([f"scale {scale}", before["total"], after.get("total"), loss["relative_by_scale"].get(scale)])
    return Table(
        ["", f"unstylized, on {len(loss['views'])} views", "stylized, in the last round of views", "relative"],
        [[name, *(number(value) for value in values)] for name, *values in rows],
    )


def _novel_views_table(report: dict[str, Any]) -> Table | None:
    """Return all measurements of novel views, without empty columns; None if there are none."""
    moments = (report.get("novel_views") or {}).get("moments") or []
    if not moments:
        return None
    columns: dict[str, list[str]] = {
        "step": [f"{moment['step']:,}" for moment in moments],
        "time": [duration(moment["seconds"]) for moment in moments],
        "Gram distance, relative": [number(moment.get("gram_relative")) for moment in moments],
    }
    for reach in ("short", "long"):
        consistencies = [(moment.get("consistency") or {}).get(reach) or {} for moment in moments]
        columns[f"RMSE, {reach} range"] = [number(entry.get("rmse")) for entry in consistencies]
        columns[f"LPIPS, {reach} range"] = [number(entry.get("lpips")) for entry in consistencies]
        columns[f"compared, {reach} range"] = [percent(entry.get("compared")) for entry in consistencies]
    columns = {title: cells for title, cells in columns.items() if any(cell != NOTHING for cell in cells)}
    return Table(list(columns), list(zip(*columns.values(), strict=True)))


#: Title and text format of each measure in the judgment of a result.
_JUDGED: dict[str, tuple[str, Callable[[float | None], str]]] = {
    "style": ("distance to the style", number),
    "interior_style": ("distance to the style, away from the background", number),
    "sliced_features": ("distance of feature distributions", number),
    "color_distance": ("distance to its colors, in 8-bit levels", number),
    "content": ("content loss (LPIPS)", number),
    "ssim": ("SSIM against the unstylized scene", number),
    "background_sensitivity": ("background sensitivity: style on black against white", number),
    "saturated": ("colors outside the displayable range", percent),
}


def _judged_table(report: dict[str, Any]) -> Table | None:
    """Return the judgment of the result beside that of the unstylized scene; None if there is none."""
    judged = (report.get("novel_views") or {}).get("judged")
    if not judged:
        return None
    before, after = judged["before"], judged["after"]
    rows = [[title, text(before.get(name)), text(after.get(name))] for name, (title, text) in _JUDGED.items()]
    return Table(["", "unstylized", "stylized"], rows)


def _decision_table(report: dict[str, Any]) -> Table:
    """Return the plan's decisions with their reasons, savings and costs."""
    texts = ["item", "decision", "reason", "error"]
    rows = [
        [*(entry[name] for name in texts[:3]), byte_count(entry["bytes"]), entry["error"]]
        for entry in report["plan"]["decisions"]
    ]
    return Table([*texts[:3], "saves memory", "error"], rows, texts)


def _prediction_table(report: dict[str, Any]) -> Table:
    """Return the plan's predictions beside the measured values."""
    predicted, measured = report["plan"].get("prediction") or {}, report["plan"].get("measured") or {}
    values: tuple[tuple[str, Callable[[float | None], str], str], ...] = (
        ("step on all scales", duration, "seconds"),
        ("peak memory (upper bound)", byte_count, "peak_bytes"),
        ("measuring, total", duration, "measuring"),
        ("peak memory of the GPU (upper bound)", byte_count, "device_bytes"),
    )
    rows: list[list[str]] = []
    for title, text, name in values:
        before, after = predicted.get(name), measured.get(name)
        if before or after:
            ratio = after / before if before and after is not None else None
            rows.append([title, text(before), text(after), number(ratio)])
    return Table(["", "predicted", "measured", "measured / predicted"], rows)


def _finding_table(report: dict[str, Any]) -> Table | None:
    """Return the findings about scene, views and style; None if there are none."""
    rows = [
        [
            each["subject"],
            each["what"],
            f"{each['count']:,} of {each['total']:,}",
            each["worst"] or NOTHING,
            each["done"],
        ]
        for each in report.get("findings") or []
    ]
    texts = ["input", "finding", "worst", "consequence"]
    return Table(["input", "finding", "count", "worst", "consequence"], rows, texts) if rows else None


def _approximation_table(report: dict[str, Any]) -> Table | None:
    """Return all comparisons of the job's gradient with the exact one; None if there are none."""
    moments = (report.get("approximations") or {}).get("moments") or []
    rows = [
        [
            f"{entry['step']:,}",
            entry["view"],
            *(number(entry["relative_error"]), number(entry["cosine"], 6)),
            *(duration(entry["seconds"]), duration(entry["seconds_exact"])),
        ]
        for entry in moments
    ]
    errors = ["relative error of the gradient", "cosine to the exact gradient"]
    return Table(["step", "view", *errors, "time", "exact time"], rows, ["view"]) if rows else None


#: Tables of the page by their name in its template.
TABLES: dict[str, Callable[[dict[str, Any]], Table | None]] = {
    "losses": _loss_table,
    "novel_views": _novel_views_table,
    "judged": _judged_table,
    "decisions": _decision_table,
    "predictions": _prediction_table,
    "findings": _finding_table,
    "approximations": _approximation_table,
}


Floats = NDArray[np.float64]
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
#: Size in inches of the chart of the page. At this width, text is legible on a phone.
_SIZE = (5.6, 3.5)


def relative_losses(report: dict[str, Any]) -> dict[int, Floats]:
    """Return the loss of each optimized scale relative to the unstylized scene, [steps]; NaN for missing values."""
    records, before = report["history"], report["loss"]["before"]["scales"]
    relative = {}
    for scale in sorted({int(scale) for record in records for scale in record["scales"]}):
        start = column([(before.get(str(scale)) or {}).get("total")])
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            relative[scale] = column([record["scales"].get(str(scale), {}).get("total") for record in records]) / start
    return relative


def round_length(report: dict[str, Any]) -> int:
    """Return the number of steps in which every view is visited once."""
    views: int = report["cameras"]["count"] - len(report["cameras"]["seeing_nothing"])
    per_step: int = report["settings"].get("views_per_step", 1)
    return max(1, math.ceil(views / per_step))


def column(values: Sequence[float | None]) -> Floats:
    """Return values as an array [n], with NaN for None."""
    return np.array([math.nan if value is None else value for value in values], dtype=np.float64)


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


def _draw_loss(figure: Figure, report: dict[str, Any]) -> None:
    """Draw the loss of each scale and their mean against seconds, relative to the start.

    Lines are running means over one round of views, with the losses of single steps behind. A dotted line ends the
    phase on the coarsest scale.
    """
    axes, records = figure.subplots(), report["history"]
    seconds = column([record["seconds"] for record in records])
    lines = [(scale_name(scale), values, color_of(scale)) for scale, values in relative_losses(report).items()]
    if len(lines) > 1:
        several = [record["relative"] if len(record["scales"]) > 1 else None for record in records]
        lines.append(("mean", column(several), INK))
    coarse = [record["seconds"] for record in records if record["stage"] == "coarse"]
    for label, values, color in lines:
        shown = (seconds > 0) & (values > 0) & np.isfinite(values)
        if not shown.any():
            continue
        x, y = seconds[shown], values[shown]
        axes.plot(x, y, color=color, alpha=0.3, linewidth=0.5)
        phases = [phase for phase in np.split(y, [shown[: len(coarse)].sum()]) if len(phase)]
        means = np.concatenate([running_mean(phase, round_length(report)) for phase in phases])
        axes.plot(x, means, color=color, label=label, marker="o" if len(x) == 1 else None)
    if 0 < len(coarse) < len(records):
        axes.axvline(coarse[-1], color=INK, linewidth=0.8, linestyle=":")
    set_log(axes, "seconds")
    axes.set_ylabel(RELATIVE_LOSS)
    draw_legend(figure)


def _loss_svg(report: dict[str, Any]) -> bytes:
    """Return the chart of the loss as SVG."""
    with matplotlib.rc_context(STYLE):
        figure, file = Figure(figsize=_SIZE, layout="constrained"), io.BytesIO()
        _draw_loss(figure, report)
        figure.savefig(file, format="svg", transparent=True, metadata={"Date": None})
    return file.getvalue()


def write_loss_chart(path: Path, report: dict[str, Any]) -> None:
    """Write the chart of the loss as a PNG.

    Args:
        report: Report from `build_report`; its history may be empty.
    """
    with png_chart(path, (8, 4.8), dpi=120) as figure:
        _draw_loss(figure, report)


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


def set_log(axes: Axes, label: str) -> None:
    """Make both axes logarithmic, once all is drawn, with plain numbers at round values, and label the x axis."""
    axes.set(xscale="log", yscale="log", xlabel=label)
    for axis in (axes.xaxis, axes.yaxis):
        low, high = axis.get_view_interval()
        axis.set_major_locator(
            MaxNLocator(4) if high < 6 * low else LogLocator(subs=(1, 2, 5) if high < 200 * low else (1,))
        )
        axis.set_major_formatter("{x:g}")
        axis.set_minor_formatter("")


def draw_legend(figure: Figure, in_row: int = 3) -> None:
    """Draw a legend below the figure, with each label once; do nothing if there are no labels."""
    named: dict[str, Artist] = {}
    for axes in figure.axes:
        for handle, label in zip(*axes.get_legend_handles_labels(), strict=True):
            named.setdefault(label, handle)
    if named:
        figure.legend(named.values(), named.keys(), loc="outside lower center", ncols=min(len(named), in_row))
