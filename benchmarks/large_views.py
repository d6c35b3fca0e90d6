"""Steps on very large views under a memory limit: seconds and peak memory, compared with the plan's bound.

python -m benchmarks.large_views SCENE.ply CAMERAS STYLE [--sizes 5187x3361 8192x5460] [--steps 10] [--memory 10]

CAMERAS is a camera file, or orbit:N. Each size runs in a separate process, so that it has its own memory peak. If the
steps of a size do not finish within --seconds, only the finished ones are reported.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import time
from typing import Any

import torch

from benchmarks.common import RESULTS, input_parser, parse, read_inputs, with_size, write_result
from sgsst_core import Stylizer, make_settings
from sgsst_core.budget import peak_memory


def main() -> None:
    """Measure, print and store all sizes; with --size, measure one size and print its row as JSON after each step."""
    parser = input_parser(__doc__)
    parser.add_argument("--sizes", nargs="+", default=["5187x3361", "8192x5460"], metavar="WIDTHxHEIGHT")
    parser.add_argument("--steps", type=int, default=10)
    parser.add_argument("--memory", type=float, default=10.0, help="GB to plan with")
    parser.add_argument("--precision", default="float32", choices=("float32", "bfloat16"))
    parser.add_argument("--seconds", type=float, default=None, help="for each size; no limit unless given")
    parser.add_argument("--size", help=argparse.SUPPRESS)
    arguments = parse(parser)
    if arguments.size:
        _measure(arguments)
        return
    for size in arguments.sizes:
        for row in _in_a_process(size, arguments.seconds):
            _print(row)
            rows = [other for other in _stored() if _key(other) != _key(row)]
            write_result(
                "large_views",
                {"sizes": [*rows, row]},
                presets=["standard"],
                scenes={arguments.scene.parent.name: arguments.scene},
            )


def _stored() -> list[dict[str, Any]]:
    """Return the stored rows of earlier runs. They are kept, so that sizes can be measured one at a time."""
    path = RESULTS / "large_views.json"
    return list(json.loads(path.read_text(encoding="utf-8"))["sizes"]) if path.exists() else []


def _key(row: dict[str, Any]) -> tuple[Any, ...]:
    return row["width"], row["height"], row["precision"], row["threads"]


def _in_a_process(size: str, limit: float | None) -> list[dict[str, Any]]:
    """Measure a size in a separate process. Return one row for the finished steps, or no row if none finished."""
    command = [sys.executable, "-m", "benchmarks.large_views", *sys.argv[1:], "--size", size]
    try:
        done = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=True, timeout=limit)
        lines = done.stdout.splitlines()
    except subprocess.TimeoutExpired as ended:
        lines = (ended.stdout or b"").decode().splitlines()
    return [json.loads(line) for line in lines[-1:]]


def _measure(arguments: argparse.Namespace) -> None:
    """Run steps on one view; the first step prepares the view."""
    width, height = (int(side) for side in arguments.size.split("x"))
    scene, cameras, style = read_inputs(arguments, 1, width)
    view = with_size(cameras[0], width, height)
    settings = make_settings(
        "standard",
        steps_sos=arguments.steps,
        scale_sampling=1,
        early_stop=False,
        memory_limit=int(arguments.memory * 1e9),
        precision=arguments.precision,
    )
    started = time.perf_counter()
    stylizer = Stylizer.planned(scene, [view], style, settings)
    planning = time.perf_counter() - started
    seconds: list[float] = []
    for _ in range(arguments.steps):
        started = time.perf_counter()
        stylizer.run_step()
        seconds.append(time.perf_counter() - started)
        row = {
            "width": width,
            "height": height,
            "precision": arguments.precision,
            "threads": torch.get_num_threads(),
            "memory_gb": arguments.memory,
            "planning_seconds": planning,
            "first_step_seconds": seconds[0],
            "step_seconds": seconds[1:],
            "parts": stylizer.history[-1].parts,
            "peak_gb": peak_memory() / 1e9,
            "planned_peak_gb": stylizer.job.plan.peak_bytes / 1e9,
            "losses": [record.loss for record in stylizer.history],
        }
        print(json.dumps(row), flush=True)


def _print(row: dict[str, Any]) -> None:
    later = ", ".join(f"{seconds:.1f}" for seconds in row["step_seconds"]) or "none"
    print(f"{row['width']}x{row['height']}, {row['precision']}: first step {row['first_step_seconds']:.1f} s", end=" ")
    print(f"later ones {later} s; peak {row['peak_gb']:.2f} GB (at most {row['planned_peak_gb']:.2f})", flush=True)


if __name__ == "__main__":
    main()
