from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from skimage import data

from api.cli.demo_scene import (
    BASELINE,
    CENTER_X,
    CENTER_Y,
    DISPARITY_OFFSET,
    FOCAL,
    DemoScene,
    build_demo,
)
from sgsst_core.errors import OutputError
from sgsst_core.files.scene_file import read_scene
from sgsst_core.rasterizer.cpu import CpuRasterizer
from sgsst_core.scene.camera import Camera
from sgsst_core.scene.gaussians import Scene


@pytest.fixture(scope="module")
def demo(tmp_path_factory: pytest.TempPathFactory) -> DemoScene:
    return build_demo(tmp_path_factory.mktemp("demo"))


@pytest.fixture(scope="module")
def scene(demo: DemoScene) -> Scene:
    return read_scene(demo.ply).scene


def photo_camera(x: float, center_x: float) -> Camera:
    pose = torch.eye(4, dtype=torch.float64)
    pose[0, 3] = -x
    return Camera("photo", 741, 500, FOCAL, FOCAL, center_x, CENTER_Y, pose)


def render(scene: Scene, camera: Camera) -> tuple[torch.Tensor, torch.Tensor]:
    rasterizer = CpuRasterizer(scene)
    colors = (0.5 + 0.28209479177387814 * scene.sh_dc).clamp_min(0)
    return rasterizer.render(colors, camera), rasterizer.coverage(camera)


@pytest.mark.parametrize(
    ("photo", "camera"),
    [(0, photo_camera(0.0, CENTER_X)), (1, photo_camera(BASELINE, CENTER_X + DISPARITY_OFFSET))],
    ids=["left", "right"],
)
def test_both_cameras_render_their_photos(scene: Scene, photo: int, camera: Camera) -> None:
    """The right photo tests the calibration: its pixels are those of the left one, moved by depth, unless occluded."""
    image, coverage = render(scene, camera)
    expected = torch.from_numpy(data.stereo_motorcycle()[photo] / 255.0).float()
    error = (image.clamp(0, 1) - expected).square().mean()
    assert float(-10 * error.log10()) > 24
    assert float((coverage < 0.5).float().mean()) < 1e-3


def test_style_is_bundled_painting(demo: DemoScene) -> None:
    with Image.open(demo.style) as image:
        assert image.size == (800, 633)
        assert image.mode == "RGB"
        assert float(np.asarray(image).std(axis=(0, 1)).min()) > 20


def test_unwritable_demo_folder_is_rejected(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(OutputError):
        build_demo(tmp_path / "file" / "demo")
