"""Tests of the stored results: each says what it was measured with, and documents state what it says."""

import json
import re
from collections.abc import Iterator
from pathlib import Path
from statistics import median
from typing import Any

import pytest

from benchmarks import common, left_out
from sgsst_core import make_settings

ROOT = Path(__file__).resolve().parents[2]
FILES = {path.name: json.loads(path.read_text(encoding="utf-8")) for path in sorted(common.RESULTS.glob("*.json"))}
DOCUMENTS = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md")), common.RESULTS / "README.md"]
FIELDS = {"date", "commit", "command", "loaded", "machine", "presets", "scenes"}
MOST_FILES = 24
#: A figure, its unit, and a comment that names its file, its place in it, and a factor.
FIGURE = re.compile(r"(-?[\d.,]*\d(?:e-?\d+)?)[^\d|]{0,24}<!-- (\w+) ([^>]+?)(?: x([\d.e-]+))? -->")


def earlier() -> set[str]:
    """Return the files that their page says to be from before provenance was stored."""
    page = (common.RESULTS / "README.md").read_text(encoding="utf-8")
    start = page.index("Files from before")
    return set(re.findall(r"`(\w+\.json)`", page[start : page.index("\n\n", start)]))


def provenances(content: dict[str, Any]) -> Iterator[dict[str, Any]]:
    """Yield the provenance of a file's figures, or that of each pair."""
    yield from content["pairs"].values() if "pairs" in content else [content]


def test_no_more_files_than_anybody_reads() -> None:
    assert len(FILES) <= MOST_FILES


def test_every_file_says_what_it_was_measured_with() -> None:
    without = {name for name, content in FILES.items() if any(FIELDS - {*each} for each in provenances(content))}
    assert without == earlier()


def test_presets_have_the_settings_that_were_measured() -> None:
    changed = {
        f"{name}: {field} of {preset}"
        for name, content in FILES.items()
        for each in provenances(content)
        for preset, settings in each.get("presets", {}).items()
        for field, value in make_settings(preset).model_dump(mode="json").items()
        if field in settings and settings[field] != value
    }
    assert not changed, "measure these again, or say in benchmarks/results/README.md that they are older"


def test_every_file_is_cited() -> None:
    text = "".join(path.read_text(encoding="utf-8") for path in DOCUMENTS)
    assert not [name for name in FILES if name not in text]


@pytest.mark.parametrize("path", DOCUMENTS, ids=lambda path: str(path.relative_to(ROOT)))
def test_marked_figures_are_those_of_their_file(path: Path) -> None:
    text = path.read_text(encoding="utf-8")
    marked = list(FIGURE.finditer(text))
    assert len(marked) == len(re.findall(r"<!-- \w+ [^>]*-->", text)), "a marker stands behind no figure"
    for match in marked:
        stated, name, place, factor = match.groups()
        value: Any = FILES[f"{name}.json"]
        for key in place.split("/"):
            value = value[int(key)] if isinstance(value, list) else value[key]
        mantissa, _, exponent = stated.replace(",", "").partition("e")
        unit = 10.0 ** (int(exponent or 0) - len(mantissa.partition(".")[2]))
        exact = float(value) * float(factor or 1)
        assert float(stated.replace(",", "")) == pytest.approx(exact, abs=0.51 * unit), match[0]


def test_what_leaving_out_saves_is_what_was_measured() -> None:
    scenes = FILES["left_out.json"]["pairs"]
    assert left_out.table(scenes) in (ROOT / "docs" / "performance.md").read_text(encoding="utf-8")
    more = [scene["rows"]["everything"]["job"]["more"] for scene in scenes.values()]
    stated = f"{median(more):.0%} longer ({min(more):.0%} to {max(more):.0%} on {len(more)} scenes)"
    assert stated in " ".join((ROOT / "README.md").read_text(encoding="utf-8").split())


def test_results_store_what_they_were_measured_with(tmp_path: Path) -> None:
    scene = tmp_path / "scene.ply"
    scene.write_bytes(b"ply")
    path = common.write_result("figures", {"figure": 1}, tmp_path, presets=["preview"], scenes={"one": scene})
    content = json.loads(path.read_text())
    assert {*content} == FIELDS | {"figure"}
    assert content["presets"]["preview"] == make_settings("preview").model_dump(mode="json")
    assert content["scenes"]["one"].startswith("c7a41639"), "SHA-256 of the file"
    assert len(content["machine"]["load_before"]) == 3


def test_busy_machine_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    import argparse

    monkeypatch.setattr(common.psutil, "getloadavg", lambda: (9.0, 9.0, 9.0))
    monkeypatch.setattr(common.psutil, "process_iter", lambda names: [])
    monkeypatch.setattr(common, "_SECONDS_TO_FALL", 1)
    with pytest.raises(
        SystemExit, match=r"The load is 9.0, above [\d.]+, which distorts what is measured: .* --loaded"
    ):
        common.parse(argparse.ArgumentParser(), [])
    assert common.parse(argparse.ArgumentParser(), ["--loaded"]).loaded
