"""Tests that docstrings start with a noun or a verb, and that identifiers use the terms of docs/style.md."""

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
#: Folders whose docstrings follow docs/style.md.
FOLDERS = ("api", "benchmarks", "deploy", "service", "sgsst_core", "tests", "worker")
OPENERS = ("Of", "Who", "What", "That", "From which", "In which")
SECTIONS = ("Args", "Attributes", "Raises")
OPENS_BADLY = re.compile(rf"(?:{'|'.join(OPENERS)})\b", re.IGNORECASE)
#: An entry: an indented name, or several with commas between, a colon, and its text.
ENTRY = re.compile(r"^ {4}[\w.*, ]+: *(.*)$")


def entries(docstring: str) -> Iterator[str]:
    """Yield the texts of the entries of `Args:`, `Attributes:` and `Raises:`."""
    section = ""
    for line in docstring.splitlines():
        if heading := re.match(r"(\w+):$", line):
            section = heading[1]
        elif line and not line.startswith(" "):
            section = ""
        elif section in SECTIONS and (entry := ENTRY.match(line)):
            yield entry[1]


def prose(docstring: str) -> list[str]:
    """Return the docstring and the texts of its entries."""
    return [docstring, *entries(docstring)]


def docstrings(path: Path) -> Iterator[tuple[int, str]]:
    """Yield line and text of each docstring of a file, including those of private functions."""
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef) and (
            text := ast.get_docstring(node)
        ):
            yield getattr(node, "lineno", 1), text


@pytest.mark.parametrize("folder", FOLDERS)
def test_docstrings_start_with_a_noun_or_a_verb(folder: str) -> None:
    paths = sorted((ROOT / folder).rglob("*.py"))
    assert paths
    bad = [
        f"{path.relative_to(ROOT)}:{line}: {text.splitlines()[0]}"
        for path in paths
        for line, docstring in docstrings(path)
        for text in prose(docstring)
        if OPENS_BADLY.match(text)
    ]
    assert bad == []


#: Words that do not say what a value is.
VAGUE = {
    *("anew", "bought", "brought", "found", "gave", "gone", "got", "heard", "kept", "made", "nobody", "picture"),
    *("pictures", "revive", "room", "somebody", "someone", "stuff", "surround", "surrounds", "swing", "tell"),
    *("tells", "thing", "things", "told", "twin", "twins", "workshop"),
}
#: Names that PyTorch and asyncio define, and an attack over HTTP connections that are kept alive.
ALLOWED = {"connection_made", "found_inf", "kept_alive"}


def names(source: str) -> Iterator[tuple[int, str]]:
    """Yield line and name of each identifier that a module defines, except tests, whose names are sentences."""
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef):
            if not node.name.startswith("test_"):
                yield node.lineno, node.name
        elif isinstance(node, ast.arg):
            yield node.lineno, node.arg
        elif isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store):
            yield node.lineno, node.id
        elif isinstance(node, ast.Attribute) and isinstance(node.ctx, ast.Store):
            yield node.lineno, node.attr


def vague(source: str) -> list[tuple[int, str]]:
    """Return line and name of each identifier that contains a vague word."""
    return [(line, name) for line, name in names(source) if name not in ALLOWED and VAGUE & set(name.split("_"))]


@pytest.mark.parametrize("folder", FOLDERS)
def test_identifiers_are_terms(folder: str) -> None:
    paths = sorted((ROOT / folder).rglob("*.py"))
    assert paths
    bad = [f"{path.relative_to(ROOT)}:{line}: {name}" for path in paths for line, name in vague(path.read_text())]
    assert bad == []
