"""Tests of the examination of a machine."""

import json
import stat
import sys
from pathlib import Path
from typing import Any

import pytest
import torch

from api.cli.main import main
from sgsst_core.bench import device_checks, doctor
from sgsst_core.bench.device_checks import check_device
from sgsst_core.bench.doctor import Diagnosis, examine
from sgsst_core.rasterizer.cpu import CpuRasterizer

pytestmark = pytest.mark.usefixtures("one_thread")
CPU = torch.device("cpu")
SMALL: dict[str, Any] = {"gaussians": 100, "size": (32, 24), "repeats": 2, "channels": 16}


def test_this_machine_works(tiny_installed: Path) -> None:
    findings = list(examine(limit=400.0))
    assert [finding for finding in findings if finding.state == "problem"] == []
    topics = [finding.topic for finding in findings]
    assert topics == ["weights", "program", "GPU", "memory", "rasterizer", "precision", "results", "kernels"]
    assert "checks pass" in findings[-2].text


@pytest.mark.slow
def test_missing_weights_are_a_problem(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("SGSST_CACHE", str(tmp_path / "cache"))
    assert main(["doctor", "--json"]) == 1
    findings = json.loads(capsys.readouterr().out)
    assert (findings[0]["topic"], findings[0]["state"]) == ("weights", "problem")
    assert "sgsst weights fetch" in findings[0]["text"]


def test_unwritable_folders_are_reported(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    file = tmp_path / "file"
    file.touch()
    monkeypatch.setenv("SGSST_CACHE", str(file))
    monkeypatch.setenv("TRITON_CACHE_DIR", str(file / "triton"))
    states = [(finding.state, finding.text.split("Set ")[-1]) for finding in device_checks._caches()]
    assert states == [("warning", "SGSST_CACHE."), ("warning", "TRITON_CACHE_DIR.")]


def test_wrong_images_are_a_problem(monkeypatch: pytest.MonkeyPatch) -> None:
    render = CpuRasterizer._render
    monkeypatch.setattr(CpuRasterizer, "_render", lambda *arguments: 1.001 * render(*arguments))
    checks = {check.name: check for check in check_device("cpu", CPU, **SMALL)}
    failed = {name for name, check in checks.items() if not check.passed}
    assert {"image", "coverage"} <= failed <= {"image", "coverage", "gradient"}
    finding, *_ = device_checks._results("cpu", CPU)
    assert finding.state == "problem"
    assert finding.text.startswith("wrong image: 0.00")


def test_hanging_or_crashed_examination_is_a_finding(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    program = tmp_path / "python"
    program.write_text(
        '#!/bin/sh\necho \'{"topic": "a", "state": "works", "text": "b"}\'\necho no driver >&2\nexit 4\n'
    )
    program.chmod(program.stat().st_mode | stat.S_IXUSR)
    monkeypatch.setattr(sys, "executable", str(program))
    first = Diagnosis("a", "works", "b")
    crashed = Diagnosis("program", "problem", "the examination ended with status 4: no driver")
    assert list(examine()) == [first, crashed]
    program.write_text(program.read_text().replace("exit 4", "exec sleep 100"))
    findings = list(examine(limit=1.0))
    assert (findings[0], findings[1].topic, findings[1].state) == (first, "time", "warning")


@pytest.mark.parametrize(
    ("states", "code"), [(["works"], 0), (["works", "warning"], 3), (["warning", "problem", "works"], 1)]
)
def test_exit_code_follows_from_the_worst_finding(
    states: list[Any], code: int, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(doctor, "examine", lambda: [Diagnosis("topic", state, "text") for state in states])
    assert main(["doctor"]) == code
    assert len(capsys.readouterr().out.splitlines()) == len(states)
