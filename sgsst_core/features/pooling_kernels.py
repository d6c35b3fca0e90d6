"""CPU kernels of `pooling`: a single pass over the input, on all cores.

Inputs are ReLU outputs, reinterpreted as integers with the same bits. Non-negative floats and their bit patterns have
the same order, and integers can be compared and selected with SIMD in any format, including bfloat16. The sign bit is
masked out, because a ReLU passes on -0 and NaN of either sign. A masked NaN is larger than all numbers, so it reaches
the loss.
"""

# Arguments are untyped: Numba compiles one version per argument type.
# mypy: disable-error-code="no-untyped-def"

from __future__ import annotations

import numba

from sgsst_core.compiled import compiled


@compiled(parallel=True)
def max_pool(source, mask, out):
    """Write the maxima of 2x2 windows of source [h, w, c] to out [h // 2, w // 2, c].

    `mask` has all bits of the type set except the sign bit.
    """
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
    """Write the gradient with respect to the ReLU's input to out [h, w, c].

    `gradient` [h // 2, w // 2, c] is the gradient of the maxima. In each window, the first maximum gets it if it is
    above 0; all other values get 0. `nothing` is the type's 0; `mask` is as in `max_pool`.
    """
    rows, columns, channels = gradient.shape
    height, width = out.shape[0], out.shape[1]
    for i in numba.prange((height + 1) // 2):
        if i == rows:  # last row if the height is odd
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
