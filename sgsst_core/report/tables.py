"""Tables of the report's page, as rows of text."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

from sgsst_core.number_format import NOTHING, byte_count, duration, number, percent
from sgsst_core.report.history import consistency_at, novel_view_moments


@dataclass(frozen=True)
class Table:
    """Table of text, with one cell per column in each row.

    Attributes:
        columns: Titles of the columns.
        rows: Cells of each row.
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
        ["", "unstylized", "stylized", "relative"],
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
        [*(entry[name] for name in texts[:3]), duration(entry["seconds"]), byte_count(entry["bytes"]), entry["error"]]
        for entry in report["plan"]["decisions"]
    ]
    return Table([*texts[:3], "saves per step", "saves memory", "error"], rows, texts)


#: Titles of rows about first visits. The other rows apply to views visited before.
_VISITS = {"first_visit": "first visit of a view, in addition", "first_visit_coarse": "the same in phase 1"}


def prediction_table(report: dict[str, Any]) -> Table:
    """Return the plan's predictions beside the measured values."""
    predicted, measured = report["plan"].get("prediction") or {}, report["plan"].get("measured") or {}
    rows = [
        _beside("step on all scales", predicted.get("seconds"), measured.get("seconds"), duration),
        *(
            _beside(text, predicted.get(name), measured[name], duration)
            for name, text in _VISITS.items()
            if measured.get(name) is not None
        ),
        _beside("peak memory", predicted.get("peak_bytes"), measured.get("peak_bytes"), byte_count),
    ]
    if predicted.get("measuring") and measured.get("measuring") is not None:
        rows.append(_beside("measuring, total", predicted["measuring"], measured["measuring"], duration))
        planned = _fraction(predicted["measuring"], predicted["job"] - predicted["measuring"])
        rows.append(
            _beside(
                "measuring, relative to the steps' time",
                planned,
                _fraction(measured["measuring"], report["seconds"]),
                percent,
            )
        )
    on_device = predicted.get("device_bytes"), measured.get("device_bytes")
    if any(value is not None for value in on_device):
        rows.append(_beside("peak memory of the GPU", *on_device, byte_count))
    one_rank, seconds = predicted.get("seconds_one_rank"), predicted.get("seconds")
    if one_rank and seconds:
        waiting = predicted["communication"], measured.get("communication")
        rows.append(_beside("waiting for other ranks, per step", *waiting, duration))
        rows.append(_beside("speedup over one rank", one_rank / seconds, measured.get("speed_up"), number))
    return Table(["", "predicted", "measured", "measured / predicted"], rows)


def _fraction(part: float, whole: float) -> float | None:
    """Return a part as a fraction of the whole; None if the whole is 0."""
    return part / whole if whole else None


def _beside(name: str, before: float | None, after: float | None, text: Callable[[float | None], str]) -> list[str]:
    """Return a row with a prediction, its measured value and their ratio."""
    return [name, text(before), text(after), number(after / before if before and after is not None else None)]


def finding_table(report: dict[str, Any]) -> Table | None:
    """Return the findings about scene, views and style; None if there are none."""
    findings = report.get("findings") or []
    rows = [
        [
            entry["subject"],
            entry["what"],
            f"{entry['count']:,} of {entry['total']:,}",
            entry["worst"] or NOTHING,
            entry["done"],
        ]
        for entry in findings
    ]
    texts = ["input", "finding", "worst", "consequence"]
    return Table(["input", "finding", "count", "worst", "consequence"], rows, texts) if rows else None


def approximation_table(report: dict[str, Any]) -> Table | None:
    """Return all comparisons of the job's gradient with the exact one; None if there are none."""
    moments = (report.get("approximations") or {}).get("moments") or []
    names = report["cameras"]["names"]
    rows = []
    for entry in moments:
        view = entry["view"]
        taken, exact = entry.get("seconds"), entry.get("seconds_exact")
        rows.append(
            [
                f"{entry['step']:,}",
                names[view] if isinstance(view, int) and 0 <= view < len(names) else str(view),
                number(entry.get("relative_error")),
                number(entry.get("cosine"), 6),
                duration(taken),
                duration(exact),
                number(exact / taken if taken and exact is not None else None),
            ]
        )
    errors = ["relative error of the gradient", "cosine to the exact gradient"]
    return Table(["step", "view", *errors, "time", "exact time", "speedup"], rows, ["view"]) if rows else None
