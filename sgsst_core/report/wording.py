"""Numbers as people read them."""

from __future__ import annotations

import math

#: What is written for a value that is not there.
NOTHING = "–"
#: Between a number and its unit, where a line must not break.
_GAP = "\u00a0"


def number(value: float | None, digits: int = 3) -> str:
    """With so many significant digits; whole thousands are not rounded further."""
    if value is None:
        return NOTHING
    if not math.isfinite(value):
        return "NaN" if math.isnan(value) else ("∞" if value > 0 else "−∞")
    return f"{value:,.0f}" if 10**digits <= abs(value) < 1e9 else f"{value:,.{digits}g}"


def percent(share: float | None, digits: int = 2) -> str:
    """A share in percent, with so many significant digits."""
    return NOTHING if share is None else f"{number(100 * share, digits)}{_GAP}%"


def duration(seconds: float | None) -> str:
    """Seconds as seconds, minutes or hours."""
    if seconds is None or not math.isfinite(seconds):
        return NOTHING
    if seconds < 60:
        return f"{number(round(seconds, 4))}{_GAP}s"
    minutes, rest = divmod(round(seconds), 60)
    return _GAP.join(
        (f"{minutes}", "min", f"{rest:02}", "s")
        if minutes < 60
        else (f"{minutes // 60}", "h", f"{minutes % 60:02}", "min")
    )


def byte_count(count: float | None) -> str:
    """Bytes with the largest unit of which there is at least one."""
    if count is None or not math.isfinite(count):
        return NOTHING
    for unit, size in (("GB", 1e9), ("MB", 1e6), ("kB", 1e3)):
        if abs(count) >= size:
            return f"{number(count / size)}{_GAP}{unit}"
    return f"{count:.0f}{_GAP}bytes"
