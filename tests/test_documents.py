"""Tests that the targets of references in README, CONTRIBUTING, CHANGELOG and docs/ exist.

Anchors are checked by `make docs`.
"""

import functools
import importlib.util
import re
from pathlib import Path

import pytest

from service.settings import ServiceSettings
from sgsst_core.files.formats import FORMATS

ROOT = Path(__file__).resolve().parents[1]
DOCUMENTS = sorted([*ROOT.glob("*.md"), *(ROOT / "docs").glob("*.md")])
#: Maximum line length; rows of a table are exempt, because they cannot be wrapped.
COLUMNS = 120
#: Folders with files that a document may refer to.
FOLDERS = ("sgsst_core", "worker", "service", "api", "tests", "benchmarks", "deploy", "docs")


def name_of(document: Path) -> str:
    """Return the id of a document's test."""
    return document.relative_to(ROOT).as_posix()


each_document = pytest.mark.parametrize("document", DOCUMENTS, ids=name_of)
#: Excludes the changelog, which also names files and modules of earlier versions.
each_document_of_today = pytest.mark.parametrize(
    "document", [path for path in DOCUMENTS if path.name != "CHANGELOG.md"], ids=name_of
)


@each_document
def test_lines_have_at_most_120_columns(document: Path) -> None:
    lines = document.read_text().splitlines()
    assert [line for line in lines if len(line) > COLUMNS and not line.startswith("|")] == []


@each_document
def test_link_targets_exist(document: Path) -> None:
    targets = re.findall(r"\]\(([^)#]+)", document.read_text())
    files = [target for target in targets if "://" not in target]
    assert [file for file in files if not (document.parent / file).exists()] == []


@each_document_of_today
def test_cited_files_exist(document: Path) -> None:
    named = re.findall(rf"`((?:{'|'.join(FOLDERS)})/[^` ]*)`", document.read_text())
    assert [path for path in named if not list(ROOT.glob(path))] == []


@each_document_of_today
def test_cited_modules_exist(document: Path) -> None:
    named = re.findall(rf"(?:python -m|from) ((?:{'|'.join(FOLDERS)})[\w.]*)", document.read_text())
    assert [name for name in named if importlib.util.find_spec(name) is None] == []


@functools.cache
def names_in_tests() -> set[str]:
    """Return the names of all tests, and of their modules, classes and constants."""
    paths = list((ROOT / "tests").rglob("*.py"))
    pattern = re.compile(r"(?:def |class |^)(\w+)", re.M)
    return {path.stem for path in paths} | {name for path in paths for name in pattern.findall(path.read_text())}


@each_document_of_today
def test_cited_tests_exist(document: Path) -> None:
    named = set(re.findall(r"`(?:[\w/]+\.py::)?(test_\w+|Test\w+)`", document.read_text()))
    assert named - names_in_tests() == set()


def usage_rows(heading: str) -> list[list[str]]:
    """Return the cells of the table in `docs/usage.md` with a heading."""
    lines = (ROOT / "docs" / "usage.md").read_text().partition(heading)[2].splitlines()
    rows = [line for line in lines[2:] if line.startswith("|") or not line]
    return [row.strip("|").split(" | ") for row in rows[: rows.index("")]]


def test_usage_lists_every_scene_format() -> None:
    listed = {suffix for row in usage_rows("| scene format |") for suffix in re.findall(r"`(\.[\w.]+)`", row[0])}
    assert {each.suffix for each in FORMATS} == listed | {".v3.spz"}


def test_usage_lists_every_capture() -> None:
    captures = {path.name for path in (ROOT / "tests/sgsst_core/files/captures").iterdir()}
    assert {name for row in usage_rows("| from | give |") for name in re.findall(r"`(\w+)`", row[-1])} == captures


def test_operations_lists_every_setting_with_its_default() -> None:
    listed = dict(re.findall(r"^\| `SGSST_(\w+)` \| (.*?) \| ", (ROOT / "docs/operations.md").read_text(), re.M))
    defaults = {name.upper(): field.default for name, field in ServiceSettings.model_fields.items()}
    assert listed.keys() == defaults.keys()
    written = {name: text.strip("`").replace(",", "").replace(" GB", "0" * 9) for name, text in listed.items()}
    described = {name for name, value in defaults.items() if value is None or value == ""}
    wrong = {name for name, value in defaults.items() if written[name] != str(value).replace("False", "false")}
    assert wrong == described
