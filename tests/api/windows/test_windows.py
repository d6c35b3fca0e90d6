"""Library, commands and client, run by the Windows build of Python under Wine; `prepare.sh` installs both."""

import json
import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from api.cli.main import main
from sgsst_core.files.scene_file import read_scene
from tests.api.service import Service
from tests.small_scenes import cameras, wall, write_files

pytestmark = pytest.mark.slow
ROOT = Path(__file__).resolve().parents[3]
FOLDER = Path(os.environ.get("SGSST_WINE", "/var/tmp/sgsst-windows"))
#: Modules that are for the service, which does not run on Windows, and for GPUs, for which Triton has another package.
ELSEWHERE = ("triton",)
OPTIONS = [
    "--preset",
    "preview",
    "--steps-coarse",
    "1",
    "--steps-sos",
    "2",
    "--backbone",
    "vgg16",
    "--precision",
    "float32",
]
IMPORT_ALL = f"""
import importlib, pathlib, sys
root, count = pathlib.Path({f"Z:{ROOT}"!r}), 0
for path in sorted(path for package in sys.argv[1:] for path in root.joinpath(package).rglob("*.py")):
    name = ".".join(path.relative_to(root).with_suffix("").parts).removesuffix(".__init__")
    if path.name == "__main__.py" or name in {ELSEWHERE}:
        continue
    try:
        importlib.import_module(name)
        count += 1
    except Exception as error:
        if getattr(error, "name", None) not in {ELSEWHERE}:
            print(name, "cannot be imported:", error)
print(count, "modules")
"""
HOLD = """
import pathlib, sys
from sgsst_core.files import atomic
atomic.HELD_SECONDS = 0.5
target = pathlib.Path("held.ply")
target.write_text("old")
with target.open() as held:
    try:
        with atomic.atomic_path(target) as temporary:
            temporary.write_text("new")
    except atomic.HeldOpenError as error:
        print(error)
"""


class Windows:
    """Windows' Python in a folder of the tests, with this source tree."""

    def __init__(self, folder: Path, cache: Path) -> None:
        self.folder = folder
        paths = "\n".join(["python313.zip", ".", "..\\start", f"Z:{ROOT}", "import site"])
        (FOLDER / "cp313" / "python313._pth").write_text(paths)
        self.environment = {
            **os.environ,
            "WINEPREFIX": str(FOLDER / "prefix"),
            "WINEDEBUG": "-all",
            "KMP_AFFINITY": "disabled",  # OpenMP would ask Wine 8 for groups of processors, which it does not know
            "SGSST_CACHE": f"Z:{cache}",
        }

    def python(self, *arguments: str) -> tuple[int, str]:
        """Run Python; return its exit code, and its output and errors."""
        command = ["wine", str(FOLDER / "cp313" / "python.exe"), *arguments]
        ended = subprocess.run(
            command, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
            errors="replace", env=self.environment, cwd=self.folder, check=False, timeout=1200,
        )  # fmt: skip
        return ended.returncode, ended.stdout

    def sgsst(self, *arguments: str) -> str:
        """Run a command that must succeed, and return its output."""
        code, output = self.python("-m", "api.cli", *arguments)
        assert code == 0, output
        return output


@pytest.fixture(scope="module")
def windows(tmp_path_factory: pytest.TempPathFactory, tiny_cache: Path) -> Windows:
    if sys.platform != "linux" or not (FOLDER / "ready").exists():
        pytest.skip(f"Windows' Python is not in {FOLDER}: run tests/api/windows/prepare.sh")
    folder = tmp_path_factory.mktemp("windows")
    scene = wall()
    away = 0.1 * torch.rand(len(scene), generator=torch.Generator().manual_seed(2))  # equal depths have any order
    write_files(folder, replace(scene, means=scene.means + torch.stack([0 * away, 0 * away, away], dim=1)))
    return Windows(folder, tiny_cache)


def test_all_modules_can_be_imported(windows: Windows) -> None:
    code, output = windows.python("-c", IMPORT_ALL, "sgsst_core", "worker", "api/client", "api/cli")
    assert code == 0, output
    assert "cannot be imported" not in output
    assert "modules" in output


def test_commands_of_a_scene_give_the_losses_of_linux(windows: Windows, tiny_installed: Path) -> None:
    inputs = ["scene.ply", "--cameras", "cameras.json", "--style", "style.png"]
    windows.sgsst("check", *inputs)
    windows.sgsst("plan", *inputs, *OPTIONS)
    windows.sgsst("stylize", *inputs, *OPTIONS, "--out", "stylized.spz")
    outputs = {"stylized.ply", "stylized.spz", "stylized.report.html", "stylized.before_after.jpg"}
    assert outputs <= {path.name for path in windows.folder.iterdir()}
    windows.sgsst("convert", "stylized.ply", "stylized.sog")
    windows.sgsst("blend", "scene.ply", "stylized.ply", "--out", "half.ply")
    windows.sgsst("render", "half.ply", "--cameras", "cameras.json", "--out", "views")
    assert len(list((windows.folder / "views").iterdir())) == len(cameras())

    files = [str(windows.folder / name) for name in ("scene.ply", "cameras.json", "style.png")]
    out = windows.folder / "linux.ply"
    command = ["stylize", files[0], "--cameras", files[1], "--style", files[2], *OPTIONS, "--out", str(out)]
    assert main(command) == 0
    expected, loss = (
        json.loads((windows.folder / f"{name}.report.json").read_text())["loss"] for name in ("linux", "stylized")
    )
    assert loss["before"]["total"] == pytest.approx(expected["before"]["total"], rel=1e-4)
    assert loss["relative"] == pytest.approx(expected["relative"], rel=0.02)


def test_output_that_another_program_holds_open_is_kept_beside_it(windows: Windows) -> None:
    code, output = windows.python("-c", HOLD)
    assert code == 0, output
    assert "held.ply: cannot be replaced" in output
    assert (windows.folder / "held.ply").read_text() == "old"
    (remaining,) = windows.folder.glob("held-*.new.ply")
    assert remaining.read_text() == "new"


def test_client_reaches_a_service(windows: Windows, whole_service: Service) -> None:
    files = ["scene.ply", "--cameras", "cameras.json", "--style", "style.png"]
    windows.sgsst("submit", *files, *OPTIONS, "--out", "from_service.ply", "--url", whole_service.url)
    assert len(read_scene(windows.folder / "from_service.ply").scene) == len(wall())


def test_ranks_are_refused_before_any_work(windows: Windows) -> None:
    inputs = ["scene.ply", "--cameras", "cameras.json", "--style", "style.png"]
    code, output = windows.python("-m", "api.cli", "stylize", *inputs, *OPTIONS, "--workers", "2", "--out", "ranks.ply")
    assert code == 2
    assert output.splitlines() == [
        "error: --workers requires Linux or macOS. Omit it, or run the command in WSL2 (`wsl --install`)."
    ]
    assert not list(windows.folder.glob("ranks*"))


def test_service_names_the_ways_to_run_it(windows: Windows) -> None:
    code, output = windows.python("-m", "api.cli", "serve")
    assert code == 2
    assert "WSL2" in output
    assert "Traceback" not in output
