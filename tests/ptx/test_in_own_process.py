"""Run of the compiled kernels in the PTX interpreter, in a process of its own."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

pytest.importorskip("triton")
pytestmark = pytest.mark.slow
#: Tests that compare kernels with float64 references, and that run on any device.
COMPARISONS = (
    "tests/sgsst_core/rasterizer/test_triton.py",
    "tests/sgsst_core/rasterizer/test_triton_cached.py",
    "tests/sgsst_core/features/test_layers.py",
    "tests/sgsst_core/loss/test_fused.py",
    "tests/sgsst_core/scene/test_spherical_harmonics.py",
)
#: Tests in these files that plan jobs, compile for other targets, or expect that there is no device.
OTHERS = "job or plan or compile or without_a_gpu or trial"


def run(*arguments: str) -> None:
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "-p", "tests.ptx.plugin", *arguments]
    environment = {**os.environ, "TRITON_INTERPRET": "0"}
    ended = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    assert ended.returncode == 0, ended.stdout[-5000:] + ended.stderr[-2000:]


def test_compiled_kernel_tests_pass() -> None:
    """These tests choose their targets themselves."""
    run("tests/ptx")


@pytest.mark.parametrize("target", ["sm_80", "sm_90"])
def test_kernel_comparisons_pass_on_target(target: str) -> None:
    run(f"--ptx-target={target}", "-k", f"not ({OTHERS})", *COMPARISONS)
