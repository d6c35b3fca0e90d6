"""Browser for tests of the web page: Chromium, driven by Playwright, with software WebGL."""

import base64
import io
import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from sgsst_core.files.scene_file import read_scene
from sgsst_core.rasterizer import make_rasterizer
from sgsst_core.scene.camera import Camera
from sgsst_core.scene.spherical_harmonics import rest_colors, view_colors

#: WebGL is computed by the CPU, for the same pixels on every machine.
FLAGS = ["--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--disable-dev-shm-usage"]
#: Timeout of tests in milliseconds.
PATIENCE = 240_000
#: Script that runs before the page's own, and counts violations of the page's content security policy.
_COUNT_VIOLATIONS = """
window.violations = [];
document.addEventListener("securitypolicyviolation", ({ violatedDirective, blockedURI }) => {
  window.violations.push(`${violatedDirective} ${blockedURI}`);
});
"""


def missing() -> str | None:
    """Return why no browser can be started, or None if one can."""
    try:
        import playwright.sync_api  # noqa: F401
    except ImportError:
        return "playwright is not installed: pip install -e '.[dev]'"
    if chromium() is None:
        return "there is no Chromium: apt-get install chromium, or name one by SGSST_CHROMIUM"
    return None


def chromium() -> str | None:
    """Return the path of Chromium, or None if there is none."""
    named = os.environ.get("SGSST_CHROMIUM")
    return named or shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")


@contextmanager
def open_browser(*flags: str) -> Iterator[Any]:
    """Yield a browser of Playwright's synchronous API. No asyncio event loop can run within the block."""
    from playwright.sync_api import sync_playwright

    with sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=chromium(), args=[*FLAGS, *flags], chromium_sandbox=False)
        yield browser
        browser.close()


class Watched:
    """Browser page that records errors and requests to other origins.

    Attributes:
        page: Page of Playwright.
        wrong: Console errors, exceptions, and requests to other origins.
    """

    def __init__(self, browser: Any, url: str, *, width: int = 600, height: int = 500, **context: Any) -> None:
        self.url = url
        self.context = browser.new_context(viewport={"width": width, "height": height}, **context)
        self.context.set_default_timeout(PATIENCE)
        self.page = self.context.new_page()
        self.page.add_init_script(_COUNT_VIOLATIONS)
        self.wrong: list[str] = []
        self.page.on("pageerror", lambda error: self.wrong.append(f"exception: {error}"))
        self.page.on("console", self._console)
        self.page.on("request", self._request)

    def _console(self, message: Any) -> None:
        if message.type == "error":
            self.wrong.append(f"console: {message.text}")

    def _request(self, request: Any) -> None:
        if not request.url.startswith((self.url, "blob:", "data:")):
            self.wrong.append(f"request: {request.url}")

    def check(self, *allowed: str) -> None:
        """Fail on any error, except for console errors that contain one of the allowed texts."""
        violations = self.page.evaluate("() => window.violations")
        messages = [text for text in self.wrong if not any(part in text for part in allowed)]
        assert not messages, messages
        assert not violations, violations

    def settled(self) -> None:
        """Wait until the 3D view shows the whole scene, sorted for the current camera."""
        self.page.locator("canvas[data-state=settled]").wait_for()

    def wipe(self, key: str) -> None:
        """Press a key on the wipe's slider: "Home" shows only the right-hand scene, "End" only the left-hand one."""
        slider = self.page.get_by_label("Wipe", exact=True)
        slider.wait_for()
        slider.focus()
        self.page.keyboard.press(key)

    def pixels(self) -> NDArray[np.float64]:
        """Return the image that the page saves of the 3D view, [h, w, 3], 0 to 255."""
        self.settled()
        with self.page.expect_download() as download:
            self.page.get_by_role("button", name="Save image").click()
        with Image.open(download.value.path()) as image:
            return np.asarray(image.convert("RGB"), dtype=np.float64)


def appear(*locators: Any) -> None:
    """Wait until the page shows all of these."""
    for locator in locators:
        locator.wait_for()


def click(*locators: Any) -> None:
    """Click on these in turn."""
    for locator in locators:
        locator.click()


def rendered(scene: Path, camera: Camera) -> NDArray[np.float64]:
    """Render a scene file with `sgsst render`, [h, w, 3], 0 to 255."""
    loaded = read_scene(scene).scene
    colors = view_colors(loaded.sh_dc, rest_colors(loaded.sh_rest, loaded.means, camera))
    image = make_rasterizer("cpu", loaded).render(colors, camera)
    return (image.double().clamp(0, 1) * 255).round().numpy()


def in_frame(camera: Camera, width: int, height: int) -> Camera:
    """Return the camera of an image of this size, in the middle of which lies the whole frame of a camera."""
    scale = min(height / camera.height, width / camera.width)
    return replace(
        camera,
        width=width,
        height=height,
        fx=camera.fx * scale,
        fy=camera.fy * scale,
        cx=width / 2,
        cy=height / 2,
    )


def psnr(actual: NDArray[np.float64], wanted: NDArray[np.float64]) -> float:
    """Return the peak signal-to-noise ratio in decibels between images [h, w, 3] with values from 0 to 255."""
    assert actual.shape == wanted.shape, (actual.shape, wanted.shape)
    return float(10 * np.log10(255**2 / max(float(((actual - wanted) ** 2).mean()), 1e-9)))


#: Script that shows a scene with the page's own modules. It takes `[base, scene, cameras, name, width, height]`, and
#: returns what `STEPS` return.
VIEW = """async ([base, scene, cameras, name, width, height]) => {
  const { Viewer } = await import(`${base}/viewer/viewer.js`), { readCameras } = await import(`${base}/cameras.js`);
  const canvas = document.createElement("canvas");
  const size = { width: `${width}px`, height: `${height}px` };
  Object.assign(canvas.style, { ...size, position: "fixed", left: 0, top: 0, zIndex: 9 });
  document.body.append(canvas);
  const viewer = new Viewer(canvas), blob = await (await fetch(cameras)).blob();
  const camera = (await readCameras([{ name: "cameras.json", blob }])).find((each) => each.name === name);
  const source = viewer.open(new URL(scene, location.href).href);
  viewer.show({ scene: source, colors: "own" });
  await source.ready;
  viewer.camera.stand(camera, source.middle);
  viewer.draw();
  const pause = () => new Promise((go) => setTimeout(go, 20));
  const settled = async () => { while (canvas.dataset.state !== "settled") await pause(); };
  const picture = async () => {
    await settled();
    const bytes = new Uint8Array(await (await viewer.picturePng()).arrayBuffer());
    return btoa(Array.from(bytes, (byte) => String.fromCharCode(byte)).join(""));
  };
  try {
    return await (STEPS)(viewer, source, picture, base);
  } finally {
    viewer.end();
    canvas.remove();
  }
}"""


def view_script(steps: str = "(viewer, source, picture) => picture()") -> str:
    """Return the script `VIEW` with these steps.

    Steps are a JavaScript function. Its arguments are the viewer, the scene, a function that returns the current view
    as a base64 PNG, and the base URL of the page's modules.
    """
    return VIEW.replace("STEPS", steps)


def decoded(png: str) -> NDArray[np.float64]:
    """Return the pixels [h, w, 3] of a base64 PNG."""
    return np.asarray(Image.open(io.BytesIO(base64.b64decode(png))).convert("RGB"), dtype=np.float64)


def serve_files(page: Any, folder: Path) -> None:
    """Serve the files of a folder to the page as `/given/NAME`."""
    page.route("**/given/*", lambda route: route.fulfill(path=folder / route.request.url.rsplit("/", 1)[1]))
