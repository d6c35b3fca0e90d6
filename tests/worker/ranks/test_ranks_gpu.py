"""Tests on GPUs: several ranks with NCCL against one rank, and one GPU against the CPU."""

from datetime import timedelta
from pathlib import Path
from typing import Any

import pytest
import torch
import torch.multiprocessing as multiprocessing
from torch import Tensor

from sgsst_core.features.network_weights import load_network_weights
from sgsst_core.parallel.collectives import ALONE, Collectives
from sgsst_core.settings import make_settings
from sgsst_core.stylizing.stylizer import Stylizer
from tests.ports import free_port
from tests.sgsst_core.synthetic_images import relative_error
from tests.small_scenes import ball, cameras, style, wall
from worker.ranks.process_group import process_group

pytestmark = [pytest.mark.gpu, pytest.mark.usefixtures("vgg16_weights")]


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


@pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA GPU that PyTorch can use")
@pytest.mark.parametrize("name", ["wall", "ball"])
def test_gpu_gradient_matches_cpu(name: str, exact_convolutions: None, monkeypatch: pytest.MonkeyPatch) -> None:
    """Devices add in different orders, so near-ties of max pooling may be resolved differently."""
    on_gpu = gradient(ALONE, name)
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    on_cpu = gradient(ALONE, name)
    assert relative_error(on_gpu, on_cpu) < 1e-3
