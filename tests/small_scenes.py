"""Tiny scenes, cameras and files, with which an optimizer step takes a few hundredths of a second."""

import json
import math
from pathlib import Path

import torch
from PIL import Image
from torch import Tensor

from sgsst_core.files.scene_file import write_scene
from sgsst_core.scene.camera import Camera, look_at
from sgsst_core.scene.gaussians import Scene
from tests.sgsst_core.synthetic_images import synthetic_image

WIDTH, HEIGHT = 64, 48


#: Content of a file that Git LFS did not download.
LFS_POINTER = "version https://git-lfs.github.com/spec/v1\noid sha256:0123\nsize 12345\n"


def wall(columns: int = 28, rows: int = 22, sh_degree: int = 0) -> Scene:
    """Return a wall of flat Gaussians at z = 3 that fills every view of `cameras`."""
    generator = torch.Generator().manual_seed(5)
    x = torch.linspace(-2.4, 2.4, columns)
    y = torch.linspace(-1.9, 1.9, rows)
    grid = torch.stack(torch.meshgrid(x, y, indexing="xy"), dim=-1).reshape(-1, 2)
    count = len(grid)
    rest = (sh_degree + 1) ** 2 - 1
    return Scene(
        means=torch.cat([grid, torch.full((count, 1), 3.0)], dim=1),
        quats=torch.tensor([1.0, 0, 0, 0]).repeat(count, 1),
        scales=torch.tensor([0.16, 0.16, 0.01]).log().repeat(count, 1),
        opacities=torch.full((count,), 5.0),
        sh_dc=torch.randn(count, 3, generator=generator),
        sh_rest=0.1 * torch.randn(count, rest, 3, generator=generator),
    )


def ball(count: int = 300) -> Scene:
    """Return a ball of radius 0.7 at z = 3 without a background, like an object scan."""
    generator = torch.Generator().manual_seed(6)
    directions = torch.nn.functional.normalize(torch.randn(count, 3, generator=generator), dim=1)
    return Scene(
        means=0.7 * directions + torch.tensor([0.0, 0.0, 3.0]),
        quats=torch.tensor([1.0, 0, 0, 0]).repeat(count, 1),
        scales=torch.full((count, 3), math.log(0.1)),
        opacities=torch.full((count,), 4.0),
        sh_dc=torch.randn(count, 3, generator=generator),
        sh_rest=torch.zeros(count, 0, 3),
    )


def cameras(count: int = 3, width: int = WIDTH, height: int = HEIGHT) -> list[Camera]:
    """Return cameras side by side at z = 0 that look at (0, 0, 3)."""
    target, up = torch.tensor([0.0, 0.0, 3.0]), torch.tensor([0.0, -1.0, 0.0])
    positions = torch.linspace(-0.3, 0.3, count) if count > 1 else torch.zeros(1)
    return [
        look_at(f"view_{i}", torch.tensor([float(x), 0.0, 0.0]), target, up, width=width, height=height, focal=width)
        for i, x in enumerate(positions)
    ]


def blind_camera() -> Camera:
    """Return a camera that looks away from the scene."""
    there = torch.tensor([0.0, 0.0, -3.0])
    up = torch.tensor([0.0, -1.0, 0.0])
    return look_at("blind", torch.zeros(3), there, up, width=WIDTH, height=HEIGHT, focal=WIDTH)


def style() -> Tensor:
    """Return a style image [96, 80, 3] float32."""
    return synthetic_image(96, 80, seed=1, dtype=torch.float32)


def write_files(folder: Path, scene: Scene | None = None, views: list[Camera] | None = None) -> tuple[Path, Path, Path]:
    """Write scene.ply, cameras.json (in INRIA's format) and style.png, and return their paths."""
    ply, file, image = folder / "scene.ply", folder / "cameras.json", folder / "style.png"
    write_scene(ply, scene or wall())
    entries = [
        {
            "id": index,
            "img_name": camera.name,
            "width": camera.width,
            "height": camera.height,
            "position": camera.center.tolist(),
            "rotation": camera.world_to_camera[:3, :3].T.tolist(),
            "fx": camera.fx,
            "fy": camera.fy,
        }
        for index, camera in enumerate(views or cameras())
    ]
    file.write_text(json.dumps(entries))
    Image.fromarray((style() * 255).to(torch.uint8).numpy()).save(image)
    return ply, file, image


def input_files(folder: Path, scene: Scene | None = None, views: list[Camera] | None = None) -> dict[str, Path]:
    """Write these files, and return their paths by their role in a job."""
    return dict(zip(("scene", "cameras", "style"), write_files(folder, scene, views), strict=True))
