"""Tests that PyTorch's allocator for GPUs is configured before it starts."""

from __future__ import annotations

import subprocess
import sys

import pytest

NAMES = ("PYTORCH_ALLOC_CONF", "PYTORCH_CUDA_ALLOC_CONF", "PYTORCH_HIP_ALLOC_CONF")
_PROGRAM = f"""
import os, sys
import sgsst_core
assert "torch" not in sys.modules
print({{name: os.environ[name] for name in {NAMES} if name in os.environ}})
"""


@pytest.mark.parametrize(
    "given", [{}, {"PYTORCH_CUDA_ALLOC_CONF": "backend:cudaMallocAsync"}, {"PYTORCH_ALLOC_CONF": ""}]
)
def test_segments_can_grow_unless_the_user_configures_the_allocator(
    given: dict[str, str], monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in NAMES:
        monkeypatch.delenv(name, raising=False)
    for name, value in given.items():
        monkeypatch.setenv(name, value)
    done = subprocess.run([sys.executable, "-c", _PROGRAM], stdout=subprocess.PIPE, text=True, check=True)
    assert done.stdout.strip() == str(given or {"PYTORCH_ALLOC_CONF": "expandable_segments:True"})
