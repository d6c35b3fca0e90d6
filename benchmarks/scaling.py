"""Forecast of the time of an SOS iteration on 1 to 64 GPUs, by the planner's model for choosing the number of ranks.

python -m benchmarks.scaling [--shown 0.65]

Nothing here is measured on several GPUs. The times of one GPU are those of `benchmarks.forecast` for an H100 in
float16, with all data of the views in memory. One GPU replays the loss as a CUDA graph; several launch the kernels of
their partition tiles one by one. Launches for exchanges are not counted. The other assumptions are the constants below;
they are stored with the tables. `benchmarks.ranks` validates the same model on a CPU, by predicting the speedup of two
ranks from one rank's seconds.
"""

from __future__ import annotations

import argparse
from dataclasses import asdict, replace
from typing import Any

from benchmarks.forecast import DEVICES, JOBS, LAUNCHES, LOSS_LAUNCHES, SHARES, Job, Part, step_parts
from benchmarks.iteration_work import IterationWork, Link, loads, proportional
from benchmarks.machine import write_result
from sgsst_core.features.partition import Rectangle
from sgsst_core.features.vgg import HALO
from sgsst_core.parallel.division import Piece, divide
from sgsst_core.scales import scale_count

RANKS = (1, 2, 4, 8, 16, 32, 64)
#: Links between two ranks: 80 % of the data sheet's bandwidth in one direction, and latency in seconds.
LINKS = {
    "NVLink 4": Link(0.8 * 450e9, 5e-6),
    "PCIe 4.0 x16": Link(0.8 * 32e9, 10e-6),
    "25 Gb/s Ethernet": Link(0.8 * 25e9 / 8, 30e-6),
}
#: Fraction of the optimized Gaussians that a view shows: 65 % for the plush toy scene with its real cameras. Views of
#: walk-through scenes show fewer.
SHOWN_SHARE = 0.65
#: Scales at which `LOSS_LAUNCHES` was counted, each with one partition tile.
COUNTED_SCALES = 3
#: Parts of a forecast by what they are proportional to. All other parts are the same on every rank.
NETWORK = (
    "convolutions forward",
    "convolutions backward",
    "ReLUs, pools, copies",
    "statistics",
    "style gradient",
    "content loss",
    "pyramid",
)
RASTER = ("render", "raster gradient")


def main() -> None:
    """Compute the forecast, then print and store it."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--shown", type=float, default=SHOWN_SHARE, help="share of the Gaussians that a view shows")
    arguments = parser.parse_args()
    results: dict[str, Any] = {}
    for name, job in JOBS.items():
        work = work_of(job, arguments.shown)
        results[name] = forecast(work)
        print(f"\n{name}: {1e3 * work.computing(1):.1f} ms an iteration on one GPU\n\n{table(results[name])}")
        for link in LINKS:
            print(f"\n{name}, {link}, ms of the GPU with most work\n\n{breakdown(results[name], link)}")
    assumptions = {
        "halo": HALO["vgg19"],
        "links": {name: asdict(link) for name, link in LINKS.items()},
        "jobs": {name: asdict(job) for name, job in JOBS.items()},
        "shown_share": arguments.shown,
    }
    write_result("scaling", {"assumptions": assumptions, "forecast": results})


def work_of(job: Job, shown: float) -> IterationWork:
    """Return the work of an iteration, from the forecast of its parts on an H100.

    The division assumes the forecast's cost of rendering, as jobs do after they have compared their ranks' speeds.
    """
    height, width = job.size
    device, shares = DEVICES["H100"], SHARES["likely"]
    parts = step_parts(job, device, "float16", everything_cached=True)
    rates = shares.rates(device, "float16")

    def seconds(part: Part) -> float:
        return part.visits * sum(work.seconds(rates) for work in part.works)

    network, raster = (sum(seconds(parts[name]) for name in names) for names in (NETWORK, RASTER))
    same = sum(seconds(part) for name, part in parts.items() if name not in NETWORK + RASTER)
    sizes = [(height >> scale, width >> scale) for scale in range(scale_count(height, width))]
    pieces = tuple(Piece(scale, size, Rectangle(0, 0, *size)) for scale, size in enumerate(sizes))
    pixel = network / sum(piece.region.pixels for piece in pieces)
    return IterationWork(
        pieces=pieces,
        halo=HALO["vgg19"],
        pixel=pixel,
        raster=proportional(raster),
        fixed=same + shares.gap * LAUNCHES,
        gaussians=job.gaussians,
        shown=shown * job.gaussians,
        rendering=raster / (height * width) / pixel,
        launch=shares.launch * LOSS_LAUNCHES / COUNTED_SCALES,
        graphs=True,
    )


def forecast(work: IterationWork) -> dict[str, Any]:
    """Return the forecast by number of ranks.

    It consists of the speedup limit due to halos, the bytes sent, the milliseconds of each part, and for each link the
    speedup and the milliseconds of communication by purpose.
    """
    one = work.computing(1)
    network_alone = replace(work, rendering=0.0)
    unhaloed = loads(network_alone.shards(1), work.halo)[0]
    by_ranks = {}
    for ranks in RANKS:
        links = {}
        for name, link in LINKS.items():
            waiting = {purpose: 1e3 * seconds for purpose, seconds in work.waiting(ranks, link).items()}
            links[name] = {"speed_up": one / work.seconds(ranks, link), "milliseconds": waiting}
        by_ranks[str(ranks)] = {
            "bound_by_halos": unhaloed / max(loads(divide(work.pieces, work.halo, ranks), work.halo)),
            "bytes_sent": work.sent(ranks),
            "milliseconds": computing_parts(work, ranks),
            "links": links,
        }
    return by_ranks


def computing_parts(work: IterationWork, ranks: int) -> dict[str, float]:
    """Return the milliseconds of the slowest rank's computing parts; their sum is `IterationWork.computing`.

    The perfect portion is that of a division without halos; the excess over it is due to halos and uneven pieces.
    """
    unlaunched = replace(work, launch=0.0)
    shared = work.computing(1) - work.fixed
    network = replace(unlaunched, raster=proportional(0.0), fixed=0.0)
    halos = unlaunched.computing(ranks) - work.fixed - shared / ranks
    return {
        "network, perfectly divided": 1e3 * network.computing(1) / ranks,
        "render and gradient, perfectly divided": 1e3 * (shared - network.computing(1)) / ranks,
        "halos and uneven pieces": 1e3 * halos,
        "waiting for launches": 1e3 * (work.computing(ranks) - unlaunched.computing(ranks)),
        "the same on every GPU": 1e3 * work.fixed,
    }


def table(by_ranks: dict[str, Any]) -> str:
    """Return the speedups as Markdown."""
    lines = ["| GPUs | halos alone | " + " | ".join(LINKS) + " |", "|---:" * (2 + len(LINKS)) + "|"]
    for ranks, entry in by_ranks.items():
        cells = [f"{part['speed_up']:.1f}" for part in entry["links"].values()]
        lines.append(f"| {ranks} | {entry['bound_by_halos']:.1f} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


def breakdown(by_ranks: dict[str, Any], link: str) -> str:
    """Return the milliseconds of each part by number of GPUs as Markdown."""
    columns = [{**entry["milliseconds"], **entry["links"][link]["milliseconds"]} for entry in by_ranks.values()]
    lines = ["| part | " + " | ".join(by_ranks) + " |", "|---|" + "---:|" * len(columns)]
    lines += [f"| {part} | " + " | ".join(f"{column[part]:.2f}" for column in columns) + " |" for part in columns[0]]
    lines.append("| **in total** | " + " | ".join(f"{sum(column.values()):.2f}" for column in columns) + " |")
    return "\n".join(lines)


if __name__ == "__main__":
    main()
