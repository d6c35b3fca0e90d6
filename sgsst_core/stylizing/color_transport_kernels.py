"""Compiled kernel of `color_transport` on CPUs: all rounds in one pass over the colors, on all cores."""

# The types of compiled functions are those of their arguments.
# mypy: disable-error-code="no-untyped-def"

from __future__ import annotations

import numba
import numpy as np

from sgsst_core.compiled import compiled

#: Colors that go through one round after another together: they and a round's maps stay in a core's nearest caches.
_TOGETHER = 512


@compiled()
def _map(values, places, knots, targets, slopes):
    """Values [n] through a piecewise linear map of knots [k], whose ends hold beyond it, in place."""
    # One step of the search for all values, then the next: which half a value is in cannot be foretold, and so no
    # branch hangs on it.
    for i in range(len(values)):
        values[i] = max(values[i], knots[0])
        places[i] = 0
    half = len(knots) >> 1
    while half > 0:
        for i in range(len(values)):
            places[i] += half * (knots[places[i] + half] <= values[i])
        half >>= 1
    for i in range(len(values)):
        place = places[i]
        values[i] = targets[place] + slopes[place] * (values[i] - knots[place])


@compiled(parallel=True)
def through(colors, axes, knots, targets):
    """Colors [n, 3] float64 after all rounds, in place.

    Args:
        axes: [r, 3, 3], as columns.
        knots, targets: [r, 3, k], k a power of 2: where each axis' map bends, rising, and what becomes of these values;
            knots that are left over are infinite, and their targets the last one.
    """
    slopes = np.zeros_like(knots)
    slopes[..., :-1] = (targets[..., 1:] - targets[..., :-1]) / (knots[..., 1:] - knots[..., :-1])
    parts = (len(colors) + _TOGETHER - 1) // _TOGETHER
    for part in numba.prange(parts):
        some = colors[part * _TOGETHER : (part + 1) * _TOGETHER]
        along, places = np.empty((3, len(some))), np.empty(len(some), dtype=np.int64)
        for r in range(len(axes)):
            turn = axes[r]
            for a in range(3):
                values = along[a]
                for i in range(len(some)):
                    values[i] = some[i, 0] * turn[0, a] + some[i, 1] * turn[1, a] + some[i, 2] * turn[2, a]
                _map(values, places, knots[r, a], targets[r, a], slopes[r, a])
            for i in range(len(some)):
                for c in range(3):
                    some[i, c] = along[0, i] * turn[c, 0] + along[1, i] * turn[c, 1] + along[2, i] * turn[c, 2]
