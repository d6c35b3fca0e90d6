"""The colors of all charts, pictures and pages, for light paper and for a dark screen."""

from __future__ import annotations

PAPER = "#ffffff"
#: Of text and axes, and of the lines behind a chart.
INK, GRID = "#222222", "#888888"
#: Of what a chart tells apart, in this order; people who see fewer colors tell them apart, too.
COLORS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9")
#: What a page puts in the place of a chart's colors on a dark screen.
ON_DARK = {
    INK: "#e4e7eb",
    GRID: "#8b949e",
    **dict(zip(COLORS, ("#4aa8e8", "#ff8b3d", "#2ecc9b", "#e79cc4", "#f2b632", "#9bd4f7"), strict=True)),
}
#: A page's own colors by their names in its style sheet: on light paper, and on a dark screen.
PAGE = {
    "paper": (PAPER, "#14171b"),
    "ink": (INK, ON_DARK[INK]),
    "quiet": ("#5b636c", "#9aa4af"),
    "line": ("#d9dde2", "#333a42"),
    "shade": ("#f4f6f8", "#1d2228"),
    "accent": (COLORS[0], ON_DARK[COLORS[0]]),
}


def color_of(place: int) -> str:
    """The color of what stands at a place of a list; after the last one, the first comes again."""
    return COLORS[place % len(COLORS)]
