"""Count a step's GPU kernels, host synchronizations and copied bytes on a simulated GPU, line by line.

    python -m benchmarks.device_counts [--size 980x545] [--name device_counts]

The network has VGG19's layers with random weights, and there are three scales. One scene fills its views; the other is
an object scan, which needs weighted statistics. Each PyTorch operation counts as the kernels that it launches itself;
on a real GPU, a library may launch a few more. Steps use a small view, because Triton's interpreter takes minutes to
render a large one. Only the loss could depend on the size, so it is counted at the given size too.
"""

from __future__ import annotations

import argparse
import os
import sys
from dataclasses import replace
from typing import Any

os.environ.setdefault("TRITON_INTERPRET", "1")  # read when the kernels are first imported

import torch

from benchmarks.machine import write_result
from sgsst_core.loss.sos import SosLoss
from sgsst_core.planning.planner import make_plan
from sgsst_core.settings import Precision, make_settings
from sgsst_core.style import Style
from sgsst_core.stylizing.job import prepare_job
from sgsst_core.stylizing.stylizer import Stylizer
from tests.networks import comparing_pixels, tiny_weights
from tests.pretend_cuda.counts import Counts
from tests.pretend_cuda.runtime import pretend_cuda
from tests.small_scenes import ball, cameras, style, wall

#: Size of the view that steps use.
SMALL = (64, 64)


def counted(scan: bool, precision: Precision, size: tuple[int, int]) -> dict[str, Any]:
    """Count the work of a view's first step, of a later step, and of the loss on a small and a large view."""
    settings = make_settings(
        steps_coarse=0,
        steps_sos=2,
        coarsest_side=16,
        position_weights="on" if scan else "off",
        precision=precision,
    )
    scene = ball(60) if scan else wall(14, 11, sh_degree=1)
    with pretend_cuda() as counts:
        weights = comparing_pixels(tiny_weights("vgg19"))  # as with feature scale `even`
        plan, planning_context = make_plan(scene, cameras(1, *SMALL), settings, weights=weights)
        plan = replace(plan, precision=precision)  # independent of what is fastest on this processor
        context = planning_context if plan.precision == planning_context.network.precision else None
        stylizer = Stylizer(
            prepare_job(
                plan, scene, cameras(1, *SMALL), Style.of(style()), settings, weights=weights, planning_context=context
            )
        )
        steps = []
        for _ in range(2):
            counts.clear()
            stylizer.run_step()
            steps.append(counts.copy())
        losses = {}
        for width, height in (SMALL, size):
            loss = SosLoss(stylizer.job.network, coarsest=max(16, min(width, height) // 4))
            losses[f"{width}x{height}"] = launches_of(loss, counts, (height, width), scan)
    return {
        "launches of the loss": losses,
        "scales": stylizer.job.scale_count(0),
        "rasterizer": stylizer.job.plan.rasterizer,
        "first": totals(steps[0]),
        "steady": totals(steps[1]),
        "lines": {kind: dict(getattr(steps[1], kind).most_common()) for kind in ("launches", "waits", "copies")},
    }


def launches_of(loss: SosLoss, counts: Counts, size: tuple[int, int], scan: bool) -> int:
    """Count the kernel launches of loss and gradient of a view at three scales; `size` is (height, width)."""
    assert loss.tiling.scale_count(size) == 3
    image = torch.rand((*size, 3), generator=torch.Generator().manual_seed(0)).to("cuda")
    view = loss.targets.of_view(image.flip(0), image[..., 0] if scan else None)
    targets = loss.targets.of_style(Style.of(image.flip(1)), size)
    counts.clear()
    loss.evaluate(image, targets, view)
    return counts.launches.total()


def totals(counts: Counts) -> dict[str, int]:
    """Return the totals over all lines of code."""
    return {kind: getattr(counts, kind).total() for kind in ("launches", "waits", "copies")}


def main() -> int:
    """Count the work, then print and store it."""
    torch.set_num_threads(2)
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--size", default="980x545", help="of a large view, WIDTHxHEIGHT")
    parser.add_argument("--name", default=None, help="of the file in benchmarks/results; none is written without it")
    arguments = parser.parse_args()
    width, height = (int(side) for side in arguments.size.split("x"))
    by_case = {}
    precisions: tuple[Precision, ...] = ("float32", "bfloat16")
    for scan in (False, True):
        for precision in precisions:
            name = f"{'scan' if scan else 'scene'}, {precision}"
            by_case[name] = counted(scan, precision, (width, height))
            print(f"{name}: {by_case[name]['scales']} scales", flush=True)
            for step in ("first", "steady"):
                print(
                    f"  {step:<8}" + "  ".join(f"{key} {value}" for key, value in by_case[name][step].items()),
                    flush=True,
                )
            print(f"  loss    {by_case[name]['launches of the loss']}", flush=True)
    for kind, lines in by_case["scan, float32"]["lines"].items():
        print(f"{kind} of a steady step, scan, float32")
        for line, count in lines.items():
            print(f"  {count:>6}  {line}")
    if arguments.name:
        write_result(arguments.name, {"size": [width, height], **by_case})
    return 0


if __name__ == "__main__":
    sys.exit(main())
