"""Speedup of two single-threaded ranks over one, on all scales of a view.

python -m benchmarks.ranks SCENE.ply CAMERAS|orbit:N STYLE [--ranks 2] [--sizes 1280x720,2048x2048] [--rounds 3]

Ranks are gloo processes on this machine; iterations on one and on all ranks take turns. Also reported are the limit of
the speedup due to halos, and the fraction of an iteration in which ranks wait for each other or for data.
"""

from __future__ import annotations

import argparse
import math
import multiprocessing
import resource
import statistics
from collections.abc import Sequence
from datetime import timedelta
from typing import Any

import torch

from benchmarks.common import free_address, input_parser, parse, read_inputs, with_size, write_result
from sgsst_core import Stylizer, make_settings
from sgsst_core.budget import peak_memory
from sgsst_core.features.partition import Rectangle, computed_twice
from sgsst_core.parallel.collectives import ALONE, Collectives
from sgsst_core.parallel.division import Piece, divide
from sgsst_core.scene.camera import Camera
from worker.ranks.process_group import process_group


def main() -> None:
    """Measure, print and store."""
    parser = input_parser(__doc__)
    parser.add_argument("--ranks", type=int, default=2)
    parser.add_argument("--sizes", default="1280x720,2048x2048")
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--name", default="ranks", help="of the results file")
    parser.add_argument("--memory", type=float, default=16.0, help="GB to plan with")
    arguments = parse(parser)
    address = free_address()
    context = multiprocessing.get_context("spawn")
    others = [context.Process(target=run_rank, args=(rank, address, arguments)) for rank in range(1, arguments.ranks)]
    for process in others:
        process.start()
    run_rank(0, address, arguments)
    for process in others:
        process.join()


def run_rank(rank: int, address: str, arguments: argparse.Namespace) -> None:
    """Run one rank's part of the comparison; rank 0 prints and stores the figures."""
    torch.set_num_threads(1)
    scene, (camera,), style = read_inputs(arguments, 1, 1280)
    results = []
    # A long timeout, because the other ranks wait while one runs alone.
    with process_group(rank, arguments.ranks, address, timeout=timedelta(hours=1)) as collectives:
        for size in arguments.sizes.split(","):
            view = with_size(camera, *map(int, size.split("x")))
            figures = compare(
                collectives, lambda c, view=view: make(c, scene, view, style, arguments), arguments.rounds
            )
            if rank == 0:
                results.append({"view": size, **figures})
                print(describe(results[-1]), flush=True)
    if rank == 0:
        name = arguments.scene.parent.name
        figures = {"scene": name, "views": results}
        write_result(arguments.name, figures, presets=["standard"], scenes={name: arguments.scene})


def make(collectives: Collectives, scene: Any, view: Camera, style: Any, arguments: argparse.Namespace) -> Stylizer:
    """Make a job of one view that stays in the second phase."""
    settings = make_settings(
        "paper",
        steps_coarse=0,
        steps_sos=10_000,
        memory_limit=int(arguments.memory * 1e9),
    )
    return Stylizer.planned(scene, [view], style, settings, collectives=collectives)


def compare(collectives: Collectives, build: Any, rounds: int) -> dict[str, Any]:
    """Measure iterations on all ranks and on one, in turn. The first of each prepares the view and is not counted."""
    together = build(collectives)
    alone = build(ALONE) if collectives.rank == 0 else None
    steps: dict[str, list[dict[str, float]]] = {"together": [], "alone": []}
    sent: dict[str, int] = {}
    for turn in range(rounds + 1):
        for name, stylizer in (("together", together), ("alone", alone)):
            collectives.all_gather(None)  # other ranks wait here while rank 0 runs alone
            if stylizer is not None:
                before, used = stylizer.seconds, resource.getrusage(resource.RUSAGE_SELF)
                record = stylizer.run_step()
                if turn:
                    seconds = {"total": stylizer.seconds - before, **processor_seconds(used)}
                    steps[name].append({**record.parts, **seconds})
                    sent = record.sent or sent
    waiting = collectives.all_gather([step["communication"] / step["total"] for step in steps["together"]])
    kernel = collectives.all_gather([step["processor_system"] for step in steps["together"]])
    peak = collectives.all_gather(peak_memory() / 1e9)
    if alone is None:
        return {}
    loss = alone.job.loss
    camera = alone.job.views.cameras[0]
    sizes = {scale: (camera.height >> scale, camera.width >> scale) for scale in alone.job.scales(0)}
    pieces = tuple(Piece(scale, size, Rectangle(0, 0, *size)) for scale, size in sizes.items())
    areas = [[tile.outer.pixels for tile in loss.divider.tiles(piece.size)] for piece in pieces]
    halo = loss.network.halo
    one, shared = (divide(pieces, halo, count) for count in (1, collectives.size))
    return {
        "ranks": collectives.size,
        "seconds_one_rank": median(steps["alone"], "total"),
        "seconds": median(steps["together"], "total"),
        "ratio": median(steps["alone"], "total") / median(steps["together"], "total"),
        "ratio_of_fastest": fastest(steps["alone"]) / fastest(steps["together"]),
        "bound_by_halos": most_pixels(one, halo) / most_pixels(shared, halo),
        "waiting_share_by_rank": [statistics.median(share) for share in waiting],
        "system_seconds_by_rank": [statistics.median(seconds) for seconds in kernel],
        "peak_gb_by_rank": peak,
        "bytes_sent": sent,
        "shown": int((alone.job.views.rasterizer.survey(camera)[1] > 0).sum()),
        "steps": steps,
        "pieces": [[piece.scale, *piece.size] for piece in pieces],
        "halo": halo,
        "held_pixels": loss.tiling.held,
        "pixels_one_rank": sum(map(sum, areas)),
        "pixels_twice_one_rank": sum(computed_twice(each, loss.tiling.cached(each)) for each in areas),
        "working": loss.tiling.working,
    }


def most_pixels(division: Sequence[Sequence[Piece]], halo: int) -> int:
    """Return the largest number of pixels that a rank passes through the network."""
    return max(sum(piece.cost(halo) for piece in own) for own in division)


def processor_seconds(before: resource.struct_rusage) -> dict[str, float]:
    """Return the user and system time of this process since `before`, and its page faults."""
    now = resource.getrusage(resource.RUSAGE_SELF)
    return {
        "processor_user": now.ru_utime - before.ru_utime,
        "processor_system": now.ru_stime - before.ru_stime,
        "page_faults": float(now.ru_minflt - before.ru_minflt),
    }


def median(steps: list[dict[str, float]], part: str) -> float:
    """Return the median over steps of a part's seconds."""
    return statistics.median(step.get(part, 0.0) for step in steps) if steps else math.nan


def fastest(steps: list[dict[str, float]]) -> float:
    """Return the seconds of the step that other programs disturbed least."""
    return min(step["total"] for step in steps)


def describe(result: dict[str, Any]) -> str:
    """Return a one-line summary."""
    waiting = ", ".join(f"{share:.1%}" for share in result["waiting_share_by_rank"])
    ratio, best, bound = (f"{result[key]:.2f}" for key in ("ratio", "ratio_of_fastest", "bound_by_halos"))
    return (
        f"{result['view']}: {result['seconds_one_rank']:.2f} s on one rank, {result['seconds']:.2f} s on "
        f"{result['ranks']}: {ratio} times faster, {best} in the fastest steps (halos bound it to {bound}); "
        f"waiting {waiting}"
    )


if __name__ == "__main__":
    main()
