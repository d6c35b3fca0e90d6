"""Tests of sharing a result: the link opens its viewer without a key, in frames of permitted sites too."""

import io
import re
from collections.abc import Iterator
from datetime import datetime, timedelta
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from threading import Thread
from typing import Any

import numpy as np
import pytest
from PIL import Image

from tests.api.page.actions import STEPS, Visit, done, submit
from tests.api.page.browser import Watched, in_frame, psnr, rendered
from tests.api.service import Service
from tests.small_scenes import cameras, wall, write_files

pytestmark = pytest.mark.slow
#: Script that waits until the 3D view has drawn more frames than a number.
_FRAMES = """(most) => new Promise((done) => {
  const stage = document.querySelector(".stage");
  new MutationObserver((_, watch) => stage.dataset.frames > most && done(watch.disconnect()))
    .observe(stage, { attributes: true });
})"""


@pytest.fixture(scope="module")
def job_id(service: Service, inputs: dict[str, Path]) -> str:
    """Return the id of a finished job."""
    return done(service, submit(service, inputs, **(STEPS | {"steps_sos": 2}), name="my wall", retention_days=2))


def test_link_shows_viewer_and_wipe_until_it_is_revoked(visit: Visit, service: Service, job_id: str) -> None:
    page = visit(f"/#/jobs/{job_id}").page
    page.get_by_label("Link expires after").select_option("1")
    page.get_by_role("button", name="Create a link").click()
    page.get_by_role("button", name="Revoke").wait_for()
    first = page.get_by_label("Link to this result").input_value()
    page.get_by_label("Link expires after").select_option("30")
    page.get_by_role("button", name="Create a link").click()
    page.get_by_role("button", name="Revoke").nth(1).wait_for()
    with service.client() as client:
        shares = client.get(f"/v1/jobs/{job_id}/shares").json()["shares"]
    page.get_by_role("button", name="Revoke").nth([share["id"] in first for share in shares].index(True)).click()
    page.get_by_role("button", name="Revoke").nth(1).wait_for(state="detached")
    assert first not in page.get_by_label("Link to this result").input_value(), "the second link stays to be copied"
    link = page.get_by_label("Link to this result").input_value()
    assert link.startswith(f"{service.url}/shared#shr_")
    page.get_by_role("button", name="Copy").click()

    other = visit(link, allowed=["404"], width=900, height=700)
    other.page.get_by_role("heading", name="my wall").wait_for()
    other.settled()
    slider = other.page.get_by_label("Wipe", exact=True).bounding_box()
    assert slider["y"] + slider["height"] <= 700, "the wipe is in sight"
    other.wipe("Home")
    assert other.page.locator(".side.right").inner_text() == "Stylized"
    options = other.page.get_by_label("Camera", exact=True).locator("option")
    options.nth(3).wait_for(state="attached")
    assert options.count() == 4, "three cameras, and the free view"
    assert other.page.locator("a, form, .blend:visible").count() == 0, "nothing but the viewer"

    page.get_by_role("button", name="Revoke").click()
    page.get_by_role("button", name="Revoke").wait_for(state="detached")
    other.page.reload()
    other.page.get_by_role("heading", name="This link doesn't work").wait_for()


def test_result_opens_where_its_maker_stood(visit: Visit, service: Service, job_id: str, tmp_path: Path) -> None:
    views = cameras(3, 96, 72)
    watched = visit(f"/#/jobs/{job_id}", width=1100, height=800, reduced_motion="reduce")
    page, panel = watched.page, watched.page.get_by_role("region", name="Views", exact=True)
    page.get_by_label("Wipe", exact=True).wait_for()
    watched.settled()
    page.get_by_label("Camera", exact=True).select_option("2")
    watched.settled()
    panel.get_by_role("button", name="Start here").click()
    panel.get_by_text("The result, its links and its page open here.").wait_for()
    page.get_by_label("Camera", exact=True).select_option("0")
    panel.get_by_label("Name of the view").fill("the left")
    panel.get_by_role("button", name="Add view").click()
    panel.get_by_text("“the left” was added.").wait_for()
    page.get_by_label("Camera", exact=True).select_option("1")
    panel.get_by_role("button", name="Add view").click()
    panel.get_by_role("button", name="2 · View 2").wait_for()
    with service.client() as client:
        link = client.post(f"/v1/jobs/{job_id}/shares", json={"poster": True}).json()["url"]
        poster = client.get(f"/v1/shared/{link.rpartition('/')[2]}/poster")
        exported = client.get(f"/v1/jobs/{job_id}/artifacts/stylized.ply?format=html")
        job = client.get(f"/v1/jobs/{job_id}").json()
    viewpoints = job["viewpoints"]
    finished_at, expires_at = (datetime.fromisoformat(job[name]) for name in ("finished_at", "expires_at"))
    assert expires_at - finished_at == timedelta(days=2)
    page.get_by_text(re.compile("kept until")).wait_for()
    assert viewpoints["start"]["position"] == pytest.approx(views[2].center.tolist())
    assert [each["name"] for each in viewpoints["named"]] == ["the left", "View 2"]
    start = viewpoints["start"]
    scene, _, _ = write_files(tmp_path, wall(sh_degree=1), views)
    with Image.open(io.BytesIO(poster.content)) as image:
        shown = np.asarray(image.convert("RGB"), dtype=np.float64)
        height, width, _ = shown.shape
        assert width / height == pytest.approx(start["width"] / start["height"], abs=0.01)
    wanted = rendered(scene, in_frame(views[2], width, height))
    left = np.s_[:, : width // 2]
    assert psnr(shown[left], wanted[left]) > 25, "a JPEG of the start"

    file = tmp_path / "page.html"
    file.write_bytes(exported.content)
    for url in (f"{service.url}{link}", file.as_uri()):
        other = visit(url, width=900, height=700, reduced_motion="reduce")
        other.wipe("End")
        pixels = other.pixels()
        assert psnr(pixels, rendered(scene, in_frame(views[2], *pixels.shape[1::-1]))) > 35  # the file has a SOG
        other.page.get_by_role("button", name="1 · the left").click()
        pixels = other.pixels()
        assert psnr(pixels, rendered(scene, in_frame(views[0], *pixels.shape[1::-1]))) > 35
        assert other.page.locator("form").count() == 0, "others change nothing"
    panel.get_by_role("button", name="Start at the usual place").click()
    panel.get_by_text("The result opens at its usual place.").wait_for()
    panel.get_by_role("button", name="Remove the left").click()
    panel.get_by_role("button", name="1 · View 2").wait_for()


@pytest.fixture
def site(tmp_path: Path) -> Iterator[tuple[int, Path]]:
    """Yield the port and the folder of another site."""
    server = ThreadingHTTPServer(("127.0.0.1", 0), partial(SimpleHTTPRequestHandler, directory=str(tmp_path)))
    Thread(target=server.serve_forever, daemon=True).start()
    yield server.server_port, tmp_path
    server.shutdown()
    server.server_close()


def test_permitted_site_shows_a_link_in_a_frame(
    visit: Visit, browser: Any, service: Service, job_id: str, site: tuple[int, Path]
) -> None:
    port, folder = site
    settings = {"SGSST_CACHE": service.environment["SGSST_CACHE"], "SGSST_EMBED_ORIGINS": f"http://localhost:{port}"}
    with Service(service.data, alone=True, **settings) as permitting:
        watched = Watched(browser, permitting.url)
        watched.page.goto(f"{permitting.url}/#/jobs/{job_id}")
        watched.page.get_by_label("Show an image where the link is posted").check()
        watched.page.get_by_role("button", name="Create a link").click()
        snippet = watched.page.get_by_label("HTML for your web page", exact=True).input_value()
        link = watched.page.get_by_label("Link to this result", exact=True).input_value()
        watched.check()
        watched.context.close()
        assert re.fullmatch(rf"{permitting.url}/shared/shr_[^/#]+", link)
        gallery, page = folder / "gallery.html", f"http://localhost:{port}/gallery.html"
        gallery.write_text(snippet)

        still = browser.new_page(reduced_motion="reduce")
        still.goto(page)
        frame = still.frame_locator("iframe")
        frame.locator("canvas[data-state=settled]").wait_for()
        assert frame.locator(":is(.top, .tools, .head, .poster):visible").count() == 0, "nothing but the scene"
        still.close()

        rotating, scenes, referrers = browser.new_page(), list[Any](), list[str]()
        rotating.on("request", lambda request: referrers.append(request.headers.get("referer", "")))
        rotating.route("**/v1/shared/*/scene", lambda route: scenes.append(route))
        with rotating.expect_request("**/v1/shared/*/scene"):
            rotating.goto(page)
        frame = rotating.frame_locator("iframe")
        frame.locator(".poster").wait_for()
        scenes.pop().continue_()
        frame.locator(".poster").wait_for(state="detached")
        count = int(frame.locator(".stage").get_attribute("data-frames") or 0)
        rotating.frames[1].evaluate(_FRAMES, count + 20)
        frame.locator("canvas").first.click(position={"x": 60, "y": 60})  # beside the divider
        frame.locator("canvas[data-state=settled]").wait_for()
        assert not [referrer for referrer in referrers if "shr_" in referrer]
        rotating.close()

        for address, embedded in (
            (page.replace("localhost", "127.0.0.1"), snippet),  # another origin
            (page, snippet.replace("?embed=1", "")),
            (page, snippet.replace(permitting.url, service.url)),
        ):
            gallery.write_text(embedded)
            refused = browser.new_page()
            with refused.expect_console_message(lambda message: "frame-ancestors" in message.text):
                refused.goto(address)
            refused.close()
