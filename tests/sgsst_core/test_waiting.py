"""Tests that threads of OpenMP that wait for others soon leave the processor to them."""

from __future__ import annotations

import re
import subprocess
import sys

import pytest

MODULES = ("api.cli.main", "service.scheduling.attempt_process", "service.inspection.process", "worker.ranks.rank")


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


@pytest.mark.parametrize(
    "module", ["sgsst_core", *(pytest.param(module, marks=pytest.mark.slow) for module in MODULES)]
)
def test_waiting_threads_spin_briefly(module: str) -> None:
    assert spin_count(module) == "1000"


@pytest.mark.slow
def test_users_choice_of_waiting_takes_precedence(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("GOMP_SPINCOUNT", "77")
    assert spin_count("sgsst_core") == "77"
    monkeypatch.delenv("GOMP_SPINCOUNT")
    monkeypatch.setenv("OMP_WAIT_POLICY", "PASSIVE")
    assert spin_count("sgsst_core") == "0"
