"""Tests of going on from a job in a browser: other paintings, changes, several paintings at once, and an early end."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import httpx2
import pytest
from PIL import Image

from sgsst_core.settings import STRENGTHS
from tests.api.page.actions import LONG, REFUSED, STEPS, Visit, choose, done, set_options, started, submit
from tests.api.page.browser import Watched
from tests.api.page.test_viewer import base_of
from tests.api.service import Service

pytestmark = pytest.mark.slow


@pytest.fixture
def night(tmp_path: Path) -> Path:
    path = tmp_path / "night.png"
    Image.new("RGB", (64, 48), (20, 30, 120)).save(path)
    return path


def uploads_of(watched: Watched) -> list[str]:
    """Return a list to which the page's new uploads are added."""
    uploads: list[str] = []
    watched.page.on(
        "request",
        lambda request: (
            uploads.append(request.url) if (request.method, request.url[-11:]) == ("POST", "/v1/uploads") else None
        ),
    )
    return uploads


def digests(job: dict[str, Any], role: str) -> list[str]:
    return [each["sha256"] for each in job["inputs"] if each["role"] == role]


def test_another_painting_and_changes_send_nothing_again(
    visit: Visit, service: Service, files: dict[str, Path], night: Path
) -> None:
    regions = [{"name": "top", "select": "half-space=0,1,0,0", "freeze": True}]
    values: dict[str, Any] = {
        "preset": "preview",
        "steps_coarse": 3,
        "background": "40,40,48",
        "regions": regions,
        "name": "mine",
    }
    before = httpx2.get(f"{service.url}/v1/jobs/{done(service, submit(service, files, **values))}").json()
    watched = visit(f"/#/jobs/{before['id']}")
    page, sent = watched.page, uploads_of(watched)
    page.get_by_role("button", name="Try another painting").click()
    page.get_by_role("button", name="Remove scene.ply").wait_for()
    page.get_by_text("3 cameras shown in the scene").wait_for()
    watched.settled()
    slot = page.locator(".slot", has_text="One painting")
    assert slot.locator(".thumb").count() == 0
    slot.locator("input").set_input_files(night)
    other = started(watched, service)
    assert len(sent) == 1, "only the painting is sent"
    assert other["name"] == "scene · night"
    for role in ("scene", "cameras"):
        assert digests(other, role) == digests(before, role)
    assert digests(other, "style") != digests(before, "style")
    unchanged = {name: value for name, value in before["parameters"].items() if name not in ("name", "background")}
    assert {name: other["parameters"][name] for name in unchanged} == unchanged
    assert other["parameters"]["background"] == pytest.approx([40 / 255, 40 / 255, 48 / 255])

    page.goto(f"{service.url}/#/jobs/{before['id']}")
    page.get_by_role("button", name="Same with changes").click()
    page.get_by_role("img", name="style.png").wait_for()
    set_options(watched, steps_coarse=2)
    again = started(watched, service)
    assert len(sent) == 1, "nothing is sent"
    assert digests(again, "style") == digests(before, "style")
    assert (again["parameters"]["steps_coarse"], before["parameters"]["steps_coarse"]) == (2, 3)
    watched.check()


def test_painting_of_a_region_is_not_one_of_the_job(
    visit: Visit, service: Service, files: dict[str, Path], night: Path, tmp_path: Path
) -> None:
    """It is no part of the blend or of the default name, and another painting replaces only that of the job."""
    region = {"name": "the left", "select": "half-space=1,0,0,0", "style": ["night.png:1.0"], "content_weight": "light"}
    body = [(role, (path.name, path.read_bytes())) for role, path in [*files.items(), ("style", night)]]
    values = STEPS | {"steps_sos": 2, "regions": [region]}
    answer = httpx2.post(f"{service.url}/v1/jobs", files=body, data={"parameters": json.dumps(values)}, timeout=60)
    before = httpx2.get(f"{service.url}/v1/jobs/{done(service, answer.json()['id'])}").json()
    assert before["name"] == "scene · style"
    watched = visit(f"/#/jobs/{before['id']}")
    page = watched.page
    labels = "async ([base, job]) => (await import(`${base}/names.js`)).labels([job])"
    assert page.evaluate(labels, [base_of(watched), before]) == ["style; the left: night"]
    page.get_by_role("button", name="Try another painting").click()
    page.get_by_role("img", name="night.png").wait_for()
    page.locator(".thumb", has_text="for the left").wait_for()
    row = page.get_by_role("group", name="Region 1")
    assert row.get_by_label("Strength").input_value() == "light"
    page.get_by_role("button", name="Start", exact=True).click()
    page.locator(".slot", has_text="Style").get_by_text("Choose a painting for the rest of the scene.").wait_for()
    page.get_by_label("Style", exact=True).first.set_input_files(files["style"])
    assert page.get_by_text("Blend them").is_hidden()
    assert page.locator("[data-name=name] input").get_attribute("placeholder") == "scene · style"
    row.get_by_label("Style").select_option("Same as the job")
    page.get_by_text("Blend them").wait_for()
    assert page.get_by_label("night.png", exact=True).input_value() == "1"
    row.get_by_label("Style").select_option("night.png")
    page.get_by_text("Blend them").wait_for(state="hidden")
    again = started(watched, service)
    assert again["name"] == "scene · style"
    assert [each["style"] for each in again["parameters"]["regions"]] == ["night.png"]
    assert digests(again, "style") == [digests(before, "style")[1], digests(before, "style")[0]]
    httpx2.post(f"{service.url}/v1/jobs/{again['id']}/cancel").raise_for_status()
    watched.check()


def test_input_that_is_gone_is_asked_for_at_its_field(visit: Visit, service: Service, files: dict[str, Path]) -> None:
    job_id = done(service, submit(service, files, steps_sos=1))
    watched = visit(f"/#/jobs/{job_id}")
    page = watched.page
    page.get_by_role("button", name="Same with changes").click()
    page.get_by_role("img", name="style.png").wait_for()
    watched.settled()
    httpx2.delete(f"{service.url}/v1/jobs/{job_id}").raise_for_status()
    page.get_by_role("button", name="Start", exact=True).click()
    slot = page.locator(".slot").first
    slot.get_by_text("Upload the file again.").wait_for()
    assert "No longer on the service: scene.ply. Choose it again." in slot.inner_text()
    assert page.get_by_label("Scene", exact=True).get_attribute("aria-invalid") == "true"
    watched.check(REFUSED, "404")


def test_each_painting_can_be_a_job_of_its_own(
    visit: Visit, service: Service, files: dict[str, Path], night: Path
) -> None:
    watched = visit(width=900, height=700)
    page, sent = watched.page, uploads_of(watched)
    choose(watched, files)
    choose(watched, {"style": night})
    set_options(watched, **(STEPS | {"steps_sos": 3}))
    page.get_by_label("One job each").check()
    assert page.get_by_label("night.png", exact=True).is_hidden(), "jobs of one painting blend nothing"
    page.get_by_role("button", name="Start 2 jobs").click()
    page.wait_for_url(re.compile("#/compare/job_[0-9a-f]+/job_[0-9a-f]+$"))
    assert len(sent) == 4, "the scene is sent once for both"
    ids = page.url.split("/")[-2:]
    for job_id, name in zip(ids, ("scene · style", "scene · night"), strict=True):
        job = httpx2.get(f"{service.url}/v1/jobs/{done(service, job_id)}").json()
        assert (job["name"], len(digests(job, "style"))) == (name, 1)
    page.get_by_label("Wipe", exact=True).wait_for()
    tiles = page.get_by_role("list", name="Jobs side by side").get_by_role("listitem")
    assert tiles.count() == 2
    watched.settled()
    for tile, name in zip(tiles.all(), ("style", "night"), strict=True):
        tile.locator("img[src$='thumbnail.jpg']").wait_for()
        assert name in tile.inner_text()
    sides = page.get_by_label("Left", exact=True).locator("option").all_inner_texts()
    assert sides[:3] == ["Original", "style", "night"]
    watched.check()


def test_job_is_finished_early_on_the_page(visit: Visit, service: Service, files: dict[str, Path]) -> None:
    job_id = submit(service, files, **LONG)
    watched = visit(f"/#/jobs/{job_id}")
    page = watched.page
    page.get_by_text("Adding detail · step").wait_for()
    page.get_by_role("button", name="Stop here and keep it").click()
    page.locator(".badge", has_text="Done").wait_for()
    page.get_by_role("link", name="Download", exact=True).wait_for()
    assert httpx2.get(f"{service.url}/v1/jobs/{job_id}").json()["result"]["stopped"] == "on-request"
    watched.check()


def test_paintings_are_chosen_from_the_gallery(visit: Visit, service: Service, files: dict[str, Path]) -> None:
    """Paintings of earlier jobs are not sent again."""
    earlier = submit(service, files, **LONG, name="earlier")
    httpx2.post(f"{service.url}/v1/jobs/{earlier}/cancel").raise_for_status()
    watched = visit(width=900, height=700)
    page, sent = watched.page, uploads_of(watched)
    choose(watched, {role: files[role] for role in ("scene", "cameras")})
    page.locator("summary", has_text="Gallery").click()
    page.get_by_role("button", name="Add style.png").click()
    page.get_by_role("button", name="Remove style.png").wait_for()
    page.get_by_role("button", name="Add The Great Wave off Kanagawa, Hokusai").click()
    page.get_by_role("button", name="Remove great_wave.jpg").wait_for()
    broken = "(images) => images.filter((image) => image.complete && !image.naturalWidth).length"
    assert page.locator(".painting img").count() > 6, "those of earlier jobs, and six of the page"
    assert page.locator(".painting img").evaluate_all(broken) == 0
    set_options(watched, **STEPS)
    page.get_by_role("radio", name="Balanced").check(force=True)
    assert page.locator("[data-name=content_weight] input[list]").input_value() == "balanced"
    page.locator("[data-name=content_weight] input[list]").fill("2.5")
    assert page.locator(".strengths input:checked").count() == 0
    page.get_by_role("radio", name="Light").check(force=True)
    job = started(watched, service)
    assert len(sent) == 3, "the scene, its cameras and the painting of the page"
    assert job["parameters"]["content_weight"] == STRENGTHS["light"]
    assert job["name"] == "scene · style + great_wave"
    httpx2.post(f"{service.url}/v1/jobs/{job['id']}/cancel").raise_for_status()
    watched.check()
