"""Tests of ranks with simulated CUDA devices, over gloo: results and host synchronizations of their steps."""

import pytest
import torch
from torch import Tensor

if torch.cuda.is_available():
    pytest.skip("there is a GPU, on which the tests marked gpu run", allow_module_level=True)

from sgsst_core.parallel.collectives import ALONE, Collectives
from sgsst_core.settings import make_settings
from sgsst_core.stylizing.stylizer import Stylizer
from tests.networks import tiny_weights
from tests.pretend_cuda.device import counts
from tests.sgsst_core.synthetic_images import relative_error
from tests.small_scenes import ball, cameras, style
from tests.worker.ranks.spawn import on_ranks

pytest.importorskip("triton")
STEPS = 4


def run_steps(collectives: Collectives) -> tuple[Tensor, list[float], list[int], str]:
    """Run a few steps of one view at two scales; return colors, losses, synchronizations, and device and rasterizer."""
    settings = make_settings(steps_coarse=0, steps_sos=STEPS, coarsest_side=16, precision="float32")
    stylizer = Stylizer.planned(
        ball(60), cameras(1, 48, 32), style(), settings, weights=tiny_weights(), collectives=collectives
    )
    losses, waits = [], []
    for _ in range(STEPS):
        counts.clear()
        losses.append(stylizer.run_step().loss)
        waits.append(counts.waits.total())
    return stylizer.stylized(), losses, waits, f"{stylizer.job.plan.device} {stylizer.job.plan.uncached}"


@pytest.mark.slow
def test_two_ranks_match_one_and_synchronize_once_per_step() -> None:
    """Communication is not counted as host synchronization, because the library waits for other ranks anyway."""
    expected, losses, _, _ = run_steps(ALONE)
    first, second = on_ranks(2, run_steps, device="cuda")
    assert first[2][2:] == second[2][2:] == [1] * (STEPS - 2)
    assert torch.equal(first[0], second[0])
    assert first[1] == second[1]
    assert first[3] == second[3] == "cuda triton"
    assert first[1] == pytest.approx(losses, rel=1e-4)
    assert relative_error(first[0], expected.double()) < 1e-3
