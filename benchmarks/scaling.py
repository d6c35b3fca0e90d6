"""Forecast of the time of an SOS iteration on 1 to 64 GPUs, by the planner's model for choosing the number of ranks.

python -m benchmarks.scaling [--tflops 370] [--shown 0.65]

Nothing here is measured on GPUs. The assumptions are the constants below; they are printed and stored with the table.
`benchmarks.ranks` validates the same model on a CPU, by predicting the speedup of two ranks from one rank's seconds.
"""

from __future__ import annotations

import argparse
from dataclasses import asdict
from typing import Any

from benchmarks.machine import write_result
from sgsst_core.features.partition import Rectangle
from sgsst_core.features.vgg import HALO
from sgsst_core.loss.tiling import RENDERING
from sgsst_core.parallel.division import Piece, divide, loads
from sgsst_core.planning.cost import IterationWork, proportional
from sgsst_core.planning.facts import Link
from sgsst_core.scene.pyramid import scale_count

RANKS = (1, 2, 4, 8, 16, 32, 64)
#: Operations per pixel in VGG19's forward pass up to relu5_1; the backward pass has as many.
FLOP_PER_PIXEL = 2 * 0.72e6
#: Links between two ranks: 80 % of the data sheet's bandwidth in one direction, and latency in seconds.
LINKS = {
    "NVLink 4": Link(0.8 * 450e9, 5e-6),
    "PCIe 4.0 x16": Link(0.8 * 32e9, 10e-6),
    "25 Gb/s Ethernet": Link(0.8 * 25e9 / 8, 30e-6),
}
#: Height, width, number of optimized Gaussians, and seconds of render plus gradient on an H100 by `forecast`, for a
#: typical scene of Tanks and Temples and for the garden scene of Mip-NeRF 360 at full size.
VIEWS = {"980x545": (545, 980, 2_500_000, 0.0015), "5187x3361": (3361, 5187, 5_800_000, 0.020)}
#: Default of `--tflops`: operations of VGG's convolutions over the time of network, statistics and losses, on an H100
#: in bfloat16 by `forecast`.
TFLOPS = 370.0
#: Fraction of the optimized Gaussians that a view shows: 65 % for the plush toy scene with its real cameras, 68 % for
#: the biker scene in an orbit. Views of walk-through scenes show fewer.
SHOWN_SHARE = 0.65
#: Seconds per iteration that do not depend on the number of ranks: comparing statistics, optimizer, kernel launches.
FIXED_SECONDS = 0.003


def main() -> None:
    """Compute the forecast, then print and store it."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--tflops", type=float, default=TFLOPS, help="that one GPU sustains in VGG's convolutions")
    parser.add_argument("--shown", type=float, default=SHOWN_SHARE, help="share of the Gaussians that a view shows")
    arguments = parser.parse_args()
    results: dict[str, Any] = {}
    for name, (height, width, gaussians, raster) in VIEWS.items():
        work = IterationWork(
            pieces=tuple(
                Piece(s, (height >> s, width >> s), Rectangle(0, 0, height >> s, width >> s))
                for s in range(scale_count(height, width))
            ),
            halo=HALO["vgg19"],
            pixel=FLOP_PER_PIXEL / (arguments.tflops * 1e12),
            raster=proportional(raster),
            fixed=FIXED_SECONDS,
            gaussians=gaussians,
            shown=arguments.shown * gaussians,
            rendering=RENDERING["cuda"],
        )
        results[name] = forecast(work)
        sent = ", ".join(f"{kind} {size / 1e6:.1f} MB" for kind, size in work.sent(2).items())
        print(f"\n{name}: {1e3 * work.computing(1):.0f} ms an iteration on one GPU; each of two sends {sent}")
        print(table(results[name]))
    assumptions = {
        "tflops": arguments.tflops,
        "flop_per_pixel": FLOP_PER_PIXEL,
        "fixed_seconds": FIXED_SECONDS,
        "halo": HALO["vgg19"],
        "links": {name: asdict(link) for name, link in LINKS.items()},
        "views": VIEWS,
        "shown_share": arguments.shown,
    }
    write_result("scaling", {"assumptions": assumptions, "forecast": results})


def forecast(work: IterationWork) -> dict[str, Any]:
    """Return the forecast by number of ranks.

    It consists of the speedup limit due to halos, the bytes sent, and for each link the speedup and the fraction of
    time spent on communication.
    """
    one = max(loads(divide(work.pieces, work.halo, (1.0,)), work.halo))
    by_scene = {}
    for ranks in RANKS:
        largest = max(loads(divide(work.pieces, work.halo, (1.0,) * ranks), work.halo))
        links = {
            name: {
                "speed_up": work.computing(1) / work.seconds(ranks, link),
                "communication_share": work.communication(ranks, link) / work.seconds(ranks, link),
            }
            for name, link in LINKS.items()
        }
        by_scene[str(ranks)] = {"bound_by_halos": one / largest, "bytes_sent": work.sent(ranks), "links": links}
    return by_scene


def table(by_scene: dict[str, Any]) -> str:
    """Return the forecast as Markdown."""
    lines = ["| GPUs | halos alone | " + " | ".join(LINKS) + " |", "|---:" * (2 + len(LINKS)) + "|"]
    for ranks, entry in by_scene.items():
        cells = [f"{part['speed_up']:.1f} ({part['communication_share']:.0%})" for part in entry["links"].values()]
        lines.append(f"| {ranks} | {entry['bound_by_halos']:.1f} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


if __name__ == "__main__":
    main()
