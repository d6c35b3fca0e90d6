"""Seconds on the CPU of listing, surveying and shading views of a scene of millions of Gaussians.

    python -m benchmarks.large_scene

The scene is generated: each of its Gaussians is copied several times, copies are moved by up to the Gaussian's size,
and scales are reduced so that the total volume stays the same. Everything is seeded. Figures are medians over views.
"""

import argparse
import math
import time
from collections.abc import Callable
from statistics import median

import torch

from benchmarks.common import parse, write_result
from sgsst_core.bench.device_checks import surface_scene
from sgsst_core.orbit import orbit
from sgsst_core.rasterizer.cpu import CpuRasterizer, build_tile_intersections
from sgsst_core.scene.camera import Camera
from sgsst_core.scene.gaussians import Scene
from sgsst_core.scene.spherical_harmonics import rest_colors

GAUSSIANS, VIEWS = 4_000_000, 6


def multiplied(scene: Scene, count: int) -> Scene:
    """Return `count` copies of a scene's Gaussians, moved by up to their size, with the same total volume."""
    generator = torch.Generator().manual_seed(0)
    copies = -(-count // len(scene))
    many = scene.subset(torch.arange(len(scene)).repeat(copies)[:count])
    moved = (2 * torch.rand(count, 3, generator=generator) - 1) * many.scales.exp()
    scales = many.scales - math.log(copies) / 3
    return Scene(many.means + moved, many.quats, scales, many.opacities, many.sh_dc, many.sh_rest)


def main() -> None:
    """Measure, print and store."""
    parse(argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter))
    small = surface_scene(50_000, degree=3)
    scene = multiplied(small, GAUSSIANS)
    rasterizer = CpuRasterizer(scene, max_intersection_bytes=0)  # caches the last view only
    measured: dict[str, Callable[[Camera], object]] = {
        "lists_seconds": lambda camera: build_tile_intersections(scene, camera),
        "survey_seconds": rasterizer.survey,
        "harmonics_seconds": lambda camera: rest_colors(scene.sh_rest, scene.means, camera),
    }
    seconds: dict[str, list[float]] = {name: [] for name in measured}
    for camera in orbit(small, VIEWS, width=990, height=742):
        for name, action in measured.items():
            action(camera)  # compiles, and lists the tile intersections that the survey finds cached
            started = time.perf_counter()
            action(camera)
            seconds[name].append(time.perf_counter() - started)
    figures = {"gaussians": GAUSSIANS, **{name: median(each) for name, each in seconds.items()}}
    print(figures)
    print(write_result("large_scene", {"scene": "generated", "views": VIEWS, "sizes": [figures]}))


if __name__ == "__main__":
    main()
