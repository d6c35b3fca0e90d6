"""Tests of the form for a new job: its layout, files, inputs and refusals."""

from __future__ import annotations

import io
import json
from pathlib import Path
from typing import Any

import httpx2
import pytest
from PIL import Image

from tests.api.page.actions import REFUSED, Visit, choose, drop, expand, set_options, write_selection
from tests.api.page.browser import FLAGS, Watched, chromium
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
    watched.check()


def test_what_was_entered_survives_other_views(visit: Visit, files: dict[str, Path]) -> None:
    watched = visit()
    page = watched.page
    choose(watched, files)
    set_options(watched, steps_sos=17, name="kept")
    page.locator("details.fold", has_text="Regions").evaluate("(fold) => { fold.open = true; }")
    page.get_by_role("button", name="Add a region").click()
    page.get_by_role("group", name="Region 1").get_by_label("Name").fill("left")
    page.get_by_role("link", name="Jobs").click()
    page.get_by_role("link", name="New", exact=True).click()
    for path in files.values():
        page.get_by_role("button", name=f"Remove {path.name}").wait_for()
    page.get_by_text("616 Gaussians · SH degree 1").wait_for()
    wait_for(lambda: page.locator("[data-name=steps_sos] input").input_value() == "17", "the options")
    assert page.locator("[data-name=name] input").input_value() == "kept"
    assert page.get_by_role("group", name="Region 1").get_by_label("Name").input_value() == "left"
    watched.check()


def test_dropped_files_that_are_not_used_are_named(visit: Visit, files: dict[str, Path], tmp_path: Path) -> None:
    notes = tmp_path / "notes.docx"
    notes.write_bytes(b"text")
    watched = visit()
    drop(watched, files | {"notes": notes})
    watched.page.get_by_role("alert").get_by_text("Not used: notes.docx").wait_for()
    watched.page.get_by_role("button", name="Remove scene.ply").wait_for()
    drop(watched, {"cameras": files["cameras"]})
    watched.page.get_by_text("Not used").wait_for(state="hidden")
    watched.check()


def test_truncated_scene_is_refused_on_its_card(visit: Visit, files: dict[str, Path]) -> None:
    watched = visit()
    page = watched.page
    whole = files["scene"].read_bytes()
    files["scene"].write_bytes(whole[:-5000])
    choose(watched, files)
    slot = page.locator(".slot", has_text="Scene")
    slot.get_by_text(f"616 Gaussians take {len(whole):,} bytes, but it has {len(whole) - 5000:,}.").wait_for()
    page.get_by_text("3 cameras").or_(page.locator(".thumb", has_text="cameras.json")).first.wait_for()
    sent: list[str] = []
    page.on("request", lambda request: sent.append(request.url) if "/v1/" in request.url else None)
    page.get_by_role("button", name="Start").click()
    assert page.get_by_label("Scene", exact=True).evaluate("(input) => input === document.activeElement")
    assert sent == []
    files["scene"].write_bytes(whole)
    choose(watched, {"scene": files["scene"]})
    slot.get_by_text("616 Gaussians · SH degree 1").wait_for()
    assert slot.locator(".wrong").is_hidden()
    watched.check()


def test_unusable_files_are_named_on_their_cards(visit: Visit, files: dict[str, Path], tmp_path: Path) -> None:
    """At once, and they stop the start. A reload says which files of this device to choose again."""
    image = io.BytesIO()
    Image.open(files["style"]).convert("RGB").save(image, "JPEG")
    contents = {"empty.ply": b"", "photo.ply": image.getvalue(), "half.jpg": image.getvalue()[:800]}
    for name, content in (contents | {"notes.txt": b"text", "cut.json": files["cameras"].read_bytes()[:-20]}).items():
        (tmp_path / name).write_bytes(content)
    watched = visit()
    page = watched.page
    for role, name, text in (
        ("Scene", "empty.ply", "empty.ply is empty (0 bytes)"),
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
    watched.check()


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
    watched.check()


def test_refusals_of_the_service_stand_at_their_place(visit: Visit, files: dict[str, Path]) -> None:
    watched = visit()
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
    watched.check(REFUSED)


def test_defaults_are_those_of_the_chosen_preset(visit: Visit) -> None:
    watched = visit()
    page = watched.page
    resolution = page.locator("[data-name=resolution] input")
    resolution.wait_for()
    assert resolution.get_attribute("placeholder") == "fits the time"
    page.locator("[data-name=within] input").fill("")
    assert resolution.get_attribute("placeholder") == "the cameras' own"
    page.get_by_label("preview").check(force=True)
    assert resolution.get_attribute("placeholder") == "640"
    assert page.locator("[data-name=bounded] option").first.text_content() == "on (default)"
    page.get_by_label("paper").check(force=True)
    assert page.locator("[data-name=steps_sos] input").get_attribute("placeholder") == "10000"
    assert page.locator("[data-name=bounded] option").first.text_content() == "off (default)"
    watched.check()


def test_form_works_without_webgl(browser: Any, service: Service, files: dict[str, Path]) -> None:
    """Without WebGL the place of the 3D view is small, and files can be chosen and dropped."""
    flags = [flag for flag in FLAGS if "swiftshader" not in flag] + ["--disable-3d-apis"]
    bare = browser.browser_type.launch(executable_path=chromium(), args=flags, chromium_sandbox=False)
    watched = Watched(bare, service.url, width=1100, height=800)
    page = watched.page
    page.goto(service.url)
    page.get_by_text("needs WebGL 2").wait_for()
    assert page.locator(".stage").bounding_box()["height"] < 450
    drop(watched, files)
    page.get_by_role("button", name="Remove scene.ply").wait_for()
    watched.check("WebGL")
    bare.close()


def test_estimate_warns_and_can_be_stopped(visit: Visit, files: dict[str, Path]) -> None:
    watched = visit()
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
    cost.get_by_role("alert").get_by_text("region empty: ignored, because it has no Gaussians").wait_for()
    cost.get_by_text("for the whole job").wait_for()
    watched.check("net::ERR")


def test_ten_minutes_are_offered_for_a_long_job(visit: Visit, files: dict[str, Path]) -> None:
    watched = visit()
    page = watched.page
    choose(watched, files)
    set_options(watched, within="", steps_sos=10_000_000, measure=0, backbone="vgg16")
    page.get_by_role("button", name="Estimate time").click()
    page.get_by_role("region", name="Estimate").get_by_text("Shall it be faster?").wait_for()

    def has_budget(request: Any) -> bool:  # estimates of the other presets may be under way, without one
        return request.url.endswith("dry_run=true") and "within" in request.post_data_json["parameters"]

    with page.expect_request(has_budget) as asked:
        page.get_by_role("button", name="As good as it gets in 10 minutes").click()
    assert asked.value.post_data_json["parameters"]["within"] == 600
    page.get_by_role("region", name="Estimate").wait_for()
    assert page.locator("[data-name=within] input").input_value() == "10"  # minutes
    watched.check()
