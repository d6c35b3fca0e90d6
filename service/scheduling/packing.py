"""How jobs share a machine: what the next one gets of it, or that it has to wait. Decides, and does nothing.

On GPUs a job has its GPUs to itself. One that names no number of `workers` is offered its part of those that are free,
all of them where no other job waits, one where many do, but never more than a job of its size is worth
(`service.scheduling.job_size`). The plan, made with measured times, then takes as many as make the job faster, and the
rest are given back (see `service.scheduling.running`). Memory of the machine is counted too: a job waits where those
that run leave too little for its scene. On a Ray cluster Ray counts it, machine by machine (`worker.ranks.placement`).

Without GPUs, places stand for parts of the processor and of the memory. There is one, unless the operator wants several
jobs side by side: one job uses all cores well. A job that needs more memory than a place has takes several.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass

from service.scheduling.job_size import estimated_size
from service.scheduling.machine import Machine
from service.store.tables import JobRow
from worker.ranks.host_memory import memory_beside_gpus, scene_bytes

#: Of all memory, what jobs side by side plan with together at most, and what one of them does: as a job that is alone
#: plans (`sgsst_core.budget`), so that it rounds the same beside another one.
_MEMORY_SHARE, _JOB_SHARE = 0.8, 0.4
#: What a job needs at least beside its scene, and how often the bytes of the scene: as it was read, as it is
#: rendered, and twice for what the views and the optimizer keep of each Gaussian. A job of 4 million Gaussians (1 GB)
#: had 5.8 GB at its peak, one of 50,000 had 0.95 GB.
_LEAST_MEMORY = 1_000_000_000
_SCENE_COPIES = 4


@dataclass(frozen=True)
class Grant:
    """What a job gets.

    Attributes:
        ranks: at most; the plan may do with fewer.
        gpus: their names; empty where there are none.
        places: of those for jobs side by side.
        threads: of the processor; None for all.
        memory: bytes to plan with; None for what a job that is alone takes.
        scene: bytes of its scene, once it is read.
    """

    ranks: int
    gpus: tuple[str, ...] = ()
    places: int = 1
    threads: int | None = None
    memory: int | None = None
    scene: int = 0

    @property
    def beside_gpus(self) -> int:
        """Bytes of the machine's memory that a job on GPUs is counted with."""
        return memory_beside_gpus(self.ranks, self.scene) if self.gpus else 0


class Room:
    """A machine and what is free of it.

    Args:
        machine: all that there is.
        parallel_jobs: side by side at most; None for one on each GPU, or one.
    """

    def __init__(self, machine: Machine, parallel_jobs: int | None) -> None:
        self._machine = machine
        self._places = parallel_jobs or max(1, len(machine.gpus))

    @property
    def size(self) -> int:
        """GPUs; places where there are none."""
        return len(self._machine.gpus) or self._places

    def free(self, held: Iterable[Grant]) -> int:
        """What is left of `size`."""
        held = list(held)
        return len(self._free_gpus(held)) if self._machine.gpus else self._free_places(held)

    def grant(self, job: JobRow, held: Iterable[Grant], waiting: int) -> Grant | None:
        """What a job gets beside those that hold something; None where it has to wait.

        Args:
            held: what running jobs have.
            waiting: jobs that this machine could start now, this one included.
        """
        held = list(held)
        places = self._free_places(held)
        if places < 1:
            return None
        asked = _asked(job, "workers")
        if self._machine.gpus:
            return self._on_gpus(job, asked, held, min(max(waiting, 1), places))
        return self._on_cores(job, asked or 1, places)

    def _free_gpus(self, held: list[Grant]) -> list[str]:
        taken = {gpu for grant in held for gpu in grant.gpus}
        return [gpu for gpu in self._machine.gpus if gpu not in taken]

    def _free_places(self, held: list[Grant]) -> int:
        return self._places - sum(grant.places for grant in held)

    def _on_gpus(self, job: JobRow, asked: int, held: list[Grant], sharers: int) -> Grant | None:
        free = self._free_gpus(held)
        if asked:
            ranks = min(asked, len(self._machine.gpus))
        else:
            share = max(1, len(free) // sharers)
            ranks = estimated_size(job.parameters, job.inputs).gpus(share) if share > 1 else 1
        if ranks > len(free):
            return None
        grant = Grant(ranks, tuple(free[:ranks]), scene=_scene_bytes(job))
        if not held or self._machine.cluster:  # one that is alone may try
            return grant
        together = sum(each.beside_gpus for each in (grant, *held))
        return grant if together <= _MEMORY_SHARE * self._machine.memory else None

    def _on_cores(self, job: JobRow, ranks: int, free: int) -> Grant | None:
        if self._places == 1 or self._machine.cluster:
            return Grant(ranks)
        share = _MEMORY_SHARE * self._machine.memory / self._places
        asked = _asked(job, "memory_limit")
        scene = _SCENE_COPIES * _scene_bytes(job)
        places = min(math.ceil((scene + (asked or _LEAST_MEMORY)) / share), self._places)
        if places > free:
            return None
        limit = max(int(min(_JOB_SHARE * self._machine.memory, places * share - scene)), _LEAST_MEMORY)
        threads = max(1, self._machine.cores * places // self._places)
        return Grant(ranks, (), places, threads, min(asked or limit, limit))


def _scene_bytes(job: JobRow) -> int:
    """Of its scene, once it is read and refined."""
    files = [entry for entry in job.inputs if entry["role"] == "scene"]
    growth = job.parameters.get("refine")
    size = sum(scene_bytes(str(entry.get("name", "")), entry["size"]) for entry in files)
    return int(size * growth) if isinstance(growth, int | float) and growth > 1 else size


def _asked(job: JobRow, name: str) -> int:
    """A number that a job was told; 0 without one. What is none was stored by an earlier version: the attempt refuses
    it, and needs no room for that.
    """
    value = job.parameters.get(name)
    return max(value, 0) if isinstance(value, int) else 0
