"""Tests of multi-view consistency on planes, for which warp and occlusion are known exactly, and on a real scene."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from sgsst_core.constants import COLOR_OFFSET, SH_C0
from sgsst_core.errors import SettingsError
from sgsst_core.files.camera_files import read_cameras
from sgsst_core.files.scene_file import read_scene
from sgsst_core.quality.judge import Lpips
from sgsst_core.quality.novel_views import (
    LONG_RANGE,
    SHORT_RANGE,
    Consistency,
    DepthMap,
    consistency,
    expected_depth,
    find_warp,
    project_pixels,
    shown,
    view_pairs,
)
from sgsst_core.rasterizer import Rasterizer, make_rasterizer
from sgsst_core.scene.camera import Camera, look_at, resized
from sgsst_core.scene.gaussians import TENSORS, Scene
from sgsst_core.scene.spherical_harmonics import rest_colors, view_colors

#: A power of two, so that positions of planes stay exact when their world is moved by whole numbers.
SPACING = 1 / 16
DEPTH = 4.0


@pytest.fixture(scope="module")
def lpips(vgg16_weights: object) -> Lpips:
    return Lpips()


def plane(half_width: float, half_height: float, depth: float, color: Tensor | None = None) -> Scene:
    """Return opaque flat Gaussians on a rectangle around the z axis, with a smooth pattern or one color [3].

    Gaussians overlap, and nearer ones hide farther ones. A pixel therefore shows the pattern at a position that is
    shifted by up to two standard deviations toward the side of the plane that is nearer to the camera.
    """
    x = torch.arange(-half_width, half_width + SPACING / 2, SPACING)
    y = torch.arange(-half_height, half_height + SPACING / 2, SPACING)
    y, x = (t.flatten() for t in torch.meshgrid(y, x, indexing="ij"))
    means = torch.stack([x, y, torch.full_like(x, depth)], dim=1)
    pattern = torch.stack([torch.sin(1.6 * x), torch.sin(1.2 * y + 0.6 * x), torch.cos(x - 1.3 * y)], dim=1)
    rgb = 0.5 + 0.4 * pattern if color is None else color.expand(len(x), 3)
    scales = torch.tensor([SPACING, SPACING, SPACING / 100]).log().expand(len(x), 3)
    quats = torch.tensor([1.0, 0, 0, 0]).expand(len(x), 4)
    return Scene(means, quats, scales, torch.full_like(x, 8.0), (rgb - COLOR_OFFSET) / SH_C0, torch.zeros(len(x), 0, 3))


def joined(first: Scene, second: Scene) -> Scene:
    return Scene(*(torch.cat([getattr(first, f), getattr(second, f)]) for f in TENSORS))


def camera(position: tuple[float, float, float], target: tuple[float, float, float] = (0, 0, DEPTH)) -> Camera:
    up = torch.tensor([0.0, -1.0, 0.0])
    return look_at("view", torch.tensor(position), torch.tensor(target), up, width=64, height=48, focal=70.0)


def ring(count: int) -> list[Camera]:
    """Return cameras on an arc in front of a plane, all of them nearer to the same side of it."""
    return [camera((0.12 * i + 0.3, 0.04 * i + 0.1, 0.02 * i)) for i in range(count)]


def renders(scene: Scene, cameras: list[Camera], rasterizer: Rasterizer):
    """Return a function that renders views of the scene in its own colors."""

    def image(index: int) -> Tensor:
        rest = rest_colors(scene.sh_rest, scene.means, cameras[index])
        return rasterizer.render(view_colors(scene.sh_dc, rest), cameras[index])

    return image


def consistency_of(
    images: Callable[[int], Tensor],
    cameras: list[Camera],
    rasterizer: Rasterizer,
    scene: Scene,
    gap: int,
    lpips: Lpips | None = None,
    at_most: int | None = None,
) -> Consistency:
    """Return the consistency of a scene's images over all pairs of views, or evenly spread ones."""

    def depth(index: int) -> DepthMap:
        return expected_depth(scene, cameras[index], rasterizer)

    return consistency(
        gap,
        view_pairs(len(cameras), gap, at_most),
        lambda index: shown(images(index), cameras[index], rasterizer.device),
        lambda first, second: find_warp(depth(second), cameras[second], depth(first), cameras[first]),
        lpips,
    )


def measure(scene: Scene, cameras: list[Camera], gap: int = 1, lpips: Lpips | None = None) -> Consistency:
    rasterizer = make_rasterizer("cpu", scene)
    return consistency_of(renders(scene, cameras, rasterizer), cameras, rasterizer, scene, gap, lpips)


def homography(camera: Camera, other: Camera) -> Tensor:
    """Return the homography [3, 3] from one view's pixels to another's, induced by the plane z = DEPTH.

    See Hartley and Zisserman, result 13.1.
    """

    def intrinsics(c: Camera) -> Tensor:
        return torch.tensor([[c.fx, 0, c.cx], [0, c.fy, c.cy], [0, 0, 1]], dtype=torch.float64)

    relative = other.world_to_camera @ torch.linalg.inv(camera.world_to_camera)
    normal = camera.world_to_camera[:3, :3] @ torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    distance = DEPTH - camera.center[2]
    motion = relative[:3, :3] + torch.outer(relative[:3, 3], normal) / distance
    return intrinsics(other) @ motion @ torch.linalg.inv(intrinsics(camera))


def pixel_centers(camera: Camera) -> Tensor:
    """Return homogeneous pixel centers [H, W, 3]."""
    y, x = torch.meshgrid(torch.arange(camera.height), torch.arange(camera.width), indexing="ij")
    return torch.stack([x + 0.5, y + 0.5, torch.ones(x.shape)], dim=-1).double()


@pytest.mark.parametrize(
    ("first", "tolerance"),
    [
        (camera((0.1, -0.2, 0), (0.1, -0.2, DEPTH)), 1e-4),  # parallel to the plane: all Gaussians have the same depth
        (camera((1.5, -0.5, 0)), 0.7),  # slanted: mean depths are biased to nearer Gaussians, by up to two deviations
    ],
    ids=["parallel", "slanted"],
)
@pytest.mark.parametrize("name", ["cpu", "reference"])
def test_pixels_of_a_plane_move_by_its_homography(first: Camera, tolerance: float, name: str):
    scene = plane(5, 4, DEPTH)
    other = replace(camera((-0.6, 0.4, 0.5)), width=80, height=40, fx=90.0, cx=37.0, cy=22.0)
    depth = expected_depth(scene, first, make_rasterizer(name, scene))
    assert depth.known.all()
    x, y, z = project_pixels(depth.depth, 0, first, other)
    expected = pixel_centers(first) @ homography(first, other).T
    error = torch.stack([x, y], dim=-1) - expected[..., :2] / expected[..., 2:]
    assert float(error.abs().max()) < tolerance
    # Depth of the plane along the ray of each position in the other view.
    rays = torch.stack([(x - other.cx) / other.fx, (y - other.cy) / other.fy, torch.ones_like(x)], dim=-1)
    slope = (rays @ other.world_to_camera[:3, :3])[..., 2]
    torch.testing.assert_close(z, (DEPTH - other.center[2]) / slope, rtol=tolerance / 20, atol=0)


def test_warp_reproduces_the_image_of_the_other_camera():
    scene = plane(5, 4, DEPTH)
    cameras = [camera((0.4, -0.1, 0)), camera((1.0, -0.4, 0.4))]
    rasterizer = make_rasterizer("cpu", scene)
    images = renders(scene, cameras, rasterizer)
    depths = [expected_depth(scene, c, rasterizer) for c in cameras]
    warped, valid = find_warp(depths[1], cameras[1], depths[0], cameras[0]).apply(images(1))
    positions = pixel_centers(cameras[0]) @ homography(*cameras).T
    x, y = positions[..., 0] / positions[..., 2], positions[..., 1] / positions[..., 2]
    to_border = torch.stack([x - 0.5, 63.5 - x, y - 0.5, 47.5 - y]).amin(0)
    assert valid[to_border > 0.1].all()
    assert not valid[to_border < -0.1].any()
    assert 0.5 < float(valid.double().mean()) < 1
    assert float((warped - images(0))[valid].abs().max()) < 0.03
    assert not warped[~valid].any()


def test_row_bands_do_not_change_results(monkeypatch):
    scene = plane(5, 4, DEPTH)
    cameras = ring(2)
    rasterizer = make_rasterizer("cpu", scene)
    depths = [expected_depth(scene, c, rasterizer) for c in cameras]
    arguments = depths[1], cameras[1], depths[0], cameras[0]
    whole = find_warp(*arguments)
    monkeypatch.setattr("sgsst_core.quality.novel_views._BAND_PIXELS", 7 * 64)
    banded = find_warp(*arguments)
    for part in ("pixels", "sources", "weights"):
        assert torch.equal(getattr(whole, part), getattr(banded, part))


def test_pixels_hidden_in_the_other_view_are_masked():
    red, blue = torch.tensor([0.9, 0.1, 0.1]), torch.tensor([0.1, 0.1, 0.9])
    scene = joined(plane(6, 4, DEPTH, blue), plane(0.4, 0.4, 2.0, red))
    cameras = [camera((0, 0, 0)), camera((1, 0, 0), (1, 0, DEPTH))]
    rasterizer = make_rasterizer("cpu", scene)
    images = renders(scene, cameras, rasterizer)
    depths = [expected_depth(scene, c, rasterizer) for c in cameras]
    warped, valid = find_warp(depths[1], cameras[1], depths[0], cameras[0]).apply(images(1))
    # A point (X, Y, 4) of the plane is hidden from the camera at (c, 0, 0) if its ray meets the patch at z = 2.
    wall = (pixel_centers(cameras[0])[..., :2] - torch.tensor([32.0, 24.0])) / 70 * DEPTH

    def meets_patch(center: float, half: float) -> Tensor:
        return ((wall[..., 0] + center).abs() < 2 * half) & (wall[..., 1].abs() < 2 * half)

    edge = 3 * SPACING
    hidden = meets_patch(1, 0.4 - edge) & ~meets_patch(0, 0.4 + edge)
    visible = ~meets_patch(1, 0.4 + edge) & ~meets_patch(0, 0.4 + edge) & (wall[..., 0] > 1 - 31 / 70 * DEPTH)
    assert hidden.sum() > 50
    assert visible.sum() > 500
    assert not valid[hidden].any()
    assert valid[visible].all()
    careless, _ = find_warp(depths[1], cameras[1], depths[0], cameras[0], tolerance=1e9).apply(images(1))
    assert (careless - images(0))[hidden].abs().amax(-1).min() > 0.7  # the patch is painted onto the wall behind it
    assert measure(scene, cameras).rmse < 0.02
    assert float((warped - images(0))[valid].abs().max()) < 0.1


def test_identical_cameras_give_zero(lpips):
    # The scene's edge is in view; rounding must not exclude the pixels of its silhouette.
    result = measure(plane(1, 1, DEPTH), [camera((0.3, 0.2, 0))] * 3, lpips=lpips)
    assert len(result.pairs) == 2
    assert result.rmse < 1e-6
    assert result.lpips < 1e-9
    scene = plane(5, 4, DEPTH)
    assert measure(scene, [camera((0.3, 0.2, 0))] * 2).compared == 1.0


def test_inconsistent_colors_give_larger_values(lpips):
    scene = plane(5, 4, DEPTH)
    cameras = ring(3)
    rasterizer = make_rasterizer("cpu", scene)
    same = measure(scene, cameras, lpips=lpips)

    def flickering(index: int) -> Tensor:
        colors = torch.rand(len(scene), 3, generator=torch.Generator().manual_seed(index))
        return rasterizer.render(colors, cameras[index])

    different = consistency_of(flickering, cameras, rasterizer, scene, 1, lpips)
    assert same.rmse < 0.005
    assert same.lpips < 0.005
    assert different.rmse > 20 * same.rmse
    assert different.lpips > 5 * same.lpips
    assert different.compared == same.compared > 0.8


def test_rmse_covers_compared_pixels_of_clamped_images():
    scene = plane(5, 4, DEPTH)
    cameras = ring(2)
    rasterizer = make_rasterizer("cpu", scene)
    result = consistency_of(lambda i: torch.full((48, 64, 3), [0.25, 1.5][i]), cameras, rasterizer, scene, 1)
    assert result.rmse == pytest.approx(0.75, rel=1e-6)
    assert result.lpips is None


def test_pairs_without_overlap_have_no_value(lpips):
    scene = plane(2, 2, DEPTH)
    behind = camera((0, 0, 0), (0, 0, -DEPTH))  # looks away from the plane and sees nothing
    other_side = camera((0, 0, 3 * DEPTH))  # sees the plane from behind, which is the same surface
    cameras = [camera((0, 0, 0)), behind, behind, other_side, camera((0.1, 0, 3 * DEPTH))]
    result = measure(scene, cameras, lpips=lpips)
    assert [pair.rmse is None for pair in result.pairs] == [True, True, True, False]
    assert [pair.compared for pair in result.pairs[:3]] == [0, 0, 0]
    assert result.rmse == result.pairs[3].rmse
    assert result.lpips == result.pairs[3].lpips
    nothing = measure(scene, cameras[:2], lpips=lpips)
    assert (nothing.rmse, nothing.lpips, nothing.compared) == (None, None, 0.0)
    alone = measure(scene, cameras[:1], gap=LONG_RANGE)
    assert (alone.pairs, alone.rmse, alone.compared) == ([], None, 0.0)


def test_views_too_small_for_lpips_still_have_an_rmse(lpips):
    result = measure(plane(5, 4, DEPTH), [resized(c, 24) for c in ring(2)], lpips=lpips)
    assert result.lpips is None
    assert result.rmse < 0.05


def test_depth_does_not_depend_on_the_background():
    scene = plane(1, 1, DEPTH)
    view = camera((0.5, 0, 0))
    black, white = (
        expected_depth(scene, view, make_rasterizer("cpu", scene, background=rgb)) for rgb in ((0, 0, 0), (1, 1, 1))
    )
    assert torch.equal(black.known, white.known)
    assert black.known.any()
    assert not black.known.all()
    torch.testing.assert_close(black.depth, white.depth, rtol=1e-6, atol=0)


def test_distance_from_the_origin_does_not_change_values():
    scene = plane(5, 4, DEPTH)
    offset = torch.tensor([2.0**18, -(2.0**17), 2.0**19])
    moved = replace(scene, means=scene.means + offset)
    cameras = ring(3)
    far = []
    for view in cameras:
        pose = view.world_to_camera.clone()
        pose[:3, 3] -= pose[:3, :3] @ offset.double()
        far.append(replace(view, world_to_camera=pose))
    near_result, far_result = measure(scene, cameras), measure(moved, far)
    assert far_result.rmse == pytest.approx(near_result.rmse, rel=1e-3)
    assert far_result.compared == pytest.approx(near_result.compared, abs=1e-3)


def test_pairs_are_all_or_evenly_spread():
    assert view_pairs(5, 2) == [(0, 2), (1, 3), (2, 4)]
    assert view_pairs(2, 2) == view_pairs(0, 1) == []
    assert view_pairs(97, 7, at_most=3) == [(15, 22), (45, 52), (75, 82)]
    assert view_pairs(4, 1, at_most=9) == view_pairs(4, 1)
    for gap, at_most in ((0, None), (-1, None), (1, 0)):
        with pytest.raises(SettingsError, match="at least 1"):
            view_pairs(5, gap, at_most)


def test_pairs_are_compared_in_their_order():
    scene = plane(5, 4, DEPTH)
    cameras = ring(6)
    rasterizer = make_rasterizer("cpu", scene)
    result = consistency_of(lambda i: torch.full((48, 64, 3), i / 10), cameras, rasterizer, scene, 2)
    assert [(pair.first, pair.second) for pair in result.pairs] == view_pairs(6, 2)
    assert all(pair.rmse == pytest.approx(0.2, rel=1e-5) for pair in result.pairs)


def test_incomparable_images_are_refused_by_name():
    scene = plane(1, 1, DEPTH)
    rasterizer = make_rasterizer("cpu", scene)
    with pytest.raises(ValueError, match=r"'view': shape \(48, 63, 3\), not \(48, 64, 3\)"):
        consistency_of(lambda i: torch.zeros(48, 63, 3), ring(2), rasterizer, scene, 1)
    with pytest.raises(ValueError, match="'view': holds NaN"):
        consistency_of(lambda i: torch.full((48, 64, 3), math.nan), ring(2), rasterizer, scene, 1)


def test_real_scene_is_more_consistent_at_short_than_at_long_range(shared_data, lpips):
    folder = shared_data / "scenes" / "snowmiku_plush"
    scene = read_scene(folder / "point_cloud.ply").scene
    cameras = [resized(c, 200) for c in read_cameras(folder / "cameras.json")]
    rasterizer = make_rasterizer("cpu", scene)
    images = renders(scene, cameras, rasterizer)
    short = consistency_of(images, cameras, rasterizer, scene, SHORT_RANGE, lpips, at_most=3)
    long = consistency_of(images, cameras, rasterizer, scene, LONG_RANGE, lpips, at_most=3)
    assert short.rmse < 0.09
    assert short.rmse < 0.8 * long.rmse
    assert short.lpips < 0.8 * long.lpips
    assert short.compared > 2 * long.compared > 0.04
