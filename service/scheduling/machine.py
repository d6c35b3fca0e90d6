"""What there is to run jobs on, found without importing PyTorch or Ray."""

from __future__ import annotations

import os
import subprocess
from dataclasses import dataclass

import psutil

from service.settings import ServiceSettings


@dataclass(frozen=True)
class Machine:
    """What a dispatcher has to give to jobs.

    Attributes:
        gpus: names of GPUs, as CUDA_VISIBLE_DEVICES takes them; of a cluster, just numbers.
        cores: of the processor.
        memory: bytes, all of it.
        cluster: jobs run on a Ray cluster, which has the GPUs and gives them out itself.
    """

    gpus: tuple[str, ...]
    cores: int
    memory: int
    cluster: bool = False

    @staticmethod
    def find(settings: ServiceSettings) -> Machine:
        """This machine, or the part of the cluster at RAY_ADDRESS that the settings name."""
        cluster = bool(os.environ.get("RAY_ADDRESS"))
        gpus = tuple(str(number) for number in range(settings.cluster_gpus)) if cluster else _own_gpus()
        return Machine(gpus, os.cpu_count() or 1, psutil.virtual_memory().total, cluster)


def _own_gpus() -> tuple[str, ...]:
    """NVIDIA GPUs that this process may use; none where there is no driver."""
    visible = os.environ.get("CUDA_VISIBLE_DEVICES")
    if visible is not None:
        return tuple(part.strip() for part in visible.split(",") if part.strip() not in ("", "-1"))
    try:
        found = subprocess.run(["nvidia-smi", "-L"], capture_output=True, text=True, timeout=20, check=False)
    except (OSError, subprocess.TimeoutExpired):
        return ()
    count = sum(line.startswith("GPU ") for line in found.stdout.splitlines()) if found.returncode == 0 else 0
    return tuple(str(number) for number in range(count))
