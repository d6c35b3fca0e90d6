"""Random search for jobs that violate a bound, with scenes, cameras, styles and settings drawn from seeds.

python -m benchmarks.stability_search [--seconds 600] [--first 0] [--only SEED]

Each seed defines a job (`drawn`). The job may be refused with one of the project's own errors; otherwise, it must stay
within the bounds of `benchmarks.stability.situations`. Violations and unexpected errors are printed and stored
with their seed, and `--only SEED` runs that job again. Each failure found in this way is added to the hard cases
(`job_cases`).
"""

from __future__ import annotations

import argparse
import math
import random
import time
import traceback
from collections import Counter
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from benchmarks.machine import write_result
from benchmarks.stability.situations import STEPS, Situation, crowd, even_network, strain, views
from sgsst_core.errors import SgsstError
from sgsst_core.scene.gaussians import Scene
from sgsst_core.scene.stored_harmonics import held

#: Largest color coefficient; with a larger one, a job may report divergence.
_MOST = 1e3


def main() -> None:
    """Search, then print and store the outcomes."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=600.0, help="of searching; hours find what is rare")
    parser.add_argument("--first", type=int, default=0, help="number of the first job")
    parser.add_argument("--only", type=int, help="run this one and tell what it is")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    if arguments.only is not None:
        _report(arguments.only)
        return
    ended, failures = search(arguments.seconds, arguments.first)
    print(f"{sum(ended.values())} jobs: " + ", ".join(f"{count} {how}" for how, count in ended.most_common()))
    figures = {"seconds": arguments.seconds, "first": arguments.first, "ended": dict(ended), "failures": failures}
    write_result("stability_search", figures)


def search(seconds: float, first: int = 0) -> tuple[Counter[str], dict[int, str]]:
    """Run the jobs from number `first` on, for the given time but at least one job.

    Returns:
        Number of jobs by outcome, and the problem of each job that violated a bound, by its number.
    """
    ended: Counter[str] = Counter()
    failures: dict[int, str] = {}
    number, started = first, time.monotonic()
    while number == first or time.monotonic() - started < seconds:
        how, problem = outcome(drawn(number))
        ended[how] += 1
        if problem:
            failures[number] = problem
            print(f"{number}: {problem}", flush=True)
        number += 1
    return ended, failures


def outcome(situation: Situation) -> tuple[str, str | None]:
    """Run a job, and classify its outcome.

    Returns:
        Outcome and problem. The outcome is "within its bounds", the name of the error that refused the job, or
        "broken"; the problem is None unless the job is broken.
    """
    try:
        result = strain(situation)
    except SgsstError as error:
        return type(error).__name__, None
    except Exception as error:
        where = traceback.extract_tb(error.__traceback__)[-1]
        return "broken", f"{type(error).__name__}: {error} ({Path(where.filename).name}:{where.lineno})"
    if result.passed:
        return "within its bounds", None
    return "broken", f"error {result.error:.3g}, bound {result.bound:.3g}; {result.note}"


def drawn(number: int) -> Situation:
    """Return the job with this number, which is the same on every machine."""
    rng = random.Random(f"stability {number}")
    settings = _settings(rng)
    scene, style = _scene(rng), _style(rng)
    width, height = _side(rng), _side(rng)
    # A decrease of the loss is only checked for small learning rates, moderate content weights and views that are not
    # tiny; other jobs may legitimately fail to reduce it.
    tame = settings["learning_rate"] <= 0.01 and 0 < settings["content_weight"] <= 3e3 and min(width, height) >= 16
    tame &= min(style.shape[:2]) >= 16 and float(style.std()) > 0.05 and settings["style_loss"] == "sos"
    tame &= settings.get("preserve_colors") is None and float(scene.sh_dc.abs().max()) < 5 and scene.sh_degree == 0
    falls = tame and "scales" not in settings
    weights = even_network() if number % 2 else None  # even numbers: feature scale of the original network
    return Situation(scene, style, settings, views(width, height), falls=falls, weights=weights)


def _side(rng: random.Random) -> int:
    """Draw the side of a view: mostly a few feature cells, sometimes less than one."""
    return rng.choice([rng.randint(1, 15), rng.randint(16, 40), rng.randint(16, 40)])


def _size(rng: random.Random, low: float, high: float) -> float:
    """Draw a number from a log-uniform distribution."""
    return math.exp(rng.uniform(math.log(low), math.log(high)))


def _scene(rng: random.Random) -> Scene:
    count = rng.choice([1, 2, rng.randint(3, 80), 60])
    scene = crowd(count, seed=rng.randrange(1 << 30), degree=rng.choice([0, 0, 1, 3]))
    changes: dict[str, Any] = {}
    if rng.random() < 0.4:
        axes = torch.tensor([_size(rng, 1e-9, 1e6) if rng.random() < 0.5 else 0.5 for _ in range(3)])
        changes["scales"] = axes.log() + 0.2 * (scene.scales - scene.scales.mean())
    if rng.random() < 0.3:
        changes["opacities"] = scene.opacities * _size(rng, 1e-3, 100) + rng.uniform(-8, 8)
    if rng.random() < 0.2:
        changes["means"] = scene.means[:1].expand(count, 3).clone()
    elif rng.random() < 0.2:
        changes["means"] = scene.means * torch.tensor([_size(rng, 1e-3, 10), _size(rng, 1e-3, 10), 1.0])
    changes["sh_dc"] = _colors(rng, scene.sh_dc)
    if scene.sh_degree:
        changes["sh_rest"] = held(scene.sh_rest) * _size(rng, 1e-6, _MOST)
    return replace(scene, **changes)


def _colors(rng: random.Random, sh_dc: Tensor) -> Tensor:
    kind = rng.choice(["as they are", "as they are", "one", "gray", "black", "bright", "large"])
    if kind == "one":
        return sh_dc[:1].expand(len(sh_dc), 3).clone()
    if kind == "gray":
        return sh_dc[:, :1].expand(-1, 3).clone()
    if kind in ("black", "bright"):
        return torch.full_like(sh_dc, rng.uniform(1.7, 4) * (-1 if kind == "black" else 1))
    return sh_dc * (_size(rng, 1e-3, _MOST) if kind == "large" else 1)


def _style(rng: random.Random) -> Tensor:
    height, width = rng.choice([(30, 26), (rng.randint(1, 60), rng.randint(1, 60)), (1, 1), (1, 50), (17, 90)])
    generator = torch.Generator().manual_seed(rng.randrange(1 << 30))
    pixels = torch.rand(height, width, 3, generator=generator)
    kind = rng.choice(["noise", "noise", "flat", "black", "white", "two", "faint"])
    if kind == "two":
        return (pixels > 0.5).float()
    if kind == "faint":
        return 0.5 + 1e-6 * pixels
    if kind in ("flat", "black", "white"):
        value = {"flat": pixels[:1, :1], "black": torch.zeros(1, 1, 3), "white": torch.ones(1, 1, 3)}[kind]
        return value.expand(height, width, 3).clone()
    return pixels


def _settings(rng: random.Random) -> dict[str, Any]:
    """Draw some of the settings; all others keep their defaults."""
    values: dict[str, Any] = {
        "steps_sos": STEPS,
        "steps_coarse": rng.choice([0, 1, 3]),
        "learning_rate": rng.choice([0.005, 0.01, 0.2, 5.0]),
        "content_weight": rng.choice([0.0, 1.0, 3e3, 1e12]),
        "style_loss": rng.choice(["sos", "sos", "sos", "nnfm", "mixed"]),
        "seed": rng.randrange(1 << 20),
    }
    chances: dict[str, list[Any]] = {
        "preserve_colors": ["match", "luminance", "luminance"],
        "sh_attenuation": [0.5, 0.999, 1.0],
        "scales": [(1.0,), (0.0, 1.0), (1.0, 1e-6), (1e12, 3.0)],
        "style_scale": [0.25, 0.6, 2.0, 4.0],
        "style_rotation": [rng.uniform(-360, 360), 90.0, 45.0],
        "training_background": ["random", "palette", "background"],
        "background": [(1.0, 1.0, 1.0), (0.2, 0.9, 0.1)],
        "warm_start": [True, False],
        "position_weights": ["on", "off"],
        "clamp_aware_gradient": [False],
        "unseen": ["freeze"],
        "ignored": [_size(rng, 1e-6, 1.0)],  # so that each number still draws the same job
        "views_per_step": [2, 3],
        "cached_weights": ["float32", "half", "none"],
        "memory_limit": [1 << 20, 1 << 24],
        "coarsest_side": [16, 32],
    }
    for name, choices in chances.items():
        if rng.random() < 0.25:
            values[name] = rng.choice(choices)
    values.pop("ignored", None)
    return values


def _report(number: int) -> None:
    """Run one job, and print its description and outcome."""
    situation = drawn(number)
    scene = situation.scene
    print(f"{len(scene)} Gaussians of degree {scene.sh_degree}, style {tuple(situation.style.shape)}")
    print(f"views {[(camera.width, camera.height) for camera in situation.cameras]}; {situation.settings}")
    print(": ".join(str(part) for part in outcome(situation)))


if __name__ == "__main__":
    main()
