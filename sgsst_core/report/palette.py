"""Colors of charts, contact sheets and pages, for light and dark themes."""

from __future__ import annotations

PAPER = "#ffffff"
#: Color of text and axes, and of grid lines.
INK, GRID = "#222222", "#888888"
#: Colors of data series, in this order; distinguishable with color vision deficiency.
COLORS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9")
#: Replacements for the colors of charts on a dark screen.
ON_DARK = {
    INK: "#e4e7eb",
    GRID: "#8b949e",
    **dict(zip(COLORS, ("#4aa8e8", "#ff8b3d", "#2ecc9b", "#e79cc4", "#f2b632", "#9bd4f7"), strict=True)),
}
#: Colors of the page by their names in its style sheet: for light paper, and for a dark screen.
PAGE = {
    "paper": (PAPER, "#14171b"),
    "ink": (INK, ON_DARK[INK]),
    "quiet": ("#5b636c", "#9aa4af"),
    "line": ("#d9dde2", "#333a42"),
    "shade": ("#f4f6f8", "#1d2228"),
    "accent": (COLORS[0], ON_DARK[COLORS[0]]),
}


def color_of(index: int) -> str:
    """Return the color of the data series with the given index; colors repeat after the last one."""
    return COLORS[index % len(COLORS)]
