"""Capacity of this machine, and pure functions that decide what the next job gets of it, or that it has to wait.

The order of jobs and the turns of keys are in `service.store.queue`; this decides only how much a job gets.

Jobs do not share GPUs. A job that does not specify `workers` gets a portion of the free GPUs: all of them if no other
job waits, one if many do, but never more than its estimated duration justifies. A job also waits if the running jobs
leave too little of the machine's memory for its scene. On a Ray cluster, Ray tracks the memory per machine.

Without GPUs, slots stand for fractions of the CPU and of the memory. There is one slot unless the operator sets
`parallel_jobs`, because a single job uses all cores well. A job that needs more memory than one slot has takes several
slots.

Names of dispatchers reveal whether one of this machine still runs. Neither PyTorch nor Ray is imported.
"""

import hashlib
import math
import os
import socket
import subprocess
from collections.abc import Sequence
from dataclasses import dataclass

from service.inputs import JobParameters, scene_size, stored_parameters
from service.settings import ServiceSettings
from service.store.tables import JobRow
from sgsst_core import container
from sgsst_core.errors import SettingsError
from sgsst_core.scales import ScaleWeights, scale_count
from sgsst_core.settings import Settings, make_settings
from worker.job import GAUSSIAN_BYTES, memory_beside_gpus
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
    def find(settings: ServiceSettings) -> "Machine":
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


#: Maximum fractions of the machine's memory that all concurrent jobs together, and each of them, may plan with. The
#: latter equals the default of a job that runs alone (`sgsst_core.budget`), so that both round in the same way.
_MEMORY_FRACTION, _JOB_FRACTION = 0.8, 0.4
#: Minimum memory of a job besides its scene, and number of copies of the scene: as read, as rendered, and twice for
#: what the views and the optimizer store per Gaussian. Measured peaks: 5.8 GB for 4 million Gaussians (1 GB), 0.95 GB
#: for 50,000.
_MIN_MEMORY = 1_000_000_000
_SCENE_COPIES = 4
#: Estimated seconds of a step on an H200: network per evaluated pixel by precision, rasterization per Gaussian, and
#: kernel launches. A step of phase 1, which optimizes only the coarsest scale, takes a tenth.
_PIXEL_SECONDS = {"auto": 5e-9, "float32": 5e-8, "winograd": 5e-8, "tf32": 1.2e-8, "bfloat16": 5e-9, "float16": 5e-9}
_GAUSSIAN_SECONDS, _FIXED_SECONDS, _COARSE_FRACTION = 1e-9, 1e-3, 0.1
#: Default longer side of views, and ratio of height to width.
_LONGER_SIDE, _ASPECT = 1600, 0.625
#: Estimated seconds of all steps on one GPU that justify another one.
_SECONDS_PER_GPU = 10.0


@dataclass(frozen=True)
class Grant:
    """Capacity that a job gets.

    Attributes:
        ranks: Maximum number of ranks; the plan may use fewer.
        gpus: Names of GPUs; empty without GPUs.
        threads: Number of CPU threads; None for all.
        memory: Memory to plan with in bytes; None for the default of a job that runs alone.
        scene: Size of the job's scene in memory, in bytes.
    """

    ranks: int
    gpus: tuple[str, ...] = ()
    slots: int = 1
    threads: int | None = None
    memory: int | None = None
    scene: int = 0

    @property
    def host_bytes(self) -> int:
        """Host memory in bytes that is reserved for a job on GPUs; 0 without GPUs."""
        return memory_beside_gpus(self.ranks, self.scene) if self.gpus else 0


class Capacity:
    """Capacity of a machine.

    Args:
        parallel_jobs: Maximum number of concurrent jobs; None for one per GPU (one in total if there are no GPUs).
    """

    def __init__(self, machine: Machine, parallel_jobs: int | None) -> None:
        self._machine = machine
        self._slots = parallel_jobs or max(1, len(machine.gpus))

    @property
    def size(self) -> int:
        """Number of GPUs, or of slots without GPUs."""
        return len(self._machine.gpus) or self._slots

    def free(self, held: Sequence[Grant]) -> int:
        """Return the free portion of `size`."""
        return len(self._free_gpus(held)) if self._machine.gpus else self._free_slots(held)

    def grant(self, job: JobRow, held: Sequence[Grant], waiting: int) -> Grant | None:
        """Return the capacity that a job gets beside the running jobs; None if it has to wait.

        Args:
            held: Capacity of running jobs.
            waiting: Number of jobs that this machine could start now, including this one.
        """
        slots = self._free_slots(held)
        if slots < 1:
            return None
        parameters, settings = _stored_settings(job)
        scene = int(scene_size(job.inputs) * settings.growth)  # once it is refined
        if self._machine.gpus:
            seconds = _seconds_of_steps(job, parameters, settings, scene)
            return self._on_gpus(parameters.workers, seconds, scene, held, min(max(waiting, 1), slots))
        return self._on_cores(parameters.workers or 1, settings.memory_limit, scene, slots)

    def _free_gpus(self, held: Sequence[Grant]) -> list[str]:
        taken = {gpu for grant in held for gpu in grant.gpus}
        return [gpu for gpu in self._machine.gpus if gpu not in taken]

    def _free_slots(self, held: Sequence[Grant]) -> int:
        return self._slots - sum(grant.slots for grant in held)

    def _on_gpus(
        self, requested: int | None, seconds: float, scene: int, held: Sequence[Grant], sharers: int
    ) -> Grant | None:
        free = self._free_gpus(held)
        if requested:
            ranks = min(requested, len(self._machine.gpus))
        else:
            ranks = min(max(1, len(free) // sharers), 1 + int(seconds / _SECONDS_PER_GPU))
        if ranks > len(free):
            return None
        grant = Grant(ranks, tuple(free[:ranks]), scene=scene)
        if not held or self._machine.cluster:  # a job that runs alone is started even if memory may be short
            return grant
        together = sum(each.host_bytes for each in (grant, *held))
        return grant if together <= _MEMORY_FRACTION * self._machine.memory else None

    def _on_cores(self, ranks: int, requested: int | None, scene: int, free: int) -> Grant | None:
        if self._machine.cluster:
            return Grant(ranks)
        most = int(_JOB_FRACTION * self._machine.memory)
        if self._slots == 1:
            return Grant(ranks, memory=min(requested, most) if requested else None)
        portion = _MEMORY_FRACTION * self._machine.memory / self._slots
        scenes = _SCENE_COPIES * scene
        slots = min(math.ceil((scenes + (requested or _MIN_MEMORY)) / portion), self._slots)
        if slots > free:
            return None
        limit = max(min(most, int(slots * portion - scenes)), _MIN_MEMORY)
        threads = max(1, self._machine.cores * slots // self._slots)
        return Grant(ranks, (), slots, threads, min(requested or limit, limit))


def _seconds_of_steps(job: JobRow, parameters: JobParameters, settings: Settings, scene: int) -> float:
    """Estimate the duration of all steps of a job on one GPU in seconds; 0 for painted views, which have no steps."""
    if any(entry["role"] == "painted" for entry in job.inputs):
        return 0.0
    side = min(parameters.resolution or _LONGER_SIDE, settings.max_resolution or math.inf)
    scales = scale_count(int(_ASPECT * side), int(side), settings.coarsest_side)
    evaluated = ScaleWeights(settings.scales).evaluated(scales, settings.scale_sampling)
    network = _PIXEL_SECONDS[settings.precision] * _ASPECT * side**2 * evaluated
    step = _FIXED_SECONDS + _GAUSSIAN_SECONDS * scene / GAUSSIAN_BYTES + network
    steps = settings.steps_sos + _COARSE_FRACTION * settings.steps_coarse
    return min(settings.views_per_step * steps * step, settings.within or math.inf)


def _stored_settings(job: JobRow) -> tuple[JobParameters, Settings]:
    """Return the settings of a job; the defaults if another version has stored them, which the attempt rejects."""
    try:
        parameters = stored_parameters(job.parameters)
        return parameters, parameters.settings()
    except SettingsError:
        return JobParameters(), make_settings()
