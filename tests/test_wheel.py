"""Tests of the wheel, which is installed into a new environment and used from another folder.

The new environment can import third-party packages of the current one, so nothing is downloaded. It cannot import this
project's source, so files that the wheel lacks are missing there. The core environment has only the packages that an
installation without extras has.
"""

import json
import os
import shutil
import subprocess
import sys
import sysconfig
import venv
import zipfile
from importlib.metadata import Distribution, distribution
from pathlib import Path

import numpy as np
import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

from api.http.sending import static_files
from sgsst_core.features.network_weights import BackboneWeights
from tests.small_scenes import wall, write_files

pytestmark = pytest.mark.slow

ROOT = Path(__file__).resolve().parents[1]
PACKAGES = ("sgsst_core", "worker", "service", "api")


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Build the wheel in a copy of the working tree, because building leaves folders behind."""
    copy = tmp_path_factory.mktemp("source")
    for name in PACKAGES:
        shutil.copytree(ROOT / name, copy / name, ignore=shutil.ignore_patterns("__pycache__"))
    (copy / "docs").mkdir()
    for name in ("pyproject.toml", "README.md", "LICENSE", "docs/credits.md"):
        shutil.copy(ROOT / name, copy / name)
    subprocess.run([sys.executable, "-m", "build", "--no-isolation", "--wheel", str(copy)], check=True)
    (built,) = (copy / "dist").glob("*.whl")
    return built


def install(wheel: Path, folder: Path) -> tuple[Path, Path]:
    """Install the wheel into a new environment, and return the folders of its commands and packages."""
    venv.create(folder, with_pip=False)
    commands = folder / "bin"
    pip = [sys.executable, "-m", "pip", "--python", str(commands / "python"), "--disable-pip-version-check"]
    subprocess.run([*pip, "install", "--quiet", "--no-deps", "--no-index", str(wheel)], check=True)
    return commands, Path(sysconfig.get_path("purelib", vars={"base": str(folder), "platbase": str(folder)}))


@pytest.fixture(scope="module")
def installed(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the folder of the commands of an environment with all packages of the current one."""
    commands, packages = install(wheel, tmp_path_factory.mktemp("environment"))
    # A .pth file adds a folder to the search path, but .pth files in that folder are not read, so no editable
    # installation is visible.
    Path(packages, "others.pth").write_text(Path(np.__file__).parents[1].as_posix() + "\n")
    return commands


def required(requirements: list[str]) -> dict[str, Distribution]:
    """Return the installed distributions that requirements without extras need, directly or not."""
    distributions: dict[str, Distribution] = {}
    waiting = [(Requirement(line), "") for line in requirements]
    while waiting:
        requirement, extra = waiting.pop()
        name = canonicalize_name(requirement.name)
        if requirement.marker and not requirement.marker.evaluate({"extra": extra}):
            continue
        if name not in distributions:
            distributions[name] = distribution(name)
            waiting += [(Requirement(line), "") for line in distributions[name].requires or ()]
        for wanted in requirement.extras:
            waiting += [
                (Requirement(line), wanted) for line in distributions[name].requires or () if "extra ==" in line
            ]
    return distributions


@pytest.fixture(scope="module")
def core(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the folder of the commands of an environment that has no extra of the wheel."""
    commands, packages = install(wheel, tmp_path_factory.mktemp("core"))
    (own,) = (Distribution.at(path) for path in packages.glob("sgsst_service-*.dist-info"))
    for each in required(own.requires or []).values():
        for name in {file.parts[0] for file in each.files or () if file.parts[0] not in ("..", "__pycache__")}:
            if not (packages / name).exists():
                (packages / name).symlink_to(Path(str(each.locate_file(name))))
    return commands


def run(command: list[str | Path], folder: Path, **variables: str) -> str:
    """Run a command in a folder outside of this project, and return its output; fail if the command does."""
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    done = subprocess.run(command, cwd=folder, env={**environment, **variables}, capture_output=True, text=True)
    assert done.returncode == 0, f"{command}:\n{done.stdout}\n{done.stderr}"
    return done.stdout


def test_wheel_contains_every_package_file(wheel: Path) -> None:
    with zipfile.ZipFile(wheel) as archive:
        packed = {name for name in archive.namelist() if not name.split("/")[0].endswith(".dist-info")}
    paths = [path for name in PACKAGES for path in (ROOT / name).rglob("*") if path.is_file()]
    expected = {path.relative_to(ROOT).as_posix() for path in paths if "__pycache__" not in path.parts}
    assert packed == {name for name in expected if not name.startswith("api/integrations/")}
    assert {f"{name}/py.typed" for name in PACKAGES} <= packed


def test_wheel_contains_the_licenses_of_its_files(wheel: Path) -> None:
    with zipfile.ZipFile(wheel) as archive:
        packed = {name.partition(".dist-info/licenses/")[2] for name in archive.namelist()}
    vendored = {f"api/static/vendor/{name}" for name in ("fzstd/LICENSE", "swagger-ui/LICENSE", "swagger-ui/NOTICE")}
    assert {"LICENSE", "docs/credits.md"} | vendored <= packed


def test_web_page_and_its_assets_are_installed(installed: Path, tmp_path: Path) -> None:
    code = (
        "from api.http.sending import static_files as served; print(served().digest, *served().pages, *served().files)"
    )
    digest, *names = run([installed / "python", "-c", code], tmp_path).split()
    assert digest == static_files().digest, "another byte"
    assert {"index.html", "docs.html", "vendor/swagger-ui/swagger-ui-bundle.js"} <= set(names)


SERVICE = ("ray", "fastapi", "sqlalchemy", "alembic", "uvicorn", "prometheus_client", "pydantic_settings")


def test_core_installs_no_service_packages(core: Path, tmp_path: Path) -> None:
    code = f"from importlib.util import find_spec; print(*(name for name in {SERVICE} if find_spec(name)))"
    assert run([core / "python", "-c", code], tmp_path).split() == []


def test_core_stylizes_and_reports_by_command_and_library(
    core: Path, vgg16_weights: BackboneWeights, tmp_path: Path
) -> None:
    ply, cameras, style = write_files(tmp_path, wall())
    out = tmp_path / "new" / "stylized.ply"
    command: list[str | Path] = [core / "sgsst", "stylize", ply, "--style", style, "--cameras", cameras]
    command += ["--backbone", "vgg16", "--steps-sos", "2", "--out", out]
    run(command, tmp_path, OMP_NUM_THREADS="1")
    assert out.stat().st_size == ply.stat().st_size
    assert "</html>" in out.with_name("stylized.report.html").read_text()
    code = """
from sgsst_core import load_cameras, load_image, load_scene, save, stylize
from sgsst_core.features.network_weights import load_network_weights
style, weights = load_image("style.png"), load_network_weights("vgg16")
result = stylize(load_scene("scene.ply"), load_cameras("cameras.json"), style, weights=weights, steps_sos=2)
save("library.ply", result)
"""
    run([core / "python", "-c", code], tmp_path, OMP_NUM_THREADS="1")
    assert (tmp_path / "library.ply").read_bytes() == out.read_bytes()
    assert (tmp_path / "library.ply").read_bytes() != ply.read_bytes()
    for arguments in ("check scene.ply --cameras cameras.json", "view scene.ply --out scene.html"):
        run([core / "sgsst", *arguments.split()], tmp_path)


@pytest.mark.parametrize("arguments", ["serve", "fsck", "keys list", "stylize --workers 2"])
def test_core_commands_name_the_missing_extra(core: Path, tmp_path: Path, arguments: str) -> None:
    command: list[str | Path] = [core / "sgsst", *arguments.split()]
    if "stylize" in arguments:
        ply, cameras, style = write_files(tmp_path, wall())
        command += [ply, "--cameras", cameras, "--style", style, "--out", tmp_path / "out" / "stylized.ply"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 2
    assert "extra `service` installs. Run `pip install 'sgsst-service[service]'`" in done.stderr
    assert "Traceback" not in done.stderr
    assert not (tmp_path / "out").exists()


def test_migrations_create_the_database(installed: Path, tmp_path: Path) -> None:
    data = ["--data", str(tmp_path / "data")]
    run([installed / "sgsst", "keys", "create", "alice", *data], tmp_path)
    listed = json.loads(run([installed / "sgsst", "keys", "list", *data, "--json"], tmp_path))
    assert [key["name"] for key in listed] == ["alice"]
