"""360-degree panoramas: the cube faces that stand for one as views, and a panorama made of renders of its faces.

A panorama is an equirectangular image: longitude grows by 360 degrees from its left to its right edge, latitude falls
by 180 degrees from its upper to its lower edge, and its middle lies in the direction of the z axis. Pixel centers are
at half-integers. This is the model EQUIRECTANGULAR of COLMAP ("Camera Models" of its documentation) and, with OpenGL's
axes, of nerfstudio.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor

from sgsst_core.scene.camera import Camera, Lens, look_at

#: Axes of the faces (right, down, forward) in those of the panorama. Names are as seen from inside.
FACES: dict[str, tuple[float, ...]] = {
    "front": (1, 0, 0, 0, 1, 0, 0, 0, 1),
    "right": (0, 0, -1, 0, 1, 0, 1, 0, 0),
    "back": (-1, 0, 0, 0, 1, 0, 0, 0, -1),
    "left": (0, 0, 1, 0, 1, 0, -1, 0, 0),
    "up": (1, 0, 0, 0, 0, 1, 0, -1, 0),
    "down": (1, 0, 0, 0, 0, -1, 0, 1, 0),
}
#: Slope beyond the edge of a face up to which it is rendered and fades into its neighbors. Large Gaussians differ
#: between two faces, because they are projected linearly and blended in the order of their depth on each.
OVERLAP = 0.25
#: Rows of a panorama that are sampled at once.
_ROWS = 64


def cube_faces(name: str, width: int, height: int, world_to_camera: Tensor) -> list[Camera]:
    """Return the cameras of a panorama's cube faces, of 90 degrees each, in the order of `FACES`.

    Their side is width / pi, rounded up: in its middle, a face has as many pixels per degree as the panorama.

    Args:
        name: Name of the panorama; those of the faces are NAME.front and so on.
        width, height: Size of the panorama in pixels.
        world_to_camera: Pose of the panorama, [4, 4] float64.
    """
    side = math.ceil(width / math.pi)
    middle = side / 2
    whole = width / (2 * math.pi), height / math.pi, width / 2, height / 2
    faces = []
    for face, axes in FACES.items():
        rotation = torch.eye(4, dtype=torch.float64)
        rotation[:3, :3] = torch.tensor(axes, dtype=torch.float64).view(3, 3)
        lens = Lens("EQUIRECTANGULAR", "equirectangular", axes, width, height, *whole)
        pose = rotation @ world_to_camera
        faces.append(Camera(f"{name}.{face}", side, side, middle, middle, middle, middle, pose, lens=lens))
    return faces


def level(camera: Camera, up: Tensor) -> Tensor:
    """Return the pose of a level panorama at a camera's position, with the camera's heading in its middle.

    Args:
        up: [3], direction toward the upper edge; need not be a unit vector.

    Returns:
        World-to-camera transform, [4, 4] float64.

    Raises:
        CameraError: If the camera looks along `up`.
    """
    forward = camera.center + camera.world_to_camera[2, :3]
    pose = look_at(camera.name, camera.center, forward, up, width=1, height=1, focal=1.0).world_to_camera.clone()
    down = -up / up.norm()
    pose[1:3, :3] = torch.stack([down, torch.linalg.cross(pose[0, :3], down)])
    pose[:3, 3] = -pose[:3, :3] @ camera.center
    return pose


def faces_to_render(world_to_camera: Tensor, width: int) -> list[Camera]:
    """Return the cameras whose images `join_faces` takes, for a panorama of this pose and even width in pixels."""
    faces = cube_faces("panorama", width, width // 2, world_to_camera)
    border = math.ceil(OVERLAP * faces[0].fx) + 1
    side, middle = faces[0].width + 2 * border, faces[0].cx + border
    return [replace(face, width=side, height=side, cx=middle, cy=middle) for face in faces]


def join_faces(images: Sequence[Tensor], width: int) -> Tensor:
    """Return the panorama [width / 2, width, 3] float32 of six images, sampled bilinearly.

    A face has the weight max(0, 1 + OVERLAP - max(|x|, |y|)) at a point (x, y, 1) before its camera, relative to the
    sum over all faces.

    Args:
        images: Images [side, side, 3] float32 of the cameras of `faces_to_render`.
        width: Width of the panorama in pixels, even.
    """
    axes = torch.tensor(list(FACES.values()), dtype=torch.float64).view(6, 3, 3)
    longitude = ((torch.arange(width, dtype=torch.float64) + 0.5) / width - 0.5) * 2 * math.pi
    panorama = torch.zeros(width // 2, width, 3)
    scale = math.ceil(width / math.pi) / images[0].shape[0]
    for top, rows in enumerate(panorama.split(_ROWS)):
        latitude = 0.5 - (top * _ROWS + torch.arange(len(rows), dtype=torch.float64) + 0.5) / (width // 2)
        phi, theta = torch.meshgrid(latitude * math.pi, longitude, indexing="ij")
        rays = torch.stack([phi.cos() * theta.sin(), -phi.sin(), phi.cos() * theta.cos()], dim=-1)
        local = torch.einsum("fij,rwj->frwi", axes, rays)
        slopes = local[..., :2] / local[..., 2:]
        weights = torch.where(local[..., 2] > 0, (1 + OVERLAP - slopes.abs().amax(dim=-1)).clamp_min(0), 0.0)
        weights /= weights.sum(dim=0)
        for image, slope, weight in zip(images, slopes, weights, strict=True):
            seen = weight > 0
            planes, grid = image.permute(2, 0, 1)[None], (scale * slope[seen]).float()[None, None]
            sampled = torch.nn.functional.grid_sample(planes, grid, "bilinear", "border", align_corners=False)
            rows[seen] += weight[seen, None].float() * sampled[0, :, 0].T
    return panorama
