"""Tests of batches on this machine: what is made, what is repeated, and what fails."""

import json
from pathlib import Path

import pytest
from PIL import Image

from api.cli.main import main
from tests.api.cli.test_cli import interrupted
from tests.api.conftest import Sgsst
from tests.small_scenes import wall, write_files

pytestmark = [pytest.mark.usefixtures("one_thread", "tiny_installed"), pytest.mark.slow]


@pytest.fixture
def arguments(tmp_path: Path) -> list[str]:
    """Return the arguments of a batch of two scenes of the same name, each with cameras beside it, and two styles."""
    scenes = []
    for name in ("one", "two"):
        (tmp_path / name).mkdir()
        scenes.append(write_files(tmp_path / name, wall())[0])
    styles = [tmp_path / "one" / "style.png", tmp_path / "red.png"]
    Image.new("RGB", (40, 40), (200, 40, 40)).save(styles[1])
    options = [text for style in styles for text in ("--style", str(style))]
    return ["batch", *map(str, scenes), *options, "--out", str(tmp_path / "out"), "--backbone", "vgg16"]


def times(out: Path) -> dict[str, int]:
    """Return the time of each result."""
    return {path.stem: path.stat().st_mtime_ns for path in out.glob("*.ply")}


def test_only_what_is_missing_or_changed_is_made(arguments: list[str], tmp_path: Path) -> None:
    out, red = tmp_path / "out", tmp_path / "red.png"
    image = red.read_bytes()
    red.write_bytes(b"no image")
    batch = [*arguments, "--steps-sos", "2"]
    assert main(batch) == 1
    first = times(out)
    assert first.keys() == {"scene_style", "2_scene_style"}
    red.write_bytes(image)
    assert main(batch) == 0
    second = times(out)
    assert second.keys() == {*first, "scene_red", "2_scene_red"}
    assert all(second[name] == first[name] for name in first)
    with Image.open(out / "batch.jpg") as sheet:
        assert sheet.width > sheet.height, "three columns, of which the first is that of the scenes, and two rows"
    assert main(batch) == 0
    assert times(out) == second
    Image.new("RGB", (40, 40), (40, 200, 40)).save(red)
    (out / "scene_style.ply").unlink()
    assert main(batch) == 0
    assert {name for name, time in times(out).items() if time == second.get(name)} == {"2_scene_style"}


def test_interrupted_result_is_resumed(arguments: list[str], tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    batch = [*arguments, "--steps-sos", "150", "--learning-rate", "0.1"]
    interrupted(batch, tmp_path)
    assert not times(tmp_path / "out")
    assert (tmp_path / "out" / "scene_style.checkpoint.safetensors").exists()
    capfd.readouterr()
    assert main(batch) == 0
    assert capfd.readouterr().out.count("resuming") == 1
    assert len(times(tmp_path / "out")) == 4
    assert all(entry["complete"] for entry in json.loads((tmp_path / "out" / "batch.json").read_text()).values())


def test_missing_scenes_and_foreign_records_are_named(arguments: list[str], tmp_path: Path, sgsst: Sgsst) -> None:
    missing = tmp_path / "missing.ply"
    assert "missing.ply" in sgsst(["batch", str(missing), *arguments[3:]], 1)
    record = tmp_path / "out" / "batch.json"
    record.parent.mkdir(exist_ok=True)
    record.write_text("[1]")
    assert "is no record of a batch" in sgsst(arguments, 2)
    assert record.read_text() == "[1]"


def test_key_without_a_service_is_refused(arguments: list[str], tmp_path: Path, sgsst: Sgsst) -> None:
    assert "--key requires --url." in sgsst([*arguments, "--key", "secret"], 2)
    assert not (tmp_path / "out").exists()


def test_results_have_different_names(tmp_path: Path, sgsst: Sgsst) -> None:
    for name in ("a.ply", "a_b.ply", "b_c.png", "c.png"):
        (tmp_path / name).write_bytes(b"neither scene nor image")
    scenes, styles = (
        [str(tmp_path / name) for name in names] for names in (("a.ply", "a_b.ply"), ("b_c.png", "c.png"))
    )
    options = [text for style in styles for text in ("--style", style)]
    batch = ["batch", *scenes, *options, "--orbit", "3", "--out", str(tmp_path / "out")]
    named = "4 of 4 results could not be made: a_b_c, a_c, a_b_b_c, 4_a_b_c"
    assert named in " ".join(sgsst(batch, 1).split())


def test_no_result_replaces_another_scene(tmp_path: Path, sgsst: Sgsst) -> None:
    ply, _, _ = write_files(tmp_path, wall())
    other = tmp_path / "scene_style.ply"
    other.write_bytes(ply.read_bytes())
    batch = ["batch", str(ply), str(other), "--style", str(tmp_path / "style.png"), "--out", str(tmp_path)]
    assert "is the scene of another result, which would be overwritten" in sgsst(batch, 2)
    assert other.read_bytes() == ply.read_bytes()
