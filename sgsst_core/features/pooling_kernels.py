"""Compiled kernels of `pooling` on CPUs: one pass over what is pooled, on all cores.

Values are ReLU outputs, seen as integers of the same bits: those of numbers that are not negative come in the same
order, and integers are compared and chosen many at a time whatever the format, bfloat16 included. Their sign is masked
out: a ReLU hands on -0, and NaN of either sign, which is then above all numbers and reaches the loss.
"""

# The types of compiled functions are those of their arguments.
# mypy: disable-error-code="no-untyped-def"

from __future__ import annotations

import numba

from sgsst_core.compiled import compiled


@compiled(parallel=True)
def max_pool(source, mask, out):
    """Maxima [h // 2, w // 2, c] of 2x2 windows of source [h, w, c]. `mask` has all bits of the type but the sign."""
    rows, columns, channels = out.shape
    for i in numba.prange(rows):
        for j in range(columns):
            a, b = source[2 * i, 2 * j], source[2 * i, 2 * j + 1]
            c, d = source[2 * i + 1, 2 * j], source[2 * i + 1, 2 * j + 1]
            result = out[i, j]
            for k in range(channels):
                result[k] = max(max(a[k] & mask, b[k] & mask), max(c[k] & mask, d[k] & mask))


@compiled(parallel=True)
def max_pool_backward(gradient, source, nothing, mask, out):
    """Gradient [h, w, c] of what went into the ReLU, from that of the maxima [h // 2, w // 2, c]: all of `out`.

    It goes to the first of equal maxima, and nowhere if they are not above 0. `nothing` is the type's 0, `mask`
    as above.
    """
    rows, columns, channels = gradient.shape
    height, width = out.shape[0], out.shape[1]
    for i in numba.prange((height + 1) // 2):
        if i == rows:  # the last of an odd number
            out[2 * i] = nothing
            continue
        if width % 2:
            out[2 * i, width - 1] = nothing
            out[2 * i + 1, width - 1] = nothing
        for j in range(columns):
            a, b = source[2 * i, 2 * j], source[2 * i, 2 * j + 1]
            c, d = source[2 * i + 1, 2 * j], source[2 * i + 1, 2 * j + 1]
            to_a, to_b = out[2 * i, 2 * j], out[2 * i, 2 * j + 1]
            to_c, to_d = out[2 * i + 1, 2 * j], out[2 * i + 1, 2 * j + 1]
            slope = gradient[i, j]
            for k in range(channels):
                at_a, at_b, at_c = a[k] & mask, b[k] & mask, c[k] & mask
                most = max(max(at_a, at_b), max(at_c, d[k] & mask))
                g = slope[k] if most > nothing else nothing
                is_a, is_b, is_c = at_a == most, at_b == most, at_c == most
                to_a[k] = g if is_a else nothing
                to_b[k] = g if is_b and not is_a else nothing
                to_c[k] = g if is_c and not (is_a or is_b) else nothing
                to_d[k] = nothing if is_a or is_b or is_c else g
