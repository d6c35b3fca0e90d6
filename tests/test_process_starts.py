"""Tests that no process that the project starts runs code from the current folder."""

import ast
import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from worker.ranks.cluster import Cluster

ROOT = Path(__file__).resolve().parents[1]
PACKAGES = ("sgsst_core", "worker", "service", "api")
#: Modules that programs import, the project itself or Python's start of a process among them.
IMPORTED = ("colorsys", "numba", "sqlalchemy", "uvicorn", "pip", "torch", "psutil", "numpy", "random", "ray")


def starts(tree: ast.AST) -> list[tuple[int, bool]]:
    """Return the line of each use of `sys.executable`, and whether it starts a command that ignores the folder."""
    safe = {
        id(node.elts[0])
        for node in ast.walk(tree)
        if isinstance(node, ast.List | ast.Tuple)
        and len(node.elts) > 1
        and isinstance(node.elts[1], ast.Constant)
        and node.elts[1].value in ("-P", "-I")
    }
    return [
        (node.lineno, id(node) in safe)
        for node in ast.walk(tree)
        if isinstance(node, ast.Attribute) and ast.unparse(node) == "sys.executable"
    ]


def test_every_python_ignores_the_current_folder() -> None:
    files = [path for package in PACKAGES for path in (ROOT / package).rglob("*.py")]
    uses = {f"{path}:{line}": safe for path in files for line, safe in starts(ast.parse(path.read_text()))}
    assert len(uses) > 5
    assert [where for where, safe in uses.items() if not safe] == [], "start it with -P"


@pytest.fixture
def hostile(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Enter a folder with modules that tell when they are imported, and return the file that they write."""
    traces = tmp_path / "traces"
    monkeypatch.chdir(tmp_path)
    for name in IMPORTED:
        Path(f"{name}.py").write_text(f"open({str(traces)!r}, 'a').write({name!r} + ' ')\n")
    return traces


@pytest.mark.slow
def test_command_imports_nothing_from_the_current_folder(hostile: Path) -> None:
    """The check of the machine compiles and computes in a process of its own."""
    command = [sys.executable, "-P", "-m", "api.cli", "doctor", "--json"]
    done = subprocess.run(command, capture_output=True, text=True, check=False, env={**os.environ, "NO_COLOR": "1"})
    assert json.loads(done.stdout), done.stderr
    assert not hostile.exists()


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="Windows has no ranks")
def test_ranks_import_nothing_from_the_current_folder(hostile: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("RAY_ADDRESS", raising=False)
    with Cluster(1):
        import ray

        path = ray.get(ray.remote(lambda: __import__("sys").path).remote())
    assert str(hostile.parent) not in path
    assert "" not in path
    assert not hostile.exists()
