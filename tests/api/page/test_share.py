"""Test of sharing a result: the link opens its viewer without a key, until it is revoked."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.api.page.actions import STEPS, Visit, done, submit
from tests.api.service import Service

pytestmark = pytest.mark.slow


def test_link_shows_viewer_and_wipe_until_it_is_revoked(visit: Visit, service: Service, files: dict[str, Path]) -> None:
    job_id = done(service, submit(service, files, **(STEPS | {"steps_sos": 2}), name="my wall"))
    watched = visit(f"/#/jobs/{job_id}")
    page = watched.page
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

    other = visit(link.removeprefix(service.url), width=900, height=700)
    other.page.get_by_role("heading", name="my wall").wait_for()
    other.settled()
    other.wipe("Home")
    assert other.page.locator(".side.right").inner_text() == "Stylized"
    options = other.page.get_by_label("Camera", exact=True).locator("option")
    options.nth(3).wait_for(state="attached")
    assert options.count() == 4, "three cameras, and the free view"
    assert other.page.locator("a, form, .blend:visible").count() == 0, "nothing but the viewer"
    other.check()

    page.get_by_role("button", name="Revoke").click()
    page.get_by_role("button", name="Revoke").wait_for(state="detached")
    other.page.reload()
    other.page.get_by_role("heading", name="This link doesn't work").wait_for()
    other.check("404")
    watched.check()
