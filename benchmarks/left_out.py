"""Savings from each component that a plan leaves out because the scene does not need it, and from our own mechanisms.

python -m benchmarks.left_out NAME=SCENE[*GAUSSIANS]:CAMERAS ... --style STYLE [--resolution 480] [--views 4]

CAMERAS is a camera file, or orbit:N; with *GAUSSIANS, the scene is so many copies of its Gaussians. The first
configuration leaves out all components that the scene does not need; each of the next ones keeps one of them, and one
keeps all; others do without one of the mechanisms by which we want to gain time or quality. The last one is the first
one again, to see what chance changes. Every job runs in a process of its own, so that it has its own memory peak, and
all of them run once in each round. Other work on a machine only makes steps slower, so each step, and what comes before
and after the steps, counts with its least seconds over the rounds; the range is that of the rounds, each compared with
the lean job of its round. Results are stored after each scene, beside those of others.
"""

import argparse
import json
import subprocess
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from statistics import mean, median
from typing import Any

import torch
from torch import Tensor

from benchmarks.common import RESULTS, add_pair, parse, read_views
from benchmarks.large_scene import multiplied
from sgsst_core import Stylizer, make_settings
from sgsst_core.budget import Cache, peak_memory
from sgsst_core.features import layers
from sgsst_core.features.network_weights import BackboneWeights, load_network_weights
from sgsst_core.features.partition import Rectangle
from sgsst_core.files.images import load_image
from sgsst_core.files.scene_file import read_scene
from sgsst_core.parallel import Divider, Division, Size, Tiling
from sgsst_core.scene.camera import Camera
from sgsst_core.scene.gaussians import Scene
from sgsst_core.settings import Settings
from sgsst_core.style import Style
from sgsst_core.stylizing.job import JobInputs, plan_job, prepare_job
from sgsst_core.stylizing.stylizer import mean_loss

#: Components that can be left out without changing the result.
EVERYTHING = ("unseen", "uncovered", "activations", "content")
#: Settings without one of our mechanisms.
WITHOUT: dict[str, dict[str, Any]] = {
    "no Winograd": {"precision": "float32"},
    "no warm start": {"warm_start": False},
}
#: Functions that replace compiled ones by PyTorch's operations, with their modules and names.
REPLACED: dict[str, tuple[Any, str, Callable[..., Any]]] = {
    "no pooling kernel": (layers, "_is_compiled_for", lambda values: False),
}
#: Names of configurations in the table, where they differ.
_TITLES = {
    "unseen": "unseen Gaussians",
    "uncovered": "uncovered pixels",
    "activations": "second forward pass",
    "content": "content features again",
    "everything": "all four",
    "no Winograd": "float32 convolutions",
    "no pooling kernel": "pooling by PyTorch",
    "again": "the same job",
}
#: Configurations of each scene.
LABELS = ("lean", *EVERYTHING, "everything", *WITHOUT, *REPLACED, "again")


def main() -> None:
    """Measure, print and store all configurations; with --keep, run one job and print its figures as JSON."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", nargs="+", metavar="NAME=SCENE[*GAUSSIANS]:CAMERAS")
    parser.add_argument("--style", type=Path, required=True)
    parser.add_argument("--resolution", type=int, default=480)
    parser.add_argument("--views", type=int, default=4)
    parser.add_argument("--steps", type=int, default=12)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--keep", help=argparse.SUPPRESS)
    arguments = parse(parser)
    if arguments.keep is not None:
        print(json.dumps(_measure(arguments)))
        return
    for text in arguments.scenes:
        name = text.partition("=")[0]
        rounds = [{label: _in_a_process(text, label) for label in LABELS} for _ in range(arguments.rounds)]
        rows = {label: _summary(label, rounds, arguments.views) for label in LABELS}
        _print(name, rows)
        job = {"style": arguments.style.name, "resolution": arguments.resolution, "views": arguments.views}
        add_pair(
            "left_out",
            name,
            job | {"steps": arguments.steps, "rounds": arguments.rounds},
            rows,
            presets=["standard"],
            scenes={name: _files(text)[0]},
        )
    print(table(json.loads((RESULTS / "left_out.json").read_text(encoding="utf-8"))["pairs"]))


def table(scenes: Mapping[str, Mapping[str, Any]]) -> str:
    """Return a Markdown table of stored scenes: how much more a step and a whole job take with each configuration."""
    names = [_TITLES.get(label, label.replace("no ", "without ", 1)) for label in LABELS[1:]]
    lines = [["", *scenes, "job: median, range"], ["---"] * (len(scenes) + 2)]
    lean = [scene["rows"]["lean"] for scene in scenes.values()]
    lines.append(["seconds", *(f"{row['step']['seconds']:.2f}, {row['job']['seconds']:.1f}" for row in lean), ""])
    for label, name in zip(LABELS[1:], names, strict=True):
        rows = [scene["rows"][label] for scene in scenes.values()]
        more = [row["job"]["more"] for row in rows]
        cells = [f"{row['step']['more']:+.0%}, {row['job']['more']:+.0%}" for row in rows]
        lines.append([name, *cells, f"{median(more):+.0%}, {min(more):+.0%} to {max(more):+.0%}"])
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


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


def _in_a_process(scene: str, label: str) -> dict[str, Any]:
    options = [argument for argument in sys.argv[1:] if "=" not in argument or argument.startswith("--")]
    command = [sys.executable, "-m", "benchmarks.left_out", scene, *options, "--keep", label, "--loaded"]
    done = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=True)
    return dict[str, Any](json.loads(done.stdout.splitlines()[-1]))


def _files(text: str) -> tuple[Path, int, str]:
    """Return the scene, the number of Gaussians to copy it to (0 for none) and the cameras of an argument."""
    path, _, cameras = text.partition("=")[2].partition(":")
    path, _, copied = path.partition("*")
    return Path(path), int(copied or 0), cameras


def _measure(arguments: argparse.Namespace) -> dict[str, Any]:
    """Run a job of the configuration of `--keep`; return the seconds of its parts, its memory peak and its loss."""
    path, copied, cameras = _files(arguments.scenes[0])
    scene = read_scene(path).scene
    scene = multiplied(scene, copied) if copied else scene
    views = read_views(cameras, scene, arguments.views, arguments.resolution)
    label: str = arguments.keep
    added = EVERYTHING if label == "everything" else tuple({label} & {*EVERYTHING})
    if label in REPLACED:
        setattr(*REPLACED[label])
    changed = {"steps_sos": arguments.steps, "early_stop": False, **WITHOUT.get(label, {})}
    style, settings = Style.of(load_image(arguments.style)), make_settings("standard", **changed)
    times = [time.perf_counter()]
    stylizer = with_components(added, scene, views, style, settings)
    times.append(time.perf_counter())
    while stylizer.step < arguments.steps:
        stylizer.run_step()
        times.append(time.perf_counter())
    stylizer.stylized()
    times.append(time.perf_counter())
    peak, weights = peak_memory(), stylizer.job.loss.weights
    before, after = (
        mean_loss(stylizer.evaluate(stylizer.job.views.covered, colors), weights)
        for colors in (stylizer.job.views.scene.sh_dc, None)
    )
    return {"seconds": [end - start for start, end in pairwise(times)], "peak_bytes": peak, "loss": after / before}


def _summary(label: str, rounds: Sequence[Mapping[str, Mapping[str, Any]]], views: int) -> dict[str, Any]:
    """Return the figures of a configuration, and how much more seconds it takes than the lean one, relatively."""
    own, lean = ([[*each[name]["seconds"]] for each in rounds] for name in (label, "lean"))
    row = {"peak_bytes": min(each[label]["peak_bytes"] for each in rounds), "loss": rounds[0][label]["loss"]}
    for name, part in (("step", slice(1 + views, -1)), ("job", slice(None))):
        least, least_lean = (
            [min(column) for column in zip(*(seconds[part] for seconds in each), strict=True)] for each in (own, lean)
        )
        more = [sum(a[part]) / sum(b[part]) - 1 for a, b in zip(own, lean, strict=True)]
        seconds = mean(least) if name == "step" else sum(least)
        row[name] = {"seconds": seconds, "more": sum(least) / sum(least_lean) - 1, "range": [min(more), max(more)]}
    return row


def _print(name: str, rows: Mapping[str, Mapping[str, Any]]) -> None:
    print(name)
    for label, row in rows.items():
        texts = []
        for part in (row["step"], row["job"]):
            least, most = part["range"]
            texts.append(f"{part['seconds']:.3g} s ({part['more']:+.1%}, {least:+.1%} to {most:+.1%})")
        texts += [f"{row['peak_bytes'] / 1e9:.2f} GB", f"loss {row['loss']:.5f}"]
        print(f"  {label:<22}" + "".join(f"{text:<36}" for text in texts), flush=True)


if __name__ == "__main__":
    main()
