"""Packages of npm and the scene that other programs exchange."""

import shutil
import subprocess
from pathlib import Path

import pytest

from sgsst_core.scene.gaussians import Scene
from tests.sgsst_core.splat_scenes import cloud

PACKAGES = (
    "@playcanvas/splat-transform@3.7.0",
    "gltf-validator@2.0.0-dev.3.10",
    "@mkkellogg/gaussian-splats-3d@0.4.7",
    "@sparkjsdev/spark@2.2.0",
    "playcanvas@2.23.3",
    "gsplat@1.2.9",
    "@babylonjs/core@9.28.0",
    "@babylonjs/loaders@9.28.0",
)


@pytest.fixture(scope="session")
def modules(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with the packages of npm."""
    if not shutil.which("npm") or not shutil.which("node"):
        pytest.skip("npm is not installed")
    folder = tmp_path_factory.mktemp("npm")
    (folder / "package.json").write_text("{}")
    done = subprocess.run(
        ["npm", "install", "--no-audit", "--no-fund", "--ignore-scripts", *PACKAGES],
        cwd=folder,
        capture_output=True,
        text=True,
    )
    if done.returncode:
        pytest.skip(f"npm cannot install the packages: {done.stderr[-300:]}")
    return folder


@pytest.fixture(scope="session")
def scene() -> Scene:
    return cloud(2000, degree=2)
