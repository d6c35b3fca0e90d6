"""Tests that shell scripts and Dockerfiles pass their linters."""

import subprocess
import sys
from pathlib import Path

import pytest

from tests.deploy.containers import ROOT

pytestmark = pytest.mark.slow


def lint(tool: str, *words: str | Path) -> None:
    """Run a linter that is installed in this Python environment, and fail if it reports anything."""
    program = Path(sys.executable).parent / tool
    if not program.exists():
        pytest.skip(f"{tool} is missing: see the extra [dev]")
    ended = subprocess.run([program, *words], cwd=ROOT, capture_output=True, text=True)
    assert ended.returncode == 0, ended.stdout + ended.stderr


def test_dockerfiles() -> None:
    lint("hadolint", "deploy/Dockerfile")
    lint("hadolint", "--ignore=DL3008", "--ignore=DL3066", "tests/deploy/stand_ins/Dockerfile")


@pytest.mark.parametrize("script", ["deploy/remove_unused.sh", "tests/deploy/stand_ins/postgres.sh"])
def test_scripts(script: str) -> None:
    lint("shellcheck", "--shell=sh", "--severity=warning", script)


@pytest.mark.parametrize("script", ["deploy/free_network.sh", "deploy/two_hosts.sh", "deploy/three_hosts.sh"])
def test_scripts_of_hosts(script: str) -> None:
    lint("shellcheck", "--severity=error", script)
