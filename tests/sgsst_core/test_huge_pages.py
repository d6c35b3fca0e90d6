"""Tests that PyTorch's large tensors use huge pages, if Linux provides them."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

_ENABLED = Path("/sys/kernel/mm/transparent_hugepage/enabled")
_PROGRAM = """
import sgsst_core
from sgsst_core.features.vgg import FeatureNetwork
import torch
large = torch.ones(1 << 25)
print(next(line.split()[1] for line in open("/proc/self/smaps_rollup") if line.startswith("AnonHugePages")))
"""


@pytest.mark.slow
@pytest.mark.parametrize("switch", ["0", None])
def test_large_tensors_use_huge_pages(switch: str | None, monkeypatch: pytest.MonkeyPatch) -> None:
    """The user's environment variables take precedence over the default."""
    if not _ENABLED.exists() or "[madvise]" not in _ENABLED.read_text():
        pytest.skip("this system gives no huge pages, or gives them to everybody")
    monkeypatch.delenv("THP_MEM_ALLOC_ENABLE", raising=False)
    if switch is not None:
        monkeypatch.setenv("THP_MEM_ALLOC_ENABLE", switch)
    done = subprocess.run([sys.executable, "-c", _PROGRAM], stdout=subprocess.PIPE, text=True, check=True)
    kilobytes = int(done.stdout)
    assert kilobytes == 0 if switch == "0" else kilobytes > 0
