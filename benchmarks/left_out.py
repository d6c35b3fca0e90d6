"""Savings from each component that a plan leaves out because the scene does not need it, and from our own mechanisms.

python -m benchmarks.left_out NAME=SCENE.ply:CAMERAS ... --style STYLE [--resolution 320] [--views 4] [--rounds 3]

CAMERAS is a camera file, or orbit:N. The first configuration leaves out all components that the scene does not need;
each of the next ones keeps one of them, and one keeps all; the others do without one of the mechanisms by which we want
to gain time or quality. Every configuration runs in a process of its own, so
that it has its own memory peak, and all of them run once in each round, so that a change of the machine's speed meets
all alike. Medians over the rounds are stored with their range.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from statistics import mean, median
from typing import Any

import torch
from torch import Tensor

from benchmarks.common import read_views, write_result
from sgsst_core import Stylizer, make_settings
from sgsst_core.budget import Cache, peak_memory
from sgsst_core.features import layers
from sgsst_core.features.network_weights import BackboneWeights, load_network_weights
from sgsst_core.features.partition import Rectangle
from sgsst_core.files.images import load_image
from sgsst_core.files.scene_file import read_scene
from sgsst_core.parallel.division import Divider, Division, Size, Tiling
from sgsst_core.scene import spherical_harmonics
from sgsst_core.scene.camera import Camera
from sgsst_core.scene.gaussians import Scene
from sgsst_core.scene.spherical_harmonics import reference_rest_colors
from sgsst_core.settings import Settings
from sgsst_core.style import Style
from sgsst_core.stylizing.job import JobInputs, prepare_job
from sgsst_core.stylizing.planner import plan_job
from sgsst_core.stylizing.steps import mean_loss

#: Components that can be left out without changing the result.
EVERYTHING = ("unseen", "uncovered", "activations", "content")
#: Settings without one of our mechanisms.
WITHOUT: dict[str, dict[str, Any]] = {
    "no Winograd": {"precision": "float32"},
    "no warm start": {"warm_start": False},
    "no sampling of scales": {"scale_sampling": 1},
}
#: Functions that replace compiled ones by PyTorch's operations, with their modules and names.
REPLACED: dict[str, tuple[Any, str, Callable[..., Any]]] = {
    "no pooling kernel": (layers, "_is_compiled_for", lambda values: False),
    "no harmonics kernel": (
        spherical_harmonics,
        "_compiled_rest_colors",
        lambda rest, means, camera, degree: reference_rest_colors(rest, means, camera, degree),
    ),
}
#: Steps of a whole job.
STEPS = 24


def main() -> None:
    """Measure, print and store all configurations; with --keep, measure one and print it as JSON."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", nargs="+", metavar="NAME=SCENE.ply:CAMERAS")
    parser.add_argument("--style", type=Path, required=True)
    parser.add_argument("--resolution", type=int, default=320)
    parser.add_argument("--views", type=int, default=4)
    parser.add_argument("--rounds", type=int, default=3, help="processes of each configuration")
    parser.add_argument("--keep", help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.keep is not None:
        print(json.dumps(_measure(arguments)))
        return
    results = {}
    for text in arguments.scenes:
        name = text.partition("=")[0]
        rounds: list[dict[str, dict[str, float]]] = [
            {label: _in_a_process(text, added) for label, added in _configurations()} for _ in range(arguments.rounds)
        ]
        results[name] = {label: _summary(label, rounds) for label, _ in _configurations()}
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
    inputs = JobInputs(scene, cameras, style, settings, weights or load_network_weights("auto"))
    job = plan_job(inputs)
    plan = job.plan
    if "unseen" in added:
        plan = replace(plan, seen=torch.ones_like(plan.seen))
    if "uncovered" in added and plan.weighted:
        whole = [Rectangle(0, 0, camera.height, camera.width) for camera in job.views.cameras]
        plan = replace(plan, survey=replace(plan.survey, regions=whole))
    job = prepare_job(plan, inputs)
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
    parts = [("lean", ()), *((item, (item,)) for item in EVERYTHING), ("everything", EVERYTHING)]
    return [*parts, *((label, (label,)) for label in (*WITHOUT, *REPLACED))]


def _in_a_process(scene: str, added: Sequence[str]) -> dict[str, float]:
    options = [argument for argument in sys.argv[1:] if "=" not in argument or argument.startswith("--")]
    command = [sys.executable, "-m", "benchmarks.left_out", scene, *options, "--keep", ",".join(added)]
    done = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=True)
    return dict[str, float](json.loads(done.stdout.splitlines()[-1]))


def _measure(arguments: argparse.Namespace) -> dict[str, float]:
    """Return the seconds of a step and of a whole job, and the peak memory, with the components of `--keep`."""
    ply, _, cameras = arguments.scenes[0].partition("=")[2].partition(":")
    scene = read_scene(Path(ply)).scene
    views = read_views(cameras, scene, arguments.views, arguments.resolution)
    added = tuple(item for item in EVERYTHING if item in arguments.keep.split(","))
    if arguments.keep in REPLACED:
        setattr(*REPLACED[arguments.keep])
    changed = WITHOUT.get(arguments.keep, {})
    settings = make_settings("standard", **{"steps_sos": STEPS, "early_stop": False, **changed})
    style, started = Style.of(load_image(arguments.style)), time.perf_counter()
    stylizer = with_components(added, scene, views, style, settings)
    while stylizer.step < STEPS:
        stylizer.run_step()
    stylizer.stylized()
    figures = {"job_seconds": time.perf_counter() - started, "peak_bytes": peak_memory()}
    later, weights = stylizer.history[len(stylizer.job.views.covered) :], stylizer.job.loss.weights
    before, after = (
        mean_loss(stylizer.evaluate(stylizer.job.views.covered, colors), weights)
        for colors in (stylizer.job.views.scene.sh_dc, None)
    )
    return {"step_seconds": mean(sum(record.parts.values()) for record in later), **figures, "loss": after / before}


def _summary(label: str, rounds: Sequence[Mapping[str, Mapping[str, float]]]) -> dict[str, dict[str, float]]:
    """Return median and range of each figure, and those of its difference from the lean configuration's."""
    result = {}
    for name in rounds[0][label]:
        own = [each[label][name] for each in rounds]
        more = [each[label][name] - each["lean"][name] for each in rounds]
        result[name] = {"median": median(own), "least": min(own), "most": max(own)}
        result[name] |= {"more": median(more), "more_least": min(more), "more_most": max(more)}
    return result


def _print(name: str, rows: Mapping[str, Mapping[str, Mapping[str, float]]]) -> None:
    print(name)
    for label, row in rows.items():
        texts = [f"{row[key]['median']:.3g} s ({row[key]['more']:+.2g})" for key in ("step_seconds", "job_seconds")]
        texts.append(f"{row['peak_bytes']['median'] / 1e9:.2f} GB ({row['peak_bytes']['more'] / 1e9:+.2f})")
        texts.append(f"loss {row['loss']['more']:+.1e}")
        print(f"  {label:<22}" + "".join(f"{text:<22}" for text in texts), flush=True)


if __name__ == "__main__":
    main()
