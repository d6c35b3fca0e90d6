"""Screenshots and a recording of the web page for docs/, from a temporary service that runs jobs on a real scene.

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

import httpx2
from PIL import Image

from tests.api.page.browser import Watched, open_browser
from tests.api.service import Service

DOCS = Path(__file__).parents[1] / "docs"
_QUALITY = 72
_WIDTH = 1280
#: Recording: width in pixels, frames, milliseconds of each frame (20 s in all), and maximum size in bytes.
_RECORDED_WIDTH, _FRAMES, _FRAME_MS, _RECORDED_BYTES = 720, 80, 250, 2_000_000


def screenshot(watched: Watched, width: int) -> Image.Image:
    """Return a screenshot of the window, scaled to `width` pixels."""
    with Image.open(io.BytesIO(watched.page.screenshot())) as image:
        size = (width, round(image.height * width / image.width))
        return image.convert("RGB").resize(size, Image.Resampling.LANCZOS)


def save(watched: Watched, name: str, folder: Path, width: int = _WIDTH) -> None:
    """Save a screenshot of the window as page_NAME.webp, scaled to `width` pixels."""
    screenshot(watched, width).save(folder / f"page_{name}.webp", quality=_QUALITY, method=6)


def save_recording(frames: list[Image.Image], path: Path) -> None:
    """Save evenly chosen frames as a WebP of 20 seconds, at the highest quality that fits the size limit."""
    chosen = [frames[i * len(frames) // _FRAMES] for i in range(_FRAMES)]
    for quality in range(70, 0, -10):
        chosen[0].save(path, save_all=True, append_images=chosen[1:], duration=_FRAME_MS, loop=0, quality=quality)
        if path.stat().st_size <= _RECORDED_BYTES:
            return
    raise SystemExit(f"{path}: above {_RECORDED_BYTES:,} bytes at the lowest quality. Record a smaller window.")


def record(watched: Watched, options: Any, folder: Path) -> None:
    """Record the page of a running job, one frame for each step, while the camera moves around the scene."""
    page = watched.page
    page.get_by_label("Wipe", exact=True).wait_for()
    watched.settled()
    page.mouse.move(0, 0)
    frames: list[Image.Image] = []
    step, done, taken = -1, page.locator(".badge", has_text="Done"), False
    while not done.count():
        if page.locator(".state").is_visible() and shown_step(page) != step:
            step = shown_step(page)
            move(watched, len(frames))
            frames.append(screenshot(watched, _RECORDED_WIDTH))
        if not taken and step >= options.steps // 2 and page.get_by_text("Adding detail · step").is_visible():
            save(watched, "watch", folder)
            taken = True
        page.wait_for_timeout(200)
    page.locator(".side.right", has_text="Stylized").wait_for()
    frames += [screenshot(watched, _RECORDED_WIDTH)] * max(4, len(frames) // 12)
    save_recording(frames, folder / "page_live.webp")


def move(watched: Watched, frame: int) -> None:
    """Move the wipe a little with each frame, and the camera with some, which the view draws coarsely at first."""
    if frame % 12 == 0:
        for _ in range(3 if frame else 0):
            watched.page.locator("canvas.view").press("ArrowRight" if frame % 48 in (12, 36) else "ArrowLeft")
        watched.settled()
    watched.page.get_by_label("Wipe", exact=True).fill(str(abs((60 * frame) % 1400 - 700) + 150))


def submit(service: Service, files: dict[str, Path], parameters: dict[str, Any]) -> str:
    """Submit a job and return its id."""
    body = {role: (path.name, path.read_bytes()) for role, path in files.items()}
    answer = httpx2.post(f"{service.url}/v1/jobs", files=body, data={"parameters": json.dumps(parameters)}, timeout=120)
    answer.raise_for_status()
    return str(answer.json()["id"])


def finished(service: Service, job_id: str) -> bool:
    """Return whether a job has succeeded.

    Raises:
        SystemExit: If it has failed or was canceled.
    """
    job = httpx2.get(f"{service.url}/v1/jobs/{job_id}", timeout=60).json()
    if job["status"] in ("failed", "canceled"):
        raise SystemExit(f"{job_id}: {job['error']}")
    return bool(job["status"] == "succeeded")


def shown_step(page: Any) -> int:
    """Return the number of the current step as shown on a job's page, or 0 if it shows none."""
    match = re.search(r"step (\d+)", page.locator(".state").inner_text())
    return int(match[1]) if match else 0


def open_form(watched: Watched, files: dict[str, Path], folder: Path) -> None:
    """Take pictures of the form: with all files, and while Gaussians are selected by hand."""
    page = watched.page
    for role, path in files.items():
        page.get_by_label(role.capitalize(), exact=True).set_input_files(path)
    watched.settled()
    save(watched, "new", folder)
    page.locator("details.fold", has_text="Regions").evaluate("(fold) => { fold.open = true; }")
    page.get_by_role("button", name="Add a region").click()
    page.get_by_role("group", name="Region 1").get_by_label("Name").fill("toy")
    page.get_by_role("button", name="Select in the 3D view").click()
    page.get_by_label("Lasso").check()
    view = page.locator("canvas.view").bounding_box()
    corners = [(0.42, 0.16), (0.62, 0.2), (0.72, 0.5), (0.8, 0.75), (0.5, 0.9), (0.22, 0.75), (0.36, 0.5), (0.42, 0.16)]
    places = [(view["x"] + x * view["width"], view["y"] + y * view["height"]) for x, y in corners]
    page.mouse.move(*places[0])
    page.mouse.down()
    for place in places[1:]:
        page.mouse.move(*place, steps=8)
    page.mouse.up()
    page.locator(".selecting output", has_text=re.compile("^[1-9]")).wait_for()
    watched.settled()
    save(watched, "select", folder)


def take(
    service: Service, browser: Any, files: dict[str, Path], styles: list[Path], options: Any, folder: Path
) -> None:
    """Take all screenshots, in the order in which a user sees the views."""
    steps = {"steps_coarse": options.steps // 2, "steps_sos": options.steps, "early_stop": False, "measure": 0}
    parameters = {"resolution": options.resolution, "views": 12} | steps
    watched = Watched(browser, service.url, width=1280, height=800)
    page = watched.page
    page.goto(service.url)
    open_form(watched, files, folder)
    ids = [submit(service, files | {"style": style}, parameters) for style in styles]
    page.goto(f"{service.url}/#/jobs/{ids[0]}")
    record(watched, options, folder)
    watched.wipe("Home")
    page.get_by_label("Wipe", exact=True).fill("500")
    watched.settled()
    save(watched, "look", folder)
    while not finished(service, ids[1]):
        page.wait_for_timeout(1000)
    page.goto(f"{service.url}/#/compare/{ids[0]}/{ids[1]}")
    page.get_by_label("Wipe", exact=True).wait_for()
    watched.settled()
    page.locator(".result-stage").scroll_into_view_if_needed()
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
