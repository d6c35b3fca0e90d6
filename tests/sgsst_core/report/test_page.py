import base64
import functools
import io
import math
import os
import re
import subprocess
import sys
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image, ImageColor

from sgsst_core.report.images import COLORS, INK
from sgsst_core.report.page import render_page, running_mean, write_loss_chart, write_page
from sgsst_core.scales import smoothed
from tests.sgsst_core.report.sample import sample_report

#: Warning of matplotlib if it cannot lay out a figure.
pytestmark = pytest.mark.filterwarnings("error")

VOID = {"meta", "link", "img", "input", "br", "hr"}
SVG = "data:image/svg+xml;base64,"
HOSTILE = '"><script>alert(\'x\')</script><b onclick="y">&amp; {{ 7 * 7 }} $x^2$ \u202egnp.\u540d\u524d'


class Page(HTMLParser):
    """Parsed HTML page: its elements and text. Parsing fails if tags are not properly nested."""

    def __init__(self, html: str) -> None:
        super().__init__()
        self.html = html
        self.open: list[str] = []
        self.elements: list[tuple[str, dict[str, str | None]]] = []
        self.cells: list[str] = []
        self.pieces: list[str] = []
        self.feed(html)
        self.close()
        assert self.open == []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        assert len(attrs) == len(dict(attrs)), f"<{tag}> has an attribute twice"
        self.elements.append((tag, dict(attrs)))
        if tag not in VOID:
            self.open.append(tag)
        if tag == "td":
            self.cells.append("")

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        self.pieces.append(data)
        if self.open and self.open[-1] == "td":
            self.cells[-1] += data.replace("\u00a0", " ")

    @property
    def text(self) -> str:
        return " ".join(" ".join(self.pieces).split())

    @property
    def drawings(self) -> list[str]:
        images = [attributes for tag, attributes in self.elements if tag == "img"]
        return [image["alt"] or "" for image in images if (image["src"] or "").startswith(SVG)]

    def assert_self_contained(self) -> None:
        identifiers = [attributes["id"] for _, attributes in self.elements if "id" in attributes]
        assert len(identifiers) == len(set(identifiers))
        tags = {tag for tag, _ in self.elements}
        assert not tags & {"script", "iframe", "object", "embed", "base", "form", "foreignobject"}
        for _, attributes in self.elements:
            for name, value in attributes.items():
                assert not name.startswith("on")
                assert name not in ("srcset", "action", "formaction", "poster", "srcdoc")
                if name.removeprefix("xlink:") in ("href", "src"):
                    assert value is not None
                    assert value.startswith(("data:", "#"))
                    assert value.startswith("data:") or value[1:] in identifiers
                for target in re.findall(r"url\(([^)]*)\)", value or ""):
                    assert target[0] == "#"
                    assert target[1:] in identifiers
        for sheet in re.findall(r"<style>(.*?)</style>", self.html, re.DOTALL):
            assert "url(" not in sheet
            assert "@import" not in sheet


def sample_sheet() -> bytes:
    file = io.BytesIO()
    Image.fromarray(np.arange(40 * 60 * 3, dtype=np.uint8).reshape(40, 60, 3)).save(file, format="JPEG")
    return file.getvalue()


def parsed(report: dict[str, Any], sheet: bytes | None = None) -> Page:
    page = Page(render_page(report, sheet))
    page.assert_self_contained()
    return page


@functools.cache
def sample_page() -> Page:
    """Return the parsed page of the unchanged sample report, for tests that only read it."""
    return parsed(sample_report(), sample_sheet())


def parsed_without_figures(report: dict[str, Any]) -> Page:
    """Return the parsed page of a report without charts, which would take most of the time."""
    return parsed({**report, "history": []})


def test_page_is_complete_and_self_contained() -> None:
    page = sample_page()
    assert page.html.startswith("<!DOCTYPE html>")
    assert "4 times the time would pay." in page.text
    assert "http:" not in page.html
    assert "https:" not in page.html
    policies = [attributes.get("content") for tag, attributes in page.elements if tag == "meta"]
    assert "default-src 'none'; img-src data:; style-src 'unsafe-inline'" in policies


def test_sheet_is_embedded_unchanged() -> None:
    def images_of(sheet: bytes | None) -> list[str]:
        page = parsed(sample_report(0, 0), sheet)
        return [attributes["src"] or "" for tag, attributes in page.elements if tag == "img"]

    (source,) = images_of(sample_sheet())
    assert base64.b64decode(source.removeprefix("data:image/jpeg;base64,")) == sample_sheet()
    assert images_of(None) == []


def test_loss_is_drawn_against_seconds() -> None:
    page = sample_page()
    assert [attributes["id"] for tag, attributes in page.elements if tag == "figure"] == ["loss"]
    assert page.drawings == ["Loss, relative to the start, against seconds"]
    sources = [attributes["src"] or "" for tag, attributes in page.elements if tag == "img"]
    (source,) = (source for source in sources if source.startswith(SVG))
    assert b"loss, relative to the unstylized scene" in base64.b64decode(source.removeprefix(SVG))


def test_hostile_names_are_escaped() -> None:
    report = sample_report()
    report["scene"]["path"] = f"folder/{HOSTILE.replace('/', '∕')}.ply"
    report["styles"][0]["path"] = "<img src=x onerror=alert(1)>.jpg"
    report["cameras"]["names"][1] = HOSTILE
    for moment in report["approximations"]["moments"]:
        moment["view"] = HOSTILE
    report["cameras"]["seeing_nothing"] = [HOSTILE]
    report["findings"][0]["worst"] = HOSTILE
    report["plan"]["decisions"][0]["decision"] = HOSTILE
    report["settings"]["preset"] = HOSTILE
    report["stopped"] = HOSTILE
    report["seconds_by_part"] = {HOSTILE: 1.0}
    report["machine"] = {HOSTILE: HOSTILE}
    report["history"][0]["stage"] = '"><script> $x^2$'
    report["approximations"]["what"] = [HOSTILE]
    report["novel_views"] = None
    page = parsed(report)
    assert page.cells.count(HOSTILE) == 4  # finding, decision, and the view of both probes
    assert "49" not in page.cells
    assert "<img src=x onerror=alert(1)>.jpg" in page.text


def test_non_unicode_names_are_replaced(tmp_path: Path) -> None:
    report = sample_report(0, 0)  # without charts
    report["scene"]["path"] = "caf\udce9.ply"  # Python's name for a file in another encoding
    write_page(tmp_path / "page.html", report, None)
    assert "caf?.ply" in (tmp_path / "page.html").read_text(encoding="utf-8")


def test_every_decision_and_finding_is_in_a_table() -> None:
    report = sample_report()
    cells = parsed_without_figures(report).cells
    for decision in report["plan"]["decisions"]:
        assert all(decision[name] in cells for name in ("item", "decision", "reason", "error"))
    assert {"4 MB", "8 MB"} <= set(cells)
    for finding in report["findings"]:
        assert all(finding[name] in cells for name in ("subject", "what", "done"))
    assert {"1,200 of 5,000", "Gaussian 7", "1 of 1"} <= set(cells)


@pytest.mark.parametrize(
    "row",
    [
        ["step on all scales", "2 s", "2.5 s", "1.25"],
        ["peak memory (upper bound)", "3 GB", "2.4 GB", "0.8"],
        ["peak memory of the GPU (upper bound)", "40 GB", "20 GB", "0.5"],
        ["distance to the style", "1.5", "0.625"],
        ["colors outside the displayable range", "2 %", "2 %"],
    ],
)
def test_values_to_compare_are_in_one_row(row: list[str]) -> None:
    report = sample_report()
    report["plan"]["prediction"]["device_bytes"] = 40_000_000_000
    report["plan"]["measured"]["device_bytes"] = 20_000_000_000
    cells = parsed_without_figures(report).cells
    place = cells.index(row[0])
    assert cells[place : place + len(row)] == row


def test_values_that_a_report_lacks_are_left_out() -> None:
    report = sample_report()
    report["loss_over_time"]["more_time"] = report["novel_views"]["judged"] = None
    text = parsed_without_figures(report).text
    for value in ("4 times the time", "distance to the style", "peak memory of the GPU"):
        assert value not in text


def test_time_is_divided_in_percent_with_a_remainder() -> None:
    page = parsed_without_figures(sample_report())
    widths = [attributes["style"] for tag, attributes in page.elements if tag == "i"]
    assert widths == ["width: 50.0%", "width: 20.0%", "width: 10.0%", "width: 20.0%"]
    assert "feature network, forward 50.0 % 1.8 s" in page.text
    assert "everything else 20.0 % 0.72 s" in page.text


def test_reports_without_optional_parts_are_shown() -> None:
    report = sample_report()
    report.update(novel_views=None, approximations=None, loss_over_time=None, findings=[], seconds_by_part={})
    report["plan"] = {"decisions": [], "prediction": None, "measured": {"seconds": None, "peak_bytes": 1}}
    for record in report["history"]:
        del record["parts"]
    page = parsed(report)
    assert [attributes["id"] for tag, attributes in page.elements if tag == "figure"] == ["loss"]
    assert "No extreme values were found." in page.text
    assert "Loss over time" not in page.text


def test_report_without_steps_has_no_figures() -> None:
    report = sample_report(0, 0)
    page = parsed(report)
    assert "No steps were run." in page.text
    assert page.drawings == []
    assert "No time was measured." in page.text


@pytest.mark.parametrize("wrong", [math.nan, -1.0])
def test_losses_outside_of_logarithmic_axes_are_left_out(wrong: float) -> None:
    report = sample_report()
    for record in report["history"]:
        record.update(loss=wrong, relative=wrong)
        for terms in record["scales"].values():
            terms.update(dict.fromkeys(terms, wrong))
    assert len(parsed(report).drawings) == 1


def colors_in(path: Path) -> set[tuple[int, ...]]:
    with Image.open(path) as image:
        assert image.format == "PNG"
        return {tuple(pixel) for pixel in np.unique(np.asarray(image.convert("RGB")).reshape(-1, 3), axis=0).tolist()}


@pytest.mark.parametrize(("coarse", "sos", "scales"), [(0, 1, 1), (3, 0, 2), (40, 60, 3)])
def test_chart_has_a_line_for_each_optimized_scale(coarse: int, sos: int, scales: int, tmp_path: Path) -> None:
    write_loss_chart(tmp_path / "c.png", sample_report(coarse, sos, scales))
    colors = colors_in(tmp_path / "c.png")
    there = range(scales) if sos else [scales - 1]
    for place, color in enumerate(COLORS):
        assert (ImageColor.getrgb(color) in colors) == (place in there), f"scale {place}"


def test_chart_without_steps_has_only_axes(tmp_path: Path) -> None:
    write_loss_chart(tmp_path / "c.png", sample_report(0, 0))
    colors = colors_in(tmp_path / "c.png")
    assert ImageColor.getrgb(INK) in colors
    assert not colors & {ImageColor.getrgb(color) for color in COLORS}


@pytest.mark.slow
def test_charts_need_no_home_folder(tmp_path: Path) -> None:
    environment = {name: value for name, value in os.environ.items() if not name.startswith(("MPL", "XDG_", "HOME"))}
    environment |= {"TMPDIR": str(tmp_path), "HOME": "/proc/absent"}
    command = [sys.executable, "-c", "import sgsst_core.report.page"]
    shown = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
    assert shown.stdout + shown.stderr == ""


def test_running_mean_is_geometric_and_over_the_last_window() -> None:
    values = [1.0, 10.0, 100.0, 1000.0, 10.0]
    np.testing.assert_allclose(running_mean(values, 3), [1, 10**0.5, 10, 100, 100])
    np.testing.assert_allclose(running_mean(values, 1), values)
    np.testing.assert_allclose(running_mean(values, 99), [math.prod(values[:n]) ** (1 / n) for n in range(1, 6)])
    for window in (1, 3, 99):
        assert running_mean(values, window)[-1] == pytest.approx(smoothed(values, window))
    assert np.isfinite(running_mean([0.0, 1.0], 1)).all()
    assert len(running_mean([], 3)) == 0
