"""Tests of `sgsst paint`: pictures of views, painted scenes, and pictures that cannot be used."""

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from PIL.PngImagePlugin import PngInfo

from api.cli.console import BAD_INPUT
from api.cli.main import main
from sgsst_core.files.scene_file import read_scene, write_scene
from sgsst_core.painting import PASSES
from sgsst_core.progress import Progress
from sgsst_core.settings import make_settings
from tests.small_scenes import wall
from worker.job import JobSpec, SceneRequest
from worker.options import PaintedFile
from worker.painting import run_painting
from worker.ranks.rank import WorkerOptions
from worker.run import Listener

OPTIONS = ("--orbit", "6", "--resolution", "96")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with a scene and the picture of its first view."""
    folder = tmp_path_factory.mktemp("painting")
    write_scene(folder / "scene.ply", wall(sh_degree=1))
    assert command(folder, *OPTIONS, "--export", "orbit_0000", out="view.png") == 0
    return folder


def command(folder: Path, *options: str, out: str = "painted.ply") -> int:
    return main(["paint", str(folder / "scene.ply"), *options, "--out", str(folder / out)])


def paint(folder: Path, name: str, view: str = "orbit_0000", out: str = "painted.ply") -> int:
    return command(folder, *OPTIONS, "--view", f"{view}={folder / name}", out=out)


def test_scene_follows_a_painted_picture(folder: Path) -> None:
    with Image.open(folder / "view.png") as image:
        image.point(lambda value: value // 2).save(folder / "dark.png")
    assert paint(folder, "dark.png") == 0
    before, after = (read_scene(folder / name).scene for name in ("scene.ply", "painted.ply"))
    assert after.sh_dc.mean() < before.sh_dc.mean()
    assert after.means.equal(before.means)
    report = json.loads((folder / "painted.report.json").read_text())
    assert report["psnr_after"] > report["psnr_before"]


@pytest.mark.parametrize(
    ("name", "change", "message"),
    [
        ("larger.png", lambda image: image.resize((192, image.height * 2)), "Export and paint in one size"),
        ("crop.png", lambda image: image.crop((0, 0, 96, 20)), "another aspect ratio"),
        ("empty.png", lambda image: Image.new("RGBA", image.size), "transparent everywhere"),
        ("nan.tiff", lambda image: Image.fromarray(np.full(image.size[::-1], np.nan, np.float32)), "NaN"),
    ],
)
def test_unusable_pictures_are_refused(
    folder: Path,
    name: str,
    change: Callable[[Image.Image], Image.Image],
    message: str,
    capsys: pytest.CaptureFixture[str],
) -> None:
    (folder / "painted.ply").unlink(missing_ok=True)
    with Image.open(folder / "view.png") as image:
        change(image).save(folder / name)
    assert paint(folder, name) == BAD_INPUT
    assert message in " ".join(capsys.readouterr().err.split())
    assert not (folder / "painted.ply").exists()


@pytest.mark.parametrize("name", ["kept.png", "scene.ply", "painted.txt"])
def test_inputs_are_not_overwritten(folder: Path, name: str) -> None:
    shutil.copy(folder / "view.png", folder / "kept.png")
    files = {path: path.read_bytes() for path in folder.iterdir()}
    assert paint(folder, "kept.png", out=name) == BAD_INPUT
    if name != "kept.png":
        assert command(folder, *OPTIONS, "--export", "orbit_0000", out=name) == BAD_INPUT
    assert {path: path.read_bytes() for path in folder.iterdir()} == files


def test_result_has_the_format_of_its_name(folder: Path) -> None:
    assert paint(folder, "view.png", out="painted.spz") == 0
    assert read_scene(folder / "painted.spz").format == "spz"


def test_picture_is_recognized_by_itself(folder: Path) -> None:
    shutil.copy(folder / "view.png", folder / "renamed.png")
    assert command(folder, "--view", str(folder / "renamed.png")) == 0
    report = json.loads((folder / "painted.report.json").read_text())
    assert report["views"] == [{"name": "orbit_0000", "width": 91, "height": 76}]
    assert report["psnr_before"] > 45, "the picture has the resolution of its export, not of the cameras"


def test_hostile_text_chunk_is_ignored(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    metadata = PngInfo()
    metadata.add_text("sgsst-view", '{"view": "orbit_0000", "camera": {"width": 1e99}}')
    with Image.open(folder / "view.png") as image:
        image.save(folder / "hostile.png", pnginfo=metadata)
    assert command(folder, "--view", str(folder / "hostile.png")) == BAD_INPUT
    assert "does not state its view" in " ".join(capsys.readouterr().err.split())


def test_interrupted_job_writes_nothing(folder: Path, tmp_path: Path) -> None:
    request = JobSpec(
        source=SceneRequest(scene=folder / "scene.ply"),
        styles=(),
        out=tmp_path / "painted.ply",
        settings=make_settings(),
        paintings=(PaintedFile(folder / "view.png"),),
    )
    reported: list[Progress] = []
    listener = Listener(progress=reported.append, stop=lambda: reported[-1].step == 3)
    result = run_painting(request, listener, WorkerOptions())
    assert (result.stopped, result.steps, result.total) == ("interrupted", 3, PASSES)
    assert list(tmp_path.iterdir()) == []


def test_picture_of_another_view_is_named(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert paint(folder, "view.png", "orbit_0003") == BAD_INPUT
    assert "is an image of the view orbit_0000" in " ".join(capsys.readouterr().err.split())
    Image.open(folder / "view.png").convert("RGB").save(folder / "unnamed.png")
    assert paint(folder, "unnamed.png", "front") == BAD_INPUT
    assert "No view is called front" in " ".join(capsys.readouterr().err.split())
