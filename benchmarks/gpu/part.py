"""What parts share: their sizes, and what they find, on disk after every entry."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch


@dataclass(frozen=True)
class Sizes:
    """How large everything is.

    Attributes:
        gaussians: of the synthetic scenes, smallest first.
        view: (width, height) in which they are rendered.
        steps: (width, height, Gaussians) of SOS steps.
        step_repeats: steps that count.
        parity: (Gaussians, width, height) of what `reference` draws too.
        network: pixels of the side of the picture that goes through the network.
        curve: (steps, longer side in pixels) of the run that the CPU repeats.
        repeats: of what is timed.
    """

    gaussians: tuple[int, ...] = (1_000_000, 3_000_000, 6_000_000)
    view: tuple[int, int] = (980, 545)
    steps: tuple[tuple[int, int, int], ...] = ((980, 545, 2_500_000), (5187, 3361, 5_800_000))
    step_repeats: int = 5
    parity: tuple[int, int, int] = (20_000, 320, 200)
    network: int = 1024
    curve: tuple[int, int] = (200, 128)
    repeats: int = 20


#: Through the interpreter, in seconds.
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
    """What is measured: the GPU, or without one the CPU with Triton's interpreter."""
    return torch.device("cuda", torch.cuda.current_device()) if torch.cuda.is_available() else torch.device("cpu")


class Findings:
    """What a part has found so far, written to a file at every entry: a part that is ended keeps what it has.

    Args:
        path: of the JSON file.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self.entries: dict[str, Any] = {}
        self.broken: list[str] = []
        self._write()

    def add(self, name: str, value: Any) -> None:
        """Put a value for JSON under a name; "a/b" is b inside of a."""
        *groups, last = name.split("/")
        place = self.entries
        for group in groups:
            place = place.setdefault(group, {})
        place[last] = value
        self._write()

    def check(self, name: str, error: float, bound: float) -> None:
        """An error that must not exceed its bound: the part fails otherwise, once it has ended."""
        passed = math.isfinite(error) and error <= bound
        self.add(name, {"error": error if math.isfinite(error) else str(error), "bound": bound, "passed": passed})
        if not passed:
            self.broken.append(f"{name}: {error:.3g} exceeds {bound:.3g}")

    def _write(self) -> None:
        self._path.write_text(json.dumps(self.entries), encoding="utf-8")
