"""Jobs of a simulated fleet: their sizes, owners and arrival times, determined by a seed.

Predicted times are those of an H200; a test compares them with `benchmarks.forecast`. A job's actual time is the
predicted one times a random factor that the scheduler does not know.
"""

from __future__ import annotations

import math
import random
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cache
from typing import Any

from sgsst_core.settings import PresetName, make_settings

#: Least fraction of a step's time that another GPU must save.
_LEAST_GAIN = 0.03
#: Bytes of a Gaussian with SH of degree 3 in a PLY file.
GAUSSIAN_BYTES = 248
#: Overhead before a job's first step: seconds to start the process, CUDA and the network; download rate from the file
#: store in bytes per second; seconds of planning, and number of steps that planning makes.
_START_SECONDS, _STAGING_BYTES, _PLAN_SECONDS, _PLAN_STEPS = 12.0, 1e9, 6.0, 10
#: Seconds per step: network forward and backward per pixel; rasterization per Gaussian; and a fixed time for kernel
#: launches.
_PIXEL_SECONDS = {"auto": 7e-9, "float32": 7e-8, "tf32": 1.6e-8, "bfloat16": 7e-9, "float16": 7e-9}
_GAUSSIAN_SECONDS, _FIXED_SECONDS = 1e-9, 1e-3
#: Network time of a step in phase 1, which optimizes only the coarsest scale, as a fraction of that in phase 2.
_COARSE_FRACTION = 0.1
#: Communication between ranks: bytes per second that one rank sends, and seconds of latency per message.
_LINK_BYTES, _LINK_SECONDS = 3e11, 1e-5
#: Ratio of a view's height to its width.
_ASPECT = 0.625
#: Standard deviation of the logarithm of actual over predicted time of a job.
_SPREAD = 0.35
#: Fraction of the jobs above the usual size whose request specifies the number of workers.
_NAMES_WORKERS = 0.08
#: Bursts per day (each from one API key within a minute), and jobs per burst.
_BURSTS, _BURST_JOBS = 24, 250
#: Relative variation of the arrival rate over a day.
_SWING = 0.25


@dataclass(frozen=True)
class Kind:
    """Class of jobs of similar size.

    Attributes:
        name: Name of the kind.
        preset: Preset of its jobs.
        share: Fraction of all jobs; None for kinds whose number is chosen such that the fleet's target load is reached.
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
#: Fraction of large jobs among the kinds whose `share` is None.
_LARGE_PAPERS = 0.04


@dataclass(frozen=True)
class JobSize:
    """Amount of work of a job, estimated from its record.

    Attributes:
        gaussians: Number of Gaussians of the scene.
        pixels: Number of pixels per view.
        steps_coarse, steps_sos: Steps of the two phases, times views per step.
        precision: Precision of the feature network.
    """

    gaussians: float
    pixels: float
    steps_coarse: int
    steps_sos: int
    precision: str = "float32"

    def seconds(self, gpus: int = 1) -> float:
        """Return the duration of all steps on this number of GPUs, in seconds."""
        raster = _GAUSSIAN_SECONDS * self.gaussians
        network = _PIXEL_SECONDS[self.precision] * self.pixels
        overhead = _FIXED_SECONDS + self._communication(gpus)
        coarse = (raster + _COARSE_FRACTION * network) / gpus + overhead
        return self.steps_coarse * coarse + self.steps_sos * ((raster + network) / gpus + overhead)

    def _communication(self, gpus: int) -> float:
        """Return the communication time per step in seconds: images, gradients of images and colors, and statistics."""
        if gpus == 1:
            return 0.0
        sent = 2 * 12 * (self.pixels + self.gaussians)
        return 6 * (gpus - 1) * _LINK_SECONDS + sent / _LINK_BYTES


@dataclass(frozen=True)
class SimulatedJob:
    """Job as its user submits it, with its actual run time.

    Attributes:
        at: Arrival time in seconds from the start.
        owner: API key that submits the job.
        kind: Name of the job's `Kind`.
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
        """Input files as recorded in the database."""
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
        """Return the actual seconds of all steps on `gpus` GPUs."""
        return self.factor * self.size.seconds(gpus)

    def start_seconds(self) -> float:
        """Return the seconds before the first step of an attempt."""
        planning = _PLAN_SECONDS + _PLAN_STEPS * self.seconds(1) / max(self.steps, 1)
        return _START_SECONDS + self.scene_bytes / _STAGING_BYTES + planning

    def planned(self, offered: int) -> int:
        """Return how many of the offered GPUs the job's plan uses: the point beyond which more GPUs gain too little."""
        if self.parameters.get("workers"):
            return offered
        seconds = [self.seconds(gpus) for gpus in range(1, offered + 1)]
        return next(gpus for gpus, each in enumerate(seconds, 1) if each <= min(seconds) * (1 + _LEAST_GAIN))


@cache
def _size(preset: PresetName, side: int, scene_bytes: int) -> JobSize:
    settings = make_settings(preset)
    side = min(side, settings.max_resolution or side)
    steps = settings.views_per_step
    return JobSize(
        settings.growth * scene_bytes / GAUSSIAN_BYTES,
        _ASPECT * side**2,
        settings.steps_coarse * steps,
        settings.steps_sos * steps,
        settings.precision,
    )


@dataclass(frozen=True)
class Demand:
    """Demand on a fleet.

    Attributes:
        gpus: Number of GPUs of the fleet.
        load: Requested GPU seconds (as if each job ran on one GPU) relative to available GPU seconds.
        jobs_a_day: Jobs per day of all API keys together for a fleet of 1,000 GPUs; scaled in proportion for other
            fleet sizes.
        keys: Number of API keys that submit jobs.
        greedy: Fraction of all jobs that the first API key submits at once.
    """

    gpus: int
    load: float = 0.9
    jobs_a_day: int = 200_000
    keys: int = 500
    greedy: float = 0.05

    def jobs(self, hours: float, seed: int) -> list[SimulatedJob]:
        """Return the jobs that arrive within `hours`, in order of arrival."""
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
        """Yield arrival times, each with the API key if the job is in a burst and None otherwise."""
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
        """Return each kind's fraction of all jobs, such that all jobs together produce the target load."""
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
