"""Tests of camera paths for videos: they pass through the cameras, smoothly, whatever the cameras are."""

import itertools
import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from sgsst_core.errors import CameraError
from sgsst_core.quality.novel_views import neighbors
from sgsst_core.scene.camera import Camera, look_at
from sgsst_core.scene.camera_path import CameraPath, catmull_rom_tangents, framed, in_path_order, moved


def camera(center, rotation=None, focal=100.0, size=(64, 48)):
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
    return [camera(center, Rotation.from_rotvec(rng.normal(0, 0.5, 3)), rng.uniform(60, 200)) for center in centers]


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
    still = [camera([origin + index // 8, 0, 0], rotated(45 * index)) for index in range(24)]
    shaken = [camera([origin + index // 8, 0, 0] + noise[index], rotated(45 * index)) for index in range(24)]
    assert np.allclose(CameraPath(shaken).knots, CameraPath(still).knots, rtol=1e-2)
    assert len(neighbors(shaken)) == len(neighbors(still)) == 23


def test_jitter_of_a_pan_does_not_count_as_motion():
    noise = np.random.default_rng(0).normal(0, 1e-10, (24, 3))
    pan = [camera([1.0, 2.0, 3.0] + noise[index], rotated(15 * index)) for index in range(24)]
    assert np.allclose(np.diff(CameraPath(pan).knots), math.sqrt(0.5))
    assert len(neighbors(pan)) == 23


@pytest.mark.parametrize("count", [3, 5000])
def test_every_camera_of_an_arc_has_moved(count):
    angles = np.linspace(0, 2, count)
    centers = 1e3 + np.stack([np.sin(angles), np.cos(angles), angles], axis=1)
    assert moved(np.linalg.norm(np.diff(centers, axis=0), axis=1), centers).all()


def test_knots_are_centripetal_where_cameras_move():
    centers = np.array([[0, 0, 0], [1, 0, 0], [5, 0, 0], [5, 9, 0]], dtype=np.float64)
    steps = np.diff(CameraPath([camera(center) for center in centers]).knots)
    assert np.allclose(steps, np.sqrt(np.array([1, 4, 9]) / 4))


def test_positions_and_velocities_are_continuous_at_the_cameras():
    path = CameraPath(some_cameras())
    step = 1e-6
    for knot in path.knots[1:-1]:
        before, at, after = (c.center.numpy() for c in path.at(np.array([knot - step, knot, knot + step])))
        assert np.linalg.norm(after - before) < 1e-4
        assert np.allclose((at - before) / step, (after - at) / step, atol=1e-3)


def test_rotations_are_rotations_at_constant_speed_between_cameras():
    path = CameraPath([camera((0, 0, 0), rotated(10)), camera((1, 0, 0), rotated(70))])
    frames = path.evenly(7)
    rotations = np.stack([c.world_to_camera[:3, :3].numpy() for c in frames])
    assert np.allclose(rotations @ rotations.transpose(0, 2, 1), np.eye(3), atol=1e-12)
    assert np.allclose(np.linalg.norm(Rotation.from_matrix(rotations).as_quat(), axis=1), 1)
    angles = Rotation.from_matrix(rotations).as_euler("yxz", degrees=True)[:, 0]
    assert np.allclose(angles, np.linspace(10, 70, 7))


def test_rotation_takes_the_short_way_across_the_antipodal_sign():
    """Rotations of 170 and 190 degrees have quaternions of opposite signs, but are 20 degrees apart."""
    middle = CameraPath([camera((0, 0, 0), rotated(170)), camera((1, 0, 0), rotated(190))]).evenly(3)[1]
    assert np.allclose(middle.world_to_camera[:3, :3].numpy(), rotated(180).as_matrix(), atol=1e-12)


def test_half_turn_is_a_rotation_all_the_way():
    frames = CameraPath([camera((0, 0, 0)), camera((1, 0, 0), rotated(180))]).evenly(5)
    assert all(np.isclose(np.linalg.det(c.world_to_camera[:3, :3].numpy()), 1) for c in frames)
    steps = [
        (Rotation.from_matrix(a.world_to_camera[:3, :3].numpy()).inv()
         * Rotation.from_matrix(b.world_to_camera[:3, :3].numpy())).magnitude()
        for a, b in itertools.pairwise(frames)
    ]  # fmt: skip
    assert np.allclose(steps, math.pi / 4)


def test_one_camera_stands_still():
    only = camera((1, 2, 3), rotated(40))
    frames = CameraPath([only]).evenly(4)
    assert len(frames) == 4
    assert all(np.allclose(c.world_to_camera, only.world_to_camera, atol=1e-15) and c.fx == only.fx for c in frames)


def test_two_cameras_are_joined_by_a_straight_line():
    frames = CameraPath([camera((0, 0, 0)), camera((4, 2, 0))]).evenly(5)
    assert np.allclose([c.center.numpy() for c in frames], np.linspace((0, 0, 0), (4, 2, 0), 5))


def test_coinciding_cameras_count_once():
    a, b = camera((0, 0, 0)), camera((2, 0, 0), rotated(20))
    path = CameraPath([a, a, b, replace(b, name="again"), b])
    assert len(path.cameras) == 2
    assert np.isfinite(poses(path.evenly(9))).all()
    assert len(CameraPath([a, a]).evenly(3)) == 3


def test_a_camera_that_turns_or_zooms_in_place_takes_time():
    path = CameraPath([camera((0, 0, 0)), camera((0, 0, 0), rotated(30)), camera((0, 0, 0), rotated(30), focal=150)])
    assert np.allclose(path.knots, [0, 1, 2])
    assert np.isclose(path.at(np.array([1.5]))[0].fx, math.sqrt(100 * 150))


def test_cameras_of_another_size_get_the_frame_of_most_cameras():
    small = camera((1, 0, 0), focal=50.0, size=(32, 24))
    path = CameraPath([camera((0, 0, 0)), small, camera((2, 0, 0))])
    frame = path.at(path.knots[1:2])[0]
    assert (frame.width, frame.height, frame.cx, frame.cy) == (64, 48, 32, 24)
    assert frame.fx == pytest.approx(100)


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
    path = CameraPath([camera(center, rotated(angle)) for center, angle in given_poses])
    path_poses = poses(path.evenly(20))
    assert np.isfinite(path_poses).all()
    assert np.allclose(path_poses[:, :3, :3] @ path_poses[:, :3, :3].transpose(0, 2, 1), np.eye(3), atol=1e-9)


def test_tangents_of_points_on_a_parabola_are_exact():
    knots = np.array([0.0, 0.5, 2.0, 2.25])
    tangents = catmull_rom_tangents(knots, (knots**2)[:, None])
    assert np.allclose(tangents[1:-1, 0], 2 * knots[1:-1])


def ring(count):
    """Return cameras on half a circle."""
    up, origin = torch.tensor([0.0, 1.0, 0.0]), torch.zeros(3)
    angles = [math.pi * index / count for index in range(count)]
    return [
        look_at(str(i), torch.tensor([math.cos(a), 0.3, math.sin(a)]), origin, up, width=64, height=48, focal=50)
        for i, a in enumerate(angles)
    ]


def test_order_of_the_file_is_kept_unless_it_jumps():
    cameras = ring(20)
    assert in_path_order(cameras) == cameras
    assert in_path_order(cameras[::-1]) == cameras[::-1]
    shuffled = [cameras[(index * 7) % 20] for index in range(20)]
    assert [c.name for c in in_path_order(shuffled)] == [str(index) for index in range(20)]


def test_framed_cameras_keep_what_they_show_but_for_one_pixel():
    first = camera((0, 0, 0), size=(65, 49))
    same = framed(first, None, even=True)
    assert (same.width, same.height, same.fx, same.cx) == (64, 48, first.fx, first.cx)
    double = framed(first, 130, even=False)
    assert (double.width, double.height, double.fx, double.cx) == (130, 98, 200, 65)
