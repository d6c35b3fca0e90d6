"""Seconds to the first pictures of a job, from a cold start: of the command, and of the page in a real browser.

python -m benchmarks.first_picture SCENE STYLE

The command is timed from the start of its process to its end. The page's times start with the click on Start, once the
page shows the scene, in a service that has run no job: until it shows the painting's colors, the first strokes, and the
result. The views are an orbit.
"""

import argparse
import re
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import httpx2

from benchmarks.common import add_pair, parse
from tests.api.page.browser import Watched, chromium, open_browser
from tests.api.service import SETTINGS, Service

#: Seconds that the command and the page are given.
_COMMAND_WITHIN, _PAGE_WITHIN = 60, 180
#: Steps after which strokes are clear in a preview: on Massa, the eye sees the first ones after 8.
_STROKES = 12
_POLL_SECONDS = 0.2
_SHOWN = "() => [...document.querySelectorAll('figure.preview img')].map((each) => each.src)"


def time_command(arguments: argparse.Namespace, folder: Path) -> dict[str, float]:
    """Return the seconds until the command has written its result, and its budget."""
    line = [sys.executable, "-m", "api.cli", "stylize", str(arguments.scene), "--style", str(arguments.style)]
    line += ["--orbit", "auto", "--out", str(folder / "stylized.ply"), "--within", str(_COMMAND_WITHIN)]
    started = time.monotonic()
    subprocess.run(line, check=True)
    return {"result": time.monotonic() - started, "budget": _COMMAND_WITHIN}


def time_page(arguments: argparse.Namespace, folder: Path) -> dict[str, float]:
    """Return the seconds from the click on Start to each kind of picture, and the time budget."""
    times: dict[str, float] = {}
    service = Service(folder / "data")
    for name in SETTINGS:  # one thread, and short intervals
        service.environment.pop(name)
    with service, open_browser() as browser:
        watched = Watched(browser, service.url, width=1280, height=800)
        page: Any = watched.page
        page.goto(service.url)
        page.locator(".presets input").first.wait_for()
        for role, path in (("Scene", arguments.scene), ("Style", arguments.style)):
            page.get_by_label(role, exact=True).set_input_files(path)
        orbit = page.get_by_label("Orbit the object")
        if not orbit.is_checked():
            orbit.check()
        page.locator("[data-name=within] input").fill(str(_PAGE_WITHIN / 60))
        watched.settled()
        page.get_by_role("button", name="Start", exact=True).click()
        started = time.monotonic()
        page.wait_for_url(re.compile("#/jobs/"))
        job = page.url.rpartition("/")[2]
        while "result" not in times:
            time.sleep(_POLL_SECONDS)
            now, seen = time.monotonic() - started, page.evaluate(_SHOWN)
            record = httpx2.get(f"{service.url}/v1/jobs/{job}").json()
            if record["status"] in ("failed", "canceled"):
                raise SystemExit(f"the job has failed: {record['error']}")
            steps = [int(step) for src in seen for step in re.findall(r"step_(\d+)", src)]
            if steps:
                times.setdefault("colors", now)
            if steps and max(steps) >= _STROKES:
                times.setdefault("strokes", now)
            if record["status"] == "succeeded":
                times["result"] = now
    return {**times, "budget": _PAGE_WITHIN}


def main() -> None:
    """Print the seconds, and add them to benchmarks/results."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scene", type=Path)
    parser.add_argument("style", type=Path)
    arguments = parse(parser)
    if chromium() is None:
        raise SystemExit("there is no Chromium: apt-get install chromium, or name one by SGSST_CHROMIUM")
    figures: dict[str, dict[str, float]] = {}
    for name, measure in (("command", time_command), ("page", time_page)):
        with tempfile.TemporaryDirectory() as folder:
            figures[name] = {each: round(seconds, 1) for each, seconds in measure(arguments, Path(folder)).items()}
        print(name, figures[name], flush=True)
    name = arguments.scene.stem
    add_pair("first_picture", name, {}, figures, presets=["standard"], scenes={name: arguments.scene})


if __name__ == "__main__":
    main()
