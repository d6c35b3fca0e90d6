"""Tests of `python -m benchmarks.gpu` at small sizes: all parts run, and the results have the expected fields."""

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from benchmarks.gpu.__main__ import PARTS

pytest.importorskip("triton")
pytestmark = pytest.mark.slow
ROOT = Path(__file__).resolve().parents[2]


def benchmark(folder: Path, *options: str) -> tuple[int, dict[str, Any]]:
    """Run the benchmark; return its exit status and the written results."""
    out = folder / "gpu.json"
    command = [sys.executable, "-m", "benchmarks.gpu", "--quick", "--out", str(out), *options]
    environment = {key: value for key, value in os.environ.items() if key != "TRITON_INTERPRET"}
    ended = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True)
    assert out.is_file(), ended.stderr
    return ended.returncode, json.loads(out.read_text())


def test_every_part_succeeds(tmp_path: Path) -> None:
    status, written = benchmark(tmp_path)
    parts = written["parts"]
    assert {name: part.get("reason", part["status"]) for name, part in parts.items()} == dict.fromkeys(
        PARTS, "succeeded"
    )
    assert status == 0
    assert written["quick"]
    findings = {name: part["findings"] for name, part in parts.items()}
    assert all(check["passed"] for check in findings["poison"]["small"].values())
    assert all(findings["parity"]["triton"][name]["passed"] for name in ("image", "coverage", "gradient"))
    assert findings["parity"]["triton"]["different_of_2_repeats"]["error"] == 0
    whole = findings["job"]["3x32x32"]
    assert whole["steps"] == 2
    assert sum(whole["seconds_by_part"].values()) == pytest.approx(whole["seconds_total"], abs=0.02)
    assert whole["seconds_total"] < whole["seconds"] + 0.02, "the process ends after its last report"
    assert whole["plan"]["prediction"]["seconds"] > 0
    assert {"60", "120"} <= findings["raster"].keys()
    assert findings["step"]["32x32"]["float32"]["rasterizer"] == "triton"
    assert len(findings["curve"]["losses"]) == len(findings["curve"]["losses_on_the_cpu"]) == 2
    assert findings["curve"]["loss"]["passed"]
    assert findings["ranks"]["colors"]["passed"]


def test_failed_part_reports_reason_and_others_continue(tmp_path: Path) -> None:
    status, written = benchmark(tmp_path, "--only", "raster", "parity", "--gaussians", "0")
    assert status == 1
    assert written["parts"]["raster"]["status"] == "failed"
    assert "ZeroDivisionError" in written["parts"]["raster"]["reason"]
    assert written["parts"]["raster"]["findings"]["view"] == [32, 16]
    assert written["parts"]["parity"]["status"] == "succeeded"
