"""Synthetic scenes and cameras for tests of orbits, with y pointing down as in captured scenes."""

import math
from dataclasses import replace

import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from sgsst_core.scene.camera import Camera, look_at
from sgsst_core.scene.gaussians import Scene

UP = (0.0, -1.0, 0.0)


def scene_of(means: Tensor, size: float | Tensor = 0.02, opacities: Tensor | None = None) -> Scene:
    """Return Gaussians at `means` with standard deviations `size` (a number, or [N, 3])."""
    n = len(means)
    sizes = torch.full((n, 3), float(size)) if not isinstance(size, Tensor) else size
    return Scene(
        means.float(),
        torch.tensor([1.0, 0, 0, 0]).repeat(n, 1),
        sizes.float().log(),
        torch.full((n,), 3.0) if opacities is None else opacities,
        torch.zeros(n, 3),
        torch.zeros(n, 0, 3),
    )


def joined(*scenes: Scene) -> Scene:
    """Return all Gaussians of several scenes."""
    names = ("means", "quats", "scales", "opacities", "sh_dc", "sh_rest")
    return Scene(*(torch.cat([getattr(scene, name) for scene in scenes]) for name in names))


def box(low: tuple[float, float, float], high: tuple[float, float, float], count: int = 1500, seed: int = 0) -> Tensor:
    """Return points [count, 3] that are uniformly distributed over the faces of a box."""
    generator = torch.Generator().manual_seed(seed)
    corner = torch.tensor(low, dtype=torch.float32)
    sides = torch.tensor(high, dtype=torch.float32) - corner
    areas = torch.tensor([sides[1] * sides[2], sides[0] * sides[2], sides[0] * sides[1]])
    axis = torch.multinomial(areas, count, replacement=True, generator=generator)
    points = torch.rand(count, 3, generator=generator)
    points[torch.arange(count), axis] = (torch.rand(count, generator=generator) < 0.5).float()
    return corner + points * sides


def ball(center: tuple[float, float, float], radius: float, count: int = 800, seed: int = 0) -> Tensor:
    """Return points [count, 3] on a sphere."""
    generator = torch.Generator().manual_seed(seed)
    directions = torch.nn.functional.normalize(torch.randn(count, 3, generator=generator), dim=1)
    return torch.tensor(center, dtype=torch.float32) + radius * directions


def figure() -> Scene:
    """Return a standing human figure of height 1.8, with feet apart, on the floor y = 0 at the origin."""
    parts = [
        box((-0.30, -0.08, -0.12), (-0.12, 0.0, 0.16), 400, 1),  # feet
        box((0.12, -0.08, -0.12), (0.30, 0.0, 0.16), 400, 2),
        box((-0.26, -0.90, -0.08), (-0.10, -0.08, 0.08), 900, 3),  # legs
        box((0.10, -0.90, -0.08), (0.26, -0.08, 0.08), 900, 4),
        box((-0.28, -1.50, -0.12), (0.28, -0.90, 0.12), 1500, 5),
        ball((0.0, -1.66, 0.0), 0.14, 700, 6),
    ]
    return scene_of(torch.cat(parts))


def ground(width: float = 2.0, count: int = 3000) -> Scene:
    """Return a flat, rough patch of ground below y = 0."""
    generator = torch.Generator().manual_seed(9)
    points = (torch.rand(count, 3, generator=generator) - 0.5) * torch.tensor([width, 0.01, width])
    return scene_of(points, torch.tensor([0.03, 0.005, 0.03]).repeat(count, 1))


def moved(scene: Scene, turn: Rotation, factor: float = 1.0, shift: tuple[float, float, float] = (0, 0, 0)) -> Scene:
    """Return the scene rotated, then scaled, then translated."""
    matrix = torch.from_numpy(turn.as_matrix())
    quats = (turn * Rotation.from_quat(scene.quats.double().roll(-1, 1).numpy())).as_quat()
    return replace(
        scene,
        means=(factor * scene.means.double() @ matrix.T + torch.tensor(shift)).float(),
        quats=torch.from_numpy(quats).roll(1, 1).float(),
        scales=scene.scales + math.log(factor),
    )


def ring(count: int, radius: float = 3.0) -> list[Camera]:
    """Return cameras on a circle around the origin that look at it."""
    origin, up = torch.zeros(3), torch.tensor([0.0, -1.0, 0.0])
    angles = [2 * math.pi * i / count for i in range(count)]
    return [
        look_at(
            str(i),
            torch.tensor([radius * math.sin(a), 0, radius * math.cos(a)]),
            origin,
            up,
            width=64,
            height=48,
            focal=60,
        )
        for i, a in enumerate(angles)
    ]
