"""Cost of the web page in a real browser with software WebGL: bytes, load times, memory, frame times.

python -m benchmarks.page SCENE.ply... [--frames 5] [--width 640 --height 480]

Figures of each scene: seconds until the first and until all Gaussians are drawn, memory of the browser's processes, and
milliseconds per frame while the view rotates (sorting and drawing) and while the wipe moves (drawing only). Figures of
the page itself, from the browser's tracing: transferred bytes, largest contentful paint, and total blocking time. A GPU
draws hundreds of times faster, but needs the same time for reading and sorting, and the same memory except textures.
"""

from __future__ import annotations

import argparse
import statistics
import tempfile
from pathlib import Path
from typing import Any

import psutil

from benchmarks.machine import write_result
from tests.api.page.browser import Watched, chromium, open_browser
from tests.api.service import Service

_LOADED = """() => new Promise((done) => {
  let paint = 0, blocked = 0, moved = 0;
  const watch = (type, act) =>
    new PerformanceObserver((list) => list.getEntries().forEach(act)).observe({ type, buffered: true });
  watch("largest-contentful-paint", (entry) => { paint = entry.startTime; });
  watch("longtask", (entry) => { blocked += Math.max(0, entry.duration - 50); });
  watch("layout-shift", (entry) => { moved += entry.value; });
  setTimeout(() => {
    const files = [...performance.getEntriesByType("navigation"), ...performance.getEntriesByType("resource")];
    const ours = files.filter((file) => !file.name.endsWith("/openapi.json") && !file.name.includes("/v1/"));
    done({
      requests: files.length,
      bytes: files.reduce((sum, file) => sum + file.encodedBodySize, 0),
      bytes_of_the_page: ours.reduce((sum, file) => sum + file.encodedBodySize, 0),
      largest_paint_ms: Math.round(paint),
      blocking_ms: Math.round(blocked),
      layout_shift: Number(moved.toFixed(4)),
    });
  }, 2500);
})"""

_SCENE = """async ([base, frames, width, height]) => {
  const { Viewer } = await import(`${base}/viewer/viewer.js`);
  const canvas = document.createElement("canvas");
  const size = { width: `${width}px`, height: `${height}px` };
  Object.assign(canvas.style, { ...size, position: "fixed", left: 0, top: 0, zIndex: 9 });
  document.body.append(canvas);
  const viewer = new Viewer(canvas), pause = () => new Promise((go) => setTimeout(go, 5)), begun = performance.now();
  const since = (start) => performance.now() - start;
  const source = viewer.open(document.querySelector("#given").files[0]);
  viewer.show({ scene: source, colors: "own" });
  while (!source.drawn || !viewer.milliseconds.length) await pause();
  const first = since(begun);
  await source.ready;
  const whole = since(begun);
  const settled = async () => { while (canvas.dataset.state !== "settled") await pause(); };
  await settled();
  const drawn = since(begun), timed = async (change) => {
    const found = [];
    for (let i = 0; i < frames; i++) {
      const start = performance.now();
      change(i);
      viewer.draw();
      await settled();
      found.push(since(start));
    }
    return found;
  };
  const turns = await timed(() => viewer.camera.turn(0.02, 0, true));
  const wipes = await timed((i) => { viewer.cut = (i + 1) / (frames + 1); });
  return {
    gaussians: source.header.count, bytes: source.header.size, harmonics_kept: source.degree,
    harmonics_in_the_file: source.header.degree,
    drawn_gaussians: source.drawn, texture_bytes: source.bytes, first_picture_s: first / 1000, read_s: whole / 1000,
    whole_picture_s: drawn / 1000, turn_ms: turns, wipe_ms: wipes,
  };
}"""


def memory_bytes() -> dict[str, int]:
    """Return the resident bytes of the browser by kind of process; pages shared by processes count once in each."""
    totals: dict[str, int] = {}
    for process in psutil.Process().children(recursive=True):
        try:
            line = process.cmdline()
            kind = next((part.partition("=")[2] for part in line if part.startswith("--type=")), "browser")
            if line and "chrom" in line[0] and kind in ("browser", "renderer", "gpu-process"):
                totals[kind] = totals.get(kind, 0) + process.memory_info().rss
        except psutil.Error:
            continue
    return totals


def measure_page(url: str) -> dict[str, Any]:
    """Measure the first visit to the page, with an empty browser cache."""
    with open_browser() as browser:
        watched = Watched(browser, url, width=1280, height=800)
        watched.page.goto(url)
        measured: dict[str, Any] = watched.page.evaluate(_LOADED)
        watched.check()
        return {"chromium": browser.version, **measured}


def measure_scene(url: str, path: Path, frames: int, size: tuple[int, int]) -> dict[str, Any]:
    """Measure one scene in a new browser."""
    with open_browser() as browser:
        watched = Watched(browser, url)
        watched.page.goto(f"{url}/#/jobs")
        watched.page.evaluate(
            "() => { const input = document.createElement('input'); input.type = 'file'; input.id = 'given'; "
            "document.body.append(input); }"
        )
        watched.page.locator("#given").set_input_files(path)
        base = str(watched.page.locator("script[type=module]").get_attribute("src")).rsplit("/", 1)[0]
        before = memory_bytes()
        measured: dict[str, Any] = watched.page.evaluate(_SCENE, [base, frames, *size])
        after = memory_bytes()
        watched.check()
    for name in ("turn", "wipe"):
        times = measured.pop(f"{name}_ms")
        measured[f"{name}_frame_ms"] = round(statistics.median(times))
        measured[f"{name}_frames_per_second"] = round(1000 / statistics.median(times), 2)
    grown = {kind: after[kind] - before.get(kind, 0) for kind in after}
    rounded = {name: round(value, 2) if isinstance(value, float) else value for name, value in measured.items()}
    return {"scene": path.name, **rounded, "resident_bytes": after, "resident_bytes_of_the_scene": grown}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", nargs="+", type=Path)
    parser.add_argument("--frames", type=int, default=5)
    parser.add_argument("--width", type=int, default=640)
    parser.add_argument("--height", type=int, default=480)
    arguments = parser.parse_args()
    if chromium() is None:
        raise SystemExit("there is no Chromium: apt-get install chromium, or name one by SGSST_CHROMIUM")
    size = (arguments.width, arguments.height)
    with tempfile.TemporaryDirectory() as folder, Service(Path(folder) / "data", alone=True) as service:
        figures: dict[str, Any] = {"page": measure_page(service.url), "window": list(size), "scenes": []}
        for path in arguments.scenes:
            measured = measure_scene(service.url, path, arguments.frames, size)
            figures["scenes"].append(measured)
            print(measured, write_result("page", figures), flush=True)


if __name__ == "__main__":
    main()
