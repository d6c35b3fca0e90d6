"""Tests of selecting Gaussians in the 3D view and of painting on it: what the tools take, and jobs with the result."""

import hashlib
import json
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import httpx2
import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from PIL import Image
from PIL.PngImagePlugin import PngInfo

from sgsst_core.files.scene_file import read_scene
from sgsst_core.scene.camera import Camera
from sgsst_core.scene.gaussians import Scene
from tests.api.page.actions import STEPS, Visit, choose, done, drop, fetched, result_of, set_options, submit
from tests.api.page.browser import Watched, appear, click, psnr, rendered
from tests.api.page.test_viewer import FAITHFUL, base_of
from tests.api.service import Service
from tests.small_scenes import cameras, wall, write_files

pytestmark = pytest.mark.slow

#: Script that makes changes to a selection of the given Gaussians, and returns the flags after each.
_SELECTOR = """async ([base, centers, colors, view, changes]) => {
  const { Selector } = await import(`${base}/viewer/selector.js`);
  const count = colors.length / 3, reach = new Float32Array(count).fill(0.01);
  const selector = new Selector(Float32Array.from(centers), reach, Uint8ClampedArray.from(colors), 1);
  selector.answer({ op: "view", ...view, ids: new Uint32Array(view.width * view.height) });
  return changes.map((change) => {
    const { total } = selector.answer(change);
    return [total, [...selector.flags], [...selector.bits()]];
  });
}"""
WIDTH, HEIGHT, FOCAL = 80, 60, 70.0


def front(count: int, *, seed: int = 4) -> NDArray[np.float32]:
    """Return random centers [n, 3] before a camera at the origin that looks along z."""
    generator = np.random.default_rng(seed)
    return generator.uniform([-1, -1, 1.5], [1, 1, 3.5], (count, 3)).astype(np.float32)


def flags(watched: Watched, centers: NDArray[np.float32], *changes: dict[str, Any]) -> list[NDArray[np.bool_]]:
    """Return the flags after each change; totals and bits must be those of the flags."""
    colors = (centers[:, :1] * 100 + 100).clip(0, 255).astype(np.uint8).repeat(3, axis=1)
    view = {"axes": np.eye(3).tolist(), "eye": [0, 0, 0], "focal": [FOCAL, FOCAL], "near": 0.2}
    given = [
        base_of(watched),
        centers.ravel().tolist(),
        colors.ravel().tolist(),
        {**view, "width": WIDTH, "height": HEIGHT},
    ]
    selections = []
    for total, values, bits in watched.page.evaluate(_SELECTOR, [*given, list(changes)]):
        selections.append(np.array(values, bool))
        assert total == sum(values)
        assert bits == np.packbits(selections[-1], bitorder="little").tolist()
    return selections


def projected(centers: NDArray[np.float32]) -> NDArray[np.float64]:
    """Return the positions of centers in the view [n, 2] in float64."""
    return centers[:, :2].astype(float) * FOCAL / centers[:, 2:] + [WIDTH / 2, HEIGHT / 2]


@pytest.fixture(scope="module")
def watched(browser: Any, service: Service) -> Any:
    page = Watched(browser, service.url)
    page.page.goto(f"{service.url}/#/jobs")
    yield page
    page.check()
    page.context.close()


def test_shapes_select_as_the_command_line_does(watched: Watched) -> None:
    centers = front(3000)
    low, high = [-0.5, -0.6, 1.8], [0.4, 0.7, 2.9]
    box = {"op": "box", "low": low, "high": high}
    ball = {"op": "sphere", "center": [0.1, 0.2, 2.4], "radius": 0.6}
    third = np.arange(3000) % 3 == 0
    load = {"op": "load", "bits": np.packbits(third, bitorder="little").tolist()}
    loaded, added, removed = flags(watched, centers, load, {**box, "mode": "add"}, {**ball, "mode": "subtract"})
    inside = ((centers >= np.array(low, np.float32)) & (centers <= np.array(high, np.float32))).all(axis=1)
    near = ((centers.astype(float) - ball["center"]) ** 2).sum(axis=1) <= 0.36
    assert 100 < inside.sum() < 2000
    assert loaded.tolist() == third.tolist()
    assert added.tolist() == (third | inside).tolist()
    assert removed.tolist() == ((third | inside) & ~near).tolist()


def test_strokes_and_lassos_take_centers_inside(watched: Watched) -> None:
    centers = front(3000)
    points, radius = [20.0, 20.0, 50.0, 25.0, 50.0, 45.0], 6.0
    corners = [10.0, 10.0, 70.0, 12.0, 40.0, 55.0]
    stroke = {"op": "stroke", "points": points, "radius": radius, "mode": "add", "through": True, "change": 1}
    brushed, both = flags(watched, centers, stroke, {"op": "lasso", "points": corners, "mode": "add", "through": True})
    at = projected(centers)
    away = np.full(len(at), np.inf)
    for start, end in zip(np.reshape(points, (-1, 2))[:-1], np.reshape(points, (-1, 2))[1:], strict=True):
        along = (((at - start) @ (end - start)) / ((end - start) @ (end - start))).clip(0, 1)
        away = np.minimum(away, np.linalg.norm(at - start - along[:, None] * (end - start), axis=1))
    clear = abs(away - radius) > 1e-4
    assert brushed[clear].tolist() == (away <= radius)[clear].tolist()
    pixel = np.floor(at) + 0.5
    sides = []
    for start, end in zip(np.reshape(corners, (-1, 2)), np.roll(np.reshape(corners, (-1, 2)), -1, axis=0), strict=True):
        sides.append((end[0] - start[0]) * (pixel[:, 1] - start[1]) - (end[1] - start[1]) * (pixel[:, 0] - start[0]))
    inside = np.array(sides).min(axis=0) > 0
    seen = (abs(np.array(sides)).min(axis=0) > 1e-3) & ((pixel > 0) & (pixel < [WIDTH, HEIGHT])).all(axis=1) & ~brushed
    assert inside[seen].sum() > 100
    assert both[seen].tolist() == inside[seen].tolist()


def test_connected_colors_stop_at_gaps(watched: Watched) -> None:
    """Two equal clusters of one color: connectedness takes only that of the seed, and tolerance limits the colors."""
    script = """async ([base]) => {
      const { Selector } = await import(`${base}/viewer/selector.js`);
      const count = 4000, centers = new Float32Array(count * 3);
      const colors = new Uint8ClampedArray(count * 3).fill(100);
      let state = 1;
      const random = () => (state = (state * 16807) % 2147483647) / 2147483647;
      for (let i = 0; i < count; i++) {
        centers.set([random() + (i % 2 ? 3 : 0), random(), 4], 3 * i);
        if (centers[3 * i + 1] > 0.5) colors.fill(140, 3 * i, 3 * i + 3);
      }
      const selector = new Selector(centers, new Float32Array(count).fill(0.01), colors, 2);
      const ids = new Uint32Array(100).fill(1), axes = [[1, 0, 0], [0, 1, 0], [0, 0, 1]];
      selector.answer({ op: "view", axes, eye: [0, 0, 0], focal: [10, 10], near: 0.2, ids, width: 10, height: 10 });
      colors.fill(100, 0, 3);
      centers[1] = 0.2;
      const ask = (tolerance, connected) => {
        selector.answer({ op: "clear" });
        selector.answer({ op: "similar", point: [5, 5], tolerance, connected, mode: "add" });
        return [...selector.flags];
      };
      return [[...centers], [ask(0.1, true), ask(0.1, false), ask(0.2, true), ask(1, false)]];
    }"""
    places, (narrow, all_narrow, wide, everything) = watched.page.evaluate(script, [base_of(watched)])
    centers = np.reshape(places, (-1, 3))
    left, low = centers[:, 0] < 2, centers[:, 1] <= 0.5
    assert np.array(narrow, bool).tolist() == (left & low).tolist()
    assert np.array(all_narrow, bool).tolist() == low.tolist()
    assert np.array(wide, bool).tolist() == left.tolist()
    assert all(everything)


def two_walls() -> Scene:
    """Return a wall in the left and right half, and another one behind it."""
    near = wall()
    far = replace(near, means=near.means * torch.tensor([2.0, 2.0, 2.0]), scales=near.scales + torch.tensor(2.0).log())
    return Scene(
        *(
            torch.cat([getattr(near, name), getattr(far, name)])
            for name in ("means", "quats", "scales", "opacities", "sh_dc", "sh_rest")
        )
    )


def opened(visit: Visit, files: dict[str, Path], **size: Any) -> Watched:
    """Open the form with the files, and start to select a region `near`."""
    watched = visit(**size)
    page = watched.page
    choose(watched, files)
    watched.settled()
    page.locator("details.fold", has_text="Regions").evaluate("(fold) => { fold.open = true; }")
    page.get_by_role("button", name="Add a region").click()
    region = page.get_by_role("group", name="Region 1")
    region.get_by_label("Name").fill("near")
    region.get_by_role("button", name="Select in the 3D view").click()
    page.get_by_role("heading", name="Select “near”").wait_for()
    return watched


def selected(watched: Watched, text: str = "") -> int:
    """Return the number of selected Gaussians once the page shows this text."""
    output = watched.page.locator(".selecting output", has_text=re.compile(f"^{text}"))
    output.wait_for()
    return int(output.inner_text().split()[0].replace(",", ""))


def selected_at_last(watched: Watched) -> int:
    """Return the number of selected Gaussians after all strokes, whose parts are answered in order."""
    page = watched.page
    page.evaluate("() => new Promise(requestAnimationFrame)")  # the last part of a stroke is sent in a frame
    click(page.get_by_role("button", name="Undo"), page.get_by_role("button", name="Redo"))
    page.locator(".selecting button:disabled", has_text="Redo").wait_for()
    return selected(watched)


def some_selected(watched: Watched) -> None:
    """Wait until the page shows that a Gaussian is selected."""
    watched.page.locator(".selecting output", has_text=re.compile("^[1-9]")).wait_for()


def drag(watched: Watched, *points: tuple[float, float]) -> None:
    """Drag over the 3D view; points are fractions of its width and height."""
    view = watched.page.locator("canvas.view")
    view.scroll_into_view_if_needed()
    box = view.bounding_box()
    mouse = watched.page.mouse
    places = [(box["x"] + x * box["width"], box["y"] + y * box["height"]) for x, y in points]
    mouse.move(*places[0])
    mouse.down()
    for place in places[1:]:
        mouse.move(*place, steps=8)
    mouse.up()


def test_drawn_selections_take_what_is_visible(visit: Visit, files: dict[str, Path], tmp_path: Path) -> None:
    """A lasso around the middle takes Gaussians of the near wall only, unless it selects through."""
    write_files(tmp_path, two_walls(), cameras(3, 96, 72))
    watched = opened(visit, files)
    page = watched.page
    page.get_by_label("Lasso").check()
    loop = [(0.3, 0.3), (0.7, 0.3), (0.7, 0.7), (0.3, 0.7), (0.3, 0.3)]
    assert selected(watched, "0 of 1,232 Gaussians") == 0
    drag(watched, *loop)
    some_selected(watched)
    near = selected(watched)
    page.keyboard.press("Control+z")  # the focus is where the pointer has drawn
    assert selected(watched, "0 of 1,232") == 0
    page.keyboard.press("Control+Shift+z")
    assert selected(watched, f"{near} of") == near
    page.keyboard.press("Control+z")
    assert selected(watched, "0 of 1,232") == 0
    page.get_by_label("Select through").check()
    drag(watched, *loop)
    some_selected(watched)
    through = selected(watched)
    assert through > 1.15 * near
    assert near > 50
    page.get_by_label("Intersect").check()
    drag(watched, (0.5, 0.3), (0.9, 0.3), (0.9, 0.7), (0.5, 0.7), (0.5, 0.3))
    page.locator(".selecting output").filter(has_not_text=f"{through} of").wait_for()
    assert 0 < selected(watched) < 0.8 * through
    page.keyboard.press("b")
    assert page.get_by_label("Brush", exact=True).is_checked()
    assert page.locator("details.help").get_by_text("brush, lasso, box").count() == 1
    page.get_by_role("button", name="Use selection").click()
    region = page.get_by_role("group", name="Region 1")
    region.get_by_text("Gaussians selected by hand").wait_for()
    assert region.get_by_role("button", name="Change the selection").evaluate("(it) => it === document.activeElement")


def test_selected_region_stays_frozen(visit: Visit, service: Service, files: dict[str, Path], tmp_path: Path) -> None:
    """The whole path in the browser: select with the brush, freeze, submit, and compare the result's colors."""
    watched = opened(visit, files)
    page = watched.page
    before_image = watched.pixels()
    drag(watched, (0.25, 0.5), (0.45, 0.4), (0.45, 0.6))
    some_selected(watched)
    drag(watched, (0.3, 0.6), (0.4, 0.65))
    watched.settled()
    assert np.abs(watched.pixels() - before_image).max() > 40, "the selection is not highlighted"
    count = selected_at_last(watched)
    for _ in range(2):
        page.get_by_role("button", name="Undo").click()
    selected(watched, "0 of")
    assert np.array_equal(watched.pixels(), before_image)
    for _ in range(2):
        page.get_by_role("button", name="Redo").click()
    assert selected(watched, f"{count} of") == count
    region = page.get_by_role("group", name="Region 1")
    region.get_by_label("Freeze").check()
    set_options(watched, **STEPS, name="by hand")
    page.get_by_role("button", name="Start").click()  # uses the open selection
    page.locator(".badge", has_text="Done").wait_for()
    job_id = page.url.rsplit("/", 1)[1]
    job = httpx2.get(f"{service.url}/v1/jobs/{job_id}").json()
    (region,) = job["parameters"]["regions"]
    assert (region["name"], region["select"], region["freeze"]) == ("near", "mask=region_1.bin", True)
    mask = httpx2.get(f"{service.url}/v1/jobs/{job_id}/inputs/mask").content
    frozen = np.unpackbits(np.frombuffer(mask, np.uint8), bitorder="little").astype(bool)[:616]
    assert 10 < frozen.sum() == count < 600
    before, after = (read_scene(path).scene for path in (files["scene"], result_of(service, job_id, tmp_path)))
    same = (before.sh_dc.numpy().view(np.uint32) == after.sh_dc.numpy().view(np.uint32)).all(axis=1)
    assert same[frozen].all()
    assert same[~frozen].mean() < 0.5
    x = before.means[:, 0].numpy()
    assert x[frozen].max() < 1.0, "the brush moved over the left half"


def test_panel_works_by_keyboard_on_small_screens(visit: Visit, files: dict[str, Path]) -> None:
    from axe_playwright_python.sync_playwright import Axe

    watched = opened(visit, files, width=360, height=760, is_mobile=True, has_touch=True)
    page = watched.page
    view = page.locator("canvas.view").bounding_box()
    assert 0 <= view["y"] <= 760 - view["height"], "what is selected is in sight"
    help_text = page.locator(".selecting .help").first.inner_text()
    assert "Subtract" in help_text
    assert "Alt" not in help_text
    for tool in ("Brush", "Lasso", "Similar", "Box", "Sphere"):
        page.get_by_label(tool, exact=True).check()
        assert page.evaluate("() => document.documentElement.scrollWidth") <= 360, tool
        results = Axe().run(page, options={"runOnly": ["wcag2a", "wcag2aa", "wcag21a", "wcag21aa", "wcag22aa"]})
        assert not results.response["violations"], results.generate_report()
    page.get_by_label("Radius", exact=True).fill("0.8")
    page.get_by_role("button", name="Apply").press("Enter")
    some_selected(watched)
    scene = read_scene(files["scene"]).scene
    center = [float(page.get_by_label(name, exact=True).input_value()) for name in ("X", "Y", "Z")]
    inside = ((scene.means.double() - torch.tensor(center, dtype=torch.float64)).norm(dim=1) <= 0.8).sum()
    assert abs(selected(watched) - int(inside)) <= 2  # the page shows five digits
    handle = page.get_by_role("button", name="Move", exact=True)
    handle.press("ArrowRight")
    assert float(page.get_by_label("X", exact=True).input_value()) != center[0]
    count = selected(watched)
    page.get_by_role("button", name="Invert").press("Enter")
    assert selected(watched, f"{616 - count} of") == 616 - count
    page.keyboard.press("Control+z")
    assert selected(watched, f"{count} of") == count
    page.get_by_label("Similar", exact=True).check()
    page.get_by_role("button", name="Clear").press("Enter")
    page.get_by_role("button", name="Pick at the middle").press("Enter")
    some_selected(watched)
    page.keyboard.press("Escape")
    page.locator(".selecting").first.wait_for(state="hidden")
    assert "selected by hand" not in page.get_by_role("group", name="Region 1").inner_text()
    page.get_by_role("button", name="Add a region").focus()
    focused, bar = page.locator(":focus").bounding_box(), page.locator(".actions").bounding_box()
    assert focused["y"] + focused["height"] <= bar["y"] + 14, "the bar covers the focus"


QUICK: dict[str, Any] = {"steps_coarse": 2, "steps_sos": 2}
TITLE = "Paint on this view"


@pytest.fixture(scope="module")
def finished(service: Service, inputs: dict[str, Path]) -> str:
    """Return the id of a finished job, whose page is shown from its first camera."""
    return done(service, submit(service, inputs, name="wall", **QUICK))


def camera_of(view: dict[str, Any]) -> Camera:
    """Return the camera that a request or a picture states."""
    stated = view["camera"]
    intrinsics = [[stated["fx"], 0, stated["cx"]], [0, stated["fy"], stated["cy"]], [0, 0, 1]]
    return Camera.from_matrix(stated["world_to_camera"], intrinsics, stated["width"], stated["height"])


def of_canvas(camera: Camera, pixels: NDArray[np.float64]) -> Camera:
    """Return the camera with which an image of another size, which is wide enough, shows the same height of a scene."""
    height, width, _ = pixels.shape
    focal = camera.fy * height / camera.height
    intrinsics = [[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]]
    return Camera.from_matrix(camera.world_to_camera, intrinsics, width, height)


def frozen(watched: Watched) -> Any:
    """Freeze the view, and return the panel."""
    watched.settled()
    watched.page.get_by_role("button", name="Paint", exact=True).click()
    return watched.page.get_by_role("region", name=TITLE)


def applied(watched: Watched) -> dict[str, Any]:
    """Send what was painted, and return the job once its result is shown."""
    page = watched.page
    with page.expect_response(lambda answer: answer.request.method == "POST" and "/v1/jobs?" in answer.url) as answer:
        page.get_by_role("button", name="Apply", exact=True).click()
    assert answer.value.status == 202, answer.value.text()
    job: dict[str, Any] = answer.value.json()
    page.wait_for_url(re.compile(f"#/jobs/{job['id']}$"))
    appear(page.locator(".badge", has_text="Done"), page.locator(".side.right", has_text="Painted"))
    return job


def test_scene_follows_a_stroke_and_undo_restores_it(
    visit: Visit, service: Service, finished: str, tmp_path: Path
) -> None:
    base = result_of(service, finished, tmp_path)
    digest = hashlib.sha256(base.read_bytes()).hexdigest()
    watched = visit(f"/#/jobs/{finished}", width=1100, height=800)
    page = watched.page
    panel = frozen(watched)
    panel.get_by_label("Color").fill("#20d040")
    panel.get_by_label("Brush size").fill("120")
    drag(watched, (0.4, 0.45), (0.6, 0.55))
    drag(watched, (0.2, 0.2), (0.8, 0.2))
    page.keyboard.press("Control+z")
    job = applied(watched)
    page.get_by_role("heading", name="wall, painted", exact=True).wait_for()

    layer = np.asarray(Image.open(fetched(service, f"/v1/jobs/{job['id']}/inputs/painted", tmp_path / "layer.png")))
    assert layer.shape[2] == 4
    stroke = layer[:, :, 3] == 255
    assert np.unique(layer[stroke], axis=0).tolist() == [[0x20, 0xD0, 0x40, 255]]
    rows, columns = stroke.nonzero()
    height, width = stroke.shape
    assert abs(rows.mean() / height - 0.5) < 0.01
    assert abs(columns.mean() / width - 0.5) < 0.01
    [view] = job["parameters"]["painted"]
    camera, painted = camera_of(view), result_of(service, job["id"], tmp_path)
    before, after = rendered(base, camera), rendered(painted, camera)
    color = np.broadcast_to(layer[stroke][0, :3].astype(float), after[stroke].shape)
    assert psnr(after[stroke], color) > psnr(before[stroke], color) + 6
    far = np.ones_like(stroke)
    far[max(rows.min() - height // 5, 0) : rows.max() + height // 5] = False
    assert psnr(after[far], before[far]) > 35
    shown = watched.pixels()
    assert psnr(shown, rendered(painted, of_canvas(camera, shown))) >= FAITHFUL

    page.get_by_role("link", name="Undo painting").click()
    appear(page.get_by_role("heading", name="wall", exact=True), page.locator(".side.right", has_text="Stylized"))
    watched.wipe("Home")
    shown = watched.pixels()
    assert psnr(shown, rendered(base, of_canvas(camera, shown))) >= FAITHFUL, "the same viewpoint"
    assert hashlib.sha256(result_of(service, finished, tmp_path).read_bytes()).hexdigest() == digest


def test_painted_picture_returns_to_its_view(visit: Visit, service: Service, finished: str, tmp_path: Path) -> None:
    watched = visit(f"/#/jobs/{finished}", width=1100, height=800)
    page = watched.page
    panel = frozen(watched)
    watched.settled()
    with page.expect_download() as download:
        panel.get_by_role("button", name="Download picture").click()
    with Image.open(download.value.path()) as image:
        stated, pixels = image.info["sgsst-view"], np.asarray(image.convert("RGB"), dtype=np.float64)
    camera = camera_of(json.loads(stated))
    before = rendered(result_of(service, finished, tmp_path), camera)
    assert psnr(pixels, before) >= FAITHFUL
    panel.get_by_role("button", name="Cancel").click()
    page.locator("canvas.view").focus()
    page.keyboard.press("d")

    night = pixels * [0.3, 0.3, 0.5]
    text = PngInfo()
    text.add_text("sgsst-view", stated)
    Image.fromarray(night.round().astype(np.uint8)).save(tmp_path / "night.png", pnginfo=text)
    drop(watched, {"painted": tmp_path / "night.png"})
    panel.locator("button:enabled", has_text="Apply").wait_for()
    job = applied(watched)
    assert job["parameters"]["painted"] == [json.loads(stated)]
    painted = rendered(result_of(service, job["id"], tmp_path), camera)
    assert psnr(painted, night) > psnr(before, night) + 10


def test_scene_of_the_form_is_painted(visit: Visit, service: Service, files: dict[str, Path]) -> None:
    watched = visit(width=1100, height=800)
    page = watched.page
    choose(watched, {"scene": files["scene"], "cameras": files["cameras"]})
    panel = frozen(watched)
    panel.get_by_label("Brush size").fill("150")
    drag(watched, (0.5, 0.5), (0.6, 0.5))
    job = applied(watched)
    page.get_by_role("heading", name="scene, painted", exact=True).wait_for()
    assert {each["role"] for each in job["inputs"]} == {"scene", "cameras", "painted"}
    page.get_by_role("button", name="Stylize this scene").click()
    appear(
        page.get_by_role("heading", name="Paint a scene"), page.locator(".slot.filled", has_text="scene, painted.ply")
    )


def test_foreign_pictures_are_refused_in_a_sentence(visit: Visit, finished: str, tmp_path: Path) -> None:
    from axe_playwright_python.sync_playwright import Axe

    watched = visit(f"/#/jobs/{finished}", width=360, height=800, has_touch=True)
    page = watched.page
    panel = frozen(watched)
    Image.new("RGB", (30, 20)).save(tmp_path / "small.png")
    (tmp_path / "text.png").write_text("not an image")
    view = {"view": "x", "camera": {"width": 9, "height": 9, "fx": 1, "fy": 1, "world_to_camera": [[1, 0, 0, 0]] * 3}}
    text = PngInfo()
    text.add_text("sgsst-view", json.dumps(view))
    Image.new("RGB", (30, 20)).save(tmp_path / "cropped.png", pnginfo=text)
    for name, problem in [
        ("small.png", r"small.png has 30×20 pixels, but the view has \d+×\d+\."),
        ("text.png", r"text.png is no image"),
        ("cropped.png", r"cropped.png has 30×20 pixels, but the view has 9×9\."),
    ]:
        with page.expect_file_chooser() as chooser:
            panel.get_by_role("button", name="Use a painted picture").click()
        chooser.value.set_files(tmp_path / name)
        panel.get_by_role("alert").filter(has_text=re.compile(problem)).wait_for()
        assert panel.get_by_role("button", name="Apply").is_disabled()
    box = page.locator("canvas.view").bounding_box()
    page.touchscreen.tap(box["x"] + box["width"] / 2, box["y"] + box["height"] / 2)
    panel.get_by_role("button", name="Undo stroke").click()
    panel.locator("button:disabled", has_text="Apply").wait_for()
    assert page.evaluate("document.documentElement.scrollWidth") <= 360
    assert Axe().run(page).violations_count == 0
