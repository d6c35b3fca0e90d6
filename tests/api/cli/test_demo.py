"""Test of `sgsst demo`, reduced to one step on small views: the same files and code path as the full demo."""

from __future__ import annotations

import json
import shlex
from pathlib import Path

import pytest
import torch

from api.cli import stylize_commands
from api.cli.main import main
from sgsst_core.features.network_weights import BackboneWeights
from sgsst_core.files.scene_file import read_scene


@pytest.mark.slow
def test_demo_stylizes_its_scene_and_prints_result_paths(
    vgg16_weights: BackboneWeights,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setattr(stylize_commands, "DEMO_STEPS", 1)
    monkeypatch.setattr(stylize_commands, "DEMO_RESOLUTION", 180)
    out = tmp_path / "demo"
    assert main(["demo", "--out", str(out)]) == 0
    shown = capsys.readouterr().out
    names = {"stylized.ply", "stylized.report.json", "stylized.before_after.jpg", "stylized.loss.png"}
    names |= {"stylized.report.html"}
    inputs = {"motorcycle.ply", "cameras.json", "starry_night.jpg"}
    assert {path.name for path in out.iterdir()} == names | inputs | {"stylized.plan.json"}
    for name in names:
        assert str(out / name) in shown
    before, after = read_scene(out / "motorcycle.ply").scene, read_scene(out / "stylized.ply").scene
    assert torch.equal(before.means, after.means)
    assert float((before.sh_dc != after.sh_dc).float().mean()) > 0.5
    report = json.loads((out / "stylized.report.json").read_text())
    assert report["loss"]["relative"] < 0.9
    assert report["cameras"]["count"] == 10

    # The printed command is the one that ran.
    command = next(line for line in shown.splitlines() if line.startswith("command:")).removeprefix("command:")
    arguments = shlex.split(command)
    assert arguments[:3] == ["sgsst", "stylize", str(out / "motorcycle.ply")]
    assert main([*arguments[1:], "--resume"]) == 2
    assert "this job is finished" in capsys.readouterr().err


def test_demo_rejects_unwritable_folder(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "file").touch()
    assert main(["demo", "--out", str(tmp_path / "file")]) == 2
    assert "file" in capsys.readouterr().err
