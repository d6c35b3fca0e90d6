"""Tests of the simulated CUDA device: it behaves like a real one in the respects that other tests rely on."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

if torch.cuda.is_available():
    pytest.skip("there is a GPU", allow_module_level=True)

from sgsst_core.bench import device_checks
from tests.pretend_cuda.counts import Counts

pytest.importorskip("triton")


def numbers() -> Tensor:
    return torch.arange(6.0).reshape(2, 3).to("cuda")


def test_operations_that_cuda_rejects_are_rejected(counts: Counts) -> None:
    there = numbers()
    with pytest.raises(RuntimeError, match="same device"):
        there + torch.ones(2, 3)
    with pytest.raises(RuntimeError, match="indices should be"):
        torch.ones(2)[torch.tensor([0], device="cuda")]
    for convert in (lambda x: x.numpy(), np.asarray):
        with pytest.raises(TypeError, match="convert cuda:0"):
            convert(there)
    with pytest.raises(ValueError, match="index"):
        torch.cuda.set_device(torch.device("cuda"))
    torch.cuda.set_device(torch.device("cuda", 0))
    assert float((there + torch.tensor(1.0)).sum()) == 21.0  # CUDA accepts CPU scalars


@pytest.mark.parametrize(
    ("asked", "waits"),
    [
        (lambda x: float(x[0, 0]), 1),
        (lambda x: bool((x > 1).any()), 1),
        (lambda x: x.tolist(), 1),
        (lambda x: x.cpu(), 1),
        (lambda x: x[x > 1], 1),
        (lambda x: x.nonzero(), 1),
        (lambda x: torch.tensor([1.0], device="cuda"), 1),
        (lambda x: x.new_tensor([1.0]), 1),
        (lambda x: torch.ones(3).to("cuda"), 1),
        (lambda x: torch.ones(3).to("cuda", non_blocking=True), 0),
        (lambda x: torch.ones(1 << 20).to("cuda", non_blocking=True), 1),
        (lambda x: torch.ones(1 << 20).pin_memory().to("cuda", non_blocking=True), 0),
        (lambda x: torch.cuda.synchronize(), 1),
        (lambda x: torch.where(x > 1, x, 0.0).cumsum(0).sort(), 0),
        (lambda x: x[:, 1:].T.contiguous() @ x[:, :1], 0),
    ],
)
def test_host_synchronizations_are_counted(counts: Counts, asked: Callable[[Tensor], object], waits: int) -> None:
    there = numbers()
    counts.clear()
    asked(there)
    assert counts.waits.total() == waits


@pytest.mark.slow
def test_doctor_describes_the_gpu(counts: Counts) -> None:
    assert device_checks._gpu().text.startswith("1 x pretend, compute capability 9.0, CUDA ")
    assert device_checks._memory(torch.device("cuda", 0)).text == "jobs plan with 105.2 GB of the GPU's memory"
    assert device_checks._precision().text == "jobs use float16; possible: float32, float16, bfloat16, tf32"


def test_doctor_explains_why_a_gpu_is_not_used(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Path, "exists", lambda path: str(path) == "/dev/nvidia0")
    finding = device_checks._gpu()
    assert finding.state == "warning"
    assert ("built for CPUs only" if torch.version.cuda is None else "PyTorch cannot use it") in finding.text
