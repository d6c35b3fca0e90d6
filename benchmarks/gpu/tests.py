"""The tests that are marked `gpu`, as pytest runs them."""

from __future__ import annotations

import subprocess
import sys
import tempfile
import xml.etree.ElementTree as ElementTree
from pathlib import Path
from typing import Any

from benchmarks.gpu.part import Findings, Sizes

ROOT = Path(__file__).resolve().parents[2]
#: What pytest ends with when every test passed, and when none was selected.
_FINE = (0, 5)
#: How a test fails, or a file cannot be read, where something is missing on this machine that is no fault of a GPU's.
_MISSING = ("ModuleNotFoundError", "the tests need VGG16")


def run(sizes: Sizes, found: Findings) -> None:
    """Run them, and sort their outcomes.

    Raises:
        RuntimeError: pytest itself has failed.
    """
    del sizes  # a test has its own
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "results.xml"
        command = [sys.executable, "-m", "pytest", "-m", "gpu", "-q", "-p", "no:cacheprovider", "--tb=short"]
        options = ["--continue-on-collection-errors", f"--junitxml={path}", *map(str, marked_files())]
        ended = subprocess.run([*command, *options], cwd=ROOT, capture_output=True, text=True)
        if not path.is_file():
            raise RuntimeError(f"pytest ended with status {ended.returncode}:\n{ended.stdout[-2000:]}{ended.stderr}")
        outcomes = [outcome(case) for case in ElementTree.parse(path).iter("testcase")]
    for kind in ("passed", "failed", "skipped"):
        own = [(name, said) for name, what, said in outcomes if what == kind]
        found.add(kind, len(own) if kind == "passed" else dict(own))
    unexplained = ended.returncode not in _FINE and not any(what != "passed" for _, what, _ in outcomes)
    found.check("tests_that_failed", float(sum(what == "failed" for _, what, _ in outcomes) + unexplained), 0.0)


def marked_files() -> list[Path]:
    """Files in which a test may be marked."""
    return sorted(path for path in (ROOT / "tests").rglob("test_*.py") if "mark.gpu" in path.read_text("utf-8"))


def outcome(case: Any) -> tuple[str, str, str]:
    """Name, "passed", "failed" or "skipped", and why, of an element of pytest's XML."""
    name = f"{case.get('classname')}.{case.get('name')}".strip(".")
    problem = next((part for part in case if part.tag in ("failure", "error", "skipped")), None)
    if problem is None:
        return name, "passed", ""
    text = f"{problem.get('message', '')}\n{problem.text or ''}"
    if problem.tag == "skipped":
        return name, "skipped", problem.get("message", "")
    if any(part in text for part in _MISSING):
        said = [line.strip() for line in text.splitlines() if any(part in line for part in _MISSING)]
        return name, "skipped", said[-1]
    return name, "failed", text[-2000:]
