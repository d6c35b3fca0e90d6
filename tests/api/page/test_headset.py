"""Tests of the stereo view, in Chromium with an emulated Quest 3 (iwer, which they install by npm)."""

from __future__ import annotations

import contextlib
import io
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image

from tests.api.page.browser import PATIENCE, Watched
from tests.api.page.test_exported import export, painted

pytestmark = pytest.mark.slow
IWER = "iwer@2.5.0"
#: Emulated headset, with a function that changes its state and waits for some frames.
DEVICE = """
window.device = new IWER.XRDevice(IWER.metaQuest3, { stereoEnabled: true });
device.ipd = 0.08;
device.installRuntime({ forceInstall: true });
window.after = async (change, frames) => {
  change(device.controllers.left, device.controllers.right);
  for (let i = 0; i < frames; i++) await new Promise((go) => device.activeSession.requestAnimationFrame(go));
};
"""


@pytest.fixture(scope="module")
def emulator() -> Path:
    """Return the script of the emulator."""
    folder = Path(sys.prefix) / "iwer"
    script = folder / "node_modules" / "iwer" / "build" / "iwer.js"
    if not script.exists():
        npm = shutil.which("npm")
        if npm is None:
            pytest.skip("npm is missing: apt-get install npm")
        command = [npm, "install", "--silent", "--no-save", "--prefix", str(folder), IWER]
        with contextlib.suppress(subprocess.TimeoutExpired):
            subprocess.run(command, check=False, timeout=120)
        if not script.exists():
            pytest.skip(f"npm could not install {IWER}")
    return script


class Worn:
    """Exported page in a headset, whose stylized scene is red and whose original is blue."""

    def __init__(self, watched: Watched) -> None:
        self.page = watched.page

    def after(self, change: str, frames: int = 8) -> NDArray[np.float64]:
        """Change the controllers `left` and `right` by JavaScript; return the display some frames later, [h, w, 3]."""
        self.page.evaluate(f"after((left, right) => {{ {change} }}, {frames})")
        with Image.open(io.BytesIO(self.page.screenshot(timeout=PATIENCE))) as image:
            return np.asarray(image.convert("RGB"), dtype=np.float64)


@pytest.fixture
def worn(tmp_path: Path, browser: Any, emulator: Path) -> Iterator[Worn]:
    assert export(tmp_path, painted(0.9, 0.1, 0.1), painted(0.1, 0.1, 0.9)) == 0
    watched = Watched(browser, (tmp_path / "page.html").as_uri())
    watched.page.add_init_script(path=emulator)
    watched.page.add_init_script(DEVICE)
    watched.page.goto(watched.url)
    watched.settled()
    watched.page.get_by_role("button", name="VR").click()
    yield Worn(watched)
    watched.check()
    watched.context.close()


def area(image: NDArray[np.float64], channel: int) -> NDArray[np.bool_]:
    """Return where red (0) or blue (2) Gaussians are."""
    mask: NDArray[np.bool_] = (image[..., channel] > 100) & (image[..., 2 - channel] < 80)
    return mask


def middle(mask: NDArray[np.bool_]) -> float:
    """Return the mean column of a mask."""
    return float(np.nonzero(mask)[1].mean())


def test_each_eye_sees_the_scene_from_its_place(worn: Worn) -> None:
    red = area(worn.after(""), 0)
    left, right = np.array_split(red, 2, axis=1)
    assert left.mean() > 0.01
    assert middle(left) > middle(right) + 1
    worn.page.evaluate("device.activeSession.end()")
    worn.page.locator("canvas[data-state=settled]").wait_for()
    assert worn.page.get_by_role("button", name="VR").get_attribute("aria-pressed") == "false"


def test_button_shows_the_original_and_stick_blends(worn: Worn) -> None:
    assert area(worn.after("right.updateButtonValue('a-button', 1)"), 2).mean() > 0.01
    assert area(worn.after("right.updateButtonValue('a-button', 0)"), 0).mean() > 0.01
    assert area(worn.after("right.updateAxes('thumbstick', 0, 1)", 120), 2).mean() > 0.01


def test_two_hands_change_the_size_of_the_scene(worn: Worn) -> None:
    apart = "left.position.set(-0.2, 1.2, -0.4); right.position.set(0.2, 1.2, -0.4)"
    before = area(worn.after(apart), 0).mean()
    worn.after("for (const hand of [left, right]) hand.updateButtonValue('squeeze', 1)")
    shrunk = area(worn.after("left.position.set(-0.1, 1.2, -0.4); right.position.set(0.1, 1.2, -0.4)"), 0).mean()
    assert shrunk < 0.75 * before  # it shrinks toward the hands, and so comes nearer
    worn.after("for (const hand of [left, right]) hand.updateButtonValue('squeeze', 0)")
    assert area(worn.after(apart), 0).mean() == pytest.approx(shrunk, rel=0.1)


def test_trigger_teleports_to_the_floor(worn: Worn) -> None:
    before = area(worn.after("right.position.set(0, 1.2, 0); right.quaternion.set(-0.5, 0, 0, 0.866)"), 0).mean()
    worn.after("right.updateButtonValue('trigger', 1)")
    assert area(worn.after("right.updateButtonValue('trigger', 0)"), 0).mean() > 1.3 * before
