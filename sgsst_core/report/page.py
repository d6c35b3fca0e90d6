"""HTML page of a report with its tables: one self-contained file."""

from __future__ import annotations

import base64
import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePath
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined

from sgsst_core.files.atomic import atomic_path
from sgsst_core.progress import NOTHING, byte_count, duration, number, percent
from sgsst_core.report.charts import AGAINST, BINS, draw_figure, round_length
from sgsst_core.report.images import PAGE

#: Fields of a report that have a section of their own on the page.
_SECTIONS = ("history", "novel_views", "approximations", "loss_over_time", "findings", "plan", "seconds_by_part")
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
    caption, drawings = draw_figure(report)
    return _ENVIRONMENT.get_template("report.html").render(
        report=report,
        scene=PurePath(report["scene"]["path"]).name,
        style=_style_names(report),
        stopped=_STOPPED.get(report["stopped"], report["stopped"]),
        colors=PAGE,
        against=AGAINST,
        bins=BINS,
        round_length=round_length(report),
        caption=caption,
        drawings={name: _base64(svg) for name, svg in drawings.items()},
        tables={name: table(report) for name, table in TABLES.items()},
        parts=_time_split(report),
        everything=_everything(report),
        sheet=_base64(sheet) if sheet else None,
        views=_base64(views) if views else None,
    )


def _base64(content: bytes) -> str:
    return base64.b64encode(content).decode("ascii")


def _style_names(report: dict[str, Any]) -> str:
    """Return the file names of the style images."""
    styles = report["styles"]
    names = [PurePath(style["path"]).name for style in styles]
    if len(names) == 1:
        return names[0]
    return ", ".join(f"{name} ({style['weight']:.0%})" for name, style in zip(names, styles, strict=True))


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


def _everything(report: dict[str, Any]) -> str:
    """Return all fields without a section of their own as JSON."""
    fields = {field: value for field, value in report.items() if field not in _SECTIONS}
    if report.get("novel_views"):
        fields["novel_views"] = {
            name: value for name, value in report["novel_views"].items() if name not in ("moments", "judged")
        }
    return json.dumps(fields, indent=2, ensure_ascii=False)


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
        if not before and not after:
            continue
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
    rows = []
    for entry in (report.get("approximations") or {}).get("moments") or []:
        taken, exact = entry.get("seconds"), entry.get("seconds_exact")
        row = [f"{entry['step']:,}", entry["view"]]
        row += [number(entry.get("relative_error")), number(entry.get("cosine"), 6), duration(taken), duration(exact)]
        rows.append([*row, number(exact / taken if taken and exact is not None else None)])
    errors = ["relative error of the gradient", "cosine to the exact gradient"]
    return Table(["step", "view", *errors, "time", "exact time", "speedup"], rows, ["view"]) if rows else None


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
