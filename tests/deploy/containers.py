"""Container images and the compose file, built and run by buildah, podman and podman-compose as root.

Images are cached in a separate storage (`SGSST_TEST_CONTAINERS`, by default a folder in the user's cache), so they are
built or pulled only once, and other containers on the machine are not affected. If no registry can be reached, Debian's
base image is built from packages, and images of third parties are replaced by those of `stand_ins`.
"""

import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
COMPOSE = ROOT / "deploy" / "compose.yaml"
STAND_INS = Path(__file__).with_name("stand_ins")
BASE = "docker.io/library/debian:bookworm-slim"
DATABASE, STORE = "docker.io/library/postgres:17", "docker.io/chrislusf/seaweedfs:4.22"
TOOLS = {"podman": "podman", "buildah": "buildah", "runc": "runc", "curl": "curl", "iptables": "iptables"}
#: A base image built here lacks documentation and package lists, like the official one.
_SLIM = [f"--dpkgopt=path-exclude=/usr/share/{name}/*" for name in ("doc", "man", "locale")]
_SLIM.append('--customize-hook=rm -rf "$1"/var/lib/apt/lists/* "$1"/var/cache/apt/*')


def problem() -> str | None:
    """Return why this machine cannot run containers, or None if it can."""
    if sys.platform != "linux" or os.geteuid() != 0:
        return "containers are run by root, on Linux"
    for tool, package in TOOLS.items():
        if shutil.which(tool) is None:
            return f"{tool} is missing: apt-get install -y {package} netavark aardvark-dns catatonit uidmap"
    if not compose_program().exists():
        return "podman-compose is missing: see the extra [dev]"
    return None


def compose_program() -> Path:
    """Return the path of podman-compose in this Python's environment."""
    return Path(sys.executable).parent / "podman-compose"


class Containers:
    """Podman, configured to run without systemd and without creating cgroups.

    Attributes:
        environment: Environment of every command.
    """

    def __init__(self, storage: Path, folder: Path) -> None:
        (folder / "containers.conf").write_text(
            '[containers]\ndefault_ulimits = ["nofile=20000:20000", "nproc=20000:20000"]\n'
            '[engine]\nruntime = "runc"\ncgroup_manager = "cgroupfs"\nevents_logger = "file"\n'
        )
        (folder / "storage.conf").write_text(
            f'[storage]\ndriver = "overlay"\ngraphroot = "{storage}"\nrunroot = "{folder / "run"}"\n'
        )
        self.environment = {
            **os.environ,
            "CONTAINERS_CONF": str(folder / "containers.conf"),
            "CONTAINERS_STORAGE_CONF": str(folder / "storage.conf"),
            "PATH": f"{Path(sys.executable).parent}:{os.environ['PATH']}",
        }

    def run(self, *command: str | Path, check: bool = True, variables: Mapping[str, str] | None = None) -> str:
        """Run a command and return its output. If `check`, fail if the command does."""
        ended = subprocess.run(
            command,
            env={**self.environment, **(variables or {})},
            cwd=ROOT,
            capture_output=True,
            text=True,
            timeout=900,
        )
        assert ended.returncode == 0 or not check, f"{command}:\n{ended.stdout[-3000:]}\n{ended.stderr[-3000:]}"
        return ended.stdout

    def succeeds(self, *command: str | Path) -> bool:
        """Return whether a command exits with status 0."""
        return subprocess.run(command, env=self.environment, cwd=ROOT, capture_output=True).returncode == 0

    def provide(self, image: str, target: str | None = None) -> None:
        """Make an image available: use the cached one, pull it, or build a replacement."""
        if self.succeeds("podman", "image", "exists", image) or self.succeeds("podman", "pull", "--quiet", image):
            return
        if target is not None:
            self._build(image, target, STAND_INS)
        else:
            self._make_base(image)

    def build(self, tag: str, target: str) -> None:
        """Build a target of the project's Dockerfile."""
        self._build(tag, target, ROOT, "--file", "deploy/Dockerfile", *_torch_wheels())

    def _build(self, tag: str, target: str, context: Path, *options: str) -> None:
        command = ["buildah", "bud", "--isolation", "chroot", "--layers", "--target", target, "--tag", tag]
        with tempfile.TemporaryDirectory() as folder:
            if context == STAND_INS:
                shutil.copytree(context, folder, dirs_exist_ok=True)
                shutil.copy(ROOT / "constraints.txt", folder)
                context = Path(folder)
            self.run(*command, *_package_sources(), *options, context)
        self.run("buildah", "rm", "--all", check=False)

    def _make_base(self, image: str) -> None:
        if shutil.which("mmdebstrap") is None:
            pytest.skip(f"{image} cannot be pulled, nor made: apt-get install -y mmdebstrap")
        with tempfile.TemporaryDirectory() as folder:
            Path(folder).chmod(0o755)
            archive = Path(folder, "base.tar")
            self.run("mmdebstrap", "--variant=minbase", "--include=ca-certificates", *_SLIM, "bookworm", archive)
            self.run("podman", "import", archive, image)


def _pip(*names: str) -> list[str]:
    """Return the values of the given pip settings on this machine."""
    listed = subprocess.run([sys.executable, "-m", "pip", "config", "list"], capture_output=True, text=True).stdout
    options = []
    for line in listed.splitlines():
        name, _, value = line.partition("=")
        if name.rpartition(".")[2] in names:
            options += value.strip("'\"").replace("\\n", " ").split()
    return options


def _package_sources() -> list[str]:
    """Return volume options that give builds this machine's pip settings and local package folders."""
    paths = {Path(word.removeprefix("file://")) for word in _pip("cert", "find-links", "extra-index-url", "index-url")}
    roots = {path.parent if path.name == "simple" else path for path in paths if path.is_absolute() and path.exists()}
    if Path("/etc/pip.conf").exists():
        roots.add(Path("/etc/pip.conf"))
    return [part for path in sorted(roots) for part in ("--volume", f"{path}:{path}:ro")]


def _torch_wheels() -> list[str]:
    """Return the build argument for the wheel of PyTorch without CUDA, if it is in a local package folder."""
    folders = [word for word in _pip("find-links") if list(Path(word).glob("torch-*cpu*.whl"))]
    return ["--build-arg", f"TORCH_CPU={folders[0]}"] if folders else []


@contextmanager
def containers() -> Iterator[Containers]:
    """Provide podman with all images of the compose file; skip the test if that is impossible."""
    if reason := problem():
        pytest.skip(reason)
    storage = os.environ.get("SGSST_TEST_CONTAINERS") or str(Path.home() / ".cache" / "sgsst-containers")
    with tempfile.TemporaryDirectory(prefix="sgsst-containers-") as folder:
        started = Containers(Path(storage), Path(folder))
        try:
            started.provide(BASE)
            started.build("docker.io/library/sgsst:cpu", "cpu")
            started.provide(DATABASE, "postgres")
            started.provide(STORE, "store")
            yield started
        finally:
            started.run(
                "podman", "volume", "prune", "--force", check=False
            )  # unnamed volumes of the images' own folders
            started.run("umount", str(Path(storage, "overlay")), check=False)
