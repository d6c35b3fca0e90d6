"""Time and memory on the CPU of reading, surveying, rendering and completing scenes of millions of Gaussians.

    python -m benchmarks.large_scene [--millions 1 4 12] [--views 4] [--parts reading survey ...] [--write FOLDER]

Large scenes are made from the plush scene, or from a generated one if it is missing: each Gaussian is copied several
times, copies are moved by up to the Gaussian's size, and scales are reduced so that the total volume stays the same.
Everything is seeded. Each size runs in a separate process, so that it has its own memory peak. Optimized code is
compared with a plain version in the same process; only the ratio counts, because seconds depend on the machine's other
load. `--write` keeps the scene files for use with `sgsst`.
"""

from __future__ import annotations

import argparse
import json
import math
import multiprocessing
import statistics
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import torch
from scipy.spatial import cKDTree

from benchmarks.common import parse, write_result
from sgsst_core.bench.device_checks import surface_scene, texture
from sgsst_core.budget import peak_memory
from sgsst_core.devices import Timer
from sgsst_core.features.network_weights import load_network_weights
from sgsst_core.files.camera_files import read_cameras
from sgsst_core.files.scene_file import read_scene, write_scene
from sgsst_core.orbit import orbit
from sgsst_core.rasterizer import Rasterizer
from sgsst_core.rasterizer.cpu import CpuRasterizer
from sgsst_core.rasterizer.projection import build_tile_intersections
from sgsst_core.scene.camera import Camera, spread
from sgsst_core.scene.gaussians import Scene
from sgsst_core.scene.spherical_harmonics import reference_rest_colors, rest_colors
from sgsst_core.scene.stored_harmonics import held
from sgsst_core.settings import make_settings
from sgsst_core.style import Style
from sgsst_core.stylizing.job import JobInputs
from sgsst_core.stylizing.planner import plan_job
from sgsst_core.stylizing.stylizer import NEIGHBORS, Stylizer, neighbors_change

DATA = Path(__file__).resolve().parents[2] / "shared" / "data" / "scenes"
PARTS = ("reading", "harmonics", "survey", "first step", "unseen")
_PLUSH = DATA / "snowmiku_plush"
#: Number of Gaussians on which the slow reference of spherical harmonics is timed.
_HARMONICS_SAMPLE = 200_000
#: Longer side in pixels of a job's views.
_RESOLUTION = 990


def timed(action: Callable[[], object]) -> float:
    """Return the seconds of one call."""
    started = time.perf_counter()
    action()
    return time.perf_counter() - started


def multiplied(scene: Scene, count: int) -> Scene:
    """Return `count` copies of a scene's Gaussians, moved by up to their size, with the same total volume."""
    generator = torch.Generator().manual_seed(0)
    copies = -(-count // len(scene))
    many = scene.subset(torch.arange(len(scene)).repeat(copies)[:count])
    moved = (2 * torch.rand(count, 3, generator=generator) - 1) * many.scales.exp()
    scales = many.scales - math.log(copies) / 3
    return Scene(many.means + moved, many.quats, scales, many.opacities, many.sh_dc, many.sh_rest)


def small_scene() -> tuple[Scene, list[Camera], str]:
    """Return the scene to copy Gaussians from, its cameras and its name."""
    if _PLUSH.is_dir():
        return read_scene(_PLUSH / "point_cloud.ply").scene, read_cameras(_PLUSH / "cameras.json"), "plush"
    scene = surface_scene(50_000, degree=3)
    return scene, orbit(scene, 24, width=990, height=742), "generated"


def middle(action: Callable[[Camera], object], cameras: list[Camera]) -> float:
    """Return the median over views of the seconds of one call per view."""
    return statistics.median(timed(lambda camera=camera: action(camera)) for camera in cameras)  # type: ignore[misc]


def measure_harmonics(scene: Scene, cameras: list[Camera]) -> dict[str, float]:
    """Time the evaluation of spherical harmonics for a view; measure the speedup over the reference on a subset."""
    part = scene.subset(torch.arange(min(_HARMONICS_SAMPLE, len(scene))))
    rest_colors(part.sh_rest, part.means, cameras[0])  # compiles
    slow = middle(
        lambda camera: reference_rest_colors(held(part.sh_rest), part.means, camera, scene.sh_degree), cameras
    )
    fast = middle(lambda camera: rest_colors(part.sh_rest, part.means, camera), cameras)
    whole = middle(lambda camera: rest_colors(scene.sh_rest, scene.means, camera), cameras)
    return {"harmonics_seconds": whole, "ratio_reference_to_harmonics": slow / fast}


def measure_views(scene: Scene, cameras: list[Camera]) -> dict[str, float]:
    """Time a view's tile intersections (on one thread and on all threads), its rendering and its survey.

    The survey makes a single pass, which is compared with separate passes for coverage and gradient.
    """
    CpuRasterizer(scene.subset(torch.arange(100))).survey(cameras[0])  # compiles
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    alone = middle(lambda camera: build_tile_intersections(scene, camera), cameras)
    torch.set_num_threads(threads)
    isects = middle(lambda camera: build_tile_intersections(scene, camera), cameras)
    rasterizer = CpuRasterizer(scene, max_intersection_bytes=0)  # caches the last view only
    by_part: dict[str, list[float]] = {"render": [], "gradient": [], "plain": [], "survey": []}
    colors = torch.rand(len(scene), 3, generator=torch.Generator().manual_seed(2))
    for camera in cameras:
        image = rasterizer.render(colors, camera)
        by_part["render"].append(timed(lambda camera=camera: rasterizer.render(colors, camera)))  # type: ignore[misc]
        gradient = timed(lambda image=image, camera=camera: rasterizer.color_gradient(image, camera))  # type: ignore[misc]
        by_part["gradient"].append(gradient)
        by_part["plain"].append(timed(lambda camera=camera: Rasterizer.survey(rasterizer, camera)))  # type: ignore[misc]
        by_part["survey"].append(timed(lambda camera=camera: rasterizer.survey(camera)))  # type: ignore[misc]
    seconds = {f"{name}_seconds": statistics.median(values) for name, values in by_part.items()}
    return {
        "lists_seconds": isects,
        "ratio_lists_one_thread_to_all": alone / isects,
        **seconds,
        "ratio_plain_to_survey": seconds["plain_seconds"] / seconds["survey_seconds"],
        "ratio_plain_view_to_surveyed": (alone + seconds["plain_seconds"]) / (isects + seconds["survey_seconds"]),
    }


def measure_unseen(scene: Scene, cameras: list[Camera]) -> dict[str, float]:
    """Time the neighbor search for unseen Gaussians, and compare it with a single-threaded one in file order."""
    rasterizer = CpuRasterizer(scene, max_intersection_bytes=0)
    weights = torch.zeros(len(scene), dtype=torch.float64)
    for camera in cameras:
        weights += rasterizer.survey(camera)[1].double()
    seen = weights > 0

    def plain() -> None:
        tree = cKDTree(scene.means[seen].double().numpy())
        tree.query(scene.means[~seen].double().numpy(), k=NEIGHBORS)

    slow = timed(plain)
    fast = timed(lambda: neighbors_change(scene.means, scene.sh_dc, weights))
    return {"unseen": int((~seen).sum()), "unseen_seconds": fast, "ratio_plain_to_unseen": slow / fast}


def measure_first_step(scene: Scene, cameras: list[Camera]) -> dict[str, float]:
    """Time a job by part, from a loaded scene to the end of the first step, with network weights installed."""
    settings = make_settings(max_resolution=_RESOLUTION)
    timer, weights, style = Timer(), load_network_weights("auto"), Style.of(texture(512, 512))
    job = plan_job(JobInputs(scene, cameras, style, settings, weights=weights), timer=timer)
    with timer("preparing"):
        stylizer = Stylizer(job)
    with timer("first_step"):
        stylizer.run_step()
    return {f"{name}_seconds_of_a_job": seconds for name, seconds in timer.seconds.items()}


def measure_reading(scene: Scene, folder: Path | None) -> dict[str, float]:
    """Time the reading of a scene file, which is kept in `folder` unless that is None."""
    with tempfile.TemporaryDirectory() as temporary:
        path = (folder or Path(temporary)) / f"{len(scene) / 1e6:g}m.ply"
        write_scene(path, scene)
        return {"file_bytes": path.stat().st_size, "read_seconds": timed(lambda: read_scene(path))}


def measure(count: int, views: int, parts: list[str], folder: Path | None) -> dict[str, float]:
    """Return all figures of one scene size; `parts` selects measurements from `PARTS`."""
    small, cameras, _ = small_scene()
    scene, cameras = multiplied(small, count), spread(cameras, views)
    figures: dict[str, float] = {"gaussians": count}
    if "reading" in parts:
        figures |= measure_reading(scene, folder)
    if "harmonics" in parts:
        figures |= measure_harmonics(scene, cameras)
    if "survey" in parts:
        figures |= measure_views(scene, cameras)
    if "first step" in parts:
        figures |= measure_first_step(scene, cameras)
    if "unseen" in parts:
        figures |= measure_unseen(scene, cameras)
    figures["peak_gb"] = peak_memory() / 1e9
    return figures


def main() -> None:
    """Measure each size in a separate process, then print and store the figures."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--millions", type=float, nargs="+", default=[1, 4, 12])
    parser.add_argument("--views", type=int, default=4)
    parser.add_argument("--parts", nargs="+", choices=PARTS, default=list(PARTS))
    parser.add_argument("--write", type=Path, metavar="FOLDER", help="keep the files that reading is measured on")
    arguments = parse(parser)
    sizes = []
    for millions in arguments.millions:
        # Spawned, not forked, so that the process has its own memory peak and threads.
        with multiprocessing.get_context("spawn").Pool(1) as pool:
            sizes.append(pool.apply(measure, (int(millions * 1e6), arguments.views, arguments.parts, arguments.write)))
        print(json.dumps(sizes[-1], indent=2), flush=True)
    print(write_result("large_scene", {"scene": small_scene()[2], "views": arguments.views, "sizes": sizes}))


if __name__ == "__main__":
    main()
