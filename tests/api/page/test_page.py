"""Tests of the web page from a user's perspective, in a real browser with a real service."""

import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import httpx2
import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from PIL import Image

from sgsst_core.files.camera_files import read_cameras
from sgsst_core.files.scene_file import write_scene
from sgsst_core.scene.camera import resized
from tests.api.page.actions import (
    LONG,
    STEPS,
    Visit,
    choose,
    done,
    drop,
    expand,
    result_of,
    set_options,
    submit,
)
from tests.api.page.browser import Watched, appear, click, psnr, rendered
from tests.api.service import Service, wait_for
from tests.small_scenes import ball, wall, write_files

pytestmark = pytest.mark.slow


def test_from_files_to_wipe(visit: Visit, service: Service, files: dict[str, Path], tmp_path: Path) -> None:
    """Drop files, view them, plan, start, watch and wipe: the pixels on each side are those of `sgsst render`."""
    earlier, sent = _jobs(service), list[str]()
    watched = visit(width=600, height=500)
    page = watched.page
    drop(watched, files)
    page.get_by_text("616 Gaussians · SH degree 1").wait_for()
    watched.settled()
    page.get_by_text("3 cameras shown in the scene").wait_for()
    assert _jobs(service) == earlier, "nothing is sent for the preview"

    set_options(watched, **STEPS)
    page.get_by_role("button", name="Estimate time").click()
    cost = page.get_by_role("region", name="Estimate")
    cost.get_by_text("616", exact=True).wait_for()
    assert cost.get_by_text("partition").is_hidden(), "what a plan decides is folded away"
    assert cost.get_by_text("automatic").count() == 0
    cost.get_by_text("How it will run").click()
    cost.get_by_text("partition").wait_for()

    page.locator("canvas.view").evaluate("(canvas) => { canvas.id = 'same'; }")
    page.on("request", lambda request: sent.append(request.url))
    page.get_by_role("button", name="Start").click()
    appear(
        page.locator("h1", has_text="scene"),
        page.locator(".badge", has_text="Done"),
        page.get_by_role("img", name="Loss over time"),
        page.get_by_role("heading", name="How it ran"),
        page.get_by_label("Wipe", exact=True),
    )
    job_id = page.url.rsplit("/", 1)[1]
    assert page.locator("canvas.view").get_attribute("id") == "same", "the job's page shows the scene of the form"
    assert not [url for url in sent if url.endswith("/inputs/scene")]

    page.get_by_label("Camera", exact=True).select_option("1")
    camera = resized(read_cameras(files["cameras"])[1], 384)
    original, stylized = (rendered(path, camera) for path in (files["scene"], result_of(service, job_id, tmp_path)))
    watched.wipe("End")
    before = frame_of(watched, original)
    watched.wipe("Home")
    after = frame_of(watched, stylized)
    assert psnr(before, original) > 38  # the view is larger than the rendered image
    assert psnr(after, stylized) > 38
    assert psnr(before, stylized) < 25


def frame_of(watched: Watched, like: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the central part of the 3D view that the job's camera shows, resized to the size of `like`."""
    pixels = watched.pixels()
    height, width = pixels.shape[:2]
    h, w = min(height, width * 3 / 4), min(width, height * 4 / 3)
    box = ((width - w) / 2, (height - h) / 2, (width + w) / 2, (height + h) / 2)
    size = (like.shape[1], like.shape[0])
    small = Image.fromarray(pixels.astype(np.uint8)).resize(size, Image.Resampling.BOX, box=box)
    return np.asarray(small, dtype=np.float64)


def large_scene(path: Path, columns: int, rows: int) -> Path:
    """Write a scene of many megabytes whose Gaussians are small, because the browser draws it on the CPU."""
    scene = wall(columns, rows, sh_degree=3)
    write_scene(path, replace(scene, scales=torch.full_like(scene.scales, math.log(0.006))))
    return path


def test_reload_while_uploading_sends_only_the_rest(visit: Visit, files: dict[str, Path], tmp_path: Path) -> None:
    big = large_scene(tmp_path / "big.ply", 400, 250)
    watched = visit(allowed=["net::ERR"])
    page = watched.page
    sent: list[tuple[str, int, int]] = []

    def note(request: Any) -> None:
        if request.method == "PATCH":
            sent.append((request.url, int(request.headers["upload-offset"]), len(request.post_data_buffer or b"")))

    def slow(route: Any) -> None:
        if len(sent) <= 3:
            route.continue_()
        # Further parts hang until the test leaves the page.

    page.on("request", note)
    page.route("**/v1/uploads/*", lambda route: slow(route) if route.request.method == "PATCH" else route.continue_())
    choose(watched, files | {"scene": big})
    page.get_by_role("button", name="Start").click()
    wait_for(lambda: page.evaluate("1") and any(offset > 0 for _, offset, _ in sent), "a second part")
    page.get_by_role("button", name="Stop").wait_for()
    page.reload()  # while the routes are there, or the parts that hang would be sent
    page.unroute_all(behavior="ignoreErrors")
    appear(
        page.get_by_text(f"“big.ply” ({big.stat().st_size / 1e6:.1f} MB) was"),
        page.get_by_text("Choose it again to finish"),
    )
    (tmp_path / "elsewhere").mkdir()
    choose(watched, {"scene": large_scene(tmp_path / "elsewhere" / "big.ply", 20, 20)})
    page.locator(".notice").wait_for(state="hidden")

    first, before = next((url, offset) for url, offset, _ in sent if offset > 0)
    sent.clear()
    set_options(watched, **LONG)
    choose(watched, files | {"scene": big})
    page.get_by_text("Only the rest will be sent.").wait_for()
    page.get_by_role("button", name="Start").click()
    page.get_by_role("button", name="Cancel").wait_for()
    again = [offset for url, offset, _ in sent if url == first]
    assert again, "the upload was begun anew"
    assert min(again) >= before
    page.get_by_role("button", name="Cancel").click()
    page.locator(".badge", has_text="Canceled").wait_for()

    sent.clear()  # the same files again: the service has them
    page.get_by_role("link", name="New", exact=True).click()
    set_options(watched, **LONG)
    choose(watched, files | {"scene": big})
    click(page.get_by_role("button", name="Start"), page.get_by_role("button", name="Cancel"))
    page.locator(".badge", has_text="Canceled").wait_for()
    assert sent == []


def test_upload_stops_and_resumes(visit: Visit, files: dict[str, Path], tmp_path: Path) -> None:
    big = large_scene(tmp_path / "big.ply", 300, 200)
    watched = visit(allowed=["net::ERR", "423", "409"])  # the first part may still hold the upload, or end meanwhile
    page = watched.page
    held: list[Any] = []
    page.route(
        "**/v1/uploads/*", lambda route: held.append(route) if route.request.method == "PATCH" else route.continue_()
    )
    set_options(watched, **LONG)
    choose(watched, files | {"scene": big})
    page.get_by_role("button", name="Start").click()
    wait_for(lambda: page.evaluate("1") and held, "a part to be sent")
    page.get_by_role("button", name="Stop").click()
    page.get_by_role("button", name="Stop").wait_for(state="hidden")
    page.unroute_all(behavior="ignoreErrors")
    click(page.get_by_role("button", name="Start"), page.get_by_role("button", name="Cancel"))
    page.locator(".badge", has_text="Canceled").wait_for()


def test_server_killed_and_back(visit: Visit, service: Service, files: dict[str, Path]) -> None:
    """After a restart of the server, the event stream resumes where it stopped, and the loss history is complete."""
    job_id = submit(service, files, **LONG)
    page = visit(f"/#/jobs/{job_id}", allowed=["net::ERR", "Failed to load resource"]).page
    appear(page.get_by_text("Adding detail · step"), page.get_by_role("img", name="Loss over time"))
    step = page.locator(".state").inner_text()
    wait_for(lambda: page.locator(".state").inner_text() != step, "news of the job: the stream is open", service.said)
    with service.killed("api.http.server"):
        page.get_by_text("Connection lost").wait_for()
    wait_for(service.ready, "the API to be back", service.said)
    page.get_by_text("Connection lost").wait_for(state="hidden")
    step = page.locator(".state").inner_text()
    wait_for(lambda: page.locator(".state").inner_text() != step, "news of the job", service.said)
    page.reload()
    page.get_by_role("img", name="Loss over time").wait_for()
    page.get_by_role("button", name="Cancel").click()
    page.get_by_role("button", name="Continue").wait_for()


def test_names_of_files_are_text(visit: Visit, service: Service, tmp_path: Path) -> None:
    """File names are shown as text everywhere: before upload, in the list, in the job's view and on the wipe."""
    hostile = "<img src=x onerror=document.title='broken'>"
    ply, file, style = write_files(tmp_path, wall())
    files = {
        "scene": ply.rename(tmp_path / f"{hostile}.ply"),
        "cameras": file,
        "style": style.rename(tmp_path / f"{hostile}.png"),
    }
    watched = visit()
    page = watched.page
    choose(watched, files)
    page.locator(".slot", has_text="Scene").get_by_text(hostile).first.wait_for()
    job_id = done(service, submit(service, files, name=hostile))
    page.goto(f"{service.url}/#/jobs")
    page.locator(".tile", has_text=hostile).wait_for()
    page.goto(f"{service.url}/#/jobs/{job_id}")
    page.get_by_role("heading", name=hostile).wait_for()
    watched.settled()
    assert page.locator("img[src=x]").count() == 0
    assert page.title() != "broken"


def test_jobs_are_listed_filtered_compared_and_deleted(visit: Visit, service: Service, files: dict[str, Path]) -> None:
    ids = [done(service, submit(service, files, name=f"run {seed} of three", seed=seed)) for seed in range(3)]
    watched = visit("/#/jobs")
    page = watched.page
    tiles = page.locator(".tile", has_text="of three")
    appear(tiles.nth(2), tiles.first.locator("img"))
    page.get_by_label("Filter").fill("run 1 of three")
    page.locator(".tile", has_text="run 0 of three").wait_for(state="detached")
    page.get_by_label("Filter").fill("of three")
    for name in ("run 0 of three", "run 1 of three"):
        page.get_by_label(f"Compare {name}").check()
    page.get_by_role("button", name="Compare", exact=True).click()
    page.get_by_label("Left").wait_for()
    watched.settled()
    watched.wipe("Home")
    right = watched.pixels()
    watched.wipe("End")
    left = watched.pixels()
    assert np.abs(left - right).mean() > 0.1  # runs with different seeds differ slightly
    page.get_by_label("Left").select_option("original")
    assert np.abs(watched.pixels() - left).mean() > 5

    page.goto(f"{service.url}/#/jobs")
    delete = page.get_by_role("button", name="Delete run 2 of three")
    delete.click()
    page.keyboard.press("Escape")
    assert delete.evaluate("(button) => button === document.activeElement")
    click(delete, page.get_by_role("button", name="Delete", exact=True))
    page.locator(".tile", has_text="run 2 of three").wait_for(state="detached")
    assert page.locator(".tile a:focus").count() == 1, "the next job has the focus"
    assert httpx2.get(f"{service.url}/v1/jobs/{ids[2]}").status_code == 404


def test_keyboard_alone(visit: Visit, service: Service, files: dict[str, Path]) -> None:
    """Open a finished job from the list and use its view, without a pointer."""
    job_id = done(service, submit(service, files, name="by keyboard"))
    watched = visit("/#/jobs")
    page = watched.page
    page.locator(".tile", has_text="by keyboard").wait_for()
    reach(page, lambda: page.evaluate("() => document.activeElement.hash || ''") == f"#/jobs/{job_id}")
    page.keyboard.press("Enter")
    page.get_by_label("Wipe", exact=True).wait_for()
    watched.settled()
    reach(page, lambda: page.evaluate("() => document.activeElement.tagName") == "CANVAS")
    frames = int(page.locator(".stage").get_attribute("data-frames"))
    page.keyboard.press("ArrowRight")
    page.keyboard.press("w")
    wait_for(lambda: int(page.locator(".stage").get_attribute("data-frames")) > frames, "the view to move")
    assert page.get_by_label("Camera", exact=True).input_value() == "-1", "the view is that of no camera"
    page.keyboard.press(" ")
    page.locator("#said", has_text="Stylized").or_(page.locator("#said", has_text="Original")).wait_for()
    page.keyboard.press(".")
    page.locator("#said", has_text="of 3").wait_for()


def reach(page: Any, there: Callable[[], bool]) -> None:
    """Press Tab until the condition holds."""
    for _ in range(60):
        page.keyboard.press("Tab")
        if there():
            return
    raise AssertionError("Tab does not lead there")


VIEWS = {"new": "/#/", "jobs": "/#/jobs", "missing": "/#/nowhere"}


@pytest.mark.parametrize(("scheme", "width"), [("light", 360), ("dark", 1100)])
def test_accessible_and_never_too_wide(
    visit: Visit, service: Service, files: dict[str, Path], scheme: str, width: int
) -> None:
    from axe_playwright_python.sync_playwright import Axe

    job_id = done(service, submit(service, files, name="looked at"))
    watched = visit(width=width, height=740, color_scheme=scheme, reduced_motion="reduce")
    page = watched.page
    for name, path in (VIEWS | {"job": f"/#/jobs/{job_id}"}).items():
        page.goto(service.url + path)
        page.locator("h1").wait_for()
        if name == "new":
            page.locator("[data-name=resolution]").wait_for()
            expand(watched)
        if name == "jobs":
            page.locator(".tile").first.wait_for()
        if name == "job":
            watched.settled()
        violations = Axe().run(page)
        assert violations.violations_count == 0, f"{name}: {violations.generate_report()}"
        assert page.evaluate("() => document.documentElement.scrollWidth <= innerWidth"), name


def test_two_keys_and_their_jobs(browser: Any, files: dict[str, Path], tmp_path: Path, tiny_installed: Path) -> None:
    service = Service(tmp_path / "data", SGSST_REQUIRE_KEYS="true")
    keys = [service.key(name) for name in ("ann", "ben")]
    with service:
        job_id = submit(service, files, keys[0], name="of ann", **{"steps_sos": 10})
        ann, ben = (Watched(browser, service.url) for _ in keys)
        for watched, key in zip((ann, ben), keys, strict=True):
            page = watched.page
            page.goto(f"{service.url}/#/jobs")
            page.get_by_text("requires an API key").wait_for()
            page.get_by_label("API key").fill("sgsst_wrong")
            page.get_by_role("button", name="Sign in").click()
            page.get_by_text("key isn't valid").wait_for()
            page.get_by_label("API key").fill(key)
            page.get_by_role("button", name="Sign in").click()
            page.get_by_role("button", name="Sign out").wait_for()
            assert page.evaluate("() => document.cookie + JSON.stringify({...localStorage, ...sessionStorage})") == "{}"
        appear(ann.page.locator(".tile", has_text="of ann"), ben.page.get_by_text("No jobs yet"))
        ben.page.goto(f"{service.url}/#/jobs/{job_id}")
        ben.page.get_by_role("heading", name="This job doesn't exist").wait_for()
        ann.page.goto(f"{service.url}/#/jobs/{job_id}")
        ann.page.locator(".badge", has_text="Done").wait_for()
        ann.settled()
        ann.page.get_by_role("link", name="New", exact=True).click()
        choose(ann, {"scene": files["scene"]})
        ann.context.clear_cookies()  # as if the session had expired
        ann.page.get_by_role("link", name="Jobs").click()
        ann.page.get_by_text("session has expired").wait_for()
        ann.page.get_by_label("API key").fill(keys[0])
        ann.page.get_by_role("button", name="Sign in").click()
        ann.page.locator(".tile", has_text="of ann").wait_for()
        ann.page.get_by_role("link", name="New", exact=True).click()
        ann.page.get_by_role("button", name="Remove scene.ply").wait_for()
        ann.page.get_by_role("button", name="Sign out").click()
        appear(ann.page.locator("main").get_by_text("You signed out."), ann.page.get_by_label("API key"))
        ann.page.reload()
        ann.page.get_by_label("API key").wait_for()
        ann.check("status of 401")
        ben.check("status of 401", "status of 404")
        for watched in (ann, ben):
            watched.context.close()


def _jobs(service: Service) -> list[str]:
    return [job["id"] for job in httpx2.get(f"{service.url}/v1/jobs").json()["jobs"]]


def test_fingers_turn_and_pinch(visit: Visit, tmp_path: Path) -> None:
    """On a phone, one finger rotates the scene, a pinch moves it away, and the page does not scroll."""
    watched = visit(width=360, height=640, has_touch=True, is_mobile=True)
    page = watched.page
    ply, _, _ = write_files(tmp_path, ball())
    page.get_by_text("Tap to choose a scene").wait_for()
    assert page.get_by_text("Drop your scene here").is_hidden()
    page.get_by_label("Scene", exact=True).set_input_files(ply)
    images = [watched.pixels()]
    for start, end in ((-40, 40), (-60, -20)):
        page.locator("canvas.view").scroll_into_view_if_needed()  # saving an image has scrolled to its button
        box = page.locator("canvas.view").bounding_box()
        x, y = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
        moved, scrolled = np.linspace(start, end, 10), page.evaluate("() => scrollY")
        touch(watched, [[(x + by, y), (x - by, y)][: len(images)] for by in moved])
        assert page.evaluate("() => scrollY") == scrolled
        images.append(watched.pixels())
    first, rotated, far = images
    assert np.abs(rotated - first).mean() > 1
    assert 0 < shown(far) < 0.6 * shown(rotated)


def touch(watched: Watched, places: list[list[tuple[float, float]]]) -> None:
    """Simulate fingers that touch the screen, move from position to position, and are lifted."""
    device = watched.context.new_cdp_session(watched.page)
    for number, fingers in enumerate(places):
        points = [{"x": x, "y": y, "id": finger} for finger, (x, y) in enumerate(fingers)]
        device.send(
            "Input.dispatchTouchEvent", {"type": "touchMove" if number else "touchStart", "touchPoints": points}
        )
    device.send("Input.dispatchTouchEvent", {"type": "touchEnd", "touchPoints": []})


def shown(pixels: NDArray[np.float64]) -> int:
    """Return the number of pixels that differ from the black background."""
    return int((pixels.max(axis=2) > 20).sum())


def test_documentation_of_the_api_needs_no_internet(visit: Visit) -> None:
    watched = visit("/docs")
    appear(
        watched.page.get_by_text("/v1/jobs/{job_id}", exact=True).first,
        watched.page.get_by_text("/v1/jobs/{job_id}/events").first,
    )
