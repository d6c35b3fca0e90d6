"""Detection of the hardware for jobs, without importing PyTorch or Ray."""

from __future__ import annotations

import os
import subprocess
from dataclasses import dataclass

import psutil

from service.settings import ServiceSettings


@dataclass(frozen=True)
class Machine:
    """Hardware that a dispatcher assigns to jobs.

    Attributes:
        gpus: Names of GPUs for CUDA_VISIBLE_DEVICES; consecutive numbers on a cluster.
        cores: Number of CPU cores.
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
        return Machine(gpus, os.cpu_count() or 1, psutil.virtual_memory().total, cluster)


def _own_gpus() -> tuple[str, ...]:
    """Return the NVIDIA GPUs that this process may use; none without a driver."""
    visible = os.environ.get("CUDA_VISIBLE_DEVICES")
    if visible is not None:
        return tuple(part.strip() for part in visible.split(",") if part.strip() not in ("", "-1"))
    try:
        found = subprocess.run(["nvidia-smi", "-L"], capture_output=True, text=True, timeout=20, check=False)
    except (OSError, subprocess.TimeoutExpired):
        return ()
    count = sum(line.startswith("GPU ") for line in found.stdout.splitlines()) if found.returncode == 0 else 0
    return tuple(str(number) for number in range(count))
