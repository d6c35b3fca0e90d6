"""Savings in time and memory from each component that a plan leaves out because the scene does not need it.

python -m benchmarks.left_out NAME=SCENE.ply:CAMERAS ... --style STYLE [--resolution 684] [--views 3] [--rounds 3]

CAMERAS is a camera file, or orbit:N. Each configuration runs in a separate process, so that it has its own memory peak.
The first configuration leaves out all components that the scene does not need; each of the next ones keeps one of them;
the last one keeps all. Measured values are seconds per iteration and peak memory, printed beside the plan's
predictions.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from statistics import median
from typing import Any

import torch
from torch import Tensor

from benchmarks.inputs import read_views
from benchmarks.machine import write_result
from sgsst_core import Stylizer, make_settings
from sgsst_core.budget import Cache, peak_memory
from sgsst_core.features.network_weights import BackboneWeights
from sgsst_core.features.partition import Rectangle
from sgsst_core.files.images import load_image
from sgsst_core.files.scene_file import read_scene
from sgsst_core.loss.tiling import Divider, Division, Tiling
from sgsst_core.parallel.division import Size
from sgsst_core.scene.camera import Camera
from sgsst_core.scene.gaussians import Scene
from sgsst_core.settings import Settings
from sgsst_core.style import Style
from sgsst_core.stylizing.job import prepare_job
from sgsst_core.stylizing.planner import plan_job

#: Components that can be left out without changing the result.
EVERYTHING = ("unseen", "uncovered", "activations", "content", "blend-weights")


def main() -> None:
    """Measure, print and store all configurations; with --keep, measure one and print it as JSON."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", nargs="+", metavar="NAME=SCENE.ply:CAMERAS")
    parser.add_argument("--style", type=Path, required=True)
    parser.add_argument("--resolution", type=int, default=684)
    parser.add_argument("--views", type=int, default=3)
    parser.add_argument("--rounds", type=int, default=3, help="the first one prepares the views and does not count")
    parser.add_argument("--keep", help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.keep is not None:
        print(json.dumps(_measure(arguments)))
        return
    results = {}
    for text in arguments.scenes:
        name = text.partition("=")[0]
        measured = {label: _in_a_process(text, cached) for label, cached in _configurations()}
        results[name] = _savings(measured)
        _print(name, results[name])
    write_result("left_out", {"style": arguments.style.name, "resolution": arguments.resolution, "scenes": results})


def with_components(
    added: Sequence[str],
    scene: Scene,
    cameras: Sequence[Camera],
    style: Style,
    settings: Settings,
    weights: BackboneWeights | None = None,
) -> Stylizer:
    """Return the stylizer of a job that computes some of `EVERYTHING` although it does not need to."""
    if "blend-weights" in added:
        settings = settings.model_copy(update={"cached_weights": "none"})
    job = plan_job(scene, cameras, style, settings, weights=weights)
    plan = job.plan
    if "unseen" in added:
        plan = replace(plan, seen=torch.ones_like(plan.seen))
    if "uncovered" in added and plan.weighted:
        whole = [Rectangle(0, 0, camera.height, camera.width) for camera in job.views.cameras]
        plan = replace(plan, survey=replace(plan.survey, regions=whole))
    job = prepare_job(plan, scene, cameras, style, settings, weights=job.weights)
    if "uncovered" in added:
        job.loss.divider = _Whole(job.loss.tiling)
    if "activations" in added:
        job.loss.tiling = job.loss.divider.tiling = _Uncached(**vars(job.loss.tiling))
    if "content" in added:
        job.view_targets._content = Cache(0)
    return Stylizer(job)


class _Uncached(Tiling):
    """Partitioning rules that compute every tile twice."""

    def cached(self, areas: Sequence[int]) -> list[bool]:
        return [False] * len(areas)


class _Whole(Divider):
    """Divider that leaves no pixel out."""

    def divide(
        self, sizes: Mapping[int, Size], coverage: Sequence[Tensor] | None = None, region: Rectangle | None = None
    ) -> Division:
        return super().divide(sizes)


def _configurations() -> list[tuple[str, Sequence[str]]]:
    return [("lean", ()), *((item, (item,)) for item in EVERYTHING), ("everything", EVERYTHING)]


def _in_a_process(scene: str, cached: Sequence[str]) -> dict[str, Any]:
    options = [argument for argument in sys.argv[1:] if "=" not in argument or argument.startswith("--")]
    command = [sys.executable, "-m", "benchmarks.left_out", scene, *options, "--keep", ",".join(cached)]
    done = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=True)
    return dict(json.loads(done.stdout.splitlines()[-1]))


def _measure(arguments: argparse.Namespace) -> dict[str, Any]:
    """Return seconds per iteration and peak memory of a job that keeps the components of `--keep`."""
    ply, _, cameras = arguments.scenes[0].partition("=")[2].partition(":")
    scene = read_scene(Path(ply)).scene
    views = read_views(cameras, scene, arguments.views, arguments.resolution)
    cached = tuple(item for item in EVERYTHING if item in arguments.keep.split(","))
    settings = make_settings("standard", steps_sos=10_000, scale_sampling=1, early_stop=False)
    stylizer = with_components(cached, scene, views, Style.of(load_image(arguments.style)), settings)
    for _ in range(arguments.rounds * len(stylizer.job.views.covered)):
        stylizer.run_step()
    steps = [sum(record.parts.values()) for record in stylizer.history[len(stylizer.job.views.covered) :]]
    prediction = stylizer.job.plan.prediction
    assert prediction is not None
    return {
        "seconds": median(steps),
        "peak_bytes": peak_memory(),
        "predicted_seconds": prediction.seconds,
        "predicted_peak_bytes": prediction.peak_bytes,
        "loss": stylizer.history[0].loss,
    }


def _savings(results: dict[str, dict[str, Any]]) -> dict[str, Any]:
    lean = results["lean"]
    rows = {
        label: {
            **values,
            "seconds_saved": values["seconds"] - lean["seconds"],
            "bytes_saved": values["peak_bytes"] - lean["peak_bytes"],
            "loss_change": values["loss"] / lean["loss"] - 1,
        }
        for label, values in results.items()
    }
    predicted = {
        "seconds": lean["predicted_seconds"] / lean["seconds"],
        "peak_bytes": lean["predicted_peak_bytes"] / lean["peak_bytes"],
    }
    return {"configurations": rows, "predicted_over_measured": predicted}


def _print(name: str, result: dict[str, Any]) -> None:
    print(f"{name}: predicted / measured {result['predicted_over_measured']}")
    for label, row in result["configurations"].items():
        seconds = f"{row['seconds']:.2f} s ({row['seconds_saved']:+.2f})"
        memory = f"{row['peak_bytes'] / 1e9:.2f} GB ({row['bytes_saved'] / 1e9:+.2f})"
        print(f"  {label:<16}{seconds:<20}{memory:<20} first loss {row['loss_change']:+.1e}", flush=True)


if __name__ == "__main__":
    main()
