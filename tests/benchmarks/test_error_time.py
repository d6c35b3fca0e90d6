"""Tests of error against run time: the tables and the figure of rows, and a run of real commands on a small scene."""

from pathlib import Path
from typing import Any

import pytest
import torch
from PIL import Image

from benchmarks import common, error_time
from benchmarks.error_time import (
    DPI,
    SIZE,
    above_envelope,
    report,
    run,
    runs_of,
    stored,
    table,
    write_cameras,
    write_figure,
)
from sgsst_core.files.camera_files import read_cameras
from tests.small_scenes import cameras, wall, write_files

ROOT = Path(__file__).resolve().parents[2]


def row(seconds: float, loss: float, curve: list[tuple[float, float]] | None = None) -> dict[str, Any]:
    return {"seconds": seconds, "loss": loss, "style": 0.5 + loss, "color_distance": 20.0, "curve": curve}


#: Two seeds of some ways, and one of another.
RUNS = runs_of(
    {
        "within 15s, seed 0": row(14, 0.5),
        "within 15s, seed 1": row(16, 0.7),
        "within 1m, seed 0": row(60, 0.36),
        "preview, seed 0": row(50, 0.3),
        "standard, seed 0": row(400, 0.25, [(20.0, 0.4), (90.0, 0.23), (380.0, 0.2)]),
        "standard, seed 1": row(400, 0.29, [(20.0, 0.8), (110.0, 0.59), (380.0, 0.58)]),
        "of another version, seed 0": row(1, 0.1),
    }
)


@pytest.mark.parametrize("document", ["README.md", "docs/performance.md"])
def test_documents_show_the_stored_results(document: str) -> None:
    pairs = {pair: runs_of(rows) for pair, rows in stored().items()}
    tables = [report(pairs).split("\n\n")[0], *(table(pair, [runs]) for pair, runs in pairs.items())]
    text = (ROOT / document).read_text()
    assert [each for each in tables[: 1 if document == "README.md" else None] if each not in text] == []


def test_table_has_means_with_their_ranges() -> None:
    head, _, first, second, *others = table("a, b", [RUNS]).splitlines()
    assert head == "| a, b | seconds | loss left | style | colors |"
    assert first == "| within 15s | 15 (14 to 16) | 0.600 (0.500 to 0.700) | 1.100 (1.000 to 1.200) | 20 |"
    assert second == "| within 1m | 60 | 0.360 | 0.860 | 20 |"
    assert [line.split(" | ")[0] for line in others] == ["| preview", "| standard"]


def test_ways_above_the_envelope_are_named() -> None:
    """A loss that is 3 % higher than that of a faster way is within the tolerance, one 20 % higher is not."""
    assert above_envelope(RUNS) == {"within 1m": "preview"}
    assert above_envelope(RUNS | {"within 15m": [row(900, 0.278)]}) == {"within 1m": "preview"}


def test_report_has_all_pairs_and_the_seconds_in_which_a_preset_is_overtaken() -> None:
    text = report({"a, b": RUNS, "c, d": runs_of({"within 15s, seed 0": row(14, 0.2)})})
    assert "| within 15s | 14 (14 to 16) | 0.400 (0.200 to 0.700) |" in text.split("\n\n")[0]
    assert "| a, b | seconds |" in text
    assert "| c, d | seconds |" in text
    assert "Above the envelope on a, b: within 1m; preview is better." in text
    assert "On a, b, standard is where preview ends after 100 (90 to 110) s." in text


def test_figure_is_small_enough_for_the_readme(tmp_path: Path) -> None:
    path = tmp_path / "error_time.png"
    write_figure(path, dict.fromkeys(error_time.PAIRS, RUNS))
    assert Image.open(path).size == (SIZE[0] * DPI, SIZE[1] * DPI)
    assert path.stat().st_size < 120_000


def test_written_cameras_are_those_that_commands_read(tmp_path: Path) -> None:
    write_cameras(tmp_path / "cameras.json", cameras(3))
    for written, read in zip(cameras(3), read_cameras(tmp_path / "cameras.json"), strict=True):
        assert (read.name, read.width, read.height) == (written.name, written.width, written.height)
        torch.testing.assert_close(read.world_to_camera, written.world_to_camera)
        assert read.fx == pytest.approx(written.fx)


@pytest.mark.slow
def test_commands_run_and_are_evaluated(
    vgg16_weights: object, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    for folder in ("scenes", "styles"):
        (tmp_path / folder).mkdir()
    write_files(tmp_path / "scenes", wall(), cameras(4, 96, 72))
    Image.effect_noise((96, 64), 80).convert("RGB").save(tmp_path / "styles" / "noise.jpg")
    monkeypatch.setattr(common, "RESULTS", tmp_path)
    monkeypatch.setattr(error_time, "RESULTS", tmp_path)
    monkeypatch.setattr(error_time, "RESOLUTION", 96)
    monkeypatch.setitem(error_time.ALL_SCENES, "wall", ("scene.ply", "cameras.json"))
    for way, steps in (("preview", "2"), ("standard", "9")):
        monkeypatch.setitem(error_time.EVERY_WAY, way, ("--steps-coarse", "0", "--steps-sos", steps))
    run(tmp_path, "wall, noise", ["preview", "standard"], [0])
    rows = stored()["wall, noise"]
    assert list(rows) == ["preview, seed 0", "standard, seed 0"]
    assert [row["steps"] for row in rows.values()] == [2, 9]
    assert rows["standard, seed 0"]["loss"] < rows["preview, seed 0"]["loss"] < 1
    assert rows["standard, seed 0"]["curve"][-1][0] < rows["standard, seed 0"]["seconds"]
    assert "wall, noise, standard, seed 0: | standard | " in capsys.readouterr().out
