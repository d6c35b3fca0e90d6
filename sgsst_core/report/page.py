"""report.html: one file that shows a report to people, with everything in it that it needs."""

from __future__ import annotations

import base64
import json
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePath
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup

from sgsst_core.errors import OutputError
from sgsst_core.files.atomic import atomic_path
from sgsst_core.report.figures import AGAINST, PLACES, draw_figures

#: What is written for a value that is not there.
NOTHING = "–"
#: Between a number and its unit, where a line must not break.
_GAP = "\u00a0"
#: Members of a list that the folded part shows; the rest is counted.
_LIST = 40
#: Fields of a report that have a place of their own on the page.
_PLACED = ("history", "held_out", "approximations", "bought", "findings", "plan", "seconds_by_part")
_STOPPED = {
    "finished": "all planned steps were done",
    "max-seconds": "stopped at the time limit",
    "target-loss": "stopped when the target loss was reached",
    "converged": "stopped when the loss had converged",
    "interrupted": "interrupted",
}
_PARTS = {
    "vgg_forward": "feature network, forward",
    "vgg_backward": "feature network, backward",
    "statistics": "statistics of the features",
    "render": "rendering",
    "raster_backward": "rendering, backward",
    "optimiser": "optimiser",
    "prepare": "preparing views and style",
    "loss": "loss and pyramid",
}
_ENVIRONMENT = Environment(
    loader=PackageLoader("sgsst_core.report"),
    autoescape=True,  # names of scenes, views and files are whatever users wrote
    undefined=StrictUndefined,
    trim_blocks=True,
    lstrip_blocks=True,
)


@dataclass(frozen=True)
class Column:
    """Of a table; numbers are set flush right."""

    title: str
    number: bool = False


@dataclass(frozen=True)
class Table:
    """Rows of text, one cell a column."""

    columns: Sequence[Column]
    rows: Sequence[Sequence[str]]


def render_page(report: dict[str, Any], sheet: bytes | None) -> str:
    """The page as HTML; nothing in it refers to anything outside, and no script runs.

    Args:
        report: of version 2, as `build_report` makes it or as it is read from report.json.
        sheet: the contact sheet, JPEG; None leaves it out.
    """
    figures = draw_figures(report)
    return _ENVIRONMENT.get_template("report.html").render(
        scene=PurePath(report["scene"]["path"]).name,
        style=PurePath(report["style"]["path"]).name,
        facts=_facts(report),
        result=_result(report),
        bought=_bought(report),
        sheet=base64.b64encode(sheet).decode("ascii") if sheet else None,
        against=AGAINST,
        places=PLACES,
        round_length=report["cameras"]["count"] - len(report["cameras"]["seeing_nothing"]),
        # The figures' text is fixed or escaped by the XML writer: they are markup.
        figures=[(figure, {against: Markup(figure.svg[against]) for against in AGAINST}) for figure in figures],
        losses=_loss_table(report),
        held_out=_held_out_table(report),
        seconds=_duration(report["seconds"]),
        parts=_time_split(report),
        decisions=_decisions(report),
        predictions=_predictions(report),
        findings=_findings(report),
        approximations=_approximations(report),
        everything=_everything(report),
        program=f"{report['program']['name']} {report['program']['version']}",
        created=report["created"],
    )


def write_page(path: Path, report: dict[str, Any], sheet_path: Path | None) -> None:
    """Write the page; the file appears whole or not at all.

    Args:
        sheet_path: the contact sheet, JPEG; None leaves it out.

    Raises:
        OutputError: the file cannot be written, or the sheet cannot be read.
    """
    try:
        sheet = sheet_path.read_bytes() if sheet_path else None
    except OSError as error:
        raise OutputError(
            f"{sheet_path}: the contact sheet cannot be read: {error.strerror}. Write it before the page."
        ) from error
    page = render_page(report, sheet)
    with atomic_path(path) as temporary:
        # A file name that is no valid Unicode shows question marks; it must not cost the page.
        temporary.write_bytes(page.encode("utf-8", errors="replace"))


# --- heading -------------------------------------------------------------------------------------------------------


def _facts(report: dict[str, Any]) -> list[str]:
    """What was stylized with what, in a few words each."""
    count = report["cameras"]["count"]
    sizes = report["cameras"]["sizes"]
    size = f", up to {' × '.join(str(side) for side in max(sizes))} pixels" if sizes else ""
    return [
        f"{report['backbone']['name'].upper()}",
        f"preset {report['settings']['preset']}",
        f"{report['scene']['gaussians']:,} Gaussians",
        f"{count:,} view{'' if count == 1 else 's'}{size}",
    ]


def _result(report: dict[str, Any]) -> dict[str, str]:
    steps = report["steps"].values()
    done, planned = sum(part["done"] for part in steps), sum(part["planned"] for part in steps)
    return {
        "relative": _number(report["loss"]["relative"]),
        "seconds": _duration(report["seconds"]),
        "steps": f"{done:,}" if done == planned else f"{done:,} of {planned:,}",
        "stopped": _STOPPED.get(report["stopped"], report["stopped"]),
    }


def _bought(report: dict[str, Any]) -> dict[str, Any] | None:
    """Which loss was reached when, and what the last tenth of the time was good for."""
    bought = report.get("bought")
    if not bought:
        return None
    total = report["seconds"]
    reached = [
        {
            "relative": _percent(entry["relative"]),
            "seconds": _duration(entry["seconds"]),
            "step": f"{entry['step']:,}",
            "share": _percent(entry["seconds"] / total) if total else NOTHING,
        }
        for entry in bought.get("reached") or []
    ]
    last = bought.get("last_tenth")
    tenth = None
    if last:
        tenth = {
            "seconds": _duration(last["seconds"]),
            "before": _percent(last["from"], 3),
            "after": _percent(last["to"], 3),
        }
    return {"relative": _percent(bought["relative"], 3), "reached": reached, "last_tenth": tenth}


# --- tables --------------------------------------------------------------------------------------------------------


def _loss_table(report: dict[str, Any]) -> Table:
    loss = report["loss"]
    rows = [["mean of the scales", loss["before"]["total"], loss["after"]["total"], loss["relative"]]]
    for scale, before in loss["before"]["scales"].items():
        after = loss["after"]["scales"].get(scale, {})
        rows.append([f"scale {scale}", before["total"], after.get("total"), loss["relative_by_scale"].get(scale)])
    return Table(
        [Column(""), Column("unstylized", True), Column("stylized", True), Column("relative", True)],
        [[name, *(_number(value) for value in values)] for name, *values in rows],
    )


def _held_out_table(report: dict[str, Any]) -> Table | None:
    """Every moment in numbers; columns that have none are left out."""
    moments = (report.get("held_out") or {}).get("moments") or []
    if not moments:
        return None
    scales = sorted({scale for moment in moments for scale in moment.get("gram") or {}}, key=int)
    columns: dict[str, list[str]] = {
        "step": [f"{moment['step']:,}" for moment in moments],
        "time": [_duration(moment["seconds"]) for moment in moments],
        "Gram distance, relative": [_number(moment.get("gram_relative")) for moment in moments],
    }
    for scale in scales:
        columns[f"scale {scale}, absolute"] = [_number((moment.get("gram") or {}).get(scale)) for moment in moments]
    for reach in ("short", "long"):
        found = [(moment.get("consistency") or {}).get(reach) or {} for moment in moments]
        columns[f"RMSE, {reach} range"] = [_number(entry.get("rmse")) for entry in found]
        columns[f"LPIPS, {reach} range"] = [_number(entry.get("lpips")) for entry in found]
        columns[f"compared, {reach} range"] = [_percent(entry.get("compared")) for entry in found]
    columns = {title: cells for title, cells in columns.items() if any(cell != NOTHING for cell in cells)}
    return Table([Column(title, True) for title in columns], list(zip(*columns.values(), strict=True)))


def _time_split(report: dict[str, Any]) -> list[dict[str, str]]:
    """Parts of the time with their share, the longest first."""
    parts = {_PARTS.get(name, name): seconds for name, seconds in (report.get("seconds_by_part") or {}).items()}
    measured = sum(parts.values())
    total = max(report["seconds"], measured)
    if not total:
        return []
    ordered = sorted(parts.items(), key=lambda part: -part[1])
    if total - measured > 0.001 * total:
        ordered.append(("everything else", total - measured))
    return [
        {"name": name, "seconds": _duration(seconds), "share": f"{100 * seconds / total:.1f}"}
        for name, seconds in ordered
    ]


def _decisions(report: dict[str, Any]) -> Table:
    columns = [
        Column("item"),
        Column("decision"),
        Column("reason"),
        Column("saves a step", True),
        Column("saves memory", True),
        Column("costs"),
    ]
    return Table(
        columns,
        [
            [
                entry["item"],
                entry["decision"],
                entry["reason"],
                _duration(entry["seconds"]),
                _bytes(entry["bytes"]),
                entry["error"],
            ]
            for entry in report["plan"]["decisions"]
        ],
    )


def _predictions(report: dict[str, Any]) -> Table:
    """What the plan expected beside what happened."""
    predicted, measured = report["plan"].get("prediction") or {}, report["plan"].get("measured") or {}
    rows = []
    for name, key, text in (
        ("a step on all scales", "seconds", _duration),
        ("peak memory", "peak_bytes", _bytes),
    ):
        before, after = predicted.get(key), measured.get(key)
        ratio = after / before if before and after is not None else None
        rows.append([name, text(before), text(after), _number(ratio)])
    one_rank = predicted.get("seconds_one_rank")
    if one_rank and predicted.get("seconds"):
        before, after = predicted["communication"], measured.get("communication")
        ratio = after / before if before and after is not None else None
        rows.append(["of it waiting for other ranks", _duration(before), _duration(after), _number(ratio)])
        before, after = one_rank / predicted["seconds"], measured.get("speed_up")
        ratio = after / before if after is not None else None
        rows.append(["speed-up over one rank", _number(before), _number(after), _number(ratio)])
    return Table(
        [Column(""), Column("predicted", True), Column("measured", True), Column("measured / predicted", True)], rows
    )


def _findings(report: dict[str, Any]) -> Table | None:
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
    columns = [Column("in"), Column("what"), Column("how many", True), Column("worst"), Column("what is done")]
    return Table(columns, rows) if rows else None


def _approximations(report: dict[str, Any]) -> dict[str, Any] | None:
    found = report.get("approximations")
    if not found:
        return None
    names = report["cameras"]["names"]
    rows = []
    for entry in found.get("moments") or []:
        view = entry["view"]
        taken, exact = entry.get("seconds"), entry.get("seconds_exact")
        rows.append(
            [
                f"{entry['step']:,}",
                names[view] if isinstance(view, int) and 0 <= view < len(names) else str(view),
                _number(entry.get("relative_error")),
                _number(entry.get("cosine"), 6),
                _duration(taken),
                _duration(exact),
                _number(exact / taken if taken and exact is not None else None),
            ]
        )
    columns = [
        Column("step", True),
        Column("view"),
        Column("relative error of the gradient", True),
        Column("cosine to the exact one", True),
        Column("time", True),
        Column("time, exact", True),
        Column("times faster", True),
    ]
    return {"what": ", ".join(found.get("what") or []), "table": Table(columns, rows) if rows else None}


def _everything(report: dict[str, Any]) -> list[tuple[str, list[tuple[str, str]]]]:
    """All fields that have no place of their own, as (field, [(name, value)])."""
    fields = {field: value for field, value in report.items() if field not in _PLACED}
    if report.get("held_out"):
        fields["held_out"] = {name: value for name, value in report["held_out"].items() if name != "moments"}
    return [(field, [(name or field, text) for name, text in _flat("", value)]) for field, value in fields.items()]


def _flat(name: str, value: Any) -> Iterable[tuple[str, str]]:
    """Nested objects as lines, named as in the JSON file: `after.scales.0.gram`."""
    if isinstance(value, dict) and value:
        for key, inner in value.items():
            yield from _flat(f"{name}.{key}" if name else str(key), inner)
    else:
        yield name, _text(name, value)


def _text(name: str, value: Any) -> str:
    if value is None or value == [] or value == {}:
        return NOTHING
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, int) and name.endswith("bytes"):
        return f"{_bytes(value)} ({value:,} bytes)"
    if isinstance(value, float):
        return _number(value, 6)
    if isinstance(value, list):
        shown = ", ".join(_text(name, member) for member in value[:_LIST])
        return shown if len(value) <= _LIST else f"{shown} … ({len(value):,} in all)"
    return value if isinstance(value, str) else json.dumps(value, ensure_ascii=False)


# --- numbers -------------------------------------------------------------------------------------------------------


def _number(value: float | None, digits: int = 3) -> str:
    """With so many significant digits; whole thousands are not rounded further."""
    if value is None:
        return NOTHING
    if not math.isfinite(value):
        return "NaN" if math.isnan(value) else ("∞" if value > 0 else "−∞")
    return f"{value:,.0f}" if 10**digits <= abs(value) < 1e9 else f"{value:,.{digits}g}"


def _percent(share: float | None, digits: int = 2) -> str:
    return NOTHING if share is None else f"{_number(100 * share, digits)}{_GAP}%"


def _duration(seconds: float | None) -> str:
    if seconds is None or not math.isfinite(seconds):
        return NOTHING
    if seconds < 60:
        return f"{_number(round(seconds, 4))}{_GAP}s"
    minutes, rest = divmod(round(seconds), 60)
    return _GAP.join(
        (f"{minutes}", "min", f"{rest:02}", "s")
        if minutes < 60
        else (f"{minutes // 60}", "h", f"{minutes % 60:02}", "min")
    )


def _bytes(count: float | None) -> str:
    if count is None or not math.isfinite(count):
        return NOTHING
    for unit, size in (("GB", 1e9), ("MB", 1e6), ("kB", 1e3)):
        if abs(count) >= size:
            return f"{_number(count / size)}{_GAP}{unit}"
    return f"{count:.0f}{_GAP}bytes"
