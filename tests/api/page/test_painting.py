"""Tests of painting on a view: strokes, pictures painted elsewhere, and what is refused."""

from __future__ import annotations

import hashlib
import json
import re
from pathlib import Path
from typing import Any

import httpx2
import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image
from PIL.PngImagePlugin import PngInfo

from sgsst_core.scene.camera import Camera
from tests.api.page.actions import Visit, choose, done, drop, submit
from tests.api.page.browser import Watched, psnr, rendered
from tests.api.page.test_selecting import drag
from tests.api.page.test_viewer import FAITHFUL
from tests.api.service import Service
from tests.small_scenes import cameras, wall, write_files

pytestmark = pytest.mark.slow

QUICK: dict[str, Any] = {"steps_coarse": 2, "steps_sos": 2}
TITLE = "Paint on this view"


@pytest.fixture(scope="module")
def finished(service: Service, tmp_path_factory: pytest.TempPathFactory) -> str:
    """Return the id of a finished job, whose page is shown from its first camera."""
    ply, file, style = write_files(tmp_path_factory.mktemp("files"), wall(sh_degree=1), cameras(3, 96, 72))
    return done(service, submit(service, {"scene": ply, "cameras": file, "style": style}, name="wall", **QUICK))


def fetched(service: Service, path: str, to: Path) -> Path:
    """Download a file of the service."""
    to.write_bytes(httpx2.get(f"{service.url}{path}").raise_for_status().content)
    return to


def result(service: Service, job_id: str, folder: Path) -> Path:
    return fetched(service, f"/v1/jobs/{job_id}/artifacts/stylized.ply", folder / f"{job_id}.ply")


def camera_of(view: dict[str, Any]) -> Camera:
    """Return the camera that a request or a picture states."""
    stated = view["camera"]
    intrinsics = [[stated["fx"], 0, stated["cx"]], [0, stated["fy"], stated["cy"]], [0, 0, 1]]
    return Camera.from_matrix(stated["world_to_camera"], intrinsics, stated["width"], stated["height"])


def of_canvas(camera: Camera, pixels: NDArray[np.float64]) -> Camera:
    """Return the camera with which an image of another size, which is wide enough, shows the same height of a scene."""
    height, width, _ = pixels.shape
    focal = camera.fy * height / camera.height
    intrinsics = [[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]]
    return Camera.from_matrix(camera.world_to_camera, intrinsics, width, height)


def frozen(watched: Watched) -> Any:
    """Freeze the view, and return the panel."""
    watched.settled()
    watched.page.get_by_role("button", name="Paint", exact=True).click()
    return watched.page.get_by_role("region", name=TITLE)


def applied(watched: Watched) -> dict[str, Any]:
    """Send what was painted, and return the job once its result is shown."""
    page = watched.page
    with page.expect_response(lambda answer: answer.request.method == "POST" and "/v1/jobs?" in answer.url) as answer:
        page.get_by_role("button", name="Apply", exact=True).click()
    assert answer.value.status == 202, answer.value.text()
    job: dict[str, Any] = answer.value.json()
    page.wait_for_url(re.compile(f"#/jobs/{job['id']}$"))
    page.locator(".badge", has_text="Done").wait_for()
    page.locator(".side.right", has_text="Painted").wait_for()
    return job


def test_scene_follows_a_stroke_and_undo_restores_it(
    visit: Visit, service: Service, finished: str, tmp_path: Path
) -> None:
    base = result(service, finished, tmp_path)
    digest = hashlib.sha256(base.read_bytes()).hexdigest()
    watched = visit(f"/#/jobs/{finished}", width=1100, height=800)
    page = watched.page
    panel = frozen(watched)
    panel.get_by_label("Color").fill("#20d040")
    panel.get_by_label("Brush size").fill("120")
    drag(watched, (0.4, 0.45), (0.6, 0.55))
    drag(watched, (0.2, 0.2), (0.8, 0.2))
    page.keyboard.press("Control+z")
    job = applied(watched)
    page.get_by_role("heading", name="wall, painted", exact=True).wait_for()

    layer = np.asarray(Image.open(fetched(service, f"/v1/jobs/{job['id']}/inputs/painted", tmp_path / "layer.png")))
    assert layer.shape[2] == 4
    stroke = layer[:, :, 3] == 255
    assert np.unique(layer[stroke], axis=0).tolist() == [[0x20, 0xD0, 0x40, 255]]
    rows, columns = stroke.nonzero()
    height, width = stroke.shape
    assert abs(rows.mean() / height - 0.5) < 0.01
    assert abs(columns.mean() / width - 0.5) < 0.01
    [view] = job["parameters"]["painted"]
    camera, painted = camera_of(view), result(service, job["id"], tmp_path)
    before, after = rendered(base, camera), rendered(painted, camera)
    color = np.broadcast_to(layer[stroke][0, :3].astype(float), after[stroke].shape)
    assert psnr(after[stroke], color) > psnr(before[stroke], color) + 6
    far = np.ones_like(stroke)
    far[max(rows.min() - height // 5, 0) : rows.max() + height // 5] = False
    assert psnr(after[far], before[far]) > 35
    shown = watched.pixels()
    assert psnr(shown, rendered(painted, of_canvas(camera, shown))) >= FAITHFUL

    page.get_by_role("link", name="Undo painting").click()
    page.get_by_role("heading", name="wall", exact=True).wait_for()
    page.locator(".side.right", has_text="Stylized").wait_for()
    watched.wipe("Home")
    shown = watched.pixels()
    assert psnr(shown, rendered(base, of_canvas(camera, shown))) >= FAITHFUL, "the same viewpoint"
    assert hashlib.sha256(result(service, finished, tmp_path).read_bytes()).hexdigest() == digest
    watched.check()


def test_painted_picture_returns_to_its_view(visit: Visit, service: Service, finished: str, tmp_path: Path) -> None:
    watched = visit(f"/#/jobs/{finished}", width=1100, height=800)
    page = watched.page
    panel = frozen(watched)
    watched.settled()
    with page.expect_download() as download:
        panel.get_by_role("button", name="Download picture").click()
    with Image.open(download.value.path()) as image:
        stated, pixels = image.info["sgsst-view"], np.asarray(image.convert("RGB"), dtype=np.float64)
    camera = camera_of(json.loads(stated))
    before = rendered(result(service, finished, tmp_path), camera)
    assert psnr(pixels, before) >= FAITHFUL
    panel.get_by_role("button", name="Cancel").click()
    page.locator("canvas.view").focus()
    page.keyboard.press("d")

    night = pixels * [0.3, 0.3, 0.5]
    text = PngInfo()
    text.add_text("sgsst-view", stated)
    Image.fromarray(night.round().astype(np.uint8)).save(tmp_path / "night.png", pnginfo=text)
    drop(watched, {"painted": tmp_path / "night.png"})
    panel.locator("button:enabled", has_text="Apply").wait_for()
    job = applied(watched)
    assert job["parameters"]["painted"] == [json.loads(stated)]
    painted = rendered(result(service, job["id"], tmp_path), camera)
    assert psnr(painted, night) > psnr(before, night) + 10
    watched.check()


def test_scene_of_the_form_is_painted(visit: Visit, service: Service, files: dict[str, Path]) -> None:
    watched = visit(width=1100, height=800)
    page = watched.page
    choose(watched, {"scene": files["scene"], "cameras": files["cameras"]})
    panel = frozen(watched)
    panel.get_by_label("Brush size").fill("150")
    drag(watched, (0.5, 0.5), (0.6, 0.5))
    job = applied(watched)
    page.get_by_role("heading", name="scene, painted", exact=True).wait_for()
    assert {each["role"] for each in job["inputs"]} == {"scene", "cameras", "painted"}
    page.get_by_role("button", name="Stylize this scene").click()
    page.get_by_role("heading", name="Paint a scene").wait_for()
    page.locator(".slot.filled", has_text="scene, painted.ply").wait_for()
    watched.check()


def test_foreign_pictures_are_refused_in_a_sentence(visit: Visit, finished: str, tmp_path: Path) -> None:
    from axe_playwright_python.sync_playwright import Axe

    watched = visit(f"/#/jobs/{finished}", width=360, height=800, has_touch=True)
    page = watched.page
    panel = frozen(watched)
    Image.new("RGB", (30, 20)).save(tmp_path / "small.png")
    (tmp_path / "text.png").write_text("not an image")
    view = {"view": "x", "camera": {"width": 9, "height": 9, "fx": 1, "fy": 1, "world_to_camera": [[1, 0, 0, 0]] * 3}}
    text = PngInfo()
    text.add_text("sgsst-view", json.dumps(view))
    Image.new("RGB", (30, 20)).save(tmp_path / "cropped.png", pnginfo=text)
    for name, problem in [
        ("small.png", r"small.png has 30×20 pixels, but the view has \d+×\d+\."),
        ("text.png", r"text.png is no image"),
        ("cropped.png", r"cropped.png has 30×20 pixels, but the view has 9×9\."),
    ]:
        with page.expect_file_chooser() as chooser:
            panel.get_by_role("button", name="Use a painted picture").click()
        chooser.value.set_files(tmp_path / name)
        panel.get_by_role("alert").filter(has_text=re.compile(problem)).wait_for()
        assert panel.get_by_role("button", name="Apply").is_disabled()
    box = page.locator("canvas.view").bounding_box()
    page.touchscreen.tap(box["x"] + box["width"] / 2, box["y"] + box["height"] / 2)
    panel.get_by_role("button", name="Undo stroke").click()
    panel.locator("button:disabled", has_text="Apply").wait_for()
    assert page.evaluate("document.documentElement.scrollWidth") <= 360
    assert Axe().run(page).violations_count == 0
    watched.check()
