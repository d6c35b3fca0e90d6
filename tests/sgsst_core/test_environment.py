"""Tests of the environment that the package sets for PyTorch: its allocator, and waiting threads."""

import re
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


def spin_count(module: str) -> str:
    """Return the spin count that OpenMP reads in a process that imports a module, then PyTorch."""
    code = f"import {module}, torch"
    done = subprocess.run([sys.executable, "-c", code], stderr=subprocess.PIPE, text=True, check=True)
    count = re.search(r"GOMP_SPINCOUNT = '(\d+)'", done.stderr)
    if count is None:
        pytest.skip("PyTorch uses another OpenMP here")
    return count[1]


@pytest.fixture(autouse=True)
def _variables(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("GOMP_SPINCOUNT", "OMP_WAIT_POLICY"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("OMP_DISPLAY_ENV", "VERBOSE")


@pytest.mark.parametrize("module", ["sgsst_core", pytest.param("worker.run", marks=pytest.mark.slow)])
def test_waiting_threads_spin_briefly(module: str) -> None:
    assert spin_count(module) == "1000"


@pytest.mark.slow
def test_users_choice_of_waiting_takes_precedence(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("GOMP_SPINCOUNT", "77")
    assert spin_count("sgsst_core") == "77"
    monkeypatch.delenv("GOMP_SPINCOUNT")
    monkeypatch.setenv("OMP_WAIT_POLICY", "PASSIVE")
    assert spin_count("sgsst_core") == "0"
