"""Tests of ranks on GPUs: with NCCL against one rank, a GPU against the CPU, and steps on simulated GPUs over gloo."""

from datetime import timedelta
from pathlib import Path
from typing import Any

import pytest
import torch
import torch.multiprocessing as multiprocessing
from torch import Tensor

from sgsst_core.features.network_weights import load_network_weights
from sgsst_core.parallel import ALONE, Collectives
from sgsst_core.settings import make_settings
from sgsst_core.stylizing.stylizer import Stylizer
from tests.networks import tiny_weights
from tests.ports import free_port
from tests.pretend_cuda.device import counts
from tests.sgsst_core.synthetic_images import relative_error
from tests.small_scenes import ball, cameras, style, wall
from tests.worker.ranks.spawn import on_ranks
from worker.ranks.process_group import process_group


def gradient(collectives: Collectives, name: str) -> Tensor:
    """Compute the color gradient [N, 3] of one view at two scales, on the devices that a job would use."""
    scene = wall(sh_degree=1) if name == "wall" else ball()
    settings = make_settings("standard", steps_coarse=0, steps_sos=1, coarsest_side=120)
    stylizer = Stylizer.planned(
        scene, cameras(1, 320, 240), style(), settings, weights=load_network_weights("vgg16"), collectives=collectives
    )
    return stylizer.gradient(0, stylizer.job.scales(0))[0]


@pytest.fixture
def exact_convolutions() -> Any:
    """Disable TF32, which rounds to ten bits and is too inaccurate for comparisons at 1e-5."""
    before = torch.backends.cudnn.allow_tf32, torch.backends.cuda.matmul.allow_tf32
    torch.backends.cudnn.allow_tf32 = torch.backends.cuda.matmul.allow_tf32 = False
    yield
    torch.backends.cudnn.allow_tf32, torch.backends.cuda.matmul.allow_tf32 = before


def run_rank(rank: int, size: int, address: str, name: str, folder: str) -> None:
    torch.backends.cudnn.allow_tf32 = torch.backends.cuda.matmul.allow_tf32 = False
    with process_group(rank, size, address, device=f"cuda:{rank}", timeout=timedelta(seconds=60)) as collectives:
        torch.save(gradient(collectives, name), Path(folder) / f"{rank}.pt")


@pytest.mark.gpu
@pytest.mark.usefixtures("vgg16_weights")
@pytest.mark.skipif(torch.cuda.device_count() < 2, reason="fewer than two CUDA GPUs")
@pytest.mark.parametrize("name", ["wall", "ball"])
def test_nccl_gradient_matches_one_rank(name: str, tmp_path: Path, exact_convolutions: None) -> None:
    expected = gradient(ALONE, name)
    size = min(torch.cuda.device_count(), 4)
    address = f"127.0.0.1:{free_port()}"
    multiprocessing.spawn(  # type: ignore[attr-defined]
        run_rank, (size, address, name, str(tmp_path)), nprocs=size
    )
    actual = [torch.load(tmp_path / f"{rank}.pt") for rank in range(size)]
    for own in actual:
        assert torch.equal(own, actual[0])
    assert relative_error(actual[0], expected) < 1e-5


@pytest.mark.gpu
@pytest.mark.usefixtures("vgg16_weights")
@pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA GPU that PyTorch can use")
@pytest.mark.parametrize("name", ["wall", "ball"])
def test_gpu_gradient_matches_cpu(name: str, exact_convolutions: None, monkeypatch: pytest.MonkeyPatch) -> None:
    """Devices add in different orders, so near-ties of max pooling may be resolved differently."""
    on_gpu = gradient(ALONE, name)
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    on_cpu = gradient(ALONE, name)
    assert relative_error(on_gpu, on_cpu) < 1e-3


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
@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a GPU, on which the tests marked gpu run")
def test_two_ranks_match_one_and_synchronize_once_per_step() -> None:
    """Communication is not counted as host synchronization, because the library waits for other ranks anyway."""
    pytest.importorskip("triton")
    expected, losses, _, _ = run_steps(ALONE)
    first, second = on_ranks(2, run_steps, device="cuda:0")
    assert first[2][2:] == second[2][2:] == [1] * (STEPS - 2)
    assert torch.equal(first[0], second[0])
    assert first[1] == second[1]
    assert first[3] == second[3] == "cuda triton"
    assert first[1] == pytest.approx(losses, rel=1e-4)
    assert relative_error(first[0], expected.double()) < 1e-3
