"""Numba kernel of the color transport of `warm_start`: all rounds in one pass over the colors, on all CPU cores."""

# Arguments are untyped: Numba compiles one version per argument type.
# mypy: disable-error-code="no-untyped-def"

from __future__ import annotations

import numba
import numpy as np

from sgsst_core.compiled import compiled

#: Number of colors that are processed together; they and the maps of a round fit in a core's L1 and L2 caches.
_TOGETHER = 512


@compiled()
def _map(values, positions, knots, targets, slopes):
    """Map values [n] in place by a piecewise linear function with knots [k], constant beyond its ends."""
    # Each step of the binary search runs over all values before the next one starts. Which half a value is in is
    # unpredictable, so the code contains no branch on it.
    for i in range(len(values)):
        values[i] = max(values[i], knots[0])
        positions[i] = 0
    half = len(knots) >> 1
    while half > 0:
        for i in range(len(values)):
            positions[i] += half * (knots[positions[i] + half] <= values[i])
        half >>= 1
    for i in range(len(values)):
        index = positions[i]
        values[i] = targets[index] + slopes[index] * (values[i] - knots[index])


@compiled(parallel=True)
def through(colors, axes, knots, targets, slopes):
    """Transform colors by all rounds, in place.

    Args:
        colors: [n, 3] float64.
        axes: [r, 3, 3], axes of each round as columns.
        knots: [r, 3, k] with k a power of 2, ascending: knots of each axis' map. Unused knots are infinite.
        targets: [r, 3, k], values at the knots; for unused knots, the last value.
        slopes: [r, 3, k], slopes between each knot and the next one.
    """
    parts = (len(colors) + _TOGETHER - 1) // _TOGETHER
    for part in numba.prange(parts):
        some = colors[part * _TOGETHER : (part + 1) * _TOGETHER]
        along, positions = np.empty((3, len(some))), np.empty(len(some), dtype=np.int64)
        for r in range(len(axes)):
            turn = axes[r]
            for a in range(3):
                values = along[a]
                for i in range(len(some)):
                    values[i] = some[i, 0] * turn[0, a] + some[i, 1] * turn[1, a] + some[i, 2] * turn[2, a]
                _map(values, positions, knots[r, a], targets[r, a], slopes[r, a])
            for i in range(len(some)):
                for c in range(3):
                    some[i, c] = along[0, i] * turn[c, 0] + along[1, i] * turn[c, 1] + along[2, i] * turn[c, 2]
