"""Problem sizes and findings of the benchmark's parts."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch


@dataclass(frozen=True)
class Sizes:
    """Sizes of all measurements.

    Attributes:
        gaussians: Numbers of Gaussians of the synthetic scenes, in ascending order.
        view: (width, height) of their views.
        steps: (width, height, Gaussians) for timed SOS steps.
        step_repeats: Number of timed steps.
        parity: (Gaussians, width, height) for the comparison with `reference`.
        network: Side in pixels of the square image for the feature network.
        curve: (steps, longer side in pixels) of the job that runs on both GPU and CPU.
        repeats: Repetitions of each timed call.
    """

    gaussians: tuple[int, ...] = (1_000_000, 3_000_000, 6_000_000)
    view: tuple[int, int] = (980, 545)
    steps: tuple[tuple[int, int, int], ...] = ((980, 545, 2_500_000), (5187, 3361, 5_800_000))
    step_repeats: int = 5
    parity: tuple[int, int, int] = (20_000, 320, 200)
    network: int = 1024
    curve: tuple[int, int] = (200, 128)
    repeats: int = 20


#: Sizes that take seconds in the interpreter.
QUICK = Sizes(
    gaussians=(60, 120),
    view=(48, 32),
    steps=((32, 32, 60), (48, 32, 60)),
    step_repeats=1,
    parity=(120, 40, 33),
    network=48,
    curve=(4, 48),
    repeats=1,
)


def device() -> torch.device:
    """Return the GPU, or the CPU (with Triton's interpreter) if there is none."""
    return torch.device("cuda", torch.cuda.current_device()) if torch.cuda.is_available() else torch.device("cpu")


class Findings:
    """Findings of a part, written to a file after each entry, so that none are lost if the part is killed.

    Args:
        path: Path of the JSON file.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self.entries: dict[str, Any] = {}
        self.broken: list[str] = []
        self._write()

    def add(self, name: str, value: Any) -> None:
        """Add a JSON-serializable value; with the name "a/b", it is entry `b` of the object `a`."""
        *groups, last = name.split("/")
        place = self.entries
        for group in groups:
            place = place.setdefault(group, {})
        place[last] = value
        self._write()

    def check(self, name: str, error: float, bound: float) -> None:
        """Add an error with its bound. If it exceeds the bound, the part continues, but counts as failed."""
        passed = math.isfinite(error) and error <= bound
        self.add(name, {"error": error if math.isfinite(error) else str(error), "bound": bound, "passed": passed})
        if not passed:
            self.broken.append(f"{name}: {error:.3g} exceeds {bound:.3g}")

    def _write(self) -> None:
        self._path.write_text(json.dumps(self.entries), encoding="utf-8")
