"""Comparison of the standard preset with the paper's schedule: loss on all views and seconds.

python -m benchmarks.standard_preset SCENE.ply CAMERAS|orbit:N STYLE NAME [--only paper|standard]

The paper's schedule is shortened to `--steps-coarse` and `--steps-sos` steps, at the paper's learning rate; 10,000 each
are the whole schedule.
Without a GPU, times are CPU seconds, so that other programs on the machine do not matter; run the benchmark with one
thread. With `--only`, the figures of the other schedules are read from the result file.
"""

from __future__ import annotations

import json
import time
from pathlib import Path
from typing import Any

from torch import Tensor

from benchmarks.common import RESULTS, input_parser, read_views, write_result
from sgsst_core import Stylizer, make_settings
from sgsst_core.files.images import load_image
from sgsst_core.files.scene_file import read_scene
from sgsst_core.files.stylized_ply import write_stylized
from sgsst_core.stylizing.steps import mean_loss

#: Fractions of each phase after which all views are evaluated.
MARKS = (0.05, 0.1, 0.2, 0.35, 0.5, 0.75, 1.0)
PAPER_RATE = 2.5e-3
SCHEDULES = ("paper", "standard")


def main() -> None:
    """Run the schedules, then print and store the figures."""
    parser = input_parser(__doc__)
    parser.add_argument("name", help="of the result: benchmarks/results/standard_NAME.json")
    parser.add_argument("--steps-coarse", type=int, default=1000)
    parser.add_argument("--steps-sos", type=int, default=1000)
    parser.add_argument("--views", type=int, default=12)
    parser.add_argument("--resolution", type=int, default=340)
    parser.add_argument("--coarsest-side", type=int, default=128)
    parser.add_argument("--only", choices=SCHEDULES)
    parser.add_argument("--out", type=Path, help="folder for the stylized scenes")
    arguments = parser.parse_args()
    file = read_scene(arguments.scene)
    cameras = read_views(arguments.cameras, file.scene, arguments.views, arguments.resolution)
    paper = {"steps_coarse": arguments.steps_coarse, "steps_sos": arguments.steps_sos, "learning_rate": PAPER_RATE}
    paper |= {
        "clamp_aware_gradient": False,
        "early_stop": False,
        "precision": "float32",
        "training_background": "background",
        "warm_start": False,
        "scale_sampling": 1,
    }
    results: dict[str, Any] = _stored(f"standard_{arguments.name}")
    for name, values in zip(SCHEDULES, (paper, {}), strict=True):
        if arguments.only in (None, name):
            settings = make_settings("standard", coarsest_side=arguments.coarsest_side, **values)
            stylizer = Stylizer.planned(file.scene, cameras, load_image(arguments.style), settings)
            points = _run(stylizer, file.scene.sh_dc)
            results[name] = {"settings": settings.model_dump(mode="json"), "points": points}
            if arguments.out:
                arguments.out.mkdir(parents=True, exist_ok=True)
                write_stylized(file, arguments.out / f"{arguments.name}_{name}.ply", stylizer.stylized())
    if "paper" in results and "standard" in results:
        results["verdict"] = _verdict(results)
        print(results["verdict"])
    scene = {"scene": arguments.scene.parent.name, "style": arguments.style.name, "views": len(cameras)}
    size = {"size": [cameras[0].width, cameras[0].height], "gaussians": len(file.scene)}
    write_result(f"standard_{arguments.name}", {**scene, **size, **results})


def _stored(name: str) -> dict[str, Any]:
    path = RESULTS / f"{name}.json"
    values = json.loads(path.read_text(encoding="utf-8")) if path.exists() else {}
    return {key: values[key] for key in SCHEDULES if key in values}


def _run(stylizer: Stylizer, own: Tensor) -> list[dict[str, Any]]:
    """Run a job, and return at each of `MARKS` the loss on all views, relative to that of the colors `own` [n, 3].

    The scene's own colors are the reference, not the first step's, because `standard` starts from the style's colors.
    """
    views = stylizer.job.views.covered
    start = stylizer.evaluate(views, own[stylizer.job.plan.seen])
    coarse, sos = stylizer.job.plan.steps_coarse, stylizer.job.settings.steps_sos
    marks = {int(coarse * mark) for mark in MARKS} | {coarse + int(sos * mark) for mark in MARKS}
    points, seconds = [], 0.0
    clock = time.perf_counter if stylizer.job.plan.device == "cuda" else time.process_time
    for _ in range(stylizer.job.total_steps):
        before = clock()
        stylizer.run_step()  # returns the loss, so it waits for the GPU
        seconds += clock() - before
        if stylizer.step in marks:
            loss = stylizer.evaluate(views)
            scales = {str(scale): loss[scale].total / start[scale].total for scale in loss}
            relative = mean_loss(loss) / mean_loss(start)
            points.append({"step": stylizer.step, "seconds": seconds, "relative": relative, "scales": scales})
            print(points[-1], flush=True)
    return points


def _verdict(results: dict[str, Any]) -> dict[str, Any]:
    """Return when the standard preset reached the final loss of the paper's schedule, and the preset's final loss."""
    last = results["paper"]["points"][-1]
    standard = results["standard"]["points"]
    reached = next((point for point in standard if point["relative"] <= last["relative"]), None)
    return {
        "paper": last["relative"],
        "standard": standard[-1]["relative"],
        "seconds_to_the_paper's_loss": reached["seconds"] / last["seconds"] if reached else None,
        "all_seconds": standard[-1]["seconds"] / last["seconds"],
    }


if __name__ == "__main__":
    main()
