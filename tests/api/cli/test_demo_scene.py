from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from scipy.spatial.transform import Rotation
from skimage import data

from api.cli import demo_scene
from api.cli.demo_scene import (
    BASELINE,
    CENTER_X,
    CENTER_Y,
    DISPARITY_OFFSET,
    FLATNESS,
    FOCAL,
    MAX_SLOPE,
    DemoScene,
    build_demo,
)
from sgsst_core.errors import OutputError
from sgsst_core.files.camera_files import read_cameras
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


def test_demo_scene_has_moderate_size(scene: Scene) -> None:
    assert 100_000 <= len(scene) <= 300_000
    assert scene.sh_degree == 0
    assert 1.9 < float(scene.means[:, 2].min()) < 2.3  # the floor in front
    assert 4.0 < float(scene.means[:, 2].max()) < 6.0  # the wall


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


def test_views_have_few_holes(demo: DemoScene, scene: Scene) -> None:
    cameras = read_cameras(demo.cameras)
    assert len(cameras) == demo_scene.VIEWS
    xs = [float(camera.center[0]) for camera in cameras]
    assert min(xs) < 0
    assert max(xs) > BASELINE
    for camera in cameras[::3]:
        image, coverage = render(scene, camera)
        assert float((coverage < 0.5).float().mean()) < 3e-3
        assert float(image.mean()) > 0.2


def test_gaussians_do_not_span_depth_edges(scene: Scene) -> None:
    """No Gaussian is longer than a merged pixel at the steepest allowed slope (in both directions, seen obliquely)."""
    radii = scene.scales.exp()
    footprint = scene.means[:, 2] / FOCAL
    longest = radii.max(dim=1).values / footprint
    slant = (1 + 2 * (MAX_SLOPE * 1.15) ** 2) ** 0.5
    assert float(longest.max()) < 2 * demo_scene.MERGED_SIGMA * slant
    assert float(longest.median()) < 1
    flatness = radii.min(dim=1).values / radii.median(dim=1).values
    torch.testing.assert_close(flatness, torch.full_like(flatness, FLATNESS), rtol=1e-3, atol=0)


def test_discs_lie_in_surface() -> None:
    """Discs on a slanted plane have centers on it, thin axes along its normal, and round projections 1 pixel wide."""
    slope_x, slope_y, constant = 0.03, -0.05, 40.0
    generator = np.random.default_rng(0)
    x, y = generator.uniform(0, 741, 50), generator.uniform(0, 500, 50)
    shifted = constant + slope_x * x + slope_y * y + DISPARITY_OFFSET
    ones = np.ones(50)
    samples = demo_scene.Samples(
        x, y, shifted - DISPARITY_OFFSET, slope_x * ones, slope_y * ones, np.full((50, 3), 0.5), ones
    )
    means, quats, scales, sh_dc = demo_scene._gaussians(samples, 0.0)
    # d = a x + b y + c over d = f B / z and x = f X / z + cx: f (a X + b Y) + (a cx + b cy + c) Z = f B.
    offset = constant + DISPARITY_OFFSET + slope_x * CENTER_X + slope_y * CENTER_Y
    normal = np.array([FOCAL * slope_x, FOCAL * slope_y, offset])
    np.testing.assert_allclose(means @ normal, FOCAL * BASELINE, rtol=1e-12)
    rotation = Rotation.from_quat(quats[:, [1, 2, 3, 0]]).as_matrix()
    np.testing.assert_allclose(np.abs(rotation[:, :, 0] @ normal), np.linalg.norm(normal), rtol=1e-6)
    assert (scales[:, 0] < scales[:, 1]).all()
    axes = rotation[:, :, 1:] * np.exp(scales[:, None, 1:])
    depth = means[:, 2]
    jacobian = np.zeros((50, 2, 3))
    jacobian[:, 0, 0] = jacobian[:, 1, 1] = FOCAL / depth
    jacobian[:, :, 2] = -FOCAL * means[:, :2] / depth[:, None] ** 2
    projected = jacobian @ axes
    covariance = projected @ projected.transpose(0, 2, 1)
    np.testing.assert_allclose(covariance, np.eye(2)[None] * demo_scene.PIXEL_SIGMA**2 * np.ones((50, 1, 1)), atol=1e-9)
    assert (sh_dc == 0).all()


def test_slope_uses_pixels_own_side_of_edge() -> None:
    disparity = np.tile(np.concatenate([10 + 0.1 * np.arange(20), 40 + 0.2 * np.arange(20)]), (8, 1))
    slope = demo_scene._slope(disparity, 1)
    np.testing.assert_allclose(slope[:, 2:20], 0.1)
    np.testing.assert_allclose(slope[:, 20:38], 0.2)
    assert (demo_scene._slope(disparity, 0) == 0).all()


def test_style_is_bundled_painting(demo: DemoScene) -> None:
    with Image.open(demo.style) as image:
        assert image.size == (800, 633)
        assert image.mode == "RGB"
        assert float(np.asarray(image).std(axis=(0, 1)).min()) > 20


def test_unwritable_demo_folder_is_rejected(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(OutputError):
        build_demo(tmp_path / "file" / "demo")
