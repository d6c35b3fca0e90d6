"""Loss curve of a job with many steps on the GPU, compared with that of the same job on the CPU.

Both run at the same time; the CPU's job is a separate process in which no GPU is visible.
"""

from __future__ import annotations

import json
import math
import os
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import torch

from benchmarks.gpu.inputs import network_weights, small_weights
from benchmarks.gpu.part import QUICK, Findings, Sizes
from sgsst_core.bench.synthetic import surface_scene, texture, views
from sgsst_core.scene.camera import Camera, resized, spread
from sgsst_core.scene.gaussians import Scene
from sgsst_core.settings import make_settings
from sgsst_core.stylizing.stylizer import Stylizer

DATA = Path(__file__).resolve().parents[3] / "shared" / "data"
#: Bound on the relative difference from the CPU's loss, for means over rounds of all views. Single losses differ more:
#: Adam normalizes gradients, so a color whose gradient is only rounding error moves as far as any other.
BOUND = 1e-3
VIEWS = 6
#: Learning rate of the paper. At 0.02, an initial difference of 3e-7 in color grows to 1 % in the final loss.
LEARNING_RATE = 2.5e-3


def run(sizes: Sizes, findings: Findings) -> None:
    """Compare the loss curves of GPU and CPU."""
    quick = sizes == QUICK
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "losses.json"
        command = [sys.executable, "-m", "benchmarks.gpu.curve", str(path), *(["--quick"] if quick else [])]
        other = subprocess.Popen(command, env={**os.environ, "CUDA_VISIBLE_DEVICES": ""})
        try:
            scene, losses = follow(sizes, None if torch.cuda.is_available() else "triton")
            if other.wait() != 0:
                raise RuntimeError(f"the CPU's run ended with status {other.returncode}")
        finally:
            other.kill()
        expected = json.loads(path.read_text())
    findings.add("scene", scene)
    findings.add("losses", losses)
    findings.add("losses_on_the_cpu", expected)
    findings.add("largest_difference_of_a_step", largest_difference(losses, expected, 1))
    findings.check("loss", largest_difference(losses, expected, 1 if quick else VIEWS), BOUND)


def largest_difference(losses: list[float], expected: list[float], window: int) -> float:
    """Return the largest relative difference between geometric means over windows of steps."""
    differences = [math.log(a / b) for a, b in zip(losses, expected, strict=True)]
    starts = range(0, len(differences) - window + 1, window)
    return max(abs(sum(differences[start : start + window])) / window for start in starts)


def follow(sizes: Sizes, rasterizer: str | None) -> tuple[str, list[float]]:
    """Run the job, and return the scene's name and the loss of each step."""
    steps, side = sizes.curve
    name, scene, cameras = inputs(side, small=sizes == QUICK)
    settings = make_settings(
        "standard", steps_coarse=steps // 2, steps_sos=steps - steps // 2, learning_rate=LEARNING_RATE,
        scale_sampling=1, early_stop=False, cached_weights="none", coarsest_side=side // 2,
    )  # fmt: skip
    weights = small_weights() if sizes == QUICK else network_weights()
    style = texture(side, side, seed=3)
    stylizer = Stylizer.planned(scene, cameras, style, settings, weights=weights, rasterizer=rasterizer)
    return name, [stylizer.run_step().loss for _ in range(stylizer.job.total_steps)]


def inputs(side: int, *, small: bool) -> tuple[str, Scene, list[Camera]]:
    """Return a real scene with cameras if it is present and readable, otherwise a synthetic one."""
    folder = DATA / "scenes" / "snowmiku_plush"
    if not small and (folder / "cameras.json").is_file():
        try:
            from sgsst_core.files.camera_files import read_cameras
            from sgsst_core.files.scene_file import read_scene
        except ModuleNotFoundError as error:
            return f"synthetic, for want of {error.name}", *synthetic(side, small)
        scene = read_scene(folder / "point_cloud.ply").scene
        cameras = spread(read_cameras(folder / "cameras.json"), VIEWS)
        return folder.name, scene, [resized(camera, side) for camera in cameras]
    return "synthetic", *synthetic(side, small)


def synthetic(side: int, small: bool) -> tuple[Scene, list[Camera]]:
    """Return a ball and cameras whose views it fills."""
    return surface_scene(60 if small else 20_000, degree=1), views(1 if small else VIEWS, side, side * 3 // 4)


def main(arguments: list[str]) -> None:
    """Run the job on the CPU, and write the losses to the file named by the first argument."""
    sizes: Any = QUICK if "--quick" in arguments else Sizes()
    Path(arguments[0]).write_text(json.dumps(follow(sizes, "cpu")[1]))


if __name__ == "__main__":
    main(sys.argv[1:])
