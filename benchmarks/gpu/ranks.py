"""Comparison of the results of two ranks on one device with those of one rank.

NCCL does not support two ranks on one GPU, so tensors are exchanged by gloo. The speed is therefore not representative.
"""

from __future__ import annotations

import tempfile
from datetime import timedelta
from pathlib import Path

import torch
import torch.distributed as dist
import torch.multiprocessing as multiprocessing
from torch import Tensor

from benchmarks.gpu.inputs import network_weights, small_weights
from benchmarks.gpu.part import QUICK, Findings, Sizes, device
from benchmarks.machine import free_address
from sgsst_core.bench.synthetic import surface_scene, texture, views
from sgsst_core.parallel.collectives import ALONE, Collectives
from sgsst_core.settings import make_settings
from sgsst_core.stylizing.stylizer import Stylizer
from tests import triton_interpreter
from worker.ranks.process_group import ProcessGroupCollectives

RANKS = 2
#: Bound on the relative error of the first step's gradient, in the Euclidean norm. It allows for near-ties in max
#: pooling, which may be resolved differently.
GRADIENT_BOUND = 1e-4
#: Bound on the relative error of the change in color. It is larger, because Adam normalizes gradients, so a color whose
#: gradient is only rounding error moves as far as any other.
COLORS_BOUND = 1e-2


def run(sizes: Sizes, findings: Findings) -> None:
    """Compare the gradient of the first step, and the colors after some steps."""
    expected_gradient, start, expected = follow(ALONE, sizes)
    address = free_address()
    with tempfile.TemporaryDirectory() as folder:
        multiprocessing.spawn(run_rank, (address, folder, sizes), nprocs=RANKS)  # type: ignore[attr-defined]
        results = [torch.load(Path(folder) / f"{rank}.pt") for rank in range(RANKS)]
    gradient, _, colors = results[0]
    findings.add("ranks", RANKS)
    findings.check("ranks_that_differ", float(sum(not torch.equal(own[2], colors) for own in results)), 0.0)
    findings.check("gradient", _error(gradient, expected_gradient, torch.zeros(())), GRADIENT_BOUND)
    findings.check("colors", _error(colors, expected, start), COLORS_BOUND)


def follow(collectives: Collectives, sizes: Sizes) -> tuple[Tensor, Tensor, Tensor]:
    """Return the gradient of a view before the first step, and the colors [N, 3] before it and after the last step."""
    quick = sizes == QUICK
    settings = make_settings(
        "standard", steps_sos=sizes.rank_steps, scale_sampling=1, early_stop=False,
        cached_weights="none", coarsest_side=24 if quick else None,
    )  # fmt: skip
    width, height = sizes.view
    stylizer = Stylizer.planned(
        surface_scene(sizes.gaussians[0], degree=3),
        views(2, width, height),
        texture(height, height, seed=3),
        settings,
        weights=small_weights() if quick else network_weights(),
        rasterizer=None if device().type == "cuda" else "triton",
        collectives=collectives,
    )
    gradient = stylizer.gradient(0, stylizer.job.scales(0))[0].cpu()
    start = stylizer.sh_dc.detach().cpu().clone()
    for _ in range(sizes.rank_steps):
        stylizer.run_step()
    return gradient, start, stylizer.sh_dc.detach().cpu()


def run_rank(rank: int, address: str, folder: str, sizes: Sizes) -> None:
    """Run one rank and save its results."""
    if device().type == "cpu":
        torch.set_num_threads(1)
        triton_interpreter.prepare()
    dist.init_process_group("gloo", init_method=f"tcp://{address}", rank=rank, world_size=RANKS)
    collectives = ProcessGroupCollectives(dist.group.WORLD, device(), timedelta(seconds=60))
    try:
        torch.save(follow(collectives, sizes), Path(folder) / f"{rank}.pt")
    finally:
        dist.destroy_process_group()


def _error(actual: Tensor, expected: Tensor, start: Tensor) -> float:
    """Return the error relative to the distance between expected and initial value."""
    return float((actual.double() - expected.double()).norm() / (expected.double() - start.double()).norm())
