"""Tests that lenses and undistorted photos are those of COLMAP, and that impossible lenses are refused."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pycolmap
import pytest
import torch

from sgsst_core.errors import CameraError
from sgsst_core.files.camera_files import _colmap_lens
from sgsst_core.files.colmap_model import ColmapCamera
from sgsst_core.files.photos import undistort
from sgsst_core.scene.camera import Camera, resized, undistorted
from sgsst_core.scene.lens import Lens

WIDTH, HEIGHT = 320, 240
#: Parameters of real lenses: phone, wide angle (barrel), telephoto (pincushion), with decentering, and fisheyes.
LENSES = {
    "SIMPLE_RADIAL": [260.0, 163.0, 118.0, 0.03],
    "RADIAL": [260.0, 163.0, 118.0, -0.21, 0.04],
    "OPENCV": [260.0, 255.0, 163.0, 118.0, 0.09, -0.02, 0.003, -0.004],
    "FULL_OPENCV": [260.0, 255.0, 163.0, 118.0, 0.4, 0.1, 0.001, -0.002, 0.02, 0.45, 0.12, 0.03],
    "OPENCV_FISHEYE": [180.0, 178.0, 163.0, 118.0, 0.02, -0.01, 0.003, -0.001],
    "SIMPLE_RADIAL_FISHEYE": [180.0, 163.0, 118.0, 0.04],
    "RADIAL_FISHEYE": [180.0, 163.0, 118.0, 0.04, -0.01],
    "FISHEYE": [180.0, 178.0, 163.0, 118.0],
    "SIMPLE_FISHEYE": [180.0, 163.0, 118.0],
}


def lens(model: str, parameters: list[float] | None = None) -> Lens:
    return _colmap_lens("", ColmapCamera(model, WIDTH, HEIGHT, tuple(parameters or LENSES[model])))


def camera(lens: Lens) -> Camera:
    pose = torch.eye(4, dtype=torch.float64)
    return Camera("view", lens.width, lens.height, lens.fx, lens.fy, lens.cx, lens.cy, pose, lens=lens)


def of_colmap(model: str) -> pycolmap.Camera:
    return pycolmap.Camera(model=model, width=WIDTH, height=HEIGHT, params=LENSES[model])


def pattern(height: int = HEIGHT, width: int = WIDTH) -> np.ndarray:
    """Return a smooth image [height, width, 3] uint8."""
    y, x = np.mgrid[:height, :width] / width
    waves = [np.sin(9 * x + 4 * y), np.cos(7 * y - 3 * x), np.sin(20 * x * y)]
    return (127.5 + 120 * np.stack(waves, axis=2)).round().astype("u1")


@pytest.mark.parametrize("model", LENSES)
def test_projected_rays_match_colmap(model: str) -> None:
    rays = np.random.default_rng(3).uniform(-0.6, 0.6, (200, 2))
    rays[0] = 0
    expected = np.array([of_colmap(model).img_from_cam(np.array([*ray, 1.0])) for ray in rays])
    u, v = lens(model).positions(*torch.from_numpy(rays).unbind(1))
    assert np.allclose(u.numpy() * WIDTH, expected[:, 0], rtol=0, atol=1e-9)
    assert np.allclose(v.numpy() * HEIGHT, expected[:, 1], rtol=0, atol=1e-9)


@pytest.mark.parametrize("model", LENSES)
def test_undistorted_photos_match_colmap(model: str) -> None:
    """Compare pixels in the frame that both show; COLMAP samples at 8 bits."""
    view = undistorted(camera(lens(model)))
    options = pycolmap.UndistortCameraOptions()
    options.max_scale = 1.0
    bitmap, expected = pycolmap.undistort_image(options, pycolmap.Bitmap.from_array(pattern()), of_colmap(model))
    same = replace(
        view,
        width=expected.width,
        height=expected.height,
        cx=expected.principal_point_x,
        cy=expected.principal_point_y,
    )
    photo = torch.from_numpy(pattern()).float() / 255
    actual = undistort(photo, same)[2:-2, 2:-2] * 255
    assert float((actual - torch.from_numpy(bitmap.to_array()).float()[2:-2, 2:-2]).abs().max()) < 1.5
    assert (view.fx, view.fy) == (expected.focal_length_x, expected.focal_length_y)


@pytest.mark.parametrize("model", LENSES)
def test_frames_shrink_just_enough_to_have_no_border(model: str) -> None:
    whole = camera(lens(model))
    view = undistorted(whole)
    u, v = corners(view)
    assert 0 <= float(min(u.min(), v.min())) <= float(max(u.max(), v.max())) <= 1
    assert view.cx / view.width == pytest.approx(whole.cx / whole.width)
    if view.width < WIDTH:
        larger = replace(view, width=view.width + 3, height=view.height + 3)
        larger = replace(larger, cx=whole.cx * larger.width / WIDTH, cy=whole.cy * larger.height / HEIGHT)
        u, v = corners(larger)
        assert float(min(u.min(), v.min())) < 0 or float(max(u.max(), v.max())) > 1
    else:
        assert view == whole


def corners(view: Camera) -> tuple[torch.Tensor, torch.Tensor]:
    """Return the positions in the photo of many points on the frame's border."""
    along = torch.linspace(0, 1, 1001, dtype=torch.float64)
    zero = torch.zeros_like(along)
    across = torch.cat([along, along, zero, zero + 1]) * view.width
    down = torch.cat([zero, zero + 1, along, along]) * view.height
    assert view.lens
    return view.lens.positions((across - view.cx) / view.fx, (down - view.cy) / view.fy)


def test_small_views_of_large_photos_do_not_alias() -> None:
    stripes = torch.zeros(4 * HEIGHT, 4 * WIDTH, 3)
    stripes[:, ::2] = 1
    small = undistort(stripes, resized(undistorted(camera(lens("RADIAL"))), 80))
    assert small.shape[1] == 80
    assert float((small - 0.5).abs()[:, 2:-2].max()) < 0.03


def test_coefficients_of_0_are_no_distortion() -> None:
    for model in ("SIMPLE_RADIAL", "RADIAL", "OPENCV", "FULL_OPENCV"):
        intrinsics = 3 if "RADIAL" in model else 4
        parameters = LENSES[model][:intrinsics] + [0.0] * (len(LENSES[model]) - intrinsics)
        assert not lens(model, parameters).distorts
        assert lens(model).distorts
    assert lens("FISHEYE").distorts  # equal angles are not equal lengths


@pytest.mark.parametrize(
    "values", [(float("inf"),), (-1e6,), (1e300, 1e300), (0, 0, 5.0, 5.0), (0, 0, 0, 0, 0, -900.0)]
)
def test_lenses_that_leave_no_image_are_refused(values: tuple[float, ...]) -> None:
    hostile = Lens.of("OPENCV", values, (WIDTH, HEIGHT), (260.0, 260.0, 160.0, 120.0))
    with pytest.raises(CameraError, match=r"'view': its distortion \(OPENCV .*leaves no image"):
        undistorted(camera(hostile))


def test_folded_borders_are_cropped() -> None:
    """Beyond a radius of 0.58, this lens maps the image back onto itself, and its corners lie inside the photo."""
    folding = camera(Lens.of("RADIAL", (-1.0,), (WIDTH, HEIGHT), (200.0, 200.0, 160.0, 120.0)))
    u, v = corners(folding)
    assert 0 < float(min(u.min(), v.min())) <= float(max(u.max(), v.max())) < 1
    view = undistorted(folding)
    radius = np.hypot(view.width / 2 / view.fx, view.height / 2 / view.fy)
    assert 0.5 < radius <= 1 / np.sqrt(3) + 0.01


def test_lenses_without_a_formula_are_refused() -> None:
    view = camera(lens("FOV", [260.0, 260.0, 160.0, 120.0, 0.9]))
    with pytest.raises(CameraError, match=r"photos of the camera model FOV cannot be undistorted here.*image_undist"):
        undistorted(view)
