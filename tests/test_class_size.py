"""Test that no class sets more attributes on itself than a reader can remember."""

import ast
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
#: Packages whose classes are small. Add a package once it passes.
PACKAGES = ("api", "service", "sgsst_core", "worker")
MOST_ATTRIBUTES = 15


def attributes(node: ast.ClassDef) -> set[str]:
    """Return the names of the attributes that the methods of a class set on `self`.

    Fields of dataclasses and of models are not counted: they are a list of data, not the state of an object.
    """
    methods = [item for item in node.body if isinstance(item, ast.FunctionDef | ast.AsyncFunctionDef)]
    return {
        item.attr
        for method in methods
        for item in ast.walk(method)
        if isinstance(item, ast.Attribute)
        and isinstance(item.ctx, ast.Store)
        and isinstance(item.value, ast.Name)
        and item.value.id == "self"
    }


def classes(source: str) -> list[ast.ClassDef]:
    return [node for node in ast.walk(ast.parse(source)) if isinstance(node, ast.ClassDef)]


@pytest.mark.parametrize("package", PACKAGES)
def test_no_class_has_more_than_15_attributes(package: str) -> None:
    paths = sorted((ROOT / package).rglob("*.py"))
    assert paths
    counts = {
        f"{path.relative_to(ROOT)}:{node.lineno}: {node.name}": len(attributes(node))
        for path in paths
        for node in classes(path.read_text())
    }
    assert {name: count for name, count in counts.items() if count > MOST_ATTRIBUTES} == {}
