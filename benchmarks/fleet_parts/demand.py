"""Jobs of a simulated fleet: their sizes, owners and arrival times, determined by a seed.

Seconds are those of `service.scheduling.job_size`, which a test compares with `benchmarks.forecast`. The actual time of
a job differs from them by a random factor that its record does not reveal.
"""

from __future__ import annotations

import math
import random
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cache
from typing import Any

from service.scheduling.job_size import JobSize, estimated_size
from sgsst_core.planning.ranks_model import LEAST_GAIN

#: Bytes of a Gaussian with SH of degree 3 in a PLY.
GAUSSIAN_BYTES = 248
#: Seconds before a job's first step (process, CUDA and network); bytes per second from the store; seconds of planning,
#: and steps it takes on top.
_START_SECONDS, _STAGING_BYTES, _PLAN_SECONDS, _PLAN_STEPS = 12.0, 1e9, 6.0, 10
#: Standard deviation of the logarithm of a job's actual time over its predicted one.
_SPREAD = 0.35
#: Fraction of the jobs above the usual size that request a number of workers.
_NAMES_WORKERS = 0.08
#: Bursts per day, each from one key within a minute, and jobs per burst.
_BURSTS, _BURST_JOBS = 24, 250
#: Relative variation of the arrival rate in the course of a day.
_SWING = 0.25


@dataclass(frozen=True)
class Kind:
    """Jobs of about one size.

    Attributes:
        name: Name of the kind.
        preset: Preset of its jobs.
        share: Fraction of all jobs; None for the kinds that fill the load up to the target.
        sides: Longer sides of views in pixels.
        gaussians: Minimum and maximum number of Gaussians.
    """

    name: str
    preset: str
    share: float | None
    sides: tuple[int, ...]
    gaussians: tuple[float, float]


KINDS = (
    Kind("preview", "preview", 0.50, (640,), (2e5, 3e6)),
    Kind("standard", "standard", 0.38, (980, 1600, 2000), (5e5, 4e6)),
    Kind("standard, large", "standard", 0.08, (4000, 5187), (2e6, 8e6)),
    Kind("paper", "paper", None, (980, 1600), (1e6, 4e6)),
    Kind("paper, large", "paper", None, (5187,), (3e6, 8e6)),
)
#: Fraction of large jobs among the kinds without a share.
_LARGE_PAPERS = 0.04


@dataclass(frozen=True)
class SimulatedJob:
    """Job as its user submits it, with its actual run time.

    Attributes:
        at: Arrival time in seconds from the start.
        owner: Key that submits it.
        kind: Name of its kind.
        parameters: Parameters of the job.
        scene_bytes: Size of the scene file.
        factor: Actual time relative to the predicted one.
    """

    at: float
    owner: str
    kind: str
    parameters: dict[str, Any]
    scene_bytes: int
    factor: float

    @property
    def inputs(self) -> list[dict[str, Any]]:
        """Inputs as the store records them."""
        return [{"role": "scene", "name": "scene.ply", "sha256": "a" * 64, "size": self.scene_bytes}]

    @property
    def size(self) -> JobSize:
        """Predicted amount of work."""
        return _size(self.parameters["preset"], self.parameters["resolution"], self.scene_bytes)

    @property
    def steps(self) -> int:
        """Number of steps in both phases."""
        return self.size.steps_coarse + self.size.steps_sos

    def seconds(self, gpus: int) -> float:
        """Return the seconds of all steps on a number of GPUs."""
        return self.factor * self.size.seconds(gpus)

    def start_seconds(self) -> float:
        """Return the seconds before the first step of an attempt."""
        planning = _PLAN_SECONDS + _PLAN_STEPS * self.seconds(1) / max(self.steps, 1)
        return _START_SECONDS + self.scene_bytes / _STAGING_BYTES + planning

    def planned(self, offered: int) -> int:
        """Return how many of the offered GPUs its plan uses: the fewest beyond which more gain too little."""
        if self.parameters.get("workers"):
            return offered
        seconds = [self.seconds(gpus) for gpus in range(1, offered + 1)]
        return next(gpus for gpus, each in enumerate(seconds, 1) if each <= min(seconds) * (1 + LEAST_GAIN))


@cache
def _size(preset: str, side: int, scene_bytes: int) -> JobSize:
    entry = {"role": "scene", "name": "scene.ply", "size": scene_bytes}
    return estimated_size({"preset": preset, "resolution": side}, [entry])


@dataclass(frozen=True)
class Demand:
    """Demand on a fleet.

    Attributes:
        gpus: Number of GPUs of the fleet.
        load: GPU seconds requested, with each job on one GPU, relative to those available.
        jobs_a_day: Jobs per day of all keys together, for a fleet of 1,000 GPUs; smaller fleets get a proportional
            number.
        keys: Number of keys that submit jobs.
        greedy: Fraction of all jobs that the first key submits at once.
    """

    gpus: int
    load: float = 0.9
    jobs_a_day: int = 200_000
    keys: int = 500
    greedy: float = 0.05

    def jobs(self, hours: float, seed: int) -> list[SimulatedJob]:
        """Return the jobs of some hours in the order of their arrival."""
        chance = random.Random(seed)
        count = round(self.jobs_a_day * self.gpus / 1000 * hours / 24)
        shares = self.shares(chance)
        weights = [1 / (number + 5) for number in range(1, self.keys)]
        owners = [f"key_{number:03d}" for number in range(1, self.keys)]
        times = self._times(count, hours * 3600, chance)
        jobs = []
        for at, burst in times:
            owner = burst or chance.choices(owners, weights)[0]
            kind = chance.choices(KINDS, shares)[0]
            jobs.append(replace(_draw(kind, chance), at=at, owner=owner))
        return sorted(jobs, key=lambda job: job.at)

    def _times(self, count: int, seconds: float, chance: random.Random) -> Iterator[tuple[float, str | None]]:
        """Yield the arrival times of jobs, with the key for jobs in a burst."""
        greedy = round(self.greedy * count)
        for _ in range(greedy):
            yield 0.3 * seconds + chance.uniform(0, 60), "key_000"
        bursts = round(_BURSTS * seconds / 86_400)
        each = min(_BURST_JOBS, (count - greedy) // (2 * bursts)) if bursts else 0
        for _ in range(bursts):
            begun, owner = chance.uniform(0, seconds), f"key_{chance.randrange(1, self.keys):03d}"
            for _ in range(each):
                yield begun + chance.uniform(0, 60), owner
        left = count - greedy - bursts * each
        while left > 0:
            at = chance.uniform(0, seconds)
            if chance.uniform(0, 1 + _SWING) < 1 - _SWING * math.cos(2 * math.pi * at / seconds):
                left -= 1
                yield at, None

    def shares(self, chance: random.Random) -> list[float]:
        """Return the fraction of each kind, such that all jobs together make up the load."""
        means = [_mean_seconds(kind, chance) for kind in KINDS]
        given = sum(kind.share or 0.0 for kind in KINDS)
        wanted = self.load * 1000 * 86_400 / self.jobs_a_day
        usual = sum((kind.share or 0.0) * mean for kind, mean in zip(KINDS, means, strict=True)) / given
        papers = (1 - _LARGE_PAPERS) * means[-2] + _LARGE_PAPERS * means[-1]
        share = min(max((wanted - usual) / (papers - usual), 0.0), 1.0)
        own = [(kind.share or 0.0) / given * (1 - share) for kind in KINDS[:-2]]
        return [*own, share * (1 - _LARGE_PAPERS), share * _LARGE_PAPERS]


def _mean_seconds(kind: Kind, chance: random.Random) -> float:
    drawn = [_draw(kind, chance) for _ in range(300)]
    return sum(job.seconds(1) + job.start_seconds() for job in drawn) / len(drawn)


def _draw(kind: Kind, chance: random.Random) -> SimulatedJob:
    low, high = (math.log(bound) for bound in kind.gaussians)
    gaussians = round(math.exp(chance.uniform(low, high)), -4)
    parameters: dict[str, Any] = {"preset": kind.preset, "resolution": chance.choice(kind.sides)}
    if kind.name not in ("preview", "standard") and chance.random() < _NAMES_WORKERS:
        parameters["workers"] = chance.choice([2, 4, 8])
    factor = math.exp(chance.gauss(-(_SPREAD**2) / 2, _SPREAD))
    return SimulatedJob(0.0, "", kind.name, parameters, int(gaussians * GAUSSIAN_BYTES), factor)
