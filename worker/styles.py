"""Style pictures as users name them: files, each with a weight behind a colon where it has one."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from sgsst_core.errors import SettingsError

#: Pictures of a style at most: more are a slip of the hand.
MOST_PICTURES = 16
_WEIGHTED = re.compile(r"(?P<path>.+):(?P<weight>[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?)", re.DOTALL)


@dataclass(frozen=True)
class StyleFile:
    """A style picture's file, and its weight among others: any number above 0."""

    path: Path
    weight: float = 1.0

    @property
    def text(self) -> str:
        """As `parse_style` takes it."""
        return str(self.path) if self.weight == 1 else f"{self.path}:{self.weight!r}"


def parse_style(text: str, exists: Callable[[Path], bool] = Path.exists) -> StyleFile:
    """FILE or FILE:WEIGHT. A file whose whole name ends like a weight is that file.

    Args:
        exists: tells whether there is a file.

    Raises:
        SettingsError: the weight is not above 0, or not finite.
    """
    match = _WEIGHTED.fullmatch(text)
    if match is None or exists(Path(text)):
        return StyleFile(Path(text))
    weight = float(match["weight"])
    if not (math.isfinite(weight) and weight > 0):
        raise SettingsError(
            f"--style {text}: the weight {match['weight']} is not a finite number greater than 0. Give one."
        )
    return StyleFile(Path(match["path"]), weight)


def parse_styles(texts: Sequence[str]) -> tuple[StyleFile, ...]:
    """Every picture of a style; see `parse_style`.

    Raises:
        SettingsError: as there; there are too many; or there are none.
    """
    if not 1 <= len(texts) <= MOST_PICTURES:
        raise SettingsError(f"There are {len(texts)} style images. Give between 1 and {MOST_PICTURES}.")
    return tuple(parse_style(text) for text in texts)
