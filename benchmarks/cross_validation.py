"""Candidates for defaults on several pairs of scene and painting, judged on pairs that they were not chosen on.

python -m benchmarks.cross_validation run DATA [--workers 6]
python -m benchmarks.cross_validation show

`run` needs a folder with scenes/ and styles/ (`SCENES`, `PAIRS`); the demo scene is built. It stylizes every pair with
the defaults, then pair by pair with every candidate (`CANDIDATES`), after the same number of steps, on a GPU if there
is one. Results are judged on novel views by a network outside the loss, always on the CPU, so that machines compare,
and added to benchmarks/results/cross_validation.json. With `--at 40 80 160`, the default is also judged after these
steps of the same run.

`show` prints Markdown tables of what is stored. The score of a candidate on a pair is the mean logarithm of the ratios
of its `SCORED` figures to the default's; negative is better. Leaving out: for each pair, the candidate with the best
mean score on pairs with another scene and another painting is chosen, or the default if none is better on average, and
its figures are reported. `second-seed` differs from the default by chance alone, and is never chosen.
"""

import argparse
import json
import math
import multiprocessing
import os
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass
from functools import lru_cache
from itertools import pairwise
from pathlib import Path
from statistics import fmean
from typing import Any

import torch

from api.cli.scene_tools import build_demo
from benchmarks.common import RESULTS, add_pair, parse, read_views
from benchmarks.equal_steps import UNSTYLIZED, judged
from sgsst_core import Stylizer, load_cameras, load_image, load_scene, make_settings
from sgsst_core.quality.judge import Judge, Lpips
from sgsst_core.rasterizer import make_rasterizer
from sgsst_core.scene.camera import Camera, between, resized, spread
from sgsst_core.scene.gaussians import Scene

#: Scenes below DATA/scenes with their cameras; the demo scene has its own.
SCENES = {
    "plush": ("snowmiku_plush/point_cloud.ply", "snowmiku_plush/cameras.json"),
    "playbot": ("playbot_synthetic_sh2/point_cloud.ply", "orbit:24"),
    "broche": ("broche/broche.splat", "orbit:24"),
}
DEMO = "demo"
#: Object scans, whose training background is drawn.
SCANS = ("playbot", "broche")
#: Every scene two or three times, every painting once or twice.
PAIRS = (
    "playbot, starry_night",
    "playbot, great_wave",
    "broche, wheat_field_with_cypresses",
    "plush, vallotton_woodcut",
    "broche, rembrandt_old_man",
    "broche, shipwreck",
    "playbot, vallotton_woodcut",
    "plush, starry_night",
    "demo, udnie",
    "demo, great_wave",
)
DEFAULT, START, SECOND_SEED = "default", "start", "second-seed"
#: Settings that differ from the standard preset, by candidate.
CANDIDATES: dict[str, dict[str, Any]] = {
    "random": {"training_background": "random"},
    "background": {"training_background": "background"},
    "paper-scale": {"feature_scale": "paper"},
    "cold": {"warm_start": False},
    "lr-low-end": {"learning_rate_end": 0.02},
    "lr-high-end": {"learning_rate_end": 0.1},
    "two-scales": {"coarsest_side": 160},
    "unbounded": {"bounded": False},
    SECOND_SEED: {"seed": 1},
}
#: Candidates that can be chosen.
CHOICES = [name for name in CANDIDATES if name != SECOND_SEED]
#: Candidates that change nothing on scenes that fill the view.
SCANS_ONLY = ("random", "background")
SCORED = ("style", "interior_style", "sliced_features", "color_distance")
COLUMNS = (*SCORED, "background_sensitivity", "content")
LEAST_PAIRS = 2  # that a candidate is chosen on
_NAMES = [name.replace("_", " ") for name in COLUMNS]

Figures = Mapping[str, float]
Rows = dict[str, dict[str, float]]


@dataclass(frozen=True)
class Task:
    """Run of one candidate on one pair."""

    data: Path
    pair: str
    candidate: str
    settings: dict[str, Any]
    resolution: int
    at: tuple[int, ...] = ()


def main() -> None:
    """Run candidates, or print tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    ways = parser.add_subparsers(dest="way", required=True)
    ways.add_parser("show")
    running = ways.add_parser("run")
    running.add_argument("data", type=Path, help="folder with scenes/ and styles/")
    running.add_argument("--pairs", nargs="+", default=PAIRS, help="as 'SCENE, PAINTING'")
    running.add_argument("--candidates", nargs="+", choices=[DEFAULT, *CANDIDATES], default=[DEFAULT, *CANDIDATES])
    running.add_argument("--steps", type=int, default=80)
    running.add_argument(
        "--at", nargs="*", type=int, default=(), help="further steps after which the default is judged"
    )
    running.add_argument("--resolution", type=int, default=384, help="of the views of a run")
    running.add_argument("--settings", default="{}", help="JSON, of all runs")
    running.add_argument("--workers", type=int, default=1)
    arguments = parse(parser)
    if arguments.way == "run" and (unknown := set(arguments.pairs) - set(PAIRS)):
        parser.error(f"unknown pairs: {', '.join(sorted(unknown))}. Choose some of: {'; '.join(PAIRS)}")
    if arguments.way == "run":
        run_all(arguments)
    for (steps, resolution), pairs in stored().items():
        print(f"## {steps} steps at {resolution} pixels\n\n{tables(pairs)}\n")


def run_all(arguments: argparse.Namespace) -> None:
    """Run and store the default on all pairs, then all candidates pair by pair."""
    base = {"steps_coarse": 0, "steps_sos": arguments.steps, "early_stop": False, "precision": "float32", "measure": 0}
    base |= json.loads(arguments.settings)
    tasks = []
    if DEFAULT in arguments.candidates:
        for pair in arguments.pairs:
            tasks.append(Task(arguments.data, pair, DEFAULT, base, arguments.resolution, tuple(arguments.at)))
    for pair in arguments.pairs:
        for name in arguments.candidates:
            if name in CANDIDATES and (name not in SCANS_ONLY or pair.startswith(SCANS)):
                tasks.append(Task(arguments.data, pair, name, base | CANDIDATES[name], arguments.resolution))
    description = {"steps": arguments.steps, "resolution": arguments.resolution, "settings": base}
    threads = max(1, (os.cpu_count() or 1) // arguments.workers)
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(arguments.workers, context, torch.set_num_threads, (threads,)) as pool:
        futures = {pool.submit(run, task): task for task in tasks}
        for future in as_completed(futures):
            task, rows = futures[future], future.result()
            name = f"{task.pair}, {arguments.steps} steps at {arguments.resolution} pixels"
            add_pair("cross_validation", name, {"pair": task.pair, **description}, rows, presets=["standard"])
            print(f"{task.pair:40} {task.candidate:12}", *_cells(list(rows.values())[-1]), flush=True)


def run(task: Task) -> Rows:
    """Run and judge a candidate."""
    scene_name, painting = task.pair.split(", ")
    scene, cameras, novel = inputs(task.data, scene_name, task.resolution)
    style = load_image(task.data / "styles" / f"{painting}.jpg")
    judge = Judge(Lpips(), style, scene, make_rasterizer("cpu", scene), novel)
    stylizer = Stylizer.planned(scene, cameras, style, make_settings("standard", **task.settings))
    rows: Rows = {}
    if task.candidate == DEFAULT:
        rows = {UNSTYLIZED: judged(judge, scene.sh_dc), START: judged(judge, stylizer.stylized())}
    seconds = 0.0
    for step in range(1, stylizer.job.total_steps + 1):
        before = time.perf_counter()
        stylizer.run_step()
        seconds += time.perf_counter() - before
        if step in task.at:
            rows[f"{DEFAULT} after {step}"] = judged(judge, stylizer.stylized()) | {"seconds": seconds}
    rows[task.candidate] = judged(judge, stylizer.stylized()) | {"seconds": seconds}
    return {name: {key: float(f"{value:.5g}") for key, value in row.items()} for name, row in rows.items()}


@lru_cache(maxsize=1)
def inputs(data: Path, name: str, resolution: int) -> tuple[Scene, list[Camera], list[Camera]]:
    """Return a scene, the views of its runs, and the novel views between them that results are judged on."""
    if name == DEMO:
        with tempfile.TemporaryDirectory() as temporary:
            demo, cameras, _ = build_demo(Path(temporary))
            own = [resized(camera, resolution) for camera in load_cameras(cameras)]
            return load_scene(demo).scene, own, spread([between(*each) for each in pairwise(own)], 6)
    folder, (ply, source) = data / "scenes", SCENES[name]
    source = source if source.startswith("orbit:") else str(folder / source)
    scene = load_scene(folder / ply).scene
    views = read_views(source, scene, 24, resolution)
    return scene, views[::2], views[1::4]


def stored() -> dict[tuple[int, int], dict[str, Rows]]:
    """Return the stored rows of each pair, by number of steps and resolution."""
    groups: dict[tuple[int, int], dict[str, Rows]] = {}
    for each in json.loads((RESULTS / "cross_validation.json").read_text())["pairs"].values():
        groups.setdefault((each["steps"], each["resolution"]), {})[each["pair"]] = each["rows"]
    return groups


def score(rows: Rows, candidate: str) -> float | None:
    """Return the score of a candidate on a pair, or None if it was not run."""
    if candidate not in rows or DEFAULT not in rows:
        return None
    own, base = rows[candidate], rows[DEFAULT]
    return fmean(math.log(own[name] / base[name]) for name in SCORED if name in own and name in base)


def choose(pairs: Mapping[str, Rows]) -> str:
    """Return the candidate with the best mean score on pairs, or the default if none is better on average."""
    means = {DEFAULT: 0.0}
    for candidate in CHOICES:
        scores = [each for rows in pairs.values() if (each := score(rows, candidate)) is not None]
        if len(scores) >= LEAST_PAIRS:
            means[candidate] = fmean(scores)
    return min(means, key=means.__getitem__)


def left_out(pairs: Mapping[str, Rows]) -> Iterator[tuple[str, str]]:
    """Yield each pair with candidates, and the candidate that is chosen without its scene and its painting.

    Scans and scenes that fill the view choose among themselves. Pairs whose chosen candidate was not run on them are
    skipped.
    """
    compared = {pair: rows for pair, rows in pairs.items() if any(name in rows for name in CHOICES)}
    for pair, rows in compared.items():
        scene, painting = pair.split(", ")
        others = {
            other: each
            for other, each in compared.items()
            if other.startswith(SCANS) == pair.startswith(SCANS)
            and not other.startswith(scene)
            and not other.endswith(painting)
        }
        chosen = choose(others)
        if chosen in rows:
            yield pair, chosen


def tables(pairs: Mapping[str, Rows]) -> str:
    """Return Markdown tables: each pair; mean and worst of all pairs, and of each candidate's pairs; pairs left out."""
    names = [name for rows in pairs.values() for name in rows]
    lines = [*_each_pair(pairs), "", *_head("all pairs", "pairs")]
    for name in dict.fromkeys(names):
        if name not in CANDIDATES:
            lines += _summary(name, [rows[name] for rows in pairs.values() if name in rows])
    if any(name in CANDIDATES for name in names):
        lines += ["", *_head("candidate", "pairs")]
    before: list[str] = []
    for name in CANDIDATES:
        scores = {pair: each for pair, rows in pairs.items() if (each := score(rows, name)) is not None}
        if scores and list(scores) != before:
            lines += _summary(DEFAULT, [pairs[pair][DEFAULT] for pair in scores])
        if scores:
            better = sum(each < 0 for each in scores.values())
            label = f"{name} (score {fmean(scores.values()):+.3f}, better on {better})"
            lines += _summary(label, [pairs[pair][name] for pair in scores])
            before = list(scores)
    if chosen := list(left_out(pairs)):
        lines += ["", *_head("left-out pair", "chosen")]
        lines += [_row(pair, name, pairs[pair][name]) for pair, name in chosen]
        lines += _summary("chosen", [pairs[pair][name] for pair, name in chosen])
        lines += _summary(DEFAULT, [pairs[pair][DEFAULT] for pair, _ in chosen])
    return "\n".join(lines)


def _each_pair(pairs: Mapping[str, Rows]) -> list[str]:
    """Return a table of the figures before and after stylization with the defaults."""
    lines = [f"| {' | '.join(['pair', *_NAMES])} |", "|---" * (len(COLUMNS) + 1) + "|"]
    for pair, rows in pairs.items():
        cells = zip(_cells(rows[UNSTYLIZED]), _cells(rows[DEFAULT]), strict=True)
        lines.append(f"| {' | '.join([pair, *(f'{before} → {after}' for before, after in cells)])} |")
    return lines


def _summary(label: str, figures: Sequence[Figures]) -> list[str]:
    rows = []
    for kind, combine in (("mean", fmean), ("worst", max)):
        values = {name: combine(each[name] for each in figures if name in each) for name in figures[0]}
        rows.append(_row(f"{label}, {kind}", str(len(figures)), values))
    return rows


def _head(first: str, second: str) -> list[str]:
    return [f"| {' | '.join([first, second, *_NAMES])} |", "|---" * (len(COLUMNS) + 2) + "|"]


def _row(label: str, second: str, figures: Figures) -> str:
    return f"| {' | '.join([label, second, *_cells(figures)])} |"


def _cells(figures: Figures) -> list[str]:
    digits = {name: 1 if name == "color_distance" else 3 for name in COLUMNS}
    return [f"{figures[name]:.{count}f}" if name in figures else "" for name, count in digits.items()]


if __name__ == "__main__":
    main()
