"""Comparison of training backgrounds and color initializations for object scans, by a network outside the loss.

python -m benchmarks.training_background SCENE.ply STYLE NAME [--ways background,random+warm,...] [--seeds 0,1]

Each item of `--ways` is a training background (background, random, palette); with "+warm", colors are initialized from
the style's color distribution. All runs have the same views around the object and the same number of steps. Results are
judged on novel views (`sgsst_core.quality.judge`), and added to benchmarks/results/training_background.json, under
NAME. With several seeds, figures are means.
"""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path
from typing import Any

import torch

from benchmarks.judged import compare_rows, judged, write_sheet
from sgsst_core import Stylizer, make_settings
from sgsst_core.files.images import load_image
from sgsst_core.files.scene_file import read_scene
from sgsst_core.orbit.cameras import orbit
from sgsst_core.quality.judge import Judge
from sgsst_core.quality.lpips import Lpips
from sgsst_core.rasterizer import make_rasterizer
from sgsst_core.scene.camera import Camera
from sgsst_core.scene.gaussians import Scene
from sgsst_core.stylizing.steps import mean_loss

WAYS = ("background", "background+warm", "random", "random+warm", "palette", "palette+warm")
#: Number of judged views.
JUDGED = 6
COLUMNS = ("style", "color_distance", "background_sensitivity", "content", "saturated", "loss", "seconds")


def main() -> None:
    """Run all jobs, then print and store the figures."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scene", type=Path)
    parser.add_argument("style", type=Path)
    parser.add_argument("name", help="of the pair, in the results")
    parser.add_argument("--ways", default=",".join(WAYS))
    parser.add_argument("--seeds", default="0")
    parser.add_argument("--views", type=int, default=12)
    parser.add_argument("--width", type=int, default=256)
    parser.add_argument("--height", type=int, default=384)
    parser.add_argument("--steps", type=int, default=80)
    parser.add_argument("--up", default="0,-1,0")
    parser.add_argument("--settings", default="{}", help="JSON, on top of the standard preset's")
    parser.add_argument("--out", type=Path, help="folder for a contact sheet and the colors")
    arguments = parser.parse_args()
    scene, style = read_scene(arguments.scene).scene, load_image(arguments.style)
    up = [float(part) for part in arguments.up.split(",")]
    ring = orbit(scene, 2 * arguments.views, width=arguments.width, height=arguments.height, up=up)
    judge = _judge(scene, style, ring[1::2])
    description = {"scene": arguments.scene.parent.name, "style": arguments.style.name, "views": arguments.views}
    description |= {"size": [arguments.width, arguments.height], "steps": arguments.steps}
    base = {"precision": "bfloat16", "steps_coarse": 0, "steps_sos": arguments.steps, "early_stop": False}

    def run(way: str, seed: int) -> tuple[torch.Tensor, dict[str, float]]:
        settings = base | _settings(way) | {"seed": seed} | json.loads(arguments.settings)
        return _run(judge, scene, ring[::2], style, settings)

    unstylized, ways = (scene.sh_dc, judged(judge, scene.sh_dc)), arguments.ways.split(",")
    colors = compare_rows(
        "training_background", arguments.name, description, COLUMNS, unstylized, ways, arguments.seeds, run
    )
    if arguments.out:
        write_sheet(arguments.out, arguments.name, judge, style, colors)


def _settings(way: str) -> dict[str, Any]:
    training_background, _, start = way.partition("+")
    return {"training_background": training_background, "warm_start": start == "warm"}


def _judge(scene: Scene, style: torch.Tensor, between: list[Camera]) -> Judge:
    """Return a judge of `JUDGED` novel views, selected at even intervals from those between the job's views."""
    step = max(1, len(between) // JUDGED)
    return Judge(Lpips(), style, scene, make_rasterizer("cpu", scene), between[::step][:JUDGED])


def _run(
    judge: Judge, scene: Scene, cameras: list[Camera], style: torch.Tensor, settings: dict[str, Any]
) -> tuple[torch.Tensor, dict[str, float]]:
    """Run a job, and return its colors [N, 3] and its figures.

    The loss is that of renders on the plain background, relative to its initial value; seconds are CPU seconds.
    """
    stylizer = Stylizer.planned(scene, cameras, style, make_settings("standard", **settings))
    start = mean_loss(stylizer.start())
    before = time.process_time()
    for _ in range(stylizer.job.total_steps):
        stylizer.run_step()
    seconds = time.process_time() - before
    sh_dc = stylizer.stylized()
    loss = mean_loss(stylizer.evaluate(stylizer.job.evaluation_views)) / start
    return sh_dc, {**judged(judge, sh_dc), "loss": loss, "seconds": seconds}


if __name__ == "__main__":
    main()
