"""Tests of what precedes a job in a browser: the example, and scenes and paintings that are turned and cropped."""

import io
import json
import re
from dataclasses import replace
from pathlib import Path

import httpx2
import numpy as np
import pytest
from PIL import Image

from sgsst_core.files.scene_file import read_scene
from tests.api.page.actions import REFUSED, STEPS, Visit, choose, done, result_of, set_options, started
from tests.api.page.browser import Watched, appear, click
from tests.api.service import Service
from tests.sgsst_core.objects import box, joined, scene_of
from tests.small_scenes import write_files

pytestmark = pytest.mark.slow

#: Extents along x and half widths of a base and what stands on it: -x is up.
TOWER = ((-2.0, 1.0, 0.4), (1.0, 1.4, 1.2))


def test_example_is_one_click_from_a_job(visit: Visit, service: Service, files: dict[str, Path]) -> None:
    """Nothing of it remains in a new job: neither in the form, nor after a reload, nor beside another scene."""
    watched = visit()
    page = watched.page
    page.locator(".presets input").first.wait_for()
    job = started(watched, service, "Try the example: a motorcycle")
    assert [each["name"] for each in job["inputs"]] == ["motorcycle.sog", "starry_night.jpg", "cameras.json"]
    assert (job["parameters"]["preset"], job["parameters"]["resolution"]) == ("preview", 480)
    page.get_by_role("link", name="New", exact=True).click()
    assert entered(watched) == ([], "", "standard")
    page.reload()
    assert entered(watched) == ([], "", "standard")
    page.goto(f"{service.url}/#/jobs/{job['id']}")
    page.get_by_role("button", name="Cancel").click()
    page.locator(".badge", has_text="Canceled").wait_for()
    page.get_by_role("button", name="Same with changes").click()
    page.get_by_role("button", name="Remove motorcycle.sog").wait_for()
    assert page.get_by_role("button", name="Try the example").count() == 0, "the example would replace the scene"
    assert entered(watched)[1:] == ("480", "preview")
    page.get_by_role("link", name="New", exact=True).click()
    page.get_by_role("button", name="Remove motorcycle.sog").wait_for(state="detached")
    assert entered(watched) == ([], "", "standard")
    page.goto(f"{service.url}/#/jobs/{job['id']}")
    page.get_by_role("button", name="Same with changes").click()
    appear(page.get_by_role("button", name="Remove motorcycle.sog"), page.locator(".presets input").first)
    choose(watched, {"scene": files["scene"], "style": files["style"]})
    assert entered(watched) == (["Remove scene.ply", "Remove style.png"], "", "standard")


def entered(watched: Watched) -> tuple[list[str | None], str, str | None]:
    """Return the buttons that remove the form's files, its resolution and its preset."""
    page = watched.page
    preset = page.locator(".presets input:checked")
    preset.wait_for(state="attached")
    removes = page.locator(".thumb button[aria-label^=Remove]").all()
    files = [button.get_attribute("aria-label") for button in removes]
    return files, page.locator("[data-name=resolution] input").input_value(), preset.get_attribute("value")


def test_cameras_of_another_scene_are_stopped_before_the_start(
    visit: Visit, service: Service, files: dict[str, Path]
) -> None:
    views = json.loads(files["cameras"].read_text())
    for view in views:
        view["position"][0] += 3.2  # the wall ends at 2.4
    files["cameras"].write_text(json.dumps(views))
    watched = visit(allowed=[REFUSED], width=1200, height=800)
    page = watched.page
    choose(watched, files)
    set_options(watched, **STEPS)
    before = httpx2.get(f"{service.url}/v1/jobs").json()["jobs"]
    page.get_by_role("button", name="Start", exact=True).click()
    page.locator(".slot", has_text="Cameras").get_by_text("The cameras hardly show this scene").wait_for()
    assert httpx2.get(f"{service.url}/v1/jobs").json()["jobs"] == before
    page.get_by_role("alert").get_by_role("button", name="Orbit the object").click()
    page.get_by_role("button", name="Start anyway").wait_for(state="detached")
    page.get_by_label("Use my cameras").check(force=True)
    page.get_by_role("button", name="Start", exact=True).click()
    with page.expect_response(lambda answer: answer.url.endswith("/v1/jobs?sure_up=false")) as answer:
        page.get_by_role("button", name="Start anyway").click()
    assert answer.value.status == 202
    page.wait_for_url(re.compile("#/jobs/job_"))


def test_scene_is_turned_and_cropped(visit: Visit, service: Service, files: dict[str, Path], tmp_path: Path) -> None:
    watched = visit(width=1200, height=800)
    page = watched.page
    choose(watched, {"scene": files["scene"], "style": files["style"]})
    set_options(watched, orbit=3, resolution=64, **STEPS)
    assert page.locator("[data-name=views]").is_hidden(), "an orbit has a number of views of its own"
    watched.settled()
    whole = from_first_camera(watched)
    click(page.get_by_role("button", name="Show everything"), page.get_by_role("button", name="Crop the scene"))
    handle = page.get_by_role("button", name="Resize +Y")
    for _ in range(8):
        handle.press("ArrowUp")
        handle.press("ArrowLeft")
    page.get_by_role("button", name="Crop to this box").click()
    assert np.abs(from_first_camera(watched) - whole).mean() > 10, "the orbit surrounds what remains"
    click(page.get_by_role("button", name="Show everything"), page.get_by_role("button", name="Turn the scene by 90°"))
    assert page.locator("[data-name=up] select").input_value() == "-x"
    page.get_by_role("button", name="Tip the scene by 90°").click()
    assert page.locator("[data-name=up] select").input_value() in ("z", "-z")

    job = started(watched, service)
    up, regions = job["parameters"]["up"], job["parameters"]["regions"]
    assert up in ("z", "-z")
    assert [(region["name"], region.get("freeze", False)) for region in regions] == [("inside", False), ("rest", True)]
    low, high = np.array(regions[0]["select"].removeprefix("box=").split(","), dtype=float).reshape(2, 3)
    out = result_of(service, done(service, job["id"]), tmp_path)
    before, after = read_scene(files["scene"]).scene, read_scene(out).scene
    inside = ((before.means.numpy() >= low) & (before.means.numpy() <= high)).all(axis=1)
    painted = (before.sh_dc != after.sh_dc).any(dim=1).numpy()
    assert 0 < np.count_nonzero(inside) < len(before.means)
    assert painted[inside].any()
    assert not painted[~inside].any()
    assert np.array_equal(before.means, after.means), "the stored geometry is never turned"

    page.get_by_role("button", name="Same with changes").click()
    watched.settled()
    crop = page.get_by_role("button", name="Crop the scene")
    assert crop.get_attribute("aria-pressed") == "true"
    click(crop, page.get_by_role("button", name="Remove the crop"))
    assert crop.get_attribute("aria-pressed") == "false"
    assert page.get_by_role("group", name="Region").count() == 0


def from_first_camera(watched: Watched) -> np.ndarray:
    """Return the view of the orbit's first camera."""
    watched.page.get_by_label("Camera", exact=True).select_option("0")
    return watched.pixels()


def test_page_asks_which_way_is_up(visit: Visit, service: Service, files: dict[str, Path], tmp_path: Path) -> None:
    block = box((-1, -0.4, -0.6), (1, 0.4, 0.6), 900)
    scene = scene_of(block, 0.08)
    write_files(tmp_path, replace(scene, sh_dc=2 * block))
    watched = visit(allowed=[REFUSED], width=1200, height=800)
    page = watched.page
    choose(watched, {"scene": files["scene"], "style": files["style"]})
    set_options(watched, orbit=3, resolution=64, **STEPS)
    watched.settled()
    before = httpx2.get(f"{service.url}/v1/jobs").json()["jobs"]
    page.get_by_role("button", name="Start", exact=True).click()
    page.get_by_role("heading", name="Which way is up?").wait_for()
    assert httpx2.get(f"{service.url}/v1/jobs").json()["jobs"] == before, "the job waits for the answer"
    first, second = shown_upright(watched, ["−Y is up", "Z is up"])
    assert np.abs(first - second).mean() > 5, "the scene stands differently"
    page.get_by_role("button", name="None of these").click()
    others = shown_upright(watched, ["X is up", "−X is up", "Y is up", "−Z is up"])
    assert len(others) == 4
    job = started(watched, service, "−X is up")
    assert job["parameters"]["up"] == "-x"
    done(service, job["id"])


def test_result_stands_as_the_service_has_found(
    visit: Visit, service: Service, files: dict[str, Path], tmp_path: Path
) -> None:
    tower = joined(*(scene_of(box((low, -half, -half), (high, half, half), 900), 0.05) for low, high, half in TOWER))
    write_files(tmp_path, replace(tower, sh_dc=tower.sh_dc + 2))
    watched = visit(width=1200, height=800)
    choose(watched, {"scene": files["scene"], "style": files["style"]})
    set_options(watched, orbit=3, resolution=64, **STEPS)
    assert stands(watched) == (False, False), "the form doesn't know it"
    job = started(watched, service)
    done(service, job["id"])
    watched.page.get_by_label("Wipe", exact=True).wait_for()
    assert stands(watched) == (True, True)
    with service.client() as client:
        shared = client.post(f"/v1/jobs/{job['id']}/shares", json={"days": 1}).json()["url"]
    for place in (f"/#/jobs/{job['id']}", shared.removeprefix(service.url)):
        assert stands(visit(place, width=1200, height=800)) == (True, True)


def stands(watched: Watched) -> tuple[bool, bool]:
    """Return whether what the view shows is taller than wide, and whether its lower half is broader."""
    shown = watched.pixels().max(axis=2) > 40
    rows, columns = shown.any(axis=1).nonzero()[0], shown.any(axis=0).nonzero()[0]
    middle = (rows[0] + rows[-1]) // 2
    taller = bool(np.ptp(rows) > np.ptp(columns))
    return taller, taller and bool(np.count_nonzero(shown[middle:]) > 1.2 * np.count_nonzero(shown[:middle]))


def shown_upright(watched: Watched, answers: list[str]) -> list[np.ndarray]:
    """Return the images of the answers to the question which way is up."""
    images = []
    for answer in answers:
        image = watched.page.get_by_role("button", name=answer, exact=True).locator("img[src]")
        image.wait_for()
        images.append(np.asarray(Image.open(io.BytesIO(image.screenshot())).convert("RGB"), dtype=np.float64))
    return images


def test_painting_is_turned_and_cropped(visit: Visit, service: Service, files: dict[str, Path]) -> None:
    quarters = np.zeros((40, 80, 3), dtype=np.uint8)
    quarters[:20, 40:, 0], quarters[20:, :40, 1], quarters[20:, 40:, 2] = 200, 200, 200  # black, red, green, blue
    Image.fromarray(quarters).save(files["style"])
    watched = visit()
    choose(watched, files)
    set_options(watched, **STEPS)
    edit(watched, files["style"].name, "Rotate right", {"Bottom %": "50"})  # green and black remain, side by side
    job = started(watched, service)
    sent = httpx2.get(f"{service.url}/v1/jobs/{job['id']}/inputs/style:0").content
    with Image.open(io.BytesIO(sent)) as image:
        pixels = np.asarray(image.convert("RGB"))
    assert pixels.shape == (40, 40, 3)
    assert (pixels[:, :20] == (0, 200, 0)).all()
    assert (pixels[:, 20:] == 0).all()
    done(service, job["id"])


def test_unreadable_painting_is_used_as_it_is(visit: Visit, files: dict[str, Path]) -> None:
    painting = files["style"].with_suffix(".tiff")
    Image.new("RGB", (64, 48)).save(painting)
    watched = visit()
    choose(watched, {"style": painting})
    watched.page.get_by_role("button", name=f"Rotate or crop {painting.name}").click()
    watched.page.get_by_text("can't be edited in this browser").wait_for()


def edit(watched: Watched, name: str, button: str, edges: dict[str, str]) -> None:
    """Edit a painting in its dialog."""
    click(
        watched.page.get_by_role("button", name=f"Rotate or crop {name}"),
        watched.page.get_by_role("button", name=button),
    )
    for edge, value in edges.items():
        watched.page.get_by_label(edge).fill(value)
    watched.page.get_by_role("button", name="Use it").click()
    watched.page.get_by_role("dialog").wait_for(state="detached")
