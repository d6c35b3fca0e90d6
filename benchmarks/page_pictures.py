"""Screenshots of the web page for docs/, from a temporary service that runs jobs on a real scene.

python -m benchmarks.page_pictures SCENE.ply CAMERAS.json STYLE.jpg STYLE.jpg [--resolution 320] [--steps 150]
"""

from __future__ import annotations

import argparse
import io
import json
import re
import tempfile
from pathlib import Path
from typing import Any

import httpx
from PIL import Image

from tests.api.page.browser import Watched, open_browser
from tests.api.service import Service, wait_for

DOCS = Path(__file__).parents[1] / "docs"
_QUALITY = 72
_WIDTH = 1280


def save(watched: Watched, name: str, folder: Path, width: int = _WIDTH) -> None:
    """Save a screenshot of the window as page_NAME.webp, scaled to `width` pixels."""
    with Image.open(io.BytesIO(watched.page.screenshot())) as image:
        size = (width, round(image.height * width / image.width))
        image.convert("RGB").resize(size, Image.Resampling.LANCZOS).save(
            folder / f"page_{name}.webp", quality=_QUALITY, method=6
        )


def submit(service: Service, files: dict[str, Path], parameters: dict[str, Any]) -> str:
    """Submit a job and return its id."""
    body = {role: (path.name, path.read_bytes()) for role, path in files.items()}
    answer = httpx.post(f"{service.url}/v1/jobs", files=body, data={"parameters": json.dumps(parameters)}, timeout=120)
    answer.raise_for_status()
    return str(answer.json()["id"])


def finished(service: Service, job_id: str) -> bool:
    """Return whether a job has succeeded.

    Raises:
        SystemExit: If it has failed or was canceled.
    """
    job = httpx.get(f"{service.url}/v1/jobs/{job_id}", timeout=60).json()
    if job["status"] in ("failed", "canceled"):
        raise SystemExit(f"{job_id}: {job['error']}")
    return bool(job["status"] == "succeeded")


def shown_step(page: Any) -> int:
    """Return the number of the current step as shown on a job's page, or 0 if it shows none."""
    match = re.search(r"step (\d+)", page.locator(".state").inner_text())
    return int(match[1]) if match else 0


def take(
    service: Service, browser: Any, files: dict[str, Path], styles: list[Path], options: Any, folder: Path
) -> None:
    """Take all screenshots, in the order in which a user sees the views."""
    parameters = {"resolution": options.resolution, "steps_sos": options.steps, "views": 12, "early_stop": False}
    watched = Watched(browser, service.url, width=1280, height=800)
    page = watched.page
    page.goto(service.url)
    for role, path in files.items():
        page.get_by_label(role.capitalize(), exact=True).set_input_files(path)
    watched.settled()
    save(watched, "new", folder)
    ids = [submit(service, files | {"style": style}, parameters | {"name": f"plush, {style.stem}"}) for style in styles]
    page.goto(f"{service.url}/#/jobs/{ids[0]}")
    page.locator(".preview img").wait_for()
    page.get_by_text("Adding detail · step").wait_for()
    wait_for(lambda: shown_step(page) >= options.steps // 2, "half of the steps")
    save(watched, "watch", folder)
    page.locator(".badge", has_text="Done").wait_for()
    page.get_by_label("Wipe", exact=True).wait_for()
    watched.settled()
    save(watched, "look", folder)
    wait_for(lambda: finished(service, ids[1]), "the second job to be done")
    page.goto(f"{service.url}/#/compare/{ids[0]}/{ids[1]}")
    page.get_by_label("Wipe", exact=True).wait_for()
    watched.settled()
    save(watched, "compare", folder)
    page.goto(f"{service.url}/#/jobs")
    page.locator(".tile img").nth(1).wait_for()
    save(watched, "jobs", folder, 960)
    small = Watched(browser, service.url, width=360, height=720, device_scale_factor=2, color_scheme="dark")
    small.page.goto(f"{service.url}/#/jobs/{ids[0]}")
    small.page.get_by_label("Wipe", exact=True).wait_for()
    small.settled()
    save(small, "telephone", folder, 480)
    for each in (watched, small):
        each.check()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scene", type=Path)
    parser.add_argument("cameras", type=Path)
    parser.add_argument("styles", type=Path, nargs=2)
    parser.add_argument("--resolution", type=int, default=320)
    parser.add_argument("--steps", type=int, default=150)
    parser.add_argument("--out", type=Path, default=DOCS)
    options = parser.parse_args()
    files = {"scene": options.scene, "cameras": options.cameras, "style": options.styles[0]}
    with tempfile.TemporaryDirectory() as data, Service(Path(data) / "data") as service, open_browser() as browser:
        take(service, browser, files, options.styles, options, options.out)


if __name__ == "__main__":
    main()
