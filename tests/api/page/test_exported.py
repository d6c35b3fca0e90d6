"""Tests of `sgsst view` and `sgsst study`: HTML files that show scenes in a browser, opened from disk."""

import json
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from api.cli.main import main
from sgsst_core.constants import SH_C0
from sgsst_core.files.scene_file import write_scene
from sgsst_core.quality.study import count_votes
from sgsst_core.scene.camera import Camera
from sgsst_core.scene.gaussians import Scene
from tests.api.conftest import Sgsst
from tests.api.page.actions import Visit
from tests.api.page.browser import in_frame, psnr, rendered
from tests.small_scenes import ball, cameras, wall, write_files


def painted(red: float, green: float, blue: float, *, harmonics: float = 0.0) -> Scene:
    """Return the wall in one color, with spherical harmonics of degree 1 and this size."""
    scene = wall(sh_degree=1)
    color = (torch.tensor([red, green, blue]) - 0.5) / SH_C0
    rest = torch.linspace(-harmonics, harmonics, 9 * len(scene)).reshape(len(scene), 3, 3)
    return replace(scene, sh_dc=color.expand(len(scene), 3).clone(), sh_rest=rest)


def export(folder: Path, stylized: Scene, original: Scene | None, *options: str) -> int:
    """Export scenes to page.html in a folder, and return the exit code."""
    for name, scene in (("stylized.ply", stylized), ("scene.ply", original)):
        if scene is not None:
            write_scene(folder / name, scene)
    compared = ["--original", str(folder / "scene.ply")] if original else []
    return main(["view", str(folder / "stylized.ply"), *compared, "--out", str(folder / "page.html"), *options])


@pytest.mark.slow
def test_exported_page_wipes_between_both_colors(tmp_path: Path, visit: Visit) -> None:
    assert export(tmp_path, painted(0.9, 0.1, 0.1), painted(0.1, 0.1, 0.9), "--title", "Red <&> blue") == 0
    page = visit((tmp_path / "page.html").as_uri())
    assert page.page.title() == "Red <&> blue"
    page.wipe("Home")
    red = page.pixels().max(axis=(0, 1))
    page.wipe("End")
    blue = page.pixels().max(axis=(0, 1))
    assert red[0] > 200 > 60 > red[2]
    assert blue[2] > 200 > 60 > blue[0]
    style = page.page.get_by_label("Amount of style")
    style.fill("0")
    page.wipe("Home")
    assert page.pixels().max(axis=(0, 1)) == pytest.approx(blue, abs=3)


@pytest.mark.slow
def test_exported_page_opens_at_the_chosen_camera_and_jumps_to_others(tmp_path: Path, visit: Visit) -> None:
    scene, views = wall(sh_degree=1), cameras(4, 96, 72)  # each looks at it slantwise, so that depths differ
    write_files(tmp_path, scene, views)
    given = ["--cameras", str(tmp_path / "cameras.json"), "--start", "view_2", "--views", "view_0,view_1"]
    assert export(tmp_path, scene, None, *given) == 0
    page = visit((tmp_path / "page.html").as_uri(), width=900, reduced_motion="reduce")

    def assert_shown(camera: Camera) -> None:
        pixels = page.pixels()
        assert psnr(pixels, rendered(tmp_path / "scene.ply", in_frame(camera, *pixels.shape[1::-1]))) > 35  # SOG

    assert_shown(views[2])
    buttons = page.page.get_by_role("list", name="Views").get_by_role("button")
    assert buttons.all_inner_texts() == ["1 · view_0", "2 · view_1"]
    buttons.nth(1).click()
    assert_shown(views[1])
    page.page.locator("canvas.view").focus()
    page.page.keyboard.press("1")
    assert_shown(views[0])
    page.page.keyboard.press("3")
    assert_shown(views[0])
    assert page.page.locator("form").count() == 0, "its viewers change nothing"


@pytest.mark.parametrize(
    ("options", "problem"),
    [
        (["--start", "view_0"], "Add --cameras"),
        (["--views", "view_0", "--cameras", "cameras.json", "--start", "front"], "No view is called front"),
        (["--views", "view_0,view_0", "--cameras", "cameras.json"], "each of them once"),
        (["--views", ",".join(map(str, range(13))), "--cameras", "cameras.json"], "at most 12"),
    ],
)
def test_unusable_names_of_cameras_are_refused(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    options: list[str],
    problem: str,
) -> None:
    monkeypatch.chdir(tmp_path)
    write_files(tmp_path)
    assert export(tmp_path, wall(), None, *options) == 2
    assert problem in capsys.readouterr().err
    assert not (tmp_path / "page.html").exists()


def test_attenuated_harmonics_are_those_of_the_original(tmp_path: Path) -> None:
    original = painted(0.2, 0.2, 0.2, harmonics=0.3)
    attenuated = painted(0.7, 0.2, 0.2, harmonics=0.12)
    assert export(tmp_path, attenuated, original) == 0
    assert '"fade": 0.6' in (tmp_path / "page.html").read_text(encoding="utf-8").replace("0.59999", "0.6")


@pytest.mark.parametrize(
    ("original", "problem"),
    [
        (wall(20, 20, sh_degree=1), "Gaussians"),
        (replace(wall(sh_degree=1), means=wall().means + 1), "positions"),
        (painted(0.2, 0.2, 0.2, harmonics=0.3), "view-dependent colors are not those of"),
    ],
)
def test_other_scene_is_refused(
    tmp_path: Path, original: Scene, problem: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert export(tmp_path, wall(sh_degree=1), original) == 2
    assert problem in capsys.readouterr().err
    assert not (tmp_path / "page.html").exists()


def test_page_must_be_an_html_file(tmp_path: Path, sgsst: Sgsst) -> None:
    write_scene(tmp_path / "stylized.ply", wall())
    assert "not the name of an HTML file" in sgsst(
        ["view", str(tmp_path / "stylized.ply"), "--out", str(tmp_path / "page.ply")], 2
    )


@pytest.mark.slow
def test_votes_by_arrow_keys_are_saved_and_counted(visit: Visit, tmp_path: Path, sgsst: Sgsst) -> None:
    scene, cameras, style = write_files(tmp_path, ball())
    page, key = tmp_path / "study.html", tmp_path / "study.key.json"
    variants = [f"{name}={scene}" for name in ("warm-start", "cold-start", "third-way")]
    assert main(["study", "make", *variants, "--cameras", str(cameras), "--style", str(style), "--out", str(page)]) == 0
    watched = visit(page.as_uri())
    known = json.loads(key.read_text())
    for _ in known["views"]:
        watched.page.keyboard.press("ArrowDown")
    watched.page.keyboard.press("Backspace")
    watched.page.keyboard.press("ArrowLeft")
    assert watched.page.get_by_role("status").inner_text().startswith("All views are done")
    with watched.page.expect_download() as download:
        watched.page.get_by_role("button", name="Save votes").click()
    votes = tmp_path / "votes.json"
    download.value.save_as(votes)
    shares = count_votes(key, [votes])
    assert sum(share.votes for share in shares) == shares[0].total == len(known["views"])
    assert f"{len(known['views'])} votes" in sgsst(["study", "count", str(key), str(votes)])
