"""Tests of running jobs in the 3D view: colors arrive, the original is beside them, and the view becomes the result."""

from __future__ import annotations

import re
from pathlib import Path

import httpx2
import numpy as np
import pytest

from sgsst_core.files.camera_files import read_cameras
from sgsst_core.files.formats import read_scene_header
from sgsst_core.scene.camera import resized
from tests.api.page.actions import LONG, Visit, done, submit
from tests.api.page.browser import Watched, psnr, rendered
from tests.api.page.test_page import frame_of
from tests.api.service import Service, wait_for

pytestmark = pytest.mark.slow


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
    waiting.check()
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
    watched.check()


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
    result = files["scene"].with_name("result.ply")
    result.write_bytes(httpx2.get(f"{service.url}/v1/jobs/{done(service, job_id)}/artifacts/stylized.ply").content)
    wanted = rendered(result, resized(read_cameras(files["cameras"])[1], 384))
    watched.wipe("Home")
    assert psnr(frame_of(watched, wanted), wanted) > 38
    assert not any(name.startswith("live/") for name in names(service, job_id))
    watched.check()


def test_refined_scene_is_watched(visit: Visit, service: Service, files: dict[str, Path], tmp_path: Path) -> None:
    job_id = submit(service, files, **LONG, refine=2)
    watched = watch(visit, job_id)
    watched.settled()
    (tmp_path / "live.ply").write_bytes(httpx2.get(f"{service.url}/v1/jobs/{job_id}/artifacts/live/scene.ply").content)
    assert read_scene_header(tmp_path / "live.ply").count > 616
    finish(service, job_id)
    watched.page.locator(".side.right", has_text="Stylized").wait_for(state="attached")
    watched.settled()
    watched.check("status of 404")  # the page first asks for colors alone, which do not exist


def test_job_that_ended_early_continues(visit: Visit, service: Service, files: dict[str, Path]) -> None:
    job_id = submit(service, files, steps_sos=200)
    watched = visit(f"/#/jobs/{job_id}", width=600, height=700)
    page = watched.page
    page.locator(".state", has_text=re.compile(r"step [1-9]")).wait_for()
    page.get_by_role("button", name="Stop here and keep it").click()
    page.locator(".head", has_text="This job was stopped early").wait_for()
    before = httpx2.get(f"{service.url}/v1/jobs/{done(service, job_id)}").json()["result"]
    assert before["steps"] < before["total"] == 200
    page.get_by_role("button", name="Continue").click()
    page.locator("figure.preview img[src*='/step_']").wait_for(state="attached")  # not the thumbnail
    page.locator(".badge", has_text="Done").wait_for()
    assert "stopped early" not in page.locator(".head").inner_text()
    assert page.get_by_role("button", name="Continue").count() == 0
    result = httpx2.get(f"{service.url}/v1/jobs/{job_id}").json()["result"]
    assert (result["steps"], result["total"]) == (200, 200)
    points = httpx2.get(f"{service.url}/v1/jobs/{job_id}/progress").json()["points"]
    steps = [point["step"] for point in points]
    assert steps == sorted(steps), "it continues where it stopped"
    page.locator(".side.right", has_text="Stylized").wait_for(state="attached")
    watched.check("status of 404")  # colors so far are gone once the job has ended
