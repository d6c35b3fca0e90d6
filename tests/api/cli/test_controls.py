"""Tests of artistic controls on the command line: they are validated, shown in the plan and applied to the result."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import torch

from api.cli.main import main
from sgsst_core.files.scene_file import read_scene
from sgsst_core.scene.stored_harmonics import held
from tests.small_scenes import wall, write_files

pytestmark = pytest.mark.usefixtures("one_thread", "tiny_installed")

CONTROLS = [
    "--preserve-colors",
    "luminance",
    "--sh-attenuation",
    "0.25",
    "--scales",
    "1,0,0.5",
    "--coarsest-side",
    "16",
]


def command(name: str, folder: Path, *options: str) -> list[str]:
    ply, cameras, style = write_files(folder, wall(sh_degree=1))
    return [name, str(ply), "--style", str(style), "--cameras", str(cameras), "--backbone", "vgg16", *options]


@pytest.mark.parametrize("form", [pytest.param("compressed.ply", marks=pytest.mark.slow), "spz"])
def test_controls_take_effect_and_are_reported(tmp_path: Path, capsys: pytest.CaptureFixture[str], form: str) -> None:
    out = tmp_path / "new" / f"out.{form}"
    steps = ["--steps-coarse", "1", "--steps-sos", "3"]
    assert main(command("stylize", tmp_path, "--out", str(out), *steps, *CONTROLS)) == 0
    shown = capsys.readouterr().out
    for line in (
        "only luminance is compared and optimized",
        "multiplied by 0.75",
        "scale 0 1, scale 2 0.5; 1 of 3 scales are not computed",
        "2 of 3 scales",
        f"compressed:           {form}, ",
        "dB PSNR against the PLY",
    ):
        assert line in shown
    before, after = (read_scene(path).scene for path in (tmp_path / "scene.ply", tmp_path / "new" / "out.ply"))
    assert torch.equal(held(after.sh_rest), 0.75 * held(before.sh_rest))
    change = after.sh_dc - before.sh_dc
    assert float(change.abs().max()) > 0.1
    torch.testing.assert_close(change, change.mean(1, keepdim=True).expand(-1, 3), atol=1e-6, rtol=0)
    report = json.loads((tmp_path / "new" / "out.report.json").read_text())
    assert report["settings"]["preserve_colors"] == "luminance"
    assert report["settings"]["scales"] == [1, 0, 0.5]
    assert report["settings"]["sh_attenuation"] == 0.25
    assert report["scene"]["sh_degree"] == 1
    assert (report["compressed"]["name"], report["compressed"]["bytes"]) == (out.name, out.stat().st_size)
    loss = report["loss"]["after"]
    assert sorted(loss["scales"]) == ["0", "2"]
    assert loss["total"] == pytest.approx((loss["scales"]["0"]["total"] + 0.5 * loss["scales"]["2"]["total"]) / 1.5)
    packed = read_scene(out).scene
    assert float(held(packed.sh_rest).abs().max()) < 0.8 * float(held(before.sh_rest).abs().max())


@pytest.mark.parametrize(
    ("options", "problem"),
    [
        (["--scales", "0,0"], "no scale has a weight"),
        (["--scales", "1,-1"], "greater than or equal to 0"),
        (["--scales", "nan"], "finite"),
        (["--scales", "fine"], "is not a list of weights"),
        (["--scales", "0,1"], "the views have one scale, 0"),
        (["--sh-attenuation", "1.5"], "less than or equal to 1"),
        (["--preserve-colors", "hue"], "hue"),
    ],
    ids=str,
)
def test_contradictory_controls_are_rejected_before_work_starts(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], options: list[str], problem: str
) -> None:
    for name in ("stylize", "plan"):
        out = tmp_path / ("out.ply" if name == "stylize" else "plan.json")
        assert main(command(name, tmp_path, "--out", str(out), *options)) == 2
        assert problem in capsys.readouterr().err
        assert not out.exists()
