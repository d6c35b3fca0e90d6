"""Test of the page at a subpath of a host, behind nginx."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from tests.api.page.actions import STEPS, choose, set_options
from tests.api.page.browser import Watched
from tests.api.service import Service
from tests.nginx import Nginx

pytestmark = pytest.mark.slow


def test_job_is_submitted_and_watched(browser: Any, service: Service, files: dict[str, Path], tmp_path: Path) -> None:
    port = int(service.url.rpartition(":")[2])
    with Nginx(tmp_path / "nginx", port, "/sgsst") as nginx:
        watched = Watched(browser, f"{nginx.url}/")  # a request to another path of the host is an error
        page = watched.page
        page.goto(watched.url)
        choose(watched, files)
        page.get_by_text("616 Gaussians · SH degree 1").wait_for()
        set_options(watched, **(STEPS | {"steps_sos": 3}))
        page.get_by_role("button", name="Start").click()
        page.locator(".badge", has_text="Done").wait_for()  # learned from events
        watched.wipe("Home")
        page.get_by_role("button", name="Create a link").click()
        link = page.get_by_label("Link to this result")
        link.wait_for()
        assert link.input_value().startswith(f"{nginx.url}/shared#shr_")
        page.goto(link.input_value())
        watched.settled()
        page.goto(f"{nginx.url}/docs")
        page.get_by_text("/v1/uploads", exact=True).first.wait_for()
        watched.check()
        watched.context.close()
