"""Test that the program stays within the sizes of `[tool.sgsst.size]` in pyproject.toml."""

import ast
import io
import tokenize
import tomllib
from functools import cache
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
BUDGETS = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["sgsst"]["size"]
SHIPPED = ("sgsst_core", "worker", "service", "api")
FOLDERS = (*SHIPPED, "benchmarks", "tests")
#: A budget more than this fraction above the size has to follow it downwards.
SLACK = 0.03
NOT_CODE = {tokenize.COMMENT, tokenize.NL, tokenize.NEWLINE, tokenize.INDENT, tokenize.DEDENT, tokenize.ENDMARKER}


def _is_text(node: ast.AST) -> bool:
    """Return whether a node is a docstring or another string that stands by itself."""
    return isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant) and isinstance(node.value.value, str)


def _lines(node: ast.stmt) -> range:
    return range(node.lineno, (node.end_lineno or node.lineno) + 1)


@cache
def python_size(folder: str) -> tuple[int, int]:
    """Return the statements of a folder, without docstrings, and its modules."""
    paths = list((ROOT / folder).rglob("*.py"))
    nodes = (node for path in paths for node in ast.walk(ast.parse(path.read_text("utf-8"))))
    return sum(isinstance(node, ast.stmt) and not _is_text(node) for node in nodes), len(paths)


def import_percentage() -> float:
    """Return the percentage of the shipped lines of code that are imports."""
    code_lines = import_lines = 0
    for path in (path for folder in SHIPPED for path in (ROOT / folder).rglob("*.py")):
        source = path.read_text("utf-8")
        statements = [node for node in ast.walk(ast.parse(source)) if isinstance(node, ast.stmt)]
        texts = {line for node in statements if _is_text(node) for line in _lines(node)}
        imports = {
            line for node in statements if isinstance(node, ast.Import | ast.ImportFrom) for line in _lines(node)
        }
        tokens = [each for each in tokenize.generate_tokens(io.StringIO(source).readline) if each.type not in NOT_CODE]
        code = {line for token in tokens for line in range(token.start[0], token.end[0] + 1)} - texts
        code_lines += len(code)
        import_lines += len(imports & code)
    return 100 * import_lines / code_lines


def page_size() -> tuple[int, int]:
    """Return the lines and files of the page, without third-party files."""
    files = [path for path in (ROOT / "api/static").rglob("*") if path.suffix in (".js", ".css", ".html")]
    files = [path for path in files if "vendor" not in path.parts]
    return sum(path.read_text("utf-8").count("\n") for path in files), len(files)


def check(what: str, size: int, budget: int) -> None:
    assert size <= budget, (
        f"{what} has {size}, more than the {budget} of pyproject.toml. Delete what became superfluous."
    )
    least = budget * (1 - SLACK)
    assert size >= least, f"{what} has only {size}: lower its budget of {budget} in pyproject.toml."


@pytest.mark.parametrize("folder", FOLDERS)
def test_statements_and_modules_are_within_budget(folder: str) -> None:
    statements, modules = python_size(folder)
    check(f"{folder}: statements", statements, BUDGETS[folder]["statements"])
    check(f"{folder}: modules", modules, BUDGETS[folder]["modules"])


def test_the_page_is_within_budget() -> None:
    lines, files = page_size()
    check("the page: lines", lines, BUDGETS["page"]["lines"])
    check("the page: files", files, BUDGETS["page"]["files"])


def test_imports_are_within_budget() -> None:
    percentage = import_percentage()
    assert percentage <= BUDGETS["imports_percent"], f"{percentage:.1f} % of the lines of code are imports"


@pytest.mark.parametrize(("size", "passes"), [(100, True), (98, True), (101, False), (96, False)])
def test_budgets_hold_upwards_and_follow_downwards(size: int, passes: bool) -> None:
    if passes:
        check("a folder", size, 100)
    else:
        with pytest.raises(AssertionError, match="a folder has"):
            check("a folder", size, 100)
