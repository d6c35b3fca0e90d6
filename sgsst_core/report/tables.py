"""Tables of the report's page, as rows of text."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

from sgsst_core.progress import NOTHING, byte_count, duration, number, percent
from sgsst_core.report.history import consistency_at, novel_view_moments


@dataclass(frozen=True)
class Table:
    """Table of text, with one cell per column in each row.

    Attributes:
        texts: Titles of the columns of text; all others hold numbers, which are right-aligned.
    """

    columns: Sequence[str]
    rows: Sequence[Sequence[str]]
    texts: Sequence[str] = ("",)


def loss_table(report: dict[str, Any]) -> Table:
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


def novel_views_table(report: dict[str, Any]) -> Table | None:
    """Return all measurements of novel views, without empty columns; None if there are none."""
    moments = novel_view_moments(report)
    if not moments:
        return None
    scales = sorted({scale for moment in moments for scale in moment.get("gram") or {}}, key=int)
    columns: dict[str, list[str]] = {
        "step": [f"{moment['step']:,}" for moment in moments],
        "time": [duration(moment["seconds"]) for moment in moments],
        "Gram distance, relative": [number(moment.get("gram_relative")) for moment in moments],
    }
    for scale in scales:
        columns[f"scale {scale}, absolute"] = [number((moment.get("gram") or {}).get(scale)) for moment in moments]
    for reach in ("short", "long"):
        consistencies = [consistency_at(moment, reach) for moment in moments]
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
    "features": ("feature distance (1 - cosine)", number),
    "background_sensitivity": ("background sensitivity: style on black against white", number),
    "saturated": ("colors outside the displayable range", percent),
}


def judged_table(report: dict[str, Any]) -> Table | None:
    """Return the judgment of the result beside that of the unstylized scene; None if there is none."""
    judged = (report.get("novel_views") or {}).get("judged")
    if not judged:
        return None
    before, after = judged["before"], judged["after"]
    rows = [[title, text(before[name]), text(after[name])] for name, (title, text) in _JUDGED.items()]
    return Table(["", "unstylized", "stylized"], rows)


def decision_table(report: dict[str, Any]) -> Table:
    """Return the plan's decisions with their reasons, savings and costs."""
    texts = ["item", "decision", "reason", "error"]
    rows = [
        [*(entry[name] for name in texts[:3]), byte_count(entry["bytes"]), entry["error"]]
        for entry in report["plan"]["decisions"]
    ]
    return Table([*texts[:3], "saves memory", "error"], rows, texts)


def prediction_table(report: dict[str, Any]) -> Table:
    """Return the plan's predictions beside the measured values."""
    predicted, measured = report["plan"].get("prediction") or {}, report["plan"].get("measured") or {}
    rows: list[list[str]] = []

    def add(title: str, text: Callable[[float | None], str], before: float | None, after: float | None) -> None:
        ratio = after / before if before and after is not None else None
        rows.append([title, text(before), text(after), number(ratio)])

    def add_value(title: str, text: Callable[[float | None], str], name: str) -> None:
        add(title, text, predicted.get(name), measured.get(name))

    add_value("step on all scales", duration, "seconds")
    add_value("peak memory (upper bound)", byte_count, "peak_bytes")
    if predicted.get("measuring"):
        add_value("measuring, total", duration, "measuring")
    if any(values.get("device_bytes") is not None for values in (predicted, measured)):
        add_value("peak memory of the GPU (upper bound)", byte_count, "device_bytes")
    return Table(["", "predicted", "measured", "measured / predicted"], rows)


def finding_table(report: dict[str, Any]) -> Table | None:
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


def approximation_table(report: dict[str, Any]) -> Table | None:
    """Return all comparisons of the job's gradient with the exact one; None if there are none."""
    names, rows = report["cameras"]["names"], []
    for entry in (report.get("approximations") or {}).get("moments") or []:
        view, taken, exact = entry["view"], entry.get("seconds"), entry.get("seconds_exact")
        row = [f"{entry['step']:,}", names[view] if isinstance(view, int) and 0 <= view < len(names) else str(view)]
        row += [number(entry.get("relative_error")), number(entry.get("cosine"), 6), duration(taken), duration(exact)]
        rows.append([*row, number(exact / taken if taken and exact is not None else None)])
    errors = ["relative error of the gradient", "cosine to the exact gradient"]
    return Table(["step", "view", *errors, "time", "exact time", "speedup"], rows, ["view"]) if rows else None


#: Tables of the page by their name in its template.
TABLES: dict[str, Callable[[dict[str, Any]], Table | None]] = {
    "losses": loss_table,
    "novel_views": novel_views_table,
    "judged": judged_table,
    "decisions": decision_table,
    "predictions": prediction_table,
    "findings": finding_table,
    "approximations": approximation_table,
}
