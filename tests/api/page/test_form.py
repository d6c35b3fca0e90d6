"""Tests of the form for a new job: its layout, files, inputs and refusals."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import httpx2
import pytest
from PIL import Image

from tests.api.page.actions import LONG, REFUSED, Visit, choose, drop, expand, set_options, write_selection
from tests.api.page.browser import FLAGS, Watched, chromium
from tests.api.service import Service, wait_for
from worker.options import GROUPS

pytestmark = pytest.mark.slow

#: Script that returns the texts of elements of the form that extend beyond it, or that are cut off by the window.
_CUT_OFF = """() => {
  const form = document.querySelector("form.panel").getBoundingClientRect();
  const shown = [...document.querySelectorAll("form.panel *")].filter((each) => each.getClientRects().length);
  const wide = shown.filter((each) => !each.closest(".away, svg, .segments input, .presets input, .pick input"));
  return wide.filter((each) => each.getBoundingClientRect().right > Math.min(form.right, innerWidth) + 1)
    .filter((each) => !each.matches("input[type=file], input[type=radio]")).map((each) => each.outerHTML.slice(0, 200));
}"""


@pytest.mark.parametrize(("width", "height"), [(1440, 900), (1100, 800), (390, 844)])
def test_form_fits_with_two_paintings_and_during_an_upload(
    visit: Visit, files: dict[str, Path], tmp_path: Path, width: int, height: int
) -> None:
    paintings = []
    for name in ("a_painting_with_a_name_that_is_longer_than_any_column_of_the_form", "another_painting_of_that_kind"):
        paintings.append(tmp_path / f"{name}.png")
        Image.new("RGB", (640, 360), (20, 30, 90)).save(paintings[-1])
    watched = visit(width=width, height=height)
    page = watched.page
    choose(watched, {"scene": files["scene"], "cameras": files["cameras"]})
    page.get_by_label("Style", exact=True).set_input_files(paintings)
    page.get_by_label(paintings[0].name, exact=True).wait_for()
    page.locator("[data-name=resolution]").wait_for()
    assert page.evaluate(_CUT_OFF) == []
    choices = page.locator(".strengths span").evaluate_all("(all) => all.map((it) => it.scrollWidth <= it.clientWidth)")
    assert choices == [True] * 3, "a picture of a strength is wider than its choice"
    assert page.locator("[data-name=video]").count() == 0, "a video is not a line of text"
    held: list[Any] = []
    page.route(
        "**/v1/uploads/*", lambda route: held.append(route) if route.request.method == "PATCH" else route.continue_()
    )
    page.get_by_role("button", name="Start").click()
    wait_for(lambda: page.evaluate("1") and held, "a part to be sent")
    page.get_by_role("button", name="Pause").wait_for()
    assert page.evaluate(_CUT_OFF) == []
    page.get_by_role("button", name="Stop").click()
    page.get_by_role("button", name="Pause").wait_for(state="hidden")
    page.unroute_all(behavior="ignoreErrors")
    watched.check("net::ERR")


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


def test_invalid_numbers_stop_the_start(visit: Visit, files: dict[str, Path]) -> None:
    watched = visit()
    page = watched.page
    choose(watched, files)
    sent: list[str] = []
    page.on("request", lambda request: sent.append(request.url) if "/v1/" in request.url else None)
    wrong = {
        "resolution": ("99999", "Must be at most 16,384."),
        "max_seconds": ("1e400", "Must be a number."),
        "content_weight": ("1e400", "Must be a number."),
        "views": ("2.5", "Must be a whole number."),
        "refine": ("0", "Must be at least 1."),
        "target_loss": ("1", "Must be less than 1."),
    }
    page.locator(".presets input").first.wait_for()
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


def in_view(watched: Watched, message: str) -> bool:
    """Return whether a message is neither outside of the window nor under the bar of buttons."""
    page = watched.page
    text, bar = page.locator(".wrong:visible", has_text=message).bounding_box(), page.locator(".actions").bounding_box()
    return bool(text["y"] >= 0 and text["y"] + text["height"] <= bar["y"])


@pytest.mark.parametrize(("width", "height"), [(1440, 900), (390, 844)])
def test_first_refused_field_is_in_view_and_focused(
    visit: Visit, files: dict[str, Path], width: int, height: int
) -> None:
    """Both the page's own refusals and those of the service, from any position of the page."""
    watched = visit(width=width, height=height)
    page = watched.page
    focused = """() => document.activeElement.closest("[data-name]")?.dataset.name
      ?? document.activeElement.labels[0].innerText"""
    choose(watched, {"scene": files["scene"], "style": files["style"]})
    set_options(watched, target_loss=1, resolution=99999)
    page.evaluate("() => scrollTo(0, 0)")
    page.get_by_role("button", name="Start").click()
    assert in_view(watched, "Choose camera files, or orbit the object.")
    assert page.evaluate(focused) == "Cameras"
    choose(watched, {"cameras": files["cameras"]})
    page.get_by_text("3 cameras shown in the scene").wait_for()
    page.evaluate("() => scrollTo(0, document.body.scrollHeight)")
    page.get_by_role("button", name="Start").click()
    assert in_view(watched, "Must be at most 16,384.")
    assert page.evaluate(focused) == "resolution"
    assert page.locator(".wrong:visible", has_text="Must be less than 1.").count() == 1
    set_options(watched, target_loss=0.5, resolution=480, background="pink", style_background="pink")
    page.evaluate("() => scrollTo(0, 0)")
    page.get_by_role("button", name="Start").click()
    page.locator("[data-name=style_background] .wrong:visible").wait_for()
    page.locator("[data-name=style_background] .wrong").evaluate("(text) => text.remove()")
    assert in_view(watched, "'pink' is not a color.")
    assert page.evaluate(focused) == "background"
    watched.check(REFUSED)


def test_defaults_are_those_of_the_chosen_preset(visit: Visit) -> None:
    watched = visit()
    page = watched.page
    resolution = page.locator("[data-name=resolution] input")
    resolution.wait_for()
    assert resolution.get_attribute("placeholder") == "the cameras' own"
    page.get_by_label("preview").check(force=True)
    assert resolution.get_attribute("placeholder") == "640"
    assert page.locator("[data-name=bounded] option").first.text_content() == "on (default)"
    page.get_by_label("paper").check(force=True)
    assert page.locator("[data-name=steps_sos] input").get_attribute("placeholder") == "10000"
    assert page.locator("[data-name=bounded] option").first.text_content() == "off (default)"
    watched.check()


def test_camera_frames_can_be_hidden(visit: Visit, files: dict[str, Path]) -> None:
    watched = visit()
    page = watched.page
    choose(watched, files)
    page.get_by_text("3 cameras shown in the scene").wait_for()
    with_frames = watched.pixels()
    page.get_by_role("button", name="Show cameras").click()
    without = watched.pixels()
    assert (with_frames != without).any()
    page.get_by_role("button", name="Show cameras").click()
    assert (watched.pixels() == with_frames).all()
    watched.check()


def test_start_does_not_take_over_another_view(visit: Visit, service: Service, files: dict[str, Path]) -> None:
    """A user who has left the form while its job is created stays where they are."""
    watched = visit()
    page = watched.page
    choose(watched, files)
    set_options(watched, **LONG, name="made elsewhere")
    held: list[Any] = []
    page.route("**/v1/jobs", lambda route: held.append(route) if route.request.method == "POST" else route.continue_())
    page.get_by_role("button", name="Start").click()
    wait_for(lambda: page.evaluate("1") and held, "the job to be sent")
    page.get_by_role("link", name="Jobs").click()
    held[0].continue_()
    tile = page.locator(".tile", has_text="made elsewhere")
    tile.wait_for()
    page.locator("#said", has_text="made elsewhere").wait_for(state="attached")
    assert page.url.endswith("#/jobs")
    (job,) = (job for job in httpx2.get(f"{service.url}/v1/jobs").json()["jobs"] if job["name"] == "made elsewhere")
    httpx2.post(f"{service.url}/v1/jobs/{job['id']}/cancel").raise_for_status()
    watched.check()


def test_form_works_without_webgl(browser: Any, service: Service, files: dict[str, Path]) -> None:
    """Without WebGL the place of the 3D view is small, and files can be chosen and dropped."""
    flags = [flag for flag in FLAGS if "swiftshader" not in flag] + ["--disable-3d-apis"]
    bare = browser.browser_type.launch(executable_path=chromium(), args=flags, chromium_sandbox=False)
    watched = Watched(bare, service.url, width=1100, height=800)
    page = watched.page
    page.goto(service.url)
    page.get_by_text("needs WebGL 2").wait_for()
    assert page.locator(".stage").bounding_box()["height"] < 300
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


def test_options_are_in_the_groups_of_the_command_line(visit: Visit) -> None:
    page = visit().page
    page.locator("[data-name=resolution]").wait_for()
    page.get_by_label("Orbit the object").check()
    page.locator("details.group").evaluate_all("(folds) => folds.forEach((fold) => { fold.open = true; })")
    for title, names in GROUPS.items():
        part = page.locator("section, details.fold").filter(has=page.locator(f":is(h2, summary):text-is('{title}')"))
        on_page = part.last.locator(".option[data-name]").evaluate_all("(all) => all.map((it) => it.dataset.name)")
        assert on_page == [name for name in names if name not in ("preset", "regions")], title
