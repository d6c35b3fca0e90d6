"""Screenshots for docs/artists.md: the example's offer, an object that is turned and cropped, and a painting's editor.

python -m benchmarks.artist_pictures OBJECT.splat
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path

from benchmarks.page_pictures import DOCS, save
from tests.api.page.browser import Watched, open_browser
from tests.api.service import Service

_WIDTH = 960


def take(watched: Watched, url: str, scene: Path, folder: Path) -> None:
    """Take the pictures, in the order in which a user sees them."""
    page = watched.page
    page.goto(url)
    page.locator(".presets input").first.wait_for()
    save(watched, "start", folder, _WIDTH)
    page.get_by_label("Scene", exact=True).set_input_files(scene)
    watched.settled()
    page.locator("details.gallery summary").click()
    page.get_by_role("button", name="Add Wheat Field").click()
    page.get_by_role("button", name="Crop the scene").click()
    for axis, key in (("+X", "ArrowLeft"), ("-Y", "ArrowDown")):
        for _ in range(6):
            page.get_by_role("button", name=f"Resize {axis.replace('-', '−')}").press(key)
    watched.settled()
    save(watched, "crop", folder, _WIDTH)
    page.get_by_role("button", name="Crop to this box").click()
    page.get_by_role("button", name="Rotate or crop wheat").click()
    for edge, value in (("Left", "25"), ("Right", "80"), ("Top", "20")):
        page.get_by_label(f"{edge} %").fill(value)
    save(watched, "painting", folder, _WIDTH)
    watched.check()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scene", type=Path)
    parser.add_argument("--out", type=Path, default=DOCS)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as data, Service(Path(data) / "data") as service, open_browser() as browser:
        take(Watched(browser, service.url, width=1280, height=800), service.url, options.scene, options.out)


if __name__ == "__main__":
    main()
