"""Parser of files with optional weights, FILE or FILE:WEIGHT: style images, and scenes of a blend."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from sgsst_core.errors import SettingsError

#: Maximum number of images of a style. More are probably a mistake.
MOST_STYLE_IMAGES = 16
_WEIGHTED = re.compile(r"(?P<file>.+):(?P<weight>[-+]?(?:\d+(?:\.\d*)?|\.\d+)(?:[eE][-+]?\d+)?)", re.DOTALL)


@dataclass(frozen=True)
class StyleFile:
    """File of a style image, and its weight relative to the other images of the style (above 0)."""

    path: Path
    weight: float = 1.0

    @property
    def text(self) -> str:
        """Return the text that `parse_style` parses to this file."""
        return str(self.path) if self.weight == 1 else f"{self.path}:{self.weight!r}"


def path_or_url(value: str | Path) -> Path | str:
    """Return the path of a local file, or an http or https URL unchanged."""
    return value if isinstance(value, str) and value.lower().startswith(("http://", "https://")) else Path(value)


def split_weight(text: str, exists: Callable[[Path], bool] = Path.exists) -> tuple[str, float]:
    """Return the file and weight of FILE or FILE:WEIGHT; see `parse_style`. The weight is 1 if there is none."""
    match = _WEIGHTED.fullmatch(text)
    if match is None or exists(Path(text)):
        return text, 1.0
    return match["file"], float(match["weight"])


def parse_style(text: str, exists: Callable[[Path], bool] = Path.exists) -> StyleFile:
    """Parse FILE or FILE:WEIGHT.

    If a file named like the whole text exists, the text is its path, even if it ends in `:WEIGHT`.

    Raises:
        SettingsError: If the weight is not finite or not above 0.
    """
    file, weight = split_weight(text, exists)
    if not (math.isfinite(weight) and weight > 0):
        given = text.rpartition(":")[2]
        raise SettingsError(f"Style image {text}: the weight must be a finite number above 0, not {given}.")
    return StyleFile(Path(file), weight)


def parse_styles(texts: Sequence[str]) -> tuple[StyleFile, ...]:
    """Parse all images of a style; see `parse_style`.

    Raises:
        SettingsError: If a weight is invalid, or there are no images or too many.
    """
    if not 1 <= len(texts) <= MOST_STYLE_IMAGES:
        raise SettingsError(f"There are {len(texts)} style images. Give between 1 and {MOST_STYLE_IMAGES}.")
    return tuple(parse_style(text) for text in texts)
