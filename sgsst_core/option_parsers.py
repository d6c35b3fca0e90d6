"""Parsers of command-line values that are more than a number or a word, for `Option.parse`.

Each raises a ValueError with a message for the user. JSON has its own syntax for these values.
"""

from __future__ import annotations

import math
import re

#: Content weight of each named style strength, chosen on the trade-off curve of style and content (docs/quality.md).
STRENGTHS: dict[str, float] = {"light": 3e4, "balanced": 1e4, "strong": 1.0}
_UNITS = {"": 1, "K": 10**3, "M": 10**6, "G": 10**9, "T": 10**12, "KI": 2**10, "MI": 2**20, "GI": 2**30, "TI": 2**40}
#: Syntax of `parse_color`, for help texts.
COLOR_SYNTAX = ": black, white, or R,G,B from 0 to 255."
_COLORS = {"black": (0.0, 0.0, 0.0), "white": (1.0, 1.0, 1.0)}


def parse_color(text: str) -> tuple[float, float, float]:
    """Return RGB in 0..1 from "black", "white" or three numbers from 0 to 255: "40,40,48"."""
    if text.lower() in _COLORS:
        return _COLORS[text.lower()]
    try:
        red, green, blue = (float(part) / 255 for part in text.split(","))
    except ValueError:
        red = math.nan
    if not (0 <= red <= 1 and 0 <= green <= 1 and 0 <= blue <= 1):
        raise ValueError(
            f"{text!r} is not a color. Give black, white or three numbers from 0 to 255, such as 40,40,48."
        )
    return red, green, blue


def parse_bytes(text: str) -> int:
    """Return bytes from "8GB", "512 MB", "6GiB" or a plain number."""
    match = re.fullmatch(r"(\d+(?:\.\d+)?)\s*([KMGT]?I?)B?", text.strip().upper())
    if not match or match[2] not in _UNITS or not (size := int(float(match[1]) * _UNITS[match[2]])):
        raise ValueError(f"{text!r} is not an amount of memory. Give one such as 8GB or 512MB.")
    return size


def parse_strength(text: str) -> float:
    """Return a content weight from "light", "balanced", "strong" or a number."""
    if text.lower() in STRENGTHS:
        return STRENGTHS[text.lower()]
    try:
        return float(text)
    except ValueError:
        raise ValueError(f"{text!r} is not a weight. Give a number or one of {', '.join(STRENGTHS)}.") from None


def parse_growth(text: str) -> float | str:
    """Return the factor of a refinement, or "auto"."""
    if text.lower() == "auto":
        return "auto"
    try:
        return float(text)
    except ValueError:
        raise ValueError(f"{text!r} is not a factor. Give a number or auto.") from None


def parse_weights(text: str) -> tuple[float, ...]:
    """Return weights of scales from "1,0.5,0,1"."""
    try:
        return tuple(float(part) for part in text.split(","))
    except ValueError:
        raise ValueError(
            f"{text!r} is not a list of weights. Give numbers separated by commas, such as 1,0.5,0,1."
        ) from None
