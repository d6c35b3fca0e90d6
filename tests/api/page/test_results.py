"""Tests of jobs on the page: live colors, downloads, thumbnails, other tabs, and browsers without WebGL."""

import re
from pathlib import Path
from typing import Any

import av
import httpx2
import numpy as np
import pytest

from sgsst_core.files.camera_files import read_cameras
from sgsst_core.files.formats import RESULT_FORMATS, read_scene_header
from sgsst_core.scene.camera import resized
from tests.api.page.actions import LONG, STEPS, Visit, done, drop, result_of, submit
from tests.api.page.browser import FLAGS, Watched, appear, chromium, click, psnr, rendered
from tests.api.page.test_page import frame_of
from tests.api.service import Service, wait_for

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def finished(service: Service, inputs: dict[str, Path]) -> str:
    """Return the id of a finished job with default name."""
    return done(service, submit(service, inputs, **STEPS))


def test_result_is_downloaded_in_every_format(visit: Visit, finished: str, tmp_path: Path) -> None:
    watched = visit(f"/#/jobs/{finished}", width=1100, height=800)
    page = watched.page
    button = page.get_by_role("link", name="Download", exact=True)
    button.wait_for()
    chart = page.get_by_role("img", name="Loss over time")
    chart.wait_for()
    assert button.bounding_box()["y"] < chart.bounding_box()["y"]
    formats = page.get_by_label("Format")
    offered = formats.locator("option").evaluate_all("(options) => options.map((each) => each.value)")
    assert offered == [*(each.name for each in RESULT_FORMATS), "html"]
    for each in RESULT_FORMATS[:3]:
        formats.select_option(each.name)
        with page.expect_download() as download:
            button.click()
        assert download.value.suggested_filename == f"scene_style-stylized{each.suffix}"
        assert read_scene_header(download.value.path()).format.title == each.title
    formats.select_option("html")
    with page.expect_download() as download:
        button.click()
    assert download.value.suggested_filename == "scene_style-stylized.html"
    download.value.save_as(tmp_path / "page.html")
    watched.settled()
    fill_the_screen(watched)
    with page.expect_download() as download:
        page.get_by_role("button", name="Save image").click()
    assert download.value.suggested_filename == "scene_style-view_0.png"
    downloaded = visit((tmp_path / "page.html").as_uri())  # as a user opens it from disk
    assert downloaded.page.title()
    downloaded.wipe("Home")
    stylized = downloaded.pixels()
    downloaded.wipe("End")
    assert not np.array_equal(downloaded.pixels(), stylized), "the scene's own colors are there"


def test_chart_ends_with_the_loss_of_the_result(visit: Visit, service: Service, finished: str) -> None:
    """The page draws the mean over a round of views, which the job's result states too, and single views thin."""
    job = httpx2.get(f"{service.url}/v1/jobs/{finished}").json()
    points = httpx2.get(f"{service.url}/v1/jobs/{finished}/progress").json()["points"]
    assert points[-1]["mean_loss"] == pytest.approx(job["result"]["loss_after"])
    assert points[-1]["mean_loss"] != points[-1]["loss"]
    watched = visit(f"/#/jobs/{finished}")
    legend = watched.page.locator(".legend")
    appear(legend.get_by_text("mean of all views"), legend.get_by_text("single views"))
    label = watched.page.get_by_role("img", name="Loss over time").get_attribute("aria-label")
    shown = float(label.split(" to ")[1].split(" in ")[0].replace(",", ""))
    assert shown == pytest.approx(job["result"]["loss_after"], rel=0.01)
    losses = watched.page.locator(".plot text[text-anchor=end]:not(.axis)").all_text_contents()
    assert losses
    assert all(re.fullmatch(r"[0-9.,]+|[1-9](\.[1-9])?×10[⁰¹²³⁴⁵⁶⁷⁸⁹]+", text) for text in losses), losses
    assert watched.page.locator(".plot text.axis").all_text_contents() == [
        "seconds of steps",
        "loss",
    ]


def fill_the_screen(watched: Watched) -> None:
    """Show the 3D view in full screen, and check that the scene takes all but the tools."""
    page = watched.page
    page.get_by_role("button", name="Full screen").click()
    page.locator(".stage:fullscreen").wait_for()
    heights = [
        page.locator(part).bounding_box()["height"] for part in (".stage", ".stage canvas.view", ".stage .tools")
    ]
    assert heights[0] == page.viewport_size["height"]
    assert heights[1] + heights[2] > heights[0] - 40
    page.get_by_role("button", name="Full screen").click()
    page.locator(".stage:not(:fullscreen)").wait_for()


def change(page: Any, job_id: str, members: dict[str, Any]) -> None:
    """Change members of a job, and of all listed ones, in the answers that the page gets."""

    def answer(route: Any) -> None:
        content = route.fetch().json()
        jobs = [job | members for job in content.get("jobs", [])]
        route.fulfill(json={**content, "jobs": jobs} if jobs else content | members)

    page.route(f"**/v1/jobs/{job_id}", answer)
    page.route("**/v1/jobs?*", answer)


@pytest.mark.parametrize(
    ("stage", "views", "text"),
    [
        ("planning", {"step": 9, "total": 9, "fraction": 1.0, "eta_s": 0.0}, "Analyzing views · view 9 of 9"),
        ("measuring", {"step": 60, "total": 60, "fraction": 1.0, "eta_s": 0.0}, "Checking quality · view 3 of 8"),
    ],
)
def test_stages_beside_steps_count_their_own_views(
    visit: Visit, finished: str, stage: str, views: dict[str, Any], text: str
) -> None:
    """The survey's own remaining time, which ends at 0, is not that of the job, and its views are not steps."""
    status = "running" if stage == "measuring" else "starting"
    checked = {"views_checked": 3, "views_to_check": 8} if stage == "measuring" else {}
    watched = visit("/#/jobs")
    page = watched.page
    change(page, finished, {"status": status, "progress": {"stage": stage, **views, **checked}})
    page.route(f"**/v1/jobs/{finished}/events", lambda route: None)  # its events are those of the real job
    page.goto(f"{watched.url}/#/jobs/{finished}")
    page.get_by_text(text, exact=True).wait_for()
    assert page.locator(".state .left").inner_text() == ("almost done" if stage == "measuring" else "")
    bar = {"planning": "1", "measuring": "0.375"}[stage]
    assert page.locator(".state progress").get_attribute("value") == bar
    page.get_by_role("heading", name="How it will run").wait_for()
    page.goto(f"{watched.url}/#/jobs")
    card = page.locator(".tile", has=page.locator(f"a[href='#/jobs/{finished}']"))
    card.locator(".badge", has_text="Running" if stage == "measuring" else "Starting").wait_for()
    assert card.get_by_text("100%").count() == card.locator("progress").count() == (stage == "measuring")
    page.unroute_all(behavior="ignoreErrors")


@pytest.mark.parametrize(
    ("result", "text"),
    [
        (
            {"stopped": "within", "steps": 2, "total": 60, "loss_after": 97.0},
            "Its time was used up: 2 of 60 steps, 97% of the loss is left. For the other steps, choose "
            "“Continue”; for a finer result, “Same with changes” with more time.",
        ),
        (
            {"stopped": "on-request", "steps": 5, "total": 60, "loss_after": 130.0},
            "This job was stopped early: 5 of 60 steps, the loss is 30% above that of the original. For all steps, "
            "choose “Continue”.",
        ),
        (
            {"stopped": "finished", "steps": 60, "total": 60, "loss_after": 130.0},
            "The loss has risen: choose “Same with changes” and give it more steps.",
        ),
    ],
)
def test_job_that_did_little_is_not_just_done(visit: Visit, finished: str, result: dict[str, Any], text: str) -> None:
    watched = visit("/#/jobs")
    page = watched.page
    page.get_by_role("link", name="Jobs").wait_for()
    change(page, finished, {"result": {**result, "loss_before": 100.0}})
    page.goto(f"{watched.url}/#/jobs/{finished}")
    page.locator(".badge", has_text="Done").wait_for()
    assert page.locator(".warnings").inner_text() == text
    page.goto(f"{watched.url}/#/jobs")
    card = page.locator(".tile", has=page.locator(f"a[href='#/jobs/{finished}']"))
    card.locator(".badge", has_text="Done").wait_for()
    early = result["steps"] < result["total"]
    assert card.get_by_text(f"{result['steps']} of 60 steps").count() == early
    page.unroute_all(behavior="ignoreErrors")


def test_another_tab_sees_changes(visit: Visit, service: Service, files: dict[str, Path]) -> None:
    job_id = submit(service, files, **LONG)
    here, there = visit(f"/#/jobs/{job_id}"), visit(f"/#/jobs/{job_id}", allowed=["status of 404"])
    here.page.get_by_role("button", name="Cancel").click()
    for watched in (here, there):
        watched.page.locator(".badge", has_text="Canceled").wait_for()
    click(
        here.page.get_by_role("button", name=re.compile("Retry|Continue")),
        there.page.get_by_role("button", name="Cancel"),
    )
    for watched in (here, there):
        watched.page.locator(".badge", has_text="Canceled").wait_for()
    here.page.get_by_role("button", name="Rename").click()
    here.page.get_by_label("New name").fill("renamed here")
    here.page.keyboard.press("Enter")
    there.page.get_by_role("heading", name="renamed here").wait_for()
    listed = visit("/#/jobs")
    listed.page.locator(".tile", has_text="renamed here").wait_for()
    click(here.page.get_by_role("button", name="Delete"), here.page.get_by_role("button", name="Delete", exact=True))
    there.page.get_by_role("heading", name="This job was deleted.").wait_for()
    listed.page.locator(".tile", has_text="renamed here").wait_for(state="detached")
    there.page.reload()
    there.page.get_by_role("heading", name="This job doesn't exist, or was deleted.").wait_for()


def test_page_without_webgl_has_the_sheet_and_the_form(
    browser: Any, service: Service, files: dict[str, Path], finished: str
) -> None:
    flags = [flag for flag in FLAGS if "swiftshader" not in flag] + ["--disable-3d-apis"]
    bare = browser.browser_type.launch(executable_path=chromium(), args=flags, chromium_sandbox=False)
    watched = Watched(bare, service.url, width=1100, height=800)
    page = watched.page
    page.goto(f"{service.url}/#/jobs/{finished}")
    page.get_by_role("img", name="before and after").wait_for()
    assert page.get_by_label("Before and after").is_checked()
    page.get_by_label("3D", exact=True).check(force=True)
    page.get_by_text("needs WebGL 2").wait_for()
    assert page.locator(".stage").bounding_box()["height"] < 200
    assert httpx2.get(f"{service.url}/v1/jobs/{finished}").json()["preview"] == "previews/thumbnail.jpg"
    page.goto(f"{service.url}/#/compare/{finished}/{finished}")
    page.get_by_text("needs WebGL 2").wait_for()
    assert page.get_by_label("Left", exact=True).is_hidden()
    page.goto(service.url)
    page.get_by_text("needs WebGL 2").wait_for()
    drop(watched, files)
    page.get_by_role("button", name="Remove scene.ply").wait_for()
    watched.check("WebGL")
    bare.close()


def test_video_is_made_and_played(visit: Visit, service: Service, finished: str) -> None:
    from axe_playwright_python.sync_playwright import Axe

    page = visit(f"/#/jobs/{finished}", allowed=["net::ERR"], width=360, height=800).page
    page.get_by_label("Camera path").select_option("cameras")
    page.get_by_label("Length").select_option("4")
    page.get_by_label("Start with the original").check()
    page.get_by_label("Size", exact=True).select_option("1280")
    page.route("**/video", lambda route: route.abort())
    with page.expect_request("**/video") as asked:
        page.get_by_role("button", name="Make a video").click()
    assert asked.value.post_data_json["resolution"] == 1280
    page.get_by_text("Can't reach the service.").wait_for()
    page.unroute_all()
    page.get_by_label("Size", exact=True).select_option("Own size")
    page.locator(".video [role=status]").evaluate(
        "(line) => new MutationObserver(() => (window.lines ??= []).push(line.textContent))"
        ".observe(line, {childList: true, characterData: true, subtree: true})"
    )
    with page.expect_response(lambda answer: "/artifacts/video.mp4" in answer.url) as received:
        page.get_by_role("button", name="Make a video").click()
    lines = page.evaluate("window.lines")  # a short video may be made before a line is drawn
    assert any("of 120" in line and "You can leave this page." in line for line in lines), lines
    assert received.value.status in (200, 206)
    player = page.get_by_label("Video of the result")
    player.wait_for()
    if player.evaluate("(video) => video.canPlayType('video/mp4; codecs=\"avc1.640028\"')"):
        page.wait_for_function("document.querySelector('video').readyState > 0")
        assert player.evaluate("(video) => [video.duration, video.videoWidth]") == [pytest.approx(4, abs=0.1), 96]
    else:  # Chromium without patented codecs
        page.get_by_text("can't play H.264").wait_for()
    assert page.evaluate("document.documentElement.scrollWidth") <= 360
    with page.expect_download() as download:
        page.get_by_role("link", name="Download video").click()
    with av.open(str(download.value.path()), "r") as container:
        assert len(list(container.decode(video=0))) == 120
    assert Axe().run(page).violations_count == 0
    page.reload()
    appear(page.get_by_label("Video of the result"), page.get_by_role("button", name="Make another video"))


def watch(visit: Visit, job_id: str) -> Watched:
    """Open the page of a running job, and wait for its colors."""
    watched = visit(f"/#/jobs/{job_id}", width=600, height=700)
    watched.page.locator(".side.right", has_text="So far").wait_for(state="attached")
    watched.page.get_by_label("Camera", exact=True).select_option("1")
    return watched


def finish(service: Service, job_id: str) -> None:
    """Ask a running job to end with its present colors."""
    httpx2.post(f"{service.url}/v1/jobs/{job_id}/finish").raise_for_status()


def names(service: Service, job_id: str) -> set[str]:
    listed = httpx2.get(f"{service.url}/v1/jobs/{job_id}/artifacts").json()["artifacts"]
    return {entry["name"] for entry in listed}


def test_scene_is_shown_while_the_job_waits_and_its_colors_while_it_runs(
    visit: Visit, service: Service, files: dict[str, Path]
) -> None:
    before, job_id = (submit(service, files, **LONG) for _ in range(2))
    wanted = rendered(files["scene"], resized(read_cameras(files["cameras"])[1], 384))
    waiting = visit(f"/#/jobs/{job_id}", width=600, height=700)
    waiting.page.locator(".state", has_text="queue").wait_for()
    waiting.page.get_by_label("Camera", exact=True).select_option("1")
    assert psnr(frame_of(waiting, wanted), wanted) > 38  # the view is larger than the rendered image
    assert waiting.page.get_by_label("Wipe", exact=True).is_hidden()
    httpx2.post(f"{service.url}/v1/jobs/{before}/cancel").raise_for_status()
    waiting.page.locator(".side.right", has_text="So far").wait_for()  # in the open tab
    watched = watch(visit, job_id)
    page = watched.page
    watched.wipe("End")
    assert psnr(frame_of(watched, wanted), wanted) > 38
    watched.wipe("Home")
    first = watched.pixels()
    wait_for(lambda: not np.array_equal(watched.pixels(), first), "other colors", service.said)
    assert httpx2.head(f"{service.url}/v1/jobs/{job_id}/artifacts/live/colors.f16").headers["content-length"] == "3696"
    assert page.get_by_label("Amount of style").is_hidden()
    assert "live" not in page.locator(".files").inner_text()
    page.get_by_label("Latest preview").check(force=True)
    page.locator(".preview img").wait_for()
    page.get_by_role("button", name="Cancel").click()
    page.locator(".badge", has_text="Canceled").wait_for()


def test_view_of_a_running_job_becomes_its_result(visit: Visit, service: Service, files: dict[str, Path]) -> None:
    job_id = submit(service, files, **LONG)
    watched = watch(visit, job_id)
    page = watched.page
    page.locator("canvas.view").evaluate("(canvas) => { canvas.id = 'same'; }")
    page.get_by_label("Latest preview").check(force=True)
    finish(service, job_id)
    page.locator(".side.right", has_text="Stylized").wait_for()
    assert page.locator("canvas.view").get_attribute("id") == "same"
    page.get_by_label("Amount of style").wait_for()
    result = result_of(service, done(service, job_id), files["scene"].parent)
    wanted = rendered(result, resized(read_cameras(files["cameras"])[1], 384))
    watched.wipe("Home")
    assert psnr(frame_of(watched, wanted), wanted) > 38
    assert not any(name.startswith("live/") for name in names(service, job_id))
