"""Actions of users of the page, and of clients beside it, for the page's tests."""

import base64
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import httpx2

from tests.api.page.browser import Watched
from tests.api.service import Service
from tests.api.service import submit as submit_job

Visit = Callable[..., Watched]
STEPS: dict[str, Any] = {"steps_coarse": 5, "steps_sos": 30, "backbone": "vgg16", "early_stop": False, "measure": 0}
#: More steps than any test waits for.
LONG = STEPS | {"steps_sos": 1_000_000}
REFUSED = "the server responded with a status of 422"


def submit(service: Service, files: dict[str, Path], key: str | None = None, **parameters: Any) -> str:
    """Submit a job through the API instead of the page, and return its id."""
    with service.client(key) as client:
        return submit_job(client, files, **STEPS | parameters)


def done(service: Service, job_id: str) -> str:
    """Wait until a job has succeeded, and return its id."""
    return str(service.succeeded(job_id)["id"])


def choose(watched: Watched, files: dict[str, Path]) -> None:
    for role, path in files.items():
        watched.page.get_by_label(role.capitalize(), exact=True).set_input_files(path)


def expand(watched: Watched) -> None:
    """Expand all groups of options."""
    watched.page.locator("details.group").evaluate_all("(folds) => folds.forEach((fold) => { fold.open = true; })")


def set_options(watched: Watched, **values: Any) -> None:
    """Expand the groups of options, and fill in the given ones."""
    page = watched.page
    page.locator(".presets input").first.wait_for()
    expand(watched)
    for name, value in values.items():
        control = page.locator(f"[data-name={name}]").locator("input, select").first
        if control.evaluate("(element) => element.tagName") == "SELECT":
            control.select_option(str(value).lower())
        else:
            control.fill(str(value))


def write_selection(region: Any, text: str) -> None:
    """Select the Gaussians of a region by a text, such as "half-space=1,0,0,0"."""
    region.locator("details").evaluate("(fold) => { fold.open = true; }")
    region.get_by_label("Select").fill(text)


_DROP = """(files) => {
  const carried = new DataTransfer();
  const bytes = (text) => Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0));
  for (const [name, text] of files) carried.items.add(new File([bytes(text)], name));
  for (const kind of ["dragenter", "dragover", "drop"]) {
    const event = new DragEvent(kind, { bubbles: true, cancelable: true, dataTransfer: carried });
    document.querySelector(".frame").dispatchEvent(event);
  }
}"""


def drop(watched: Watched, files: dict[str, Path]) -> None:
    """Drop all files at once on the page."""
    watched.page.locator(".frame").wait_for()
    carried = [[path.name, base64.b64encode(path.read_bytes()).decode()] for path in files.values()]
    watched.page.evaluate(_DROP, carried)


def started(watched: Watched, service: Service, name: str = "Start") -> dict[str, Any]:
    """Start the job of the form, and return it."""
    with watched.page.expect_response(
        lambda answer: answer.url.endswith("/v1/jobs?sure_up=true") and answer.request.method == "POST"
    ) as answer:
        watched.page.get_by_role("button", name=name, exact=True).click()
    assert answer.value.status == 202, answer.value.text()
    watched.page.wait_for_url(re.compile("#/jobs/job_"))
    job: dict[str, Any] = httpx2.get(f"{service.url}/v1/jobs/{answer.value.json()['id']}").json()
    return job


def fetched(service: Service, path: str, to: Path) -> Path:
    """Download a file of the service."""
    to.write_bytes(httpx2.get(f"{service.url}{path}").raise_for_status().content)
    return to


def result_of(service: Service, job_id: str, folder: Path) -> Path:
    return fetched(service, f"/v1/jobs/{job_id}/artifacts/stylized.ply", folder / f"{job_id}.ply")
