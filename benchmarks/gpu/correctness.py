"""Correctness on a GPU: results against float64, repeated steps, memory that held NaN, two ranks, and a loss curve.

NCCL does not support two ranks on one GPU, so theirs exchange tensors by gloo. The loss curve is compared with that of
the same job on the CPU, a separate process in which no GPU is visible; both run at the same time.
"""

import json
import math
import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from datetime import timedelta
from pathlib import Path
from typing import Any

import torch
import torch.distributed as dist
import torch.multiprocessing as multiprocessing
from torch import Tensor

from benchmarks.common import free_address
from benchmarks.gpu.part import QUICK, Findings, Sizes, device, network_weights
from sgsst_core.bench.device_checks import (
    BACKGROUND,
    Check,
    check_device,
    different_repeats,
    make_step,
    surface_scene,
    texture,
    views,
)
from sgsst_core.features.vgg import has_bfloat16
from sgsst_core.parallel import ALONE, Collectives
from sgsst_core.rasterizer import Rasterizer, drawing_problem, make_rasterizer
from sgsst_core.scene.camera import Camera
from sgsst_core.scene.gaussians import Scene
from sgsst_core.scene.spherical_harmonics import scene_colors
from sgsst_core.settings import make_settings
from sgsst_core.stylizing.stylizer import Stylizer
from tests import triton_interpreter
from tests.sgsst_core.rasterizer.splat_reference import ReferenceRasterizer
from worker.ranks.process_group import ProcessGroupCollectives

#: Number of freed blocks of memory that hold NaN, by size in bytes.
_FREED = {1 << 12: 64, 1 << 16: 64, 1 << 20: 32, 1 << 24: 8, 1 << 27: 4}
#: Size in bytes up to which the allocator of a CPU reuses freed blocks; larger ones go back to the system.
_REUSED_BY_CPU = 1 << 20
RANKS = 2
#: Bound on the relative error of the first step's gradient, in the Euclidean norm. It allows for near-ties in max
#: pooling, which may be resolved differently.
GRADIENT_BOUND = 1e-4
#: Bound on the relative error of the change in color. It is larger, because Adam normalizes gradients, so a color whose
#: gradient is only rounding error moves as far as any other.
COLORS_BOUND = 1e-2
#: Bound on the relative difference from the CPU's loss, for means over rounds of all views. Single losses differ more:
#: Adam normalizes gradients, so a color whose gradient is only rounding error moves as far as any other.
CURVE_BOUND = 1e-3
#: Relative distance from an alpha or transmittance cutoff within which float32 rounding may change the decision, and
#: relative error bounds for images, and for their gradients.
CLOSE, RASTER_BOUND, RASTER_GRADIENT_BOUND = 2e-5, 1e-5, 5e-6
VIEWS = 6
#: Learning rate of the paper. At 0.02, an initial difference of 3e-7 in color grows to 1 % in the final loss.
LEARNING_RATE = 2.5e-3


def parity(sizes: Sizes, findings: Findings) -> None:
    """Compare all available rasterizers on one view. Raise an error if `triton` is unavailable."""
    gaussians, width, height = sizes.parity
    scene, camera = surface_scene(gaussians, degree=3), views(1, width, height)[0]
    if problem := drawing_problem("triton", device()):
        raise RuntimeError(f"rasterizer 'triton': {problem}")
    for name in ("triton", "cached"):
        rasterizer = make_rasterizer(name, scene, background=BACKGROUND, device=device())
        for check in reference_checks(rasterizer, scene, camera):
            findings.check(f"{name}/{check.name}", check.error, check.bound)
        step = make_step(rasterizer, scene, camera, network_weights(sizes))
        findings.check(f"{name}/different_of_{sizes.bits}_repeats", different_repeats(step, sizes.bits), 0.0)


def reference_checks(fast: Rasterizer, scene: Scene, camera: Camera) -> Iterator[Check]:
    """Compare image, coverage and color gradient with the float64 reference, except at pixels close to a cutoff."""
    reference = ReferenceRasterizer(scene, background=BACKGROUND)
    colors = scene_colors(scene, camera)
    pixels = torch.randn(camera.height, camera.width, 3, generator=torch.Generator().manual_seed(1))
    band = reference.near_cutoff(camera, CLOSE)
    pixels[band] = 0
    image = (fast.render(colors, camera).cpu() - reference.render(colors, camera)).abs().amax(-1)
    yield Check("image", float(image[~band].max()) / max(1.0, float(colors.max())), RASTER_BOUND)
    coverage = (fast.coverage(camera).cpu() - reference.coverage(camera)).abs()
    yield Check("coverage", float(coverage[~band].max()), RASTER_BOUND)
    expected = reference.color_gradient(pixels, camera)
    error = float((fast.color_gradient(pixels, camera).cpu() - expected).norm() / expected.norm())
    yield Check("gradient", error, RASTER_GRADIENT_BOUND)


def poison(sizes: Sizes, findings: Findings) -> None:
    """Run the checks of `sgsst doctor`, then steps at the size of views."""
    quick = sizes == QUICK
    small: dict[str, Any] = {"gaussians": 100, "size": (32, 24), "repeats": 2, "channels": 16} if quick else {}
    for check in check_device("triton", device(), **small):
        findings.check(f"small/{check.name.replace(' ', '_')}", check.error, check.bound)
    weights = network_weights(sizes)
    gaussians, (width, height) = sizes.gaussians[0], sizes.view
    scene, camera = surface_scene(gaussians, degree=1), views(1, width, height)[0]
    rasterizer = make_rasterizer("triton", scene, background=BACKGROUND, device=device())
    for dtype in (torch.bfloat16, torch.float32) if has_bfloat16(device()) and not quick else (torch.float32,):
        name = str(dtype).removeprefix("torch.")
        step = make_step(rasterizer, scene, camera, weights, dtype)
        expected = step()
        leave_nan(device())
        findings.check(f"{width}x{height}/{name}/values_changed_by_nan", float((step() != expected).sum()), 0.0)


def leave_nan(device: torch.device) -> None:
    """Fill memory with NaN and free it, so that tensors that are created without values are likely to contain NaN."""
    most = _REUSED_BY_CPU if device.type == "cpu" else max(_FREED)
    sizes = [size for size, count in _FREED.items() if size <= most for _ in range(count)]
    blocks = [torch.full((size // 4,), torch.nan, device=device) for size in sizes]
    del blocks


def ranks(sizes: Sizes, findings: Findings) -> None:
    """Compare the gradient of the first step, and the colors after some steps."""
    expected_gradient, start, expected = follow_ranks(ALONE, sizes)
    address = free_address()
    with tempfile.TemporaryDirectory() as folder:
        multiprocessing.spawn(run_rank, (address, folder, sizes), nprocs=RANKS)  # type: ignore[attr-defined]
        results = [torch.load(Path(folder) / f"{rank}.pt") for rank in range(RANKS)]
    gradient, _, colors = results[0]
    findings.check("ranks_that_differ", float(sum(not torch.equal(own[2], colors) for own in results)), 0.0)
    findings.check("gradient", _error(gradient, expected_gradient, torch.zeros(())), GRADIENT_BOUND)
    findings.check("colors", _error(colors, expected, start), COLORS_BOUND)


def follow_ranks(collectives: Collectives, sizes: Sizes) -> tuple[Tensor, Tensor, Tensor]:
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
        weights=network_weights(sizes),
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
    collectives = ProcessGroupCollectives(dist.group.WORLD, timedelta(seconds=60))
    try:
        torch.save(follow_ranks(collectives, sizes), Path(folder) / f"{rank}.pt")
    finally:
        dist.destroy_process_group()


def _error(actual: Tensor, expected: Tensor, start: Tensor) -> float:
    """Return the error relative to the distance between expected and initial value."""
    return float((actual.double() - expected.double()).norm() / (expected.double() - start.double()).norm())


def curve(sizes: Sizes, findings: Findings) -> None:
    """Compare the loss curves of GPU and CPU."""
    quick = sizes == QUICK
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "losses.json"
        command = [sys.executable, "-m", "benchmarks.gpu.correctness", str(path), *(["--quick"] if quick else [])]
        other = subprocess.Popen(command, env={**os.environ, "CUDA_VISIBLE_DEVICES": ""})
        try:
            losses = follow_curve(sizes, None if torch.cuda.is_available() else "triton")
            if other.wait() != 0:
                raise RuntimeError(f"the CPU's run ended with status {other.returncode}")
        finally:
            other.kill()
        expected = json.loads(path.read_text())
    findings.add("losses", losses)
    findings.add("losses_on_the_cpu", expected)
    findings.check("loss", largest_difference(losses, expected, 1 if quick else VIEWS), CURVE_BOUND)


def largest_difference(losses: list[float], expected: list[float], window: int) -> float:
    """Return the largest relative difference between geometric means over windows of steps."""
    differences = [math.log(a / b) for a, b in zip(losses, expected, strict=True)]
    starts = range(0, len(differences) - window + 1, window)
    return max(abs(sum(differences[start : start + window])) / window for start in starts)


def follow_curve(sizes: Sizes, rasterizer: str | None) -> list[float]:
    """Run a job on a ball and cameras whose views it fills, and return the loss of each step."""
    steps, side = sizes.curve
    quick = sizes == QUICK
    ball, cameras = surface_scene(60 if quick else 20_000, degree=1), views(1 if quick else VIEWS, side, side * 3 // 4)
    settings = make_settings(
        "standard", steps_coarse=steps // 2, steps_sos=steps - steps // 2, learning_rate=LEARNING_RATE,
        scale_sampling=1, early_stop=False, cached_weights="none", coarsest_side=side // 2,
    )  # fmt: skip
    weights = network_weights(sizes)
    style = texture(side, side, seed=3)
    stylizer = Stylizer.planned(ball, cameras, style, settings, weights=weights, rasterizer=rasterizer)
    return [stylizer.run_step().loss for _ in range(stylizer.job.total_steps)]


def main(arguments: list[str]) -> None:
    """Run the job on the CPU, and write the losses to the file named by the first argument."""
    sizes = QUICK if "--quick" in arguments else Sizes()
    Path(arguments[0]).write_text(json.dumps(follow_curve(sizes, "cpu")))


if __name__ == "__main__":
    main(sys.argv[1:])
