"""Tests of cameras derived from other cameras."""

from __future__ import annotations

import itertools
import math
from dataclasses import replace
from typing import Any

import pytest
import torch
from torch import Tensor

from sgsst_core.errors import CameraError, SettingsError
from sgsst_core.scene.camera import Camera, checked_cameras, fit_cameras, look_at, resized, spread
from sgsst_core.settings import make_settings


def camera(width: int = 990, height: int = 742, name: str = "a") -> Camera:
    return Camera(name, width, height, 820.0, 810.0, 490.0, 380.0, torch.eye(4, dtype=torch.float64))


def project(view: Camera, points: Tensor) -> tuple[Tensor, Tensor]:
    """Return pixel positions [P, 2] and depths [P] of points [P, 3]."""
    local = points.double() @ view.world_to_camera[:3, :3].T + view.world_to_camera[:3, 3]
    lens = torch.tensor([[view.fx, view.fy], [view.cx, view.cy]], dtype=torch.float64)
    return local[:, :2] / local[:, 2:] * lens[0] + lens[1], local[:, 2]


@pytest.mark.parametrize("longer_side", [1, 7, 480, 990, 1600, 5187])
@pytest.mark.parametrize(("width", "height"), [(990, 742), (742, 990), (640, 640), (5000, 3)])
def test_resizing_keeps_directions_at_their_relative_image_position(width: int, height: int, longer_side: int) -> None:
    before = camera(width, height)
    after = resized(before, longer_side)
    assert max(after.width, after.height) == longer_side
    assert isinstance(after.width, int)
    assert abs(min(after.width, after.height) - longer_side * min(width, height) / max(width, height)) <= 1
    points = torch.tensor([[0.0, 0, 1], [0.3, -0.2, 1], [-1, 2, 4]])
    size = torch.tensor([[before.width, before.height], [after.width, after.height]], dtype=torch.float64)
    assert torch.allclose(project(after, points)[0] / size[1], project(before, points)[0] / size[0], rtol=1e-12)


@pytest.mark.parametrize(("width", "height"), [(242, 813), (813, 242), (444, 444)])
def test_fitted_aspect_ratio_has_the_pixels_of_its_resolution(width: int, height: int) -> None:
    chosen = replace(camera(width, height), resolution=512)
    for side in (100, 512, 1024):
        after = resized(chosen, side)
        assert after.resolution == after.side == side
        assert after.width * after.height == pytest.approx(side * side * 3 / 4, rel=0.02)
    (fitted,) = fit_cameras([chosen], make_settings(max_resolution=600))
    assert fitted is chosen
    (fitted,) = fit_cameras([chosen], make_settings(max_resolution=400))
    assert fitted.side == 400


def test_resizing_below_one_pixel_is_refused() -> None:
    with pytest.raises(SettingsError, match="resolution is 0"):
        resized(camera(), 0)


@pytest.mark.parametrize(("total", "count"), [(97, 8), (97, 96), (10, 3), (5, 5), (5, 9), (1, 1), (1000, 1)])
def test_spread_views_are_even_and_in_order(total: int, count: int) -> None:
    cameras = [camera(name=str(i)) for i in range(total)]
    chosen = [int(c.name) for c in spread(cameras, count)]
    assert len(chosen) == min(count, total)
    gaps = [after - before for before, after in itertools.pairwise(chosen)]
    assert all(gap >= 1 for gap in gaps)
    if gaps:
        assert max(gaps) - min(gaps) <= 1
        seam = chosen[0] + total - chosen[-1]  # in a ring, the last and the first are neighbors
        assert min(gaps) - 1 <= seam <= max(gaps) + 1


def test_spread_of_less_than_one_view_is_refused() -> None:
    with pytest.raises(SettingsError, match="views is 0"):
        spread([camera()], 0)


def test_look_at_centers_target_with_up_at_the_top() -> None:
    position, target, up = torch.tensor([1.0, 2, 3]), torch.tensor([4.0, -1, 7]), torch.tensor([0.0, 0, 5])
    view = look_at("a", position, target, up, width=300, height=200, focal=250.0)
    pixels, depths = project(view, torch.stack([target, target + 0.1 * up]))
    assert pixels[0].tolist() == pytest.approx([150, 100])
    assert float(depths[0]) == pytest.approx(math.sqrt(34))
    assert float(pixels[1, 0]) == pytest.approx(150)
    assert float(pixels[1, 1]) < 100
    assert torch.allclose(view.center, position.double())
    assert float(torch.linalg.det(view.world_to_camera[:3, :3])) == pytest.approx(1)
    for wrong in (target - position, torch.zeros(3)):
        with pytest.raises(CameraError, match="its up direction"):
            look_at("a", position, target, wrong, width=3, height=2, focal=2.0)


K = torch.tensor([[820.0, 0, 490], [0, 810, 380], [0, 0, 1]])


def viewmat() -> Tensor:
    return look_at(
        "a", torch.tensor([1.0, 2, 3]), torch.zeros(3), torch.tensor([0.0, 0, 1]), width=9, height=7, focal=5
    ).world_to_camera


@pytest.mark.parametrize("form", [torch.Tensor.float, torch.Tensor.numpy, torch.Tensor.tolist, lambda view: view[:3]])
def test_cameras_are_created_from_matrices(form: Any) -> None:
    created = Camera.from_matrix(form(viewmat()), form(K.double()), 990, 742, name="a")
    assert (created.name, created.width, created.height) == ("a", 990, 742)
    assert (created.fx, created.fy, created.cx, created.cy) == (820, 810, 490, 380)
    torch.testing.assert_close(created.world_to_camera, viewmat(), rtol=0, atol=2e-7)
    rotation = created.world_to_camera[:3, :3]
    torch.testing.assert_close(rotation @ rotation.T, torch.eye(3).double(), rtol=0, atol=1e-15)


MIRRORED, SKEWED = torch.diag(torch.tensor([-1.0, 1, 1, 1])), K + torch.eye(3).roll(1, 1)
WRONG: dict[str, tuple[Any, Any, Any, str]] = {
    "scaled": (2 * torch.eye(4)[:3], K, 990, "is 3 off a rotation"),
    "mirrored": (MIRRORED, K, 990, "mirrors"),
    "transposed": (viewmat().T, K, 990, r"last row of `viewmat`.*transpose"),
    "batch": (torch.eye(4)[None], K, 990, r"shape \[1, 4, 4\].*one camera at a time"),
    "nan": (torch.full((4, 4), torch.nan), K, 990, "holds NaN"),
    "text": ("front", K, 990, "not a matrix of numbers"),
    "skew": (torch.eye(4), SKEWED, 990, "undistort"),
    "focal": (torch.eye(4), -K, 990, "above 0"),
    "size": (torch.eye(4), K, 99.5, "`width` must be a positive number of whole pixels, not 99.5"),
}


@pytest.mark.parametrize("case", WRONG)
def test_invalid_camera_matrices_are_refused(case: str) -> None:
    view, intrinsics, width, problem = WRONG[case]
    with pytest.raises(CameraError, match=problem):
        Camera.from_matrix(view, intrinsics, width, 742)


def test_cameras_of_callers_are_checked() -> None:
    good = camera()
    assert checked_cameras([good])[0] is good
    single = replace(good, world_to_camera=good.world_to_camera.float())
    assert checked_cameras((single,))[0].world_to_camera.dtype == torch.float64
    for wrong in ("cameras.json", good, [good, "b"], torch.eye(4)[None]):
        with pytest.raises(CameraError, match="Read them with `load_cameras`"):
            checked_cameras(wrong)  # type: ignore[arg-type]
    with pytest.raises(CameraError, match="a: its transform is not"):
        checked_cameras([replace(good, world_to_camera=torch.eye(3))])
