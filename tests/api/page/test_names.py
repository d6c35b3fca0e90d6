"""Tests of the names of jobs on the page."""

from __future__ import annotations

from pathlib import Path

import httpx2
import pytest

from tests.api.page.actions import LONG, Visit, choose, done, set_options, submit
from tests.api.service import Service

pytestmark = pytest.mark.slow


def test_default_name_is_scene_and_painting(visit: Visit, service: Service, files: dict[str, Path]) -> None:
    watched = visit()
    page = watched.page
    fields = page.locator("form.panel input:not([type=radio])")
    assert fields.first.get_attribute("id") == page.get_by_label("Name", exact=True).first.get_attribute("id")
    choose(watched, files)
    page.get_by_placeholder("scene · style", exact=True).wait_for()
    set_options(watched, **LONG)
    page.get_by_role("button", name="Start").click()
    page.get_by_role("heading", name="scene · style").wait_for()
    job = httpx2.get(f"{service.url}/v1/jobs/{page.url.rsplit('/', 1)[1]}").json()
    assert job["name"] == "scene · style"
    page.get_by_role("button", name="Cancel").click()
    page.locator(".badge", has_text="Canceled").wait_for()
    watched.check()


def test_job_is_renamed(visit: Visit, service: Service, files: dict[str, Path]) -> None:
    job_id = done(service, submit(service, files, name="first"))
    watched = visit(f"/#/jobs/{job_id}")
    page = watched.page
    page.get_by_role("button", name="Rename").click()
    page.get_by_label("New name").fill("second <b>name</b>")
    page.keyboard.press("Enter")
    page.get_by_role("heading", name="second <b>name</b>").wait_for()
    assert httpx2.get(f"{service.url}/v1/jobs/{job_id}").json()["name"] == "second <b>name</b>"
    page.get_by_role("button", name="Rename").click()
    page.get_by_label("New name").fill("third")
    page.keyboard.press("Escape")
    page.get_by_role("heading", name="second").wait_for()
    httpx2.patch(f"{service.url}/v1/jobs/{job_id}", json={"name": "point_cloud · wheat_field_with_cypresses"})
    tile = visit("/#/jobs", width=390, height=844).page.locator(".tile", has_text="wheat_field_with_cypresses")
    assert tile.locator("strong").evaluate(
        "(it) => it.scrollWidth <= it.clientWidth && it.scrollHeight <= it.clientHeight"
    )
    page.get_by_role("button", name="Rename").click()
    page.get_by_label("New name").fill("")
    page.keyboard.press("Enter")
    page.get_by_role("heading", name="scene · style").wait_for()
    watched.check()
