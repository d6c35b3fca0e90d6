"""Tests of blends on the page: comparison with `sgsst render`, sliders, triangle, the held key, and saving."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image

from sgsst_core.files.camera_files import read_cameras
from sgsst_core.files.library import save
from sgsst_core.files.scene_file import blend_scenes, read_scene, write_colors, write_stylized
from sgsst_core.scene.camera import resized
from tests.api.page.actions import Visit, done, result_of, submit
from tests.api.page.browser import Watched, decoded, psnr, rendered
from tests.api.page.test_page import frame_of
from tests.api.page.test_viewer import FAITHFUL, real_scene, shown
from tests.api.service import Service
from tests.small_scenes import write_files

pytestmark = pytest.mark.slow

QUICK: dict[str, Any] = {"steps_coarse": 2, "steps_sos": 2}


@pytest.mark.parametrize("name", ["playbot_synthetic_sh2", "snowmiku_plush"])
def test_blend_is_that_of_the_renderer(visit: Visit, shared_data: Path, tmp_path: Path, name: str) -> None:
    scene, views = real_scene(shared_data, name)
    ply, _, _ = write_files(tmp_path, scene, views[:1])
    files = [read_scene(ply)]
    generator = torch.Generator().manual_seed(3)
    for index in range(2):
        # as a stylization: most colors change, and some leave the displayable range
        colors = (
            -scene.sh_dc.roll(1, dims=1) if index else scene.sh_dc + torch.randn(scene.sh_dc.shape, generator=generator)
        )
        write_colors(tmp_path / f"colors_{index}.f16", colors)
        write_stylized(files[0], tmp_path / f"result_{index}.ply", colors)
        files.append(read_scene(tmp_path / f"result_{index}.ply"))
    all_weights: list[list[float]] = [
        [0, 1, 0],
        [1, 0, 0],
        [0.4, 0.6, 0],
        [-0.5, 1.5, 0],
        [0, 0.5, 0.5],
        [0.2, 0.3, 0.5],
        [-0.5, 0.6, 0.9],
    ]
    steps = """async (viewer, source, picture) => {
      for (const i of [0, 1]) await source.addColors(`c${i}`, (await fetch(`/given/colors_${i}.f16`)).body);
      const found = [];
      for (const weights of WEIGHTS) {
        const blend = ["own", "c0", "c1"].map((colors, i) => ({ colors, weight: weights[i] }));
        viewer.show({ scene: source, colors: "own", blend });
        found.push(await picture());
      }
      return found;
    }""".replace("WEIGHTS", json.dumps(all_weights))
    watched, camera = visit("/#/jobs"), views[0]
    images = shown(watched, tmp_path, camera.name, (camera.width, camera.height), steps)
    for weights, png in zip(all_weights, images, strict=True):
        save(tmp_path / "blend.ply", blend_scenes(files, weights))
        assert psnr(decoded(png), rendered(tmp_path / "blend.ply", camera)) >= FAITHFUL, weights


@pytest.fixture(scope="module")
def pair(service: Service, inputs: dict[str, Path]) -> list[str]:
    """Return the ids of two finished jobs of one scene."""
    job_ids = [submit(service, inputs, name=f"run {weight}", content_weight=weight, **QUICK) for weight in (1, 900)]
    return [done(service, each) for each in job_ids]


def move(watched: Watched, label: str, percent: int) -> None:
    watched.page.get_by_label(label, exact=True).fill(str(percent))


def saved(watched: Watched, folder: Path) -> Path:
    """Save the blend, and return the downloaded file."""
    with watched.page.expect_download() as download:
        watched.page.get_by_role("button", name="Save this blend").click()
    path = folder / download.value.suggested_filename
    download.value.save_as(path)
    return path


def test_slider_shows_what_is_saved(visit: Visit, inputs: dict[str, Path], pair: list[str], tmp_path: Path) -> None:
    watched = visit(f"/#/jobs/{pair[0]}", width=600, height=500)
    page = watched.page
    page.get_by_label("Camera", exact=True).select_option("1")
    watched.wipe("Home")
    stylized = watched.pixels()
    move(watched, "Amount of style", 150)
    page.locator(".side.right", has_text="150% style").wait_for(state="attached")
    drawn, path = watched.pixels(), saved(watched, tmp_path)
    assert path.name == "run_1-stylized_1.5.ply"
    camera = resized(read_cameras(inputs["cameras"])[1], 384)
    wanted = rendered(path, camera)
    assert psnr(frame_of(watched, wanted), wanted) > 38  # the view is larger than the rendered image
    assert np.abs(drawn - stylized).mean() > 5
    move(watched, "Amount of style", 0)
    none = watched.pixels()
    watched.wipe("End")
    assert np.array_equal(watched.pixels(), none), "without style, it is the original"
    move(watched, "Amount of style", 30)
    page.get_by_label("Save as").select_option("spz")
    assert read_scene(saved(watched, tmp_path)).format == "spz"


def test_held_key_shows_the_original(visit: Visit, pair: list[str]) -> None:
    watched = visit(f"/#/jobs/{pair[0]}", width=600, height=500)
    page = watched.page
    watched.wipe("End")
    original = watched.pixels()
    watched.wipe("Home")
    stylized = watched.pixels()
    page.locator("canvas").focus()
    page.keyboard.down("o")
    page.locator("#said", has_text="Original").wait_for(state="attached")
    watched.settled()
    with page.expect_download() as download:
        page.locator("[aria-label='Save image']").evaluate("(button) => button.click()")  # the focus stays
    with Image.open(download.value.path()) as image:
        assert np.array_equal(np.asarray(image.convert("RGB"), dtype=np.float64), original)
    page.keyboard.up("o")
    assert np.array_equal(watched.pixels(), stylized)
    assert np.abs(stylized - original).mean() > 5


def test_two_results_are_blended(
    visit: Visit, service: Service, inputs: dict[str, Path], pair: list[str], tmp_path: Path
) -> None:
    watched = visit(f"/#/compare/{pair[0]}/{pair[1]}", width=600, height=500)
    page = watched.page
    page.get_by_label("Amount of style").wait_for()
    watched.settled()
    assert [page.get_by_label(side, exact=True).input_value() for side in ("Left", "Right")] == pair
    between = page.get_by_label("style, run 1 to style, run 900")
    between.fill("25")
    assert page.get_by_label("Right", exact=True).input_value() == "blend"
    move(watched, "Amount of style", 80)
    watched.settled()
    path = saved(watched, tmp_path)
    paths = [result_of(service, job_id, tmp_path) for job_id in pair]
    expected = blend_scenes([read_scene(file) for file in (*paths, inputs["scene"])], [0.6, 0.2, 0.2])
    assert torch.allclose(read_scene(path).scene.sh_dc, expected.scene.sh_dc, atol=1e-6)

    area = page.locator(".triangle .area")
    box = area.bounding_box()
    area.click(position={"x": box["width"] * 0.75, "y": box["height"] * 0.5})
    assert page.get_by_label("Amount of style").input_value() == "50"
    assert between.input_value() == "100"
