"""Tests of transformed scenes: renders are those of a transformed camera."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from sgsst_core.files.formats.frame import Frame
from sgsst_core.rasterizer import make_rasterizer
from sgsst_core.scene.gaussians import TENSORS, Scene
from sgsst_core.scene.spherical_harmonics import scene_colors
from tests.sgsst_core.splat_scenes import camera, cloud, rotated_pose


def matrix(scale: float = 1.0) -> np.ndarray:
    pose = rotated_pose(2.1).numpy()
    pose[:3, :3] *= scale
    return pose


def applied(frame: Frame, scene: Scene) -> Scene:
    arrays = {name: getattr(scene, name).numpy().copy() for name in TENSORS}
    frame.apply(arrays)
    return Scene(*(torch.from_numpy(array) for array in arrays.values()))


@pytest.mark.parametrize("scale", [1.0, 0.3])
def test_transformed_scene_and_camera_give_the_same_image(scale: float) -> None:
    scene, view = cloud(300, degree=3), camera(90, 70)
    moved = matrix(scale)
    pose = view.world_to_camera.clone()
    pose[:3, :3] = pose[:3, :3] @ torch.from_numpy(moved[:3, :3].T / scale)
    pose[:3, 3] = scale * view.world_to_camera[:3, 3] - pose[:3, :3] @ torch.from_numpy(moved[:3, 3])
    images = []
    for each, seen in (
        (scene, view),
        (applied(Frame.of(moved), scene), replace(view, world_to_camera=pose)),
    ):
        near = 0.2 if seen is view else 0.2 * scale
        images.append(make_rasterizer("reference", each, near=near).render(scene_colors(each, seen), seen))
    assert float((images[0] - images[1]).abs().max()) < 2e-4


def test_rotation_by_180_degrees_is_exact() -> None:
    scene = cloud(100, degree=3)
    frame = Frame.of(np.diag([-1.0, -1.0, 1.0, 1.0]))
    once = applied(frame, scene)
    assert torch.equal(once.means, scene.means * torch.tensor([-1.0, -1.0, 1.0]))
    assert torch.equal(held_abs(once), held_abs(scene))
    twice = applied(frame, once)
    for name in ("means", "scales", "sh_rest"):
        assert torch.equal(getattr(twice, name), getattr(scene, name))
    assert torch.equal(twice.quats, -scene.quats)


def held_abs(scene: Scene) -> torch.Tensor:
    return torch.as_tensor(scene.sh_rest).abs()


@pytest.mark.parametrize(
    "linear", [np.diag([1.0, 1.0, -1.0]), np.diag([1.0, 2.0, 1.0]), np.zeros((3, 3)), np.full((3, 3), np.nan)]
)
def test_mirrors_and_distortions_are_refused(linear: np.ndarray) -> None:
    distorted = np.eye(4)
    distorted[:3, :3] = linear
    with pytest.raises(ValueError, match="the transformation"):
        Frame.of(distorted)
