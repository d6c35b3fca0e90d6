"""Tests of the form for a new job: its layout, files, inputs and refusals, and jobs that start from another one."""

import io
import json
import re
from pathlib import Path
from typing import Any

import httpx2
import pytest
from PIL import Image

from sgsst_core.settings import STRENGTHS
from tests.api.page.actions import (
    LONG,
    REFUSED,
    STEPS,
    Visit,
    choose,
    done,
    drop,
    expand,
    set_options,
    started,
    submit,
    write_selection,
)
from tests.api.page.browser import Watched, appear, click
from tests.api.page.test_viewer import base_of
from tests.api.service import Service, wait_for

pytestmark = pytest.mark.slow


def test_files_are_removed_and_replaced(visit: Visit, files: dict[str, Path], tmp_path: Path) -> None:
    watched = visit()
    page = watched.page
    choose(watched, files)
    page.get_by_text("3 cameras shown in the scene").wait_for()
    page.get_by_role("button", name="Remove cameras.json").click()
    page.get_by_role("button", name="Remove cameras.json").wait_for(state="detached")
    choose(watched, {"cameras": files["cameras"]})
    (tmp_path / "other").mkdir()
    fewer = tmp_path / "other" / "cameras.json"
    fewer.write_text(json.dumps(json.loads(files["cameras"].read_text())[:2]))
    choose(watched, {"cameras": fewer})
    page.get_by_text("2 cameras shown in the scene").wait_for()
    assert page.get_by_role("button", name="Remove cameras.json").count() == 1
    photos = []
    for name in ("view_0.png", "view_1.png"):
        photos.append(tmp_path / name)
        Image.new("RGB", (96, 72)).save(photos[-1])
    page.get_by_label("Photos", exact=True).set_input_files(photos)
    page.get_by_role("button", name="Remove view_0.png").click()
    page.get_by_label("Photos", exact=True).set_input_files(photos)
    page.locator(".slot", has_text="Photos").get_by_role("button", name="Remove all").click()
    page.get_by_role("button", name="Remove view_1.png").wait_for(state="detached")


def test_what_was_entered_survives_other_views(visit: Visit, files: dict[str, Path]) -> None:
    watched = visit()
    page = watched.page
    choose(watched, files)
    set_options(watched, steps_sos=17, name="kept")
    page.locator("details.fold", has_text="Regions").evaluate("(fold) => { fold.open = true; }")
    page.get_by_role("button", name="Add a region").click()
    page.get_by_role("group", name="Region 1").get_by_label("Name").fill("left")
    click(page.get_by_role("link", name="Jobs"), page.get_by_role("link", name="New", exact=True))
    for path in files.values():
        page.get_by_role("button", name=f"Remove {path.name}").wait_for()
    page.get_by_text("616 Gaussians · SH degree 1").wait_for()
    wait_for(lambda: page.locator("[data-name=steps_sos] input").input_value() == "17", "the options")
    assert page.locator("[data-name=name] input").input_value() == "kept"
    assert page.get_by_role("group", name="Region 1").get_by_label("Name").input_value() == "left"


def test_dropped_files_that_are_not_used_are_named(visit: Visit, files: dict[str, Path], tmp_path: Path) -> None:
    notes = tmp_path / "notes.docx"
    notes.write_bytes(b"text")
    watched = visit()
    drop(watched, files | {"notes": notes})
    appear(
        watched.page.get_by_role("alert").get_by_text("Not used: notes.docx"),
        watched.page.get_by_role("button", name="Remove scene.ply"),
    )
    drop(watched, {"cameras": files["cameras"]})
    watched.page.get_by_text("Not used").wait_for(state="hidden")


def test_unusable_files_are_named_on_their_cards(visit: Visit, files: dict[str, Path], tmp_path: Path) -> None:
    """At once, and they stop the start. A reload says which files of this device to choose again."""
    image = io.BytesIO()
    Image.open(files["style"]).convert("RGB").save(image, "JPEG")
    contents = {"empty.ply": b"", "photo.ply": image.getvalue(), "half.jpg": image.getvalue()[:800]}
    contents["half.ply"] = files["scene"].read_bytes()[:-5000]
    for name, content in (contents | {"notes.txt": b"text", "cut.json": files["cameras"].read_bytes()[:-20]}).items():
        (tmp_path / name).write_bytes(content)
    watched = visit()
    page = watched.page
    for role, name, text in (
        ("Scene", "empty.ply", "empty.ply is empty (0 bytes)"),
        ("Scene", "half.ply", "616 Gaussians take"),
        ("Scene", "photo.ply", "Not a scene file"),
        ("Style", "half.jpg", "half.jpg is incomplete or damaged"),
        ("Photos", "half.jpg", "half.jpg is incomplete or damaged"),
        ("Cameras", "notes.txt", "notes.txt isn't a camera file"),
        ("Cameras", "cut.json", "cut.json is incomplete, or not JSON"),
    ):
        if role == "Photos":
            page.get_by_label("Use my cameras").check(force=True)
        field = page.get_by_label(role, exact=True).first
        field.set_input_files(tmp_path / name)
        page.locator(".slot", has=field).locator(".wrong", has_text=text).wait_for()
    page.locator(".presets input").first.wait_for()
    page.get_by_role("button", name="Start", exact=True).click()
    assert page.get_by_label("Scene", exact=True).evaluate("(input) => input === document.activeElement")
    page.reload()
    for name in ("photo.ply", "half.jpg", "cut.json"):
        page.locator(".slot", has_text=f"Choose again: {name}").first.wait_for()
    choose(watched, {"scene": files["scene"]})
    page.get_by_text("616 Gaussians · SH degree 1").wait_for()
    assert page.get_by_text("Choose again: photo.ply").is_hidden()


def test_invalid_numbers_stop_the_start(visit: Visit, files: dict[str, Path]) -> None:
    watched = visit()
    page = watched.page
    choose(watched, files)
    page.locator(".presets input").first.wait_for()
    budget = httpx2.get(f"{watched.url}/v1/session").json()["within"]
    assert page.locator("[data-name=within] input").input_value() == str(budget // 60)
    sent: list[str] = []
    page.on("request", lambda request: sent.append(request.url) if "/v1/" in request.url else None)
    wrong = {
        "resolution": ("99999", "Must be at most 16,384."),
        "within": ("1e400", "Must be a number."),
        "content_weight": ("1e400", "Must be a number."),
        "views": ("2.5", "Must be a whole number."),
        "refine": ("0", "Must be at least 1."),
        "target_loss": ("1", "Must be less than 1."),
    }
    expand(watched)
    for name, (text, _) in wrong.items():
        page.locator(f"[data-name={name}] input:not([type=radio])").press_sequentially(text)
    page.get_by_role("button", name="Start").click()
    for name, (_, message) in wrong.items():
        page.locator(f"[data-name={name}]").get_by_text(message).wait_for()
    assert sent == []


def test_refusals_of_the_service_stand_at_their_place(visit: Visit, files: dict[str, Path]) -> None:
    watched = visit(allowed=[REFUSED])
    page = watched.page
    choose(watched, files)
    set_options(watched, background="pink")
    page.get_by_role("button", name="Estimate time").click()
    page.locator("[data-name=background]").get_by_text("'pink' is not a color. Give black, white").wait_for()
    set_options(watched, background="40,40,48")
    page.locator("details.fold", has_text="Regions").evaluate("(fold) => { fold.open = true; }")
    for number, select in ((1, "half-space=1,0,0,0"), (2, "cube=1")):
        page.get_by_role("button", name="Add a region").click()
        region = page.get_by_role("group", name=f"Region {number}")
        assert region.get_by_label("Name").input_value() == f"Part {number}"
        write_selection(region, select)
        region.get_by_label("Freeze").check()
    region.get_by_label("Name").fill("Grandma's face, 50% [x]: \u00fc")
    page.get_by_role("button", name="Estimate time").click()
    region.locator(".wrong", has_text="not a known selection").wait_for()
    region.get_by_label("Select").fill("half-space=-1,0,0,0")
    region.get_by_label("Freeze").uncheck()
    page.get_by_role("button", name="Estimate time").click()
    page.get_by_role("region", name="Estimate").get_by_text("Region Grandma's face").wait_for(state="attached")
    region.get_by_label("Select").fill("")
    page.get_by_role("button", name="Estimate time").click()
    region.locator(".wrong", has_text="Select a part of the scene in the 3D view").wait_for()
    assert page.evaluate("() => document.activeElement.innerText") == "Select in the 3D view"
    region.get_by_label("Name").fill(" ")
    page.get_by_role("button", name="Estimate time").click()
    region.locator(".wrong", has_text="Give the region a name.").wait_for()
    assert region.get_by_label("Name").get_attribute("aria-invalid") == "true"


def test_defaults_are_those_of_the_chosen_preset(visit: Visit) -> None:
    page = visit().page
    resolution = page.locator("[data-name=resolution] input")
    resolution.wait_for()
    early_stop = page.locator("[data-name=early_stop] option").first
    assert resolution.get_attribute("placeholder") == "fits the time"
    assert early_stop.text_content() == "off (default)"
    page.locator("[data-name=within] input").fill("")
    assert resolution.get_attribute("placeholder") == "the cameras' own"
    assert early_stop.text_content() == "on (default)"
    page.get_by_label("preview").check(force=True)
    assert resolution.get_attribute("placeholder") == "640"
    assert page.locator("[data-name=bounded] option").first.text_content() == "on (default)"
    page.get_by_label("paper").check(force=True)
    assert page.locator("[data-name=steps_sos] input").get_attribute("placeholder") == "10000"
    assert page.locator("[data-name=bounded] option").first.text_content() == "off (default)"


def test_estimate_warns_and_can_be_stopped(visit: Visit, files: dict[str, Path]) -> None:
    watched = visit(allowed=["net::ERR"])
    page = watched.page
    choose(watched, files)
    page.locator("[data-name=resolution]").wait_for()
    page.locator("details.fold", has_text="Regions").evaluate("(fold) => { fold.open = true; }")
    page.get_by_role("button", name="Add a region").click()
    page.get_by_role("group", name="Region 1").get_by_label("Name").fill("empty")
    write_selection(page.get_by_role("group", name="Region 1"), "half-space=0,0,1,99")
    page.get_by_role("group", name="Region 1").get_by_label("Freeze").check()
    held: list[Any] = []
    page.route("**/v1/jobs?dry_run=true", lambda route: held.append(route))
    page.get_by_role("button", name="Estimate time").click()
    wait_for(lambda: page.evaluate("1") and held, "the request")
    page.get_by_role("button", name="Stop").click()
    page.get_by_role("button", name="Stop").wait_for(state="hidden")
    assert page.get_by_role("button", name="Estimate time").is_enabled()
    page.unroute_all(behavior="ignoreErrors")
    page.get_by_role("button", name="Estimate time").click()
    cost = page.get_by_role("region", name="Estimate")
    appear(
        cost.get_by_role("alert").get_by_text("region empty: ignored, because it has no Gaussians"),
        cost.get_by_text("for the whole job"),
    )


def test_ten_minutes_are_offered_for_a_long_job(visit: Visit, files: dict[str, Path]) -> None:
    watched = visit()
    page = watched.page
    choose(watched, files)
    set_options(watched, within="", steps_sos=10_000_000, measure=0, backbone="vgg16")
    page.get_by_role("button", name="Estimate time").click()
    page.get_by_role("region", name="Estimate").get_by_text("Shall it be faster?").wait_for()
    with page.expect_request("**/v1/jobs?dry_run=true") as asked:
        page.get_by_role("button", name="As good as it gets in 10 minutes").click()
    assert asked.value.post_data_json["parameters"]["within"] == 600
    page.get_by_role("region", name="Estimate").wait_for()
    assert page.locator("[data-name=within] input").input_value() == "10"  # minutes


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
    appear(page.get_by_role("button", name="Remove scene.ply"), page.get_by_text("3 cameras shown in the scene"))
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
    appear(page.get_by_role("img", name="night.png"), page.locator(".thumb", has_text="for the left"))
    row = page.get_by_role("group", name="Region 1")
    assert row.get_by_label("Strength").input_value() == "light"
    watched.settled()  # what is read later discards messages
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


def test_input_that_is_gone_is_asked_for_at_its_field(visit: Visit, service: Service, files: dict[str, Path]) -> None:
    job_id = done(service, submit(service, files, steps_sos=1))
    watched = visit(f"/#/jobs/{job_id}", allowed=[REFUSED, "404"])
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


def test_job_is_finished_early_on_the_page(visit: Visit, service: Service, files: dict[str, Path]) -> None:
    job_id = submit(service, files, **LONG)
    page = visit(f"/#/jobs/{job_id}").page
    page.get_by_text("Adding detail · step").wait_for()
    page.get_by_role("button", name="Stop here and keep it").click()
    appear(page.locator(".badge", has_text="Done"), page.get_by_role("link", name="Download", exact=True))
    assert httpx2.get(f"{service.url}/v1/jobs/{job_id}").json()["result"]["stopped"] == "on-request"


def test_paintings_are_chosen_from_the_gallery(visit: Visit, service: Service, files: dict[str, Path]) -> None:
    watched = visit(width=900, height=700)
    page, sent = watched.page, uploads_of(watched)
    choose(watched, files)
    page.locator("summary", has_text="Gallery").click()
    page.get_by_role("button", name="Add The Great Wave off Kanagawa, Hokusai").click()
    page.get_by_role("button", name="Remove great_wave.jpg").wait_for()
    broken = "(images) => images.filter((image) => image.complete && !image.naturalWidth).length"
    assert page.locator(".painting img").count() == 6
    assert page.locator(".painting img").evaluate_all(broken) == 0
    page.get_by_label("style.png", exact=True).fill("3")
    set_options(watched, **STEPS)
    page.get_by_role("radio", name="Balanced").check(force=True)
    assert page.locator("[data-name=content_weight] input[list]").input_value() == "balanced"
    page.locator("[data-name=content_weight] input[list]").fill("2.5")
    assert page.locator(".strengths input:checked").count() == 0
    page.get_by_role("radio", name="Light").check(force=True)
    job = started(watched, service)
    assert len(sent) == 4, "the scene, its cameras and both paintings"
    assert job["parameters"]["content_weight"] == STRENGTHS["light"]
    assert job["parameters"]["style_weights"] == [3.0, 1.0]
    assert job["name"] == "scene · style + great_wave"
    httpx2.post(f"{service.url}/v1/jobs/{job['id']}/cancel").raise_for_status()
