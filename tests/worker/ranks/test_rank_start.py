"""Tests of process-wide settings that a rank makes at startup: threads, GPU, precision of matrix products."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest
import torch
import torch.distributed as dist

from worker.ranks.process_group import with_index
from worker.ranks.rank import _failure

ROOT = Path(__file__).resolve().parents[3]

#: Program that compiles an uncached kernel after Numba's threads have started and another number of threads was set.
COLD_CACHE = """
import os, sys
import numba, numpy as np
from worker.ranks.rank import set_thread_variables

@numba.njit(parallel=True)
def doubled(x):
    for i in numba.prange(x.size):
        x[i] *= 2

doubled(np.ones(8))
set_thread_variables(numba.config.NUMBA_NUM_THREADS + 1)
doubled(np.ones(8, np.float32))
print(os.environ["OMP_NUM_THREADS"])
"""


@pytest.mark.slow
def test_thread_count_can_be_set_after_kernels_ran() -> None:
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    ended = subprocess.run(
        [sys.executable, "-c", COLD_CACHE], env=environment, capture_output=True, text=True, check=False
    )
    assert ended.returncode == 0, ended.stderr
    assert int(ended.stdout) > 1


def test_devices_get_an_index(monkeypatch: pytest.MonkeyPatch) -> None:
    """PyTorch refuses a device without an index, and does so before it looks for a GPU."""
    with pytest.raises(ValueError, match="index"):
        torch.cuda.set_device(torch.device("cuda"))
    monkeypatch.setattr(torch.cuda, "current_device", lambda: 3)
    assert with_index("cuda") == torch.device("cuda", 3)
    assert with_index("cuda:1") == torch.device("cuda", 1)
    assert with_index("cpu") == torch.device("cpu")


def test_store_error_is_an_echo_of_a_lost_rank() -> None:
    """Such an error occurs if a rank is lost while the other ranks form their process group."""
    assert _failure(dist.DistStoreError("wait timeout")).echo
    assert not _failure(RuntimeError("wait timeout")).echo
