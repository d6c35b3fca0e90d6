"""Lock files of the container images' packages, with digests: pip only installs files with a listed digest.

The files are in deploy/requirements. Versions come from constraints.txt. When versions or dependencies change, install
uv (`pip install uv`) and run:

    python deploy/lock.py torch-2.13.0+cpu-cp311-cp311-manylinux_2_28_x86_64.whl

The wheel of PyTorch without CUDA comes from https://download.pytorch.org/whl/cpu/torch/, because PyPI has none.

`build.txt` lists the project's build dependencies, `common.txt` the packages of both images, and `cpu.txt` and
`cuda.txt` the additional packages of each image.
"""

import hashlib
import re
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
FOLDER = ROOT / "deploy" / "requirements"
#: Python version of the images.
PYTHON = "3.11"
HEAD = "# Written by deploy/lock.py.\n"
#: Line in constraints.txt that precedes the packages that only PyTorch with CUDA needs.
CUDA_SECTION = "# What PyTorch's CUDA build for Linux adds."


def main(wheels: list[Path]) -> None:
    """Write all requirements files.

    Args:
        wheels: Wheels of PyTorch without CUDA, one per CPU architecture of the images.
    """
    extras = [word for extra in ("service", "postgresql", "s3", "video") for word in ("--extra", extra)]
    # pip is in the images, because it fetches VGG16
    pinned = _compile(str(ROOT / "pyproject.toml"), *extras) | _compile("-", given="pip\n")
    cuda = {name for name in pinned if name in cuda_packages() or name == "torch"}
    _write("common", {name: text for name, text in pinned.items() if name not in cuda})
    _write("cuda", {name: pinned[name] for name in cuda})
    (version,) = {wheel.name.split("-")[1] for wheel in wheels}
    digests = [f"--hash=sha256:{hashlib.sha256(wheel.read_bytes()).hexdigest()}" for wheel in wheels]
    _write("cpu", {"torch": " \\\n    ".join([f"torch=={version}", *digests]) + "\n"})
    _write("build", _compile("-", given="setuptools\n"))


def cuda_packages() -> set[str]:
    """Return the names of the packages that PyTorch with CUDA adds."""
    _, _, after = (ROOT / "constraints.txt").read_text().partition(CUDA_SECTION)
    section, _, _ = after.strip().partition("\n\n")
    return {line.partition("==")[0] for line in section.splitlines()}


def _compile(source: str, *options: str, given: str | None = None) -> dict[str, str]:
    """Return the lock entries (version and file digests) of all required packages, by package name."""
    command = ["uv", "pip", "compile", source, *options, "--quiet", "--no-header", "--no-annotate"]
    command += ["--constraint", str(ROOT / "constraints.txt"), "--generate-hashes"]
    command += ["--python-version", PYTHON, "--python-platform", "x86_64-manylinux_2_28"]
    text = subprocess.run(command, check=True, input=given, capture_output=True, text=True).stdout
    packages = re.findall(r"^\S.*\n(?:\s.*\n)*", text, flags=re.MULTILINE)
    return {package.partition("==")[0]: package for package in packages}


def _write(name: str, packages: dict[str, str]) -> None:
    FOLDER.mkdir(exist_ok=True)
    (FOLDER / f"{name}.txt").write_text(HEAD + "".join(packages[each] for each in sorted(packages)))


if __name__ == "__main__":
    main([Path(word) for word in sys.argv[1:]])
