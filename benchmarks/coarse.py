"""Rasterization time of a phase 1 step: speedup of the cached coarse operator over rasterization at full size.

    python -m benchmarks.coarse point_cloud.ply [--cameras cameras.json] [--side 1280] [--scales 1 2] [--repeats 9]

Each method computes the image at a coarse scale, and the color gradient from an image gradient at that scale. `cpu` and
`cached` render at full size and apply the box average and its adjoint; `coarse` computes both directly. The methods
take turns on the same view, and the fastest turn counts, because other programs disturbed it least. Tile intersections
are prepared in advance. `coarse` also prepares its operator; that time is measured together with the first image.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from benchmarks.machine import write_result
from benchmarks.rasterizer import timed
from sgsst_core.files.camera_files import read_cameras
from sgsst_core.files.scene_file import read_scene
from sgsst_core.orbit.cameras import orbit
from sgsst_core.rasterizer import Rasterizer
from sgsst_core.rasterizer.cached import CachedRasterizer
from sgsst_core.rasterizer.coarse import CoarseRasterizer
from sgsst_core.rasterizer.cpu import CpuRasterizer
from sgsst_core.scene.camera import Camera, resized
from sgsst_core.scene.gaussians import Scene
from sgsst_core.scene.pyramid import add_upscaled_, downscale
from sgsst_core.scene.spherical_harmonics import scene_colors


def at_full_size(rasterizer: Rasterizer, colors: Tensor, gradient: Tensor, camera: Camera, scale: int) -> None:
    """Compute image and color gradient at a scale through the full-size view."""
    downscale(rasterizer.render(colors, camera), scale)
    whole = torch.zeros((camera.height, camera.width, 3))
    add_upscaled_(whole, gradient, scale)
    rasterizer.color_gradient(whole, camera)


def measure(scene: Scene, camera: Camera, scale: int, repeats: int) -> dict[str, Any]:
    """Return for one view the fastest seconds of each method, the operator's preparation time, and the speedups."""
    colors = scene_colors(scene, camera)
    gradient = torch.randn(camera.height >> scale, camera.width >> scale, 3, generator=torch.Generator().manual_seed(1))
    cpu, cached = CpuRasterizer(scene), CachedRasterizer(scene)
    coarse = CoarseRasterizer(cpu, scale)

    def with_operator(rasterizer: CoarseRasterizer = coarse) -> None:
        rasterizer.render(colors, camera)
        rasterizer.color_gradient(gradient, camera)

    ways: dict[str, Callable[[], None]] = {
        "cpu": lambda: at_full_size(cpu, colors, gradient, camera, scale),
        "cached": lambda: at_full_size(cached, colors, gradient, camera, scale),
        "coarse": with_operator,
    }
    seconds: dict[str, list[float]] = {name: [] for name in ways}
    builds: list[float] = []
    for way in ways.values():  # compilation, intersections, cached weights
        way()
    for _ in range(repeats):
        for name, way in ways.items():
            seconds[name].append(timed(way))
        fresh = CoarseRasterizer(cpu, scale)
        builds.append(timed(lambda fresh=fresh: fresh.render(colors, camera)))  # type: ignore[misc]
    fastest = {name: min(times) for name, times in seconds.items()}
    return {
        "gaussians": len(scene),
        "view": f"{camera.width}x{camera.height}",
        "scale": scale,
        "seconds": {name: round(value, 5) for name, value in fastest.items()},
        "seconds_build": round(min(builds), 5),
        "bytes_kept": {"cached": cached.cached_bytes, "coarse": coarse.cached_bytes},
        "ratio_cpu_to_coarse": round(fastest["cpu"] / fastest["coarse"], 2),
        "ratio_cached_to_coarse": round(fastest["cached"] / fastest["coarse"], 2),
        "ratio_build_to_cpu": round(min(builds) / fastest["cpu"], 2),
        "ratio_bytes_cached_to_coarse": round(cached.cached_bytes / coarse.cached_bytes, 2),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("scene", type=Path, help="3DGS PLY")
    parser.add_argument("--cameras", type=Path, help="camera file of the scene, else an orbit; its first is used")
    parser.add_argument("--side", type=int, default=1280, help="longer side of the view in pixels")
    parser.add_argument("--scales", type=int, nargs="+", default=[1, 2])
    parser.add_argument("--repeats", type=int, default=9)
    arguments = parser.parse_args()
    scene = read_scene(arguments.scene).scene
    cameras = read_cameras(arguments.cameras) if arguments.cameras else orbit(scene, 8)
    results = [measure(scene, resized(cameras[0], arguments.side), s, arguments.repeats) for s in arguments.scales]
    for result in results:
        print(f"{arguments.scene}: {result['gaussians']:,} Gaussians, {result['view']}, scale {result['scale']}")
        print(f"  cpu / coarse            {result['ratio_cpu_to_coarse']:8.2f}")
        print(f"  cached / coarse         {result['ratio_cached_to_coarse']:8.2f}")
        print(f"  build / cpu             {result['ratio_build_to_cpu']:8.2f}")
        print(f"  cached / coarse, bytes  {result['ratio_bytes_cached_to_coarse']:8.2f}")
    print(write_result("coarse", {"scene": arguments.scene.parent.name, "results": results}))


if __name__ == "__main__":
    main()
