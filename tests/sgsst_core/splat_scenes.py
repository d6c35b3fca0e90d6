"""Small synthetic scenes and cameras for tests of rasterizers."""

import math
from dataclasses import replace

import torch
from torch import Tensor

from sgsst_core.rasterizer import Rasterizer
from sgsst_core.rasterizer.base import camera_key
from sgsst_core.scene.camera import Camera
from sgsst_core.scene.gaussians import Scene


def camera(width: int = 70, height: int = 45, *, focal: float = 60.0, pose: Tensor | None = None) -> Camera:
    """Return a camera with an off-center principal point. By default it is at the origin and looks along +z."""
    pose = torch.eye(4, dtype=torch.float64) if pose is None else pose
    return Camera("test", width, height, focal, focal * 1.1, width / 2 + 1.3, height / 2 - 0.7, pose)


def rotated_pose(angle: float = 0.3) -> Tensor:
    """Return a pose with a translation and a rotation about a slanted axis."""
    axis = torch.tensor([1.0, 2.0, -0.5], dtype=torch.float64)
    x, y, z = (axis / axis.norm()).tolist()
    cross = torch.tensor([[0, -z, y], [z, 0, -x], [-y, x, 0]], dtype=torch.float64)
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3, :3] = torch.matrix_exp(angle * cross)
    pose[:3, 3] = torch.tensor([0.2, -0.1, 0.3])
    return pose


def cloud(count: int = 400, *, seed: int = 0, log_scale: float = -2.5, degree: int = 0, depth: float = 4.0) -> Scene:
    """Return Gaussians of all shapes and opacities in front of `camera()`, some behind, beside or very close to it."""
    generator = torch.Generator().manual_seed(seed)

    def normal(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=generator)

    means = normal(count, 3) * torch.tensor([1.5, 1.0, 1.5]) + torch.tensor([0.0, 0.0, depth])
    means[: count // 20] = 3 * normal(count // 20, 3)
    return Scene(
        means=means,
        quats=normal(count, 4),
        scales=log_scale + normal(count, 3),
        opacities=2.5 * normal(count),
        sh_dc=normal(count, 3),
        sh_rest=0.3 * normal(count, (degree + 1) ** 2 - 1, 3),
    )


def needles(count: int) -> Scene:
    """Return Gaussians at all angles that are a million times longer than wide; some extend far beyond the view."""
    scene, long = cloud(count, seed=9), torch.linspace(-3, 7, count)[:, None]
    return replace(scene, scales=torch.cat([long, long - math.log(1e6), long - math.log(1e6)], dim=1))


def displaced(scene: Scene, view: Camera, offset: Tensor) -> tuple[Scene, Camera]:
    """Return a scene and a camera that are both moved by an offset [3]; positions are rounded to float32."""
    pose = view.world_to_camera.clone()
    pose[:3, 3] -= pose[:3, :3] @ offset.double()
    means = (scene.means.double() + offset.double()).float()
    return replace(scene, means=means), replace(view, world_to_camera=pose)


def single(
    mean: tuple[float, float, float],
    *,
    opacity: float = 0.8,
    scales: tuple[float, float, float] = (0.1, 0.1, 0.1),
    quat: tuple[float, float, float, float] = (1.0, 0.0, 0.0, 0.0),
) -> Scene:
    """Return one Gaussian. Opacity and scales are activated values, not logits and logarithms as in files."""
    return together([(mean, opacity, scales, quat)])


def together(
    gaussians: list[tuple[tuple[float, ...], float, tuple[float, ...], tuple[float, ...]]],
) -> Scene:
    """Return a scene of Gaussians given as tuples (mean, opacity, scales, quat)."""
    means, opacities, scales, quats = zip(*gaussians, strict=True)
    count = len(means)
    return Scene(
        means=torch.tensor(means, dtype=torch.float32),
        quats=torch.tensor(quats, dtype=torch.float32),
        scales=torch.tensor(scales, dtype=torch.float64).log().float(),
        opacities=torch.tensor([math.log(o / (1 - o)) for o in opacities], dtype=torch.float32),
        sh_dc=torch.zeros(count, 3),
        sh_rest=torch.zeros(count, 0, 3),
    )


def colors_of(scene: Scene, seed: int = 5) -> Tensor:
    """Return random colors [N, 3] from 0 to 2, float32."""
    return 2 * torch.rand(len(scene), 3, generator=torch.Generator().manual_seed(seed))


def pixels_like(view: Camera, seed: int = 6) -> Tensor:
    """Return a random image gradient [h, w, 3], float32."""
    return torch.randn(view.height, view.width, 3, generator=torch.Generator().manual_seed(seed))


def is_cached(rasterizer: Rasterizer, view: Camera) -> bool:
    """Return whether a view has cached blend weights."""
    return camera_key(view) in rasterizer.caches["weights"].values
