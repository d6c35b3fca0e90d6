"""Hardware of this machine for jobs, and names of dispatchers, which reveal whether a dispatcher still runs.

Neither PyTorch nor Ray is imported.
"""

from __future__ import annotations

import hashlib
import os
import socket
import subprocess
from dataclasses import dataclass

from service.settings import ServiceSettings
from sgsst_core import container
from worker.processes import ProcessId, home


@dataclass(frozen=True)
class Machine:
    """Hardware that a dispatcher assigns to jobs.

    Attributes:
        gpus: Names of GPUs for CUDA_VISIBLE_DEVICES; consecutive numbers on a cluster.
        memory: Total memory in bytes.
        cluster: Whether jobs run on a Ray cluster, which assigns its GPUs itself.
    """

    gpus: tuple[str, ...]
    cores: int
    memory: int
    cluster: bool = False

    @staticmethod
    def find(settings: ServiceSettings) -> Machine:
        """Return this machine, or the portion of the cluster at RAY_ADDRESS that the settings name."""
        cluster = bool(os.environ.get("RAY_ADDRESS"))
        gpus = tuple(str(number) for number in range(settings.cluster_gpus)) if cluster else _own_gpus()
        return Machine(gpus, container.cores(), container.memory().total, cluster)


def _own_gpus() -> tuple[str, ...]:
    """Return the NVIDIA GPUs that this process may use; none without a driver."""
    visible = os.environ.get("CUDA_VISIBLE_DEVICES")
    if visible is not None:
        return tuple(part.strip() for part in visible.split(",") if part.strip() not in ("", "-1"))
    try:
        listing = subprocess.run(["nvidia-smi", "-L"], capture_output=True, text=True, timeout=20, check=False)
    except (OSError, subprocess.TimeoutExpired):
        return ()
    count = sum(line.startswith("GPU ") for line in listing.stdout.splitlines()) if listing.returncode == 0 else 0
    return tuple(str(number) for number in range(count))


def own_name() -> str:
    """Return the unique name of this process: its host, its process id, and its start time."""
    own = ProcessId.of_this()
    return f"{socket.gethostname()[:40]}-{_home_digest()}-{own.number}-{int(own.started)}"


def is_dead(name: str) -> bool:
    """Return whether the dispatcher ran in this process' process namespace and has exited."""
    parts = name.rsplit("-", 3)
    if not is_of_this_machine(name) or not (parts[2] + parts[3]).isdigit():
        return False
    return ProcessId(home(), int(parts[2]), float(parts[3]) + 0.5).find() is None


def is_of_this_machine(name: str) -> bool:
    """Return whether the dispatcher runs or ran in this process' process namespace."""
    parts = name.rsplit("-", 3)
    return len(parts) == 4 and parts[1] == _home_digest()


def _home_digest() -> str:
    return hashlib.sha256(repr(home()).encode()).hexdigest()[:8]
