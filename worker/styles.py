"""Parser of style options: image files with optional weights, FILE or FILE:WEIGHT."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from sgsst_core.errors import SettingsError

#: Maximum number of images of a style. More are probably a mistake.
MOST_PICTURES = 16
_WEIGHTED = re.compile(r"(?P<path>.+):(?P<weight>[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?)", re.DOTALL)


@dataclass(frozen=True)
class StyleFile:
    """File of a style image, and its weight relative to the other images of the style (above 0)."""

    path: Path
    weight: float = 1.0

    @property
    def text(self) -> str:
        """Return the text that `parse_style` parses to this file."""
        return str(self.path) if self.weight == 1 else f"{self.path}:{self.weight!r}"


def parse_style(text: str, exists: Callable[[Path], bool] = Path.exists) -> StyleFile:
    """Parse FILE or FILE:WEIGHT.

    If a file named like the whole text exists, the text is its path, even if it ends in `:WEIGHT`.

    Args:
        text: Text to parse.
        exists: Function that returns whether a file exists.

    Raises:
        SettingsError: If the weight is not finite or not above 0.
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
    """Parse all images of a style; see `parse_style`.

    Raises:
        SettingsError: If a weight is invalid, or there are no images or too many.
    """
    if not 1 <= len(texts) <= MOST_PICTURES:
        raise SettingsError(f"There are {len(texts)} style images. Give between 1 and {MOST_PICTURES}.")
    return tuple(parse_style(text) for text in texts)
