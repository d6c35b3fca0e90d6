"""Time of an iteration by part on a real scene at 1280x720, and fraction of it spent outside the feature network.

python -m benchmarks.iteration SCENE.ply CAMERAS STYLE [--views 3] [--rounds 2]
"""

from __future__ import annotations

import argparse
from pathlib import Path

from benchmarks.machine import write_result
from benchmarks.rasterizer import resized
from sgsst_core import Stylizer, make_settings
from sgsst_core.files.camera_files import read_cameras
from sgsst_core.files.images import load_image
from sgsst_core.files.scene_file import read_scene
from sgsst_core.scene.camera import spread

NETWORK = ("vgg_forward", "vgg_backward", "network")


def main() -> None:
    """Measure, then print and store the figures."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("scene", type=Path)
    parser.add_argument("cameras", type=Path)
    parser.add_argument("style", type=Path)
    parser.add_argument("--views", type=int, default=3)
    parser.add_argument("--rounds", type=int, default=2)
    arguments = parser.parse_args()
    scene = read_scene(arguments.scene).scene
    cameras = [resized(camera) for camera in spread(read_cameras(arguments.cameras), arguments.views)]
    results = {}
    for rasterizer, kept in (("cpu", "none"), ("cached", "float32")):
        settings = make_settings("standard", steps_coarse=0, steps_sos=10_000, cached_weights=kept)
        stylizer = Stylizer.planned(scene, cameras, load_image(arguments.style), settings)
        for _ in cameras:  # the first round prepares views
            stylizer.run_step()
        seconds: dict[str, float] = {}
        for _ in range(arguments.rounds * len(cameras)):
            stylizer.run_step()
            for name, value in stylizer.timer.seconds.items():
                seconds[name] = seconds.get(name, 0.0) + value
        total = sum(seconds.values())
        steps = arguments.rounds * len(cameras)
        outside = 1 - sum(seconds.get(name, 0.0) for name in NETWORK) / total
        results[rasterizer] = {
            "seconds_per_step": {name: value / steps for name, value in seconds.items()},
            "share_outside_network": outside,
        }
        split = ", ".join(f"{name} {value / steps:.3f}" for name, value in sorted(seconds.items()))
        print(f"{rasterizer}: {total / steps:.2f} s a step, {outside:.1%} outside the network ({split})")
    write_result("iteration", {"scene": arguments.scene.parent.name, "gaussians": len(scene), "rasterizers": results})


if __name__ == "__main__":
    main()
