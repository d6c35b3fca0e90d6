"""Tests of panoramas: directions of pixels, faces taken from a panorama, and panoramas made of faces."""

import math
from dataclasses import replace

import numpy as np
import pycolmap
import pytest
import torch
from numpy.typing import NDArray
from torch import Tensor

from sgsst_core.errors import CameraError
from sgsst_core.files.photos import undistort
from sgsst_core.rasterizer import make_rasterizer
from sgsst_core.rasterizer.reference import ReferenceRasterizer
from sgsst_core.scene.camera import Camera, look_at, undistorted
from sgsst_core.scene.panorama import FACES, OVERLAP, cube_faces, faces_to_render, join_faces, level
from sgsst_core.scene.spherical_harmonics import scene_colors
from tests.sgsst_core.objects import ball, scene_of

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


def test_panorama_of_faces_has_neither_offset_nor_seams() -> None:
    images = [rays(face).float() for face in faces_to_render(POSE, 512)]
    assert float((join_faces(images, 512) - directions(512)).abs().max()) < 1e-4


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
