"""Run of all tests that are marked `gpu` but not `slow`, with pytest."""

from __future__ import annotations

import subprocess
import sys
import tempfile
import xml.etree.ElementTree as ElementTree
from pathlib import Path
from typing import Any

from benchmarks.gpu.part import Findings, Sizes

ROOT = Path(__file__).resolve().parents[2]
#: Exit statuses of pytest that are no failure: all tests passed, or no test was selected.
_FINE = (0, 5)
#: Error texts of tests that need a package or file that this machine lacks. They say nothing about its GPU.
_MISSING = ("ModuleNotFoundError", "the tests need VGG16")


def run(sizes: Sizes, findings: Findings) -> None:
    """Run the tests, and add their outcomes to the findings.

    Raises:
        RuntimeError: If pytest itself has failed.
    """
    del sizes  # tests have their own sizes
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "results.xml"
        command = [
            sys.executable,
            "-m",
            "pytest",
            "-m",
            "gpu and not slow",
            "-q",
            "-p",
            "no:cacheprovider",
            "--tb=short",
        ]
        options = ["--continue-on-collection-errors", f"--junitxml={path}", *map(str, marked_files())]
        ended = subprocess.run([*command, *options], cwd=ROOT, capture_output=True, text=True)
        if not path.is_file():
            raise RuntimeError(f"pytest ended with status {ended.returncode}:\n{ended.stdout[-2000:]}{ended.stderr}")
        outcomes = [outcome(case) for case in ElementTree.parse(path).iter("testcase")]
    for kind in ("passed", "failed", "skipped"):
        own = [(name, reason) for name, what, reason in outcomes if what == kind]
        findings.add(kind, len(own) if kind == "passed" else dict(own))
    unexplained = ended.returncode not in _FINE and not any(what != "passed" for _, what, _ in outcomes)
    findings.check("tests_that_failed", float(sum(what == "failed" for _, what, _ in outcomes) + unexplained), 0.0)


def marked_files() -> list[Path]:
    """Return the test files that contain the mark `gpu`."""
    return sorted(path for path in (ROOT / "tests").rglob("test_*.py") if "mark.gpu" in path.read_text("utf-8"))


def outcome(case: Any) -> tuple[str, str, str]:
    """Return name, outcome ("passed", "failed" or "skipped") and reason from a test case in pytest's XML report."""
    name = f"{case.get('classname')}.{case.get('name')}".strip(".")
    problem = next((part for part in case if part.tag in ("failure", "error", "skipped")), None)
    if problem is None:
        return name, "passed", ""
    text = f"{problem.get('message', '')}\n{problem.text or ''}"
    if problem.tag == "skipped":
        return name, "skipped", problem.get("message", "")
    if any(part in text for part in _MISSING):
        lines = [line.strip() for line in text.splitlines() if any(part in line for part in _MISSING)]
        return name, "skipped", lines[-1]
    return name, "failed", text[-2000:]
