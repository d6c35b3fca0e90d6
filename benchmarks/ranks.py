"""Speedup of two single-threaded ranks over one, on all scales of a view.

python -m benchmarks.ranks SCENE.ply CAMERAS|orbit:N STYLE [--memory 16]

Ranks are gloo processes on this machine; steps on one and on both ranks take turns.
"""

import argparse
import multiprocessing
from collections.abc import Callable
from datetime import timedelta
from statistics import median
from typing import Any

import torch

from benchmarks.common import free_address, input_parser, parse, read_inputs, with_size, write_result
from sgsst_core import Stylizer, make_settings
from sgsst_core.parallel import ALONE, Collectives
from worker.ranks.process_group import process_group

RANKS, ROUNDS = 2, 3
#: Width and height of the views.
SIZES = ((1280, 720), (2048, 2048))


def main() -> None:
    """Measure, print and store."""
    parser = input_parser(__doc__)
    parser.add_argument("--memory", type=float, default=16.0, help="GB to plan with")
    arguments = parse(parser)
    address = free_address()
    context = multiprocessing.get_context("spawn")
    others = [context.Process(target=run_rank, args=(rank, address, arguments)) for rank in range(1, RANKS)]
    for process in others:
        process.start()
    run_rank(0, address, arguments)
    for process in others:
        process.join()


def run_rank(rank: int, address: str, arguments: argparse.Namespace) -> None:
    """Run one rank's part of the comparison; rank 0 prints and stores the figures."""
    torch.set_num_threads(1)
    scene, (camera,), style = read_inputs(arguments, 1, 1280)
    settings = make_settings("paper", steps_coarse=0, steps_sos=10_000, memory_limit=int(arguments.memory * 1e9))
    results = []
    # A long timeout, because the other ranks wait while one runs alone.
    with process_group(rank, RANKS, address, timeout=timedelta(hours=1)) as collectives:
        for width, height in SIZES:
            view = with_size(camera, width, height)

            def build(group: Collectives, view: Any = view) -> Stylizer:
                return Stylizer.planned(scene, [view], style, settings, collectives=group)

            steps = compare(collectives, build)
            if rank == 0:
                one, all_ranks = (median(steps[name]) for name in ("alone", "together"))
                figures = {"seconds_one_rank": one, "seconds": all_ranks, "ratio": one / all_ranks, "steps": steps}
                results.append({"view": f"{width}x{height}", "ranks": RANKS, **figures})
                print(results[-1], flush=True)
    if rank == 0:
        name = arguments.scene.parent.name
        write_result("ranks", {"scene": name, "views": results}, presets=["paper"], scenes={name: arguments.scene})


def compare(collectives: Collectives, build: Callable[[Collectives], Stylizer]) -> dict[str, list[float]]:
    """Return the seconds of steps on all ranks and on one, in turn. The first of each, which prepares, is left out."""
    stylizers = {"together": build(collectives)} | ({"alone": build(ALONE)} if collectives.rank == 0 else {})
    steps: dict[str, list[float]] = {"together": [], "alone": []}
    for _ in range(ROUNDS + 1):
        for name in steps:
            collectives.all_gather(None)  # other ranks wait here while rank 0 runs alone
            if stylizer := stylizers.get(name):
                before = stylizer.seconds
                stylizer.run_step()
                steps[name].append(stylizer.seconds - before)
    collectives.all_gather(None)
    return {name: each[1:] for name, each in steps.items()}


if __name__ == "__main__":
    main()
