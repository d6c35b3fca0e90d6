"""Relative speed of the rasterizers `reference` (in float32) and `cpu` at 1280x720.

    python -m benchmarks.rasterizer [--scene point_cloud.ply --cameras cameras.json] [--repeats 15]

Each rasterizer computes one image from colors and one color gradient from an image gradient. Data that depend on the
geometry alone (projection, depth order, tile intersections) are prepared in advance and timed separately, because a job
computes them once per view. The rasterizers take turns, each on one thread and on all threads. The fastest turn counts,
because other programs disturbed it least.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from benchmarks.common import with_size, write_result
from sgsst_core.bench.device_checks import surface_scene
from sgsst_core.files.camera_files import read_cameras
from sgsst_core.files.scene_file import read_scene
from sgsst_core.orbit import orbit
from sgsst_core.rasterizer import Rasterizer
from sgsst_core.rasterizer.cpu import CpuRasterizer
from sgsst_core.rasterizer.reference import ReferenceRasterizer
from sgsst_core.scene.camera import Camera
from sgsst_core.scene.gaussians import Scene
from sgsst_core.scene.spherical_harmonics import scene_colors

WIDTH, HEIGHT = 1280, 720
DATA = Path(__file__).resolve().parents[2] / "shared" / "data" / "scenes"


def timed(action: Callable[[], object]) -> float:
    """Return the seconds of one call."""
    started = time.perf_counter()
    action()
    return time.perf_counter() - started


def both(rasterizer: Rasterizer, colors: Tensor, image_gradient: Tensor, camera: Camera, threads: int) -> float:
    """Return the seconds of forward plus backward pass on `threads` threads."""
    torch.set_num_threads(threads)
    render = timed(lambda: rasterizer.render(colors, camera))
    return render + timed(lambda: rasterizer.color_gradient(image_gradient, camera))


def measure(scene: Scene, camera: Camera, repeats: int) -> dict[str, Any]:
    """Run the rasterizers in turn on one view, and return the fastest seconds of each and the ratios between them."""
    colors = scene_colors(scene, camera)
    image_gradient = torch.randn(HEIGHT, WIDTH, 3, generator=torch.Generator().manual_seed(1))
    threads = sorted({1, torch.get_num_threads()})
    cpu = CpuRasterizer(scene)
    CpuRasterizer(scene).intersections(camera)  # compilation
    prepare = timed(lambda: cpu.intersections(camera))
    reference = ReferenceRasterizer(scene, dtype=torch.float32)
    reference.render(colors, camera)  # projection and sorting
    rasterizers: dict[str, Rasterizer] = {
        "reference": reference,
        "cpu": cpu,
    }
    seconds: dict[str, dict[int, list[float]]] = {name: {count: [] for count in threads} for name in rasterizers}
    for turn in range(repeats):
        for name, rasterizer in rasterizers.items():
            for count in threads:
                if turn < 2 or name != "reference":  # at seconds per call, two repetitions are enough
                    seconds[name][count].append(both(rasterizer, colors, image_gradient, camera, count))
    torch.set_num_threads(threads[-1])
    fastest = {name: {n: min(times) for n, times in runs.items()} for name, runs in seconds.items()}
    best = {name: min(runs.values()) for name, runs in fastest.items()}
    return {
        "gaussians": len(scene),
        "intersections": len(cpu.intersections(camera).ranks),
        "seconds": {name: round(value, 5) for name, value in best.items()},
        "seconds_by_threads": {name: {n: round(v, 5) for n, v in runs.items()} for name, runs in fastest.items()},
        "seconds_prepare": round(prepare, 5),
        "ratio_reference_to_cpu": round(best["reference"] / best["cpu"], 1),
    }


def scenes(arguments: argparse.Namespace) -> dict[str, tuple[Scene, Camera]]:
    """Return the requested scene; by default the real scenes that are present, or else a generated one."""
    if arguments.scene:
        scene = read_scene(arguments.scene).scene
        cameras = read_cameras(arguments.cameras) if arguments.cameras else orbit(scene, 8)
        return {arguments.scene.stem: (scene, with_size(cameras[0], WIDTH, HEIGHT))}
    by_name: dict[str, tuple[Scene, Camera]] = {}
    for name in ("snowmiku_plush", "playbot_synthetic_sh2"):
        if (DATA / name / "point_cloud.ply").is_file():
            scene = read_scene(DATA / name / "point_cloud.ply").scene
            file = DATA / name / "cameras.json"
            by_name[name] = (
                scene,
                with_size((read_cameras(file) if file.is_file() else orbit(scene, 8))[0], WIDTH, HEIGHT),
            )
    scene = surface_scene(100_000)
    return by_name or {"generated": (scene, with_size(orbit(scene, 8)[0], WIDTH, HEIGHT))}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--scene", type=Path, help="3DGS PLY; without it the real test scenes, or a generated one")
    parser.add_argument("--cameras", type=Path, help="camera file of the scene; its first camera is used")
    parser.add_argument("--repeats", type=int, default=15)
    arguments = parser.parse_args()
    figures: dict[str, Any] = {"width": WIDTH, "height": HEIGHT, "scenes": {}}
    for name, (scene, camera) in scenes(arguments).items():
        result = measure(scene, camera, arguments.repeats)
        figures["scenes"][name] = result
        print(f"{name}: {result['gaussians']:,} Gaussians, {result['intersections']:,} intersections")
        for run, value in result["seconds"].items():
            print(f"  {run:24} {value * 1e3:9.1f} ms")
        print(f"  prepared once a view     {result['seconds_prepare'] * 1e3:9.1f} ms")
        print(f"  reference / cpu          {result['ratio_reference_to_cpu']:9.1f}")
    print(write_result("rasterizer", figures))


if __name__ == "__main__":
    main()
