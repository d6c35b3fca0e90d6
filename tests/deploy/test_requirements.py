"""Tests of the lock files in `deploy/requirements`: tested versions, and digests of all files."""

import re
import tomllib
from importlib.metadata import PackageNotFoundError, requires

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

from deploy.lock import FOLDER, ROOT, cuda_packages

FILES = ("build", "common", "cpu", "cuda")
#: Environment markers of the images.
IMAGE = {"python_version": "3.11", "python_full_version": "3.11.2", "sys_platform": "linux", "platform_system": "Linux"}
IMAGE |= {"platform_machine": "x86_64", "implementation_name": "cpython", "platform_python_implementation": "CPython"}


def packages(file: str) -> dict[str, str]:
    """Return the versions in a lock file by package; fail on packages without digests and on any other content."""
    versions: dict[str, str] = {}
    for line in (FOLDER / f"{file}.txt").read_text().replace(" \\\n", "").splitlines():
        if line.startswith("#"):
            continue
        matched = re.fullmatch(r"([\w.-]+)==(\S+)(?: ; .*?)?((?:\s+--hash=sha256:[0-9a-f]{64})+)", line)
        assert matched is not None, f"{file}.txt: {line[:100]}"
        versions[canonicalize_name(matched[1])] = matched[2]
    return versions


def constraints() -> dict[str, str]:
    lines = (ROOT / "constraints.txt").read_text().splitlines()
    pairs = [line.split("==") for line in lines if line and not line.startswith("#")]
    return {canonicalize_name(name): version for name, version in pairs}


@pytest.mark.parametrize("file", FILES)
def test_pinned_versions_equal_the_tested_ones(file: str) -> None:
    tested = constraints()
    pinned = packages(file)
    assert pinned
    for name, version in pinned.items():
        assert tested.get(name) == version.partition("+")[0], f"{name}: run deploy/lock.py"


def test_cpu_image_has_no_cuda_packages() -> None:
    assert not cuda_packages() & packages("common").keys()
    assert packages("cpu") == {"torch": f"{constraints()['torch']}+cpu"}
    assert packages("cuda")["torch"] == constraints()["torch"]
    assert packages("cuda").keys() <= cuda_packages() | {"torch"}


@pytest.mark.parametrize("kind", ["cpu", "cuda"])
def test_requirements_are_complete(kind: str) -> None:
    """Only requirements of packages that are installed here can be checked."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    asked = [
        *project["dependencies"],
        *(one for extra in ("service", "postgresql", "s3") for one in project["optional-dependencies"][extra]),
    ]
    there = {**packages("common"), **packages(kind)}
    waiting, seen = [Requirement(line) for line in asked], set()
    while waiting:
        requirement = waiting.pop()
        name = canonicalize_name(requirement.name)
        if (name, frozenset(requirement.extras)) in seen:
            continue
        seen.add((name, frozenset(requirement.extras)))
        if kind == "cpu" and name in cuda_packages():  # the installed PyTorch may be one with CUDA
            continue
        assert name in there, f"{name}: run deploy/lock.py"
        assert requirement.specifier.contains(there[name], prereleases=True), f"{requirement}: run deploy/lock.py"
        try:
            further = [Requirement(line) for line in requires(name) or ()]
        except PackageNotFoundError:
            continue
        extras = requirement.extras or {""}
        waiting += [
            each
            for each in further
            if each.marker is None or any(each.marker.evaluate({**IMAGE, "extra": extra}) for extra in extras)
        ]
    assert len(seen) > 60
