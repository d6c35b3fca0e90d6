"""Test of the TypeScript client: its types are generated from the OpenAPI document, and its example runs a job."""

import json
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from tests.api.service import ROOT, Service

pytestmark = pytest.mark.slow
FOLDER = ROOT / "api" / "integrations" / "javascript"


@pytest.fixture(scope="module")
def package() -> Path:
    """Return a copy of the package with its dependencies, which stay in the environment."""
    folder = Path(sys.prefix) / "sgsst-javascript"
    npm = shutil.which("npm")
    if npm is None:
        pytest.skip("npm is missing: apt-get install npm")
    shutil.copytree(FOLDER, folder, dirs_exist_ok=True)
    if not (folder / "node_modules" / "openapi-fetch").exists():
        command = [
            npm,
            "install",
            "--silent",
            "--no-save",
            "--no-audit",
            "--no-fund",
            "--prefer-offline",
            "--prefix",
            str(folder),
        ]
        try:
            subprocess.run(command, check=True, timeout=240)
        except (subprocess.TimeoutExpired, subprocess.CalledProcessError):
            pytest.skip("npm could not install the package's dependencies")
    return folder


def test_example_is_compiled_and_runs(
    package: Path, service: Service, files: tuple[Path, Path, Path], tmp_path: Path
) -> None:
    scene, _, style = files
    environment = {**os.environ, "SGSST_URL": service.url}
    for command in ("generate", "build"):
        subprocess.run(["npm", "run", "--silent", command], check=True, cwd=package, env=environment)
    out = tmp_path / "stylized.ply"
    run = subprocess.run(
        ["node", "example.js", str(scene), str(style), str(out)],
        check=True,
        cwd=package,
        env=environment,
        stdout=subprocess.PIPE,
        text=True,
    )
    assert run.stdout.splitlines()[-1].startswith("succeeded")
    with service.client() as client:
        newest = client.get("/v1/jobs").json()["jobs"][0]
        assert out.read_bytes() == client.get(newest["links"]["result"]).content
    refused = subprocess.run(
        ["node", "example.js", str(style), str(style), str(out)],
        cwd=package,
        env=environment,
        stderr=subprocess.PIPE,
        text=True,
    )
    assert refused.returncode == 1
    assert "style.png" in refused.stderr


def test_compiler_is_the_page_s() -> None:
    package = json.loads((FOLDER / "package.json").read_text())
    (version,) = re.findall(r"^TYPESCRIPT_VERSION := (.*)$", (ROOT / "Makefile").read_text(), re.MULTILINE)
    assert package["devDependencies"]["typescript"] == version
    assert len((FOLDER / "example.ts").read_text().splitlines()) <= 40
