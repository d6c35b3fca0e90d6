"""Tests of cameras, camera paths, lenses, and panoramas: their faces, and panoramas made of faces."""

import itertools
import math
from dataclasses import replace
from typing import Any

import numpy as np
import pycolmap
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from torch import Tensor

from sgsst_core.errors import CameraError, SettingsError
from sgsst_core.files.camera_files import _colmap_lens
from sgsst_core.files.camera_folder import ColmapCamera
from sgsst_core.files.images import undistort
from sgsst_core.quality.novel_views import neighbors
from sgsst_core.rasterizer import make_rasterizer
from sgsst_core.scene.camera import (
    FACES,
    OVERLAP,
    Camera,
    CameraPath,
    Lens,
    checked_cameras,
    cube_faces,
    faces_to_render,
    fit_cameras,
    framed,
    in_path_order,
    join_faces,
    level,
    look_at,
    resized,
    spread,
    undistorted,
)
from sgsst_core.scene.spherical_harmonics import scene_colors
from sgsst_core.settings import make_settings
from tests.sgsst_core.objects import ball, ring, scene_of
from tests.sgsst_core.rasterizer.splat_reference import ReferenceRasterizer


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
    "nan": (torch.full((4, 4), torch.nan), K, 990, "NaN or infinite"),
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
    assert checked_cameras([good])[0].world_to_camera is good.world_to_camera
    single = replace(good, world_to_camera=good.world_to_camera.float())
    assert checked_cameras((single,))[0].world_to_camera.dtype == torch.float64
    for wrong in ("cameras.json", good, [good, "b"], torch.eye(4)[None]):
        with pytest.raises(CameraError, match="Read them with `load_cameras`"):
            checked_cameras(wrong)  # type: ignore[arg-type]
    with pytest.raises(CameraError, match="a: its transform is not"):
        checked_cameras([replace(good, world_to_camera=torch.eye(3))])


def posed(center, rotation=None, focal=100.0, size=(64, 48)):
    """Return a camera at a center with a world-to-camera rotation."""
    matrix = (Rotation.identity() if rotation is None else rotation).as_matrix()
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3, :3] = torch.from_numpy(matrix)
    pose[:3, 3] = torch.from_numpy(-matrix @ np.asarray(center, dtype=np.float64))
    return Camera("view", *size, focal, focal, size[0] / 2, size[1] / 2, pose)


def rotated(degrees, axis="y"):
    """Return a rotation about an axis."""
    return Rotation.from_euler(axis, degrees, degrees=True)


def some_cameras(count=7, seed=0):
    """Return cameras at irregular distances, with rotations and focal lengths of their own."""
    rng = np.random.default_rng(seed)
    centers = np.cumsum(rng.exponential(1.0, (count, 3)), axis=0)
    return [posed(center, Rotation.from_rotvec(rng.normal(0, 0.5, 3)), rng.uniform(60, 200)) for center in centers]


def barry_goldman(knots, points, time):
    """Return a point of a Catmull-Rom spline by the pyramid of Barry and Goldman, for inner segments."""
    first = np.searchsorted(knots, time, side="right") - 2
    t, p = knots[first : first + 4], points[first : first + 4]

    def mix(a, b, start, end):
        return ((end - time) * a + (time - start) * b) / (end - start)

    a = [mix(p[i], p[i + 1], t[i], t[i + 1]) for i in range(3)]
    b = [mix(a[i], a[i + 1], t[i], t[i + 2]) for i in range(2)]
    return mix(*b, t[1], t[2])


def poses(cameras):
    """Return the transforms [n, 4, 4] of cameras."""
    return torch.stack([each.world_to_camera for each in cameras]).numpy()


def test_path_passes_through_the_cameras():
    cameras = some_cameras()
    path = CameraPath(cameras)
    positions_at_knots = path.at(path.knots)
    assert np.allclose(poses(positions_at_knots), poses(cameras), rtol=0, atol=1e-12)
    assert np.allclose([c.fx for c in positions_at_knots], [c.fx for c in cameras], rtol=1e-12)
    assert {c.world_to_camera.dtype for c in positions_at_knots} == {torch.float64}


def test_positions_are_those_of_the_barry_goldman_pyramid():
    cameras = some_cameras()
    path = CameraPath(cameras)
    times = np.linspace(path.knots[1], path.knots[-2], 50)[:-1]
    centers = np.stack([c.center.numpy() for c in cameras])
    expected = np.stack([barry_goldman(path.knots, centers, time) for time in times])
    assert np.allclose([c.center.numpy() for c in path.at(times)], expected, rtol=0, atol=1e-12)


@pytest.mark.parametrize(("origin", "jitter"), [(0.0, 1e-3), (4.2e6, 1e-10)])
def test_jitter_at_stations_does_not_change_the_timing(origin, jitter):
    noise = np.random.default_rng(0).normal(0, jitter, (24, 3))
    still = [posed([origin + index // 8, 0, 0], rotated(45 * index)) for index in range(24)]
    shaken = [posed([origin + index // 8, 0, 0] + noise[index], rotated(45 * index)) for index in range(24)]
    assert np.allclose(CameraPath(shaken).knots, CameraPath(still).knots, rtol=1e-2)
    assert len(neighbors(shaken)) == len(neighbors(still)) == 23


def test_rotation_has_constant_speed_between_cameras():
    path = CameraPath([posed((0, 0, 0), rotated(10)), posed((1, 0, 0), rotated(70))])
    frames = path.evenly(7)
    rotations = np.stack([c.world_to_camera[:3, :3].numpy() for c in frames])
    angles = Rotation.from_matrix(rotations).as_euler("yxz", degrees=True)[:, 0]
    assert np.allclose(angles, np.linspace(10, 70, 7))


def test_rotation_takes_the_short_way_across_the_antipodal_sign():
    """Rotations of 170 and 190 degrees have quaternions of opposite signs, but are 20 degrees apart."""
    middle = CameraPath([posed((0, 0, 0), rotated(170)), posed((1, 0, 0), rotated(190))]).evenly(3)[1]
    assert np.allclose(middle.world_to_camera[:3, :3].numpy(), rotated(180).as_matrix(), atol=1e-12)


def test_one_camera_stands_still():
    only = posed((1, 2, 3), rotated(40))
    frames = CameraPath([only]).evenly(4)
    assert len(frames) == 4
    assert all(np.allclose(c.world_to_camera, only.world_to_camera, atol=1e-15) and c.fx == only.fx for c in frames)


def test_two_cameras_are_joined_by_a_straight_line():
    frames = CameraPath([posed((0, 0, 0)), posed((4, 2, 0))]).evenly(5)
    assert np.allclose([c.center.numpy() for c in frames], np.linspace((0, 0, 0), (4, 2, 0), 5))


def test_a_camera_that_turns_or_zooms_in_place_takes_time():
    path = CameraPath([posed((0, 0, 0)), posed((0, 0, 0), rotated(30)), posed((0, 0, 0), rotated(30), focal=150)])
    assert np.allclose(path.knots, [0, 1, 2])
    assert np.isclose(path.at(np.array([1.5]))[0].fx, math.sqrt(100 * 150))


def test_cameras_of_another_size_get_the_frame_of_most_cameras():
    small = posed((1, 0, 0), focal=50.0, size=(32, 24))
    path = CameraPath([posed((0, 0, 0)), small, posed((2, 0, 0))])
    frame = path.at(path.knots[1:2])[0]
    assert (frame.width, frame.height, frame.cx, frame.cy, frame.fx) == (64, 48, 32, 24, pytest.approx(100))


def test_no_cameras_are_refused():
    with pytest.raises(CameraError, match="at least one"):
        CameraPath([])


@settings(max_examples=60, deadline=None)
@given(
    st.lists(
        st.tuples(
            st.tuples(*[st.sampled_from([0.0, 1e-12, 1e-3, 1.0, -5.0, 1e6])] * 3),
            st.sampled_from([0, 1e-9, 1, 90, 179.999999, 180]),
        ),
        min_size=1,
        max_size=6,
    )
)
def test_any_cameras_make_a_finite_path(given_poses):
    path = CameraPath([posed(center, rotated(angle)) for center, angle in given_poses])
    path_poses = poses(path.evenly(20))
    assert np.isfinite(path_poses).all()
    assert np.allclose(path_poses[:, :3, :3] @ path_poses[:, :3, :3].transpose(0, 2, 1), np.eye(3), atol=1e-9)


def test_order_of_the_file_is_kept_unless_it_jumps():
    cameras = ring(40)[:20]
    assert (in_path_order(cameras), in_path_order(cameras[::-1])) == (cameras, cameras[::-1])
    shuffled = [cameras[(index * 7) % 20] for index in range(20)]
    assert [c.name for c in in_path_order(shuffled)] == [str(index) for index in range(20)]


def test_framed_cameras_keep_what_they_show_but_for_one_pixel():
    first = posed((0, 0, 0), size=(65, 49))
    same = framed(first, None, even=True)
    assert (same.width, same.height, same.fx, same.cx) == (64, 48, first.fx, first.cx)
    double = framed(first, 130, even=False)
    assert (double.width, double.height, double.fx, double.cx) == (130, 98, 200, 65)


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


def with_lens(lens: Lens) -> Camera:
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
    view = undistorted(with_lens(lens(model)))
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
    whole = with_lens(lens(model))
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
    small = undistort(stripes, resized(undistorted(with_lens(lens("RADIAL"))), 80))
    assert small.shape[1] == 80
    assert float((small - 0.5).abs()[:, 2:-2].max()) < 0.03


@pytest.mark.parametrize(
    "values", [(float("inf"),), (-1e6,), (1e300, 1e300), (0, 0, 5.0, 5.0), (0, 0, 0, 0, 0, -900.0)]
)
def test_lenses_that_leave_no_image_are_refused(values: tuple[float, ...]) -> None:
    hostile = Lens.of("OPENCV", values, (WIDTH, HEIGHT), (260.0, 260.0, 160.0, 120.0))
    with pytest.raises(CameraError, match=r"'view': its distortion \(OPENCV .*leaves no image"):
        undistorted(with_lens(hostile))


def test_folded_borders_are_cropped() -> None:
    """Beyond a radius of 0.58, this lens maps the image back onto itself, and its corners lie inside the photo."""
    folding = with_lens(Lens.of("RADIAL", (-1.0,), (WIDTH, HEIGHT), (200.0, 200.0, 160.0, 120.0)))
    u, v = corners(folding)
    assert 0 < float(min(u.min(), v.min())) <= float(max(u.max(), v.max())) < 1
    view = undistorted(folding)
    radius = np.hypot(view.width / 2 / view.fx, view.height / 2 / view.fy)
    assert 0.5 < radius <= 1 / np.sqrt(3) + 0.01


def test_lenses_without_a_formula_are_refused() -> None:
    view = with_lens(lens("FOV", [260.0, 260.0, 160.0, 120.0, 0.9]))
    with pytest.raises(CameraError, match=r"photos of the camera model FOV cannot be undistorted here.*image_undist"):
        undistorted(view)


POSE = look_at(
    "pose", torch.tensor([0.3, -0.2, 0.1]), torch.tensor([2.0, 0.7, 1.0]), torch.tensor([0.1, -1.0, 0.2]),
    width=1, height=1, focal=1.0,
).world_to_camera  # fmt: skip


def rays(face: Camera) -> Tensor:
    """Return the directions [h, w, 3] float64 of a face's pixel centers, in the axes of its panorama."""
    x = (torch.arange(face.width, dtype=torch.float64) + 0.5 - face.cx) / face.fx
    y = (torch.arange(face.height, dtype=torch.float64) + 0.5 - face.cy) / face.fy
    across, down = torch.meshgrid(x, y, indexing="xy")
    axes = torch.tensor(FACES[face.name.rpartition(".")[2]], dtype=torch.float64).view(3, 3)
    local = torch.stack([across, down, torch.ones_like(across)], dim=-1)
    return torch.nn.functional.normalize(local, dim=-1) @ axes


def directions(width: int) -> Tensor:
    """Return the directions [width / 2, width, 3] float64 of a panorama's pixel centers."""
    longitude = ((torch.arange(width, dtype=torch.float64) + 0.5) / width - 0.5) * 2 * math.pi
    latitude = (0.5 - (torch.arange(width // 2, dtype=torch.float64) + 0.5) / (width // 2)) * math.pi
    phi, theta = torch.meshgrid(latitude, longitude, indexing="ij")
    return torch.stack([phi.cos() * theta.sin(), -phi.sin(), phi.cos() * theta.cos()], dim=2)


def reference_sample(image: NDArray[np.float64], x: float, y: float) -> NDArray[np.float64]:
    """Interpolate a panorama [h, w, 3] bilinearly at a position in pixels; beyond a pole lies the other side."""
    height, width = image.shape[:2]
    left, top = math.floor(x - 0.5), math.floor(y - 0.5)
    total = np.zeros(3)
    for row, weight_y in ((top, top + 1.5 - y), (top + 1, y - top - 0.5)):
        for column, weight_x in ((left, left + 1.5 - x), (left + 1, x - left - 0.5)):
            beyond = not 0 <= row < height
            inside = min(max(row, 0), height - 1)
            total += weight_x * weight_y * image[inside, (column + beyond * (width // 2)) % width]
    return total


def test_faces_are_named_as_seen_from_inside() -> None:
    middles = {"front": [0, 0, 1], "right": [1, 0, 0], "back": [0, 0, -1], "left": [-1, 0, 0], "up": [0, -1, 0]}
    middles["down"] = [0, 1, 0]
    faces = cube_faces("a/b.jpg", 640, 320, POSE)
    assert [face.name for face in faces] == [f"a/b.jpg.{name}" for name in middles]
    for face, middle in zip(faces, middles.values(), strict=True):
        rotation = face.world_to_camera[:3, :3] @ POSE[:3, :3].T
        assert torch.allclose(rotation[2], torch.tensor(middle, dtype=torch.float64), atol=1e-12)
        assert float(torch.linalg.det(rotation)) == pytest.approx(1)
        assert torch.allclose(face.center, Camera("", 1, 1, 1.0, 1.0, 0.5, 0.5, POSE).center)
        assert face.lens
        axes = torch.tensor(face.lens.coefficients, dtype=torch.float64).view(3, 3)
        assert torch.allclose(rotation, axes, atol=1e-12)
        assert face.panorama == "a/b.jpg"
        assert undistorted(face) is face


@pytest.mark.parametrize(("width", "side"), [(1, 1), (640, 204), (4096, 1304)])
def test_middles_of_faces_have_the_density_of_the_panorama(width: int, side: int) -> None:
    for face in cube_faces("a", width, max(1, width // 2), POSE):
        assert (face.width, face.height, face.fx, face.cy) == (side, side, side / 2, side / 2)
        assert face.fx == pytest.approx(width / (2 * math.pi), abs=0.5)


@pytest.mark.parametrize("size", [(640, 320), (1000, 400)])
def test_positions_in_the_panorama_match_colmap(size: tuple[int, int]) -> None:
    reference = pycolmap.Camera(model="EQUIRECTANGULAR", width=size[0], height=size[1], params=size)
    for face in cube_faces("a", *size, POSE):
        ends = torch.linspace(-1, 1, 21, dtype=torch.float64)
        x, y = torch.meshgrid(ends, ends, indexing="xy")
        assert face.lens
        u, v = face.lens.positions(x, y)
        axes = torch.tensor(face.lens.coefficients, dtype=torch.float64).view(3, 3)
        local = torch.stack([x, y, torch.ones_like(x)], dim=-1) @ axes
        expected = np.array([reference.img_from_cam(ray) for ray in local.view(-1, 3).numpy()]).reshape(21, 21, 2)
        across = np.abs(u.numpy() * size[0] - expected[..., 0])
        assert np.minimum(across, size[0] - across).max() < 1e-6  # the edges of the panorama are the same meridian
        assert np.abs(v.numpy() * size[1] - expected[..., 1]).max() < 1e-6


def test_directions_of_pixels_match_colmap() -> None:
    camera = pycolmap.Camera(model="EQUIRECTANGULAR", width=64, height=32, params=[64, 32])
    expected = [[camera.cam_ray_from_img([x + 0.5, y + 0.5]) for x in range(64)] for y in range(32)]
    assert np.allclose(directions(64).numpy(), np.array(expected), atol=1e-12)


def test_sampled_faces_match_a_loop_over_pixels() -> None:
    photo = torch.rand(32, 64, 3, generator=torch.Generator().manual_seed(1))
    for face in cube_faces("a", 64, 32, POSE):
        expected = np.empty((face.height, face.width, 3))
        for row, column in np.ndindex(face.height, face.width):
            x, y, z = rays(face)[row, column].tolist()
            across, down = math.atan2(x, z) / (2 * math.pi) + 0.5, math.atan2(y, math.hypot(x, z)) / math.pi + 0.5
            expected[row, column] = reference_sample(photo.double().numpy(), across * 64, down * 32)
        assert np.abs(undistort(photo, face).numpy() - expected).max() < 1e-5


def test_joined_faces_match_a_loop_over_pixels() -> None:
    width, generator = 48, torch.Generator().manual_seed(2)
    faces = faces_to_render(POSE, width)
    side = faces[0].width
    images = torch.rand(6, side, side, 3, generator=generator)
    expected = np.empty((width // 2, width, 3))
    axes = np.array(list(FACES.values())).reshape(6, 3, 3)
    for row, column in np.ndindex(width // 2, width):
        total, colors = 0.0, np.zeros(3)
        for image, (across, down, forward) in zip(images, axes @ directions(width)[row, column].numpy(), strict=True):
            weight = 1 + OVERLAP - max(abs(across), abs(down)) / forward if forward > 0 else 0.0
            if weight > 0:
                x, y = (slope / forward * faces[0].fx + faces[0].cx - 0.5 for slope in (across, down))
                left, top = math.floor(x), math.floor(y)
                pixels = image.double().numpy()
                rows = [(1 - x % 1) * pixels[each, left] + x % 1 * pixels[each, left + 1] for each in (top, top + 1)]
                colors += weight * ((1 - y % 1) * rows[0] + y % 1 * rows[1])
                total += weight
        expected[row, column] = colors / total
    assert np.abs(join_faces(list(images), width).numpy() - expected).max() < 1e-5


def test_rendered_panorama_matches_views_of_single_pixels() -> None:
    """Compare with float64 renders by cameras that look straight at a pixel, at seams between faces and elsewhere.

    Half a pixel would be an error of 0.09. Larger Gaussians differ more, everywhere: they are projected linearly.
    """
    colors = torch.randn(150, 3, generator=torch.Generator().manual_seed(4))
    scene = replace(scene_of(ball((0, 0, 0), 3.0, 150), 0.06), sh_dc=colors)
    width, fast, reference = 1024, make_rasterizer("cpu", scene), ReferenceRasterizer(scene)
    faces = faces_to_render(torch.eye(4, dtype=torch.float64), width)
    panorama = join_faces([fast.render(scene_colors(scene, face), face) for face in faces], width).double()
    sight = directions(width)
    closest = sight.abs().sort(dim=-1).values
    seams, bright = closest[..., 2] - closest[..., 1] < 0.01, panorama.amax(dim=2) > 0.2
    for pixels in ((seams & bright).nonzero(), (~seams & bright).nonzero()):
        chosen = pixels[:: len(pixels) // 60]
        errors = []
        for row, column in chosen.tolist():
            up = torch.tensor([0.0, 0.0, 1.0] if abs(float(sight[row, column, 1])) > 0.9 else [0.0, -1.0, 0.0])
            view = look_at("a", torch.zeros(3), sight[row, column], up, width=3, height=3, focal=width / (2 * math.pi))
            exact = reference.render(scene_colors(scene, view).double(), view)[1, 1]
            errors.append(float((panorama[row, column] - exact).abs().max()))
        assert max(errors) < 0.04


def test_level_panoramas_keep_position_and_heading() -> None:
    camera = Camera("tilted", 64, 48, 50.0, 50.0, 32.0, 24.0, POSE)
    up = torch.tensor([0.0, -2.0, 0.0], dtype=torch.float64)
    pose = level(camera, up)
    assert torch.allclose(pose[:3, :3] @ pose[:3, :3].T, torch.eye(3, dtype=torch.float64), atol=1e-12)
    assert torch.allclose(pose[1, :3], torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64))
    assert torch.allclose(-pose[:3, :3].T @ pose[:3, 3], camera.center)
    heading = torch.nn.functional.normalize(POSE[2, :3] * torch.tensor([1.0, 0.0, 1.0]), dim=0)
    assert torch.allclose(pose[2, :3], heading)
    with pytest.raises(CameraError, match=r"'tilted' looks along its up direction"):
        level(camera, POSE[2, :3])
