"""Human-readable formatting of numbers."""

from __future__ import annotations

import math

#: Text for a missing value.
NOTHING = "–"
#: No-break space between a number and its unit.
_GAP = "\u00a0"


def number(value: float | None, digits: int = 3) -> str:
    """Format a number with `digits` significant digits; below 1e9, integer digits are never rounded away."""
    if value is None:
        return NOTHING
    if not math.isfinite(value):
        return "NaN" if math.isnan(value) else ("∞" if value > 0 else "−∞")
    return f"{value:,.0f}" if 10**digits <= abs(value) < 1e9 else f"{value:,.{digits}g}"


def percent(fraction: float | None, digits: int = 2) -> str:
    """Format a fraction in percent, with `digits` significant digits."""
    return NOTHING if fraction is None else f"{number(100 * fraction, digits)}{_GAP}%"


def duration(seconds: float | None, gap: str = _GAP) -> str:
    """Format seconds as seconds, minutes or hours, with `gap` between numbers and units."""
    if seconds is None or not math.isfinite(seconds):
        return NOTHING
    if seconds < 60:
        return f"{number(round(seconds, 4))}{gap}s"
    whole = round(seconds)
    if whole < 3600:
        return gap.join((f"{whole // 60}", "min", f"{whole % 60:02}", "s"))
    minutes = round(seconds / 60)
    return gap.join((f"{minutes // 60}", "h", f"{minutes % 60:02}", "min"))


def byte_count(count: float | None) -> str:
    """Format bytes with the largest unit that gives at least 1."""
    if count is None or not math.isfinite(count):
        return NOTHING
    for unit, size in (("GB", 1e9), ("MB", 1e6), ("kB", 1e3)):
        if abs(count) >= size:
            return f"{number(count / size)}{_GAP}{unit}"
    return f"{count:.0f}{_GAP}bytes"


def time_left(seconds: float | None) -> str:
    """Return the remaining time of a stage as text; empty if it is unknown."""
    if seconds is None:
        return ""
    return f"{clock(seconds)} left" if seconds >= 1 else "almost done"


def clock(seconds: float) -> str:
    """Return a duration as minutes and seconds, or hours, minutes and seconds."""
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02d}:{rest:02d}" if hours else f"{minutes}:{rest:02d}"
