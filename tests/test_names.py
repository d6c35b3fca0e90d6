"""Tests that identifiers use terms of docs/style.md instead of everyday words."""

import ast
from collections.abc import Iterator

import pytest

from tests.test_prose import FOLDERS, ROOT

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
