"""CPU kernels of `pooling`: a single pass over the input, on all cores.

Inputs are ReLU outputs, reinterpreted as integers with the same bits. Non-negative floats and their bit patterns have
the same order, and integers can be compared and selected with SIMD in any format, including bfloat16. The sign bit is
masked out, because a ReLU passes on -0 and NaN of either sign. A masked NaN is larger than all numbers, so it reaches
the loss.

CPU kernels of `winograd`: the transforms of windows and of products, with all channels of a value side by side.
"""

# Arguments are untyped: Numba compiles one version per argument type.
# mypy: disable-error-code="no-untyped-def"

from __future__ import annotations

import numba
import numpy as np

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


#: Windows that a thread transforms with the same working memory.
_TOGETHER = 8
_TWO, _FOUR, _EIGHT = np.float32(2), np.float32(4), np.float32(8)


@compiled(parallel=True)
def transform_windows(x, first, columns, out):
    """Write the transforms of 6x6 windows to out [36, n, c], beginning with window `first` of x [h, w, c].

    Windows are 4 cells apart, `columns` of them in a row; they begin one cell outside of x, which is 0 there.
    """
    count, channels = out.shape[1], out.shape[2]
    nothing = np.zeros(channels, np.float32)
    for part in numba.prange((count + _TOGETHER - 1) // _TOGETHER):
        half = np.empty((6, 6, channels), np.float32)
        for n in range(part * _TOGETHER, min(count, (part + 1) * _TOGETHER)):
            top, left = 4 * ((first + n) // columns) - 1, 4 * ((first + n) % columns) - 1
            for j in range(6):
                _transform_six(
                    _cell(x, top, left + j, nothing),
                    _cell(x, top + 1, left + j, nothing),
                    _cell(x, top + 2, left + j, nothing),
                    _cell(x, top + 3, left + j, nothing),
                    _cell(x, top + 4, left + j, nothing),
                    _cell(x, top + 5, left + j, nothing),
                    half[0, j], half[1, j], half[2, j], half[3, j], half[4, j], half[5, j],
                )  # fmt: skip
            for i in range(6):
                row = 6 * i
                _transform_six(
                    half[i, 0], half[i, 1], half[i, 2], half[i, 3], half[i, 4], half[i, 5],
                    out[row, n], out[row + 1, n], out[row + 2, n], out[row + 3, n], out[row + 4, n], out[row + 5, n],
                )  # fmt: skip


@compiled(parallel=True)
def transform_products(products, first, columns, bias, lowest, out):
    """Write 4x4 results of products [36, n, c] to out [h, w, c], beginning with window `first`.

    Windows are 4 cells apart, `columns` of them in a row. Each result is the sum of its products and the bias [c], or
    `lowest` if that is less.
    """
    count, channels = products.shape[1], products.shape[2]
    height, width = out.shape[0], out.shape[1]
    nothing, floor = np.zeros(channels, np.float32), np.float32(lowest)
    for part in numba.prange((count + _TOGETHER - 1) // _TOGETHER):
        half = np.empty((4, 6, channels), np.float32)
        spare = np.empty((4, channels), np.float32)
        for n in range(part * _TOGETHER, min(count, (part + 1) * _TOGETHER)):
            top, left = 4 * ((first + n) // columns), 4 * ((first + n) % columns)
            for j in range(6):
                _transform_four(
                    products[j, n], products[6 + j, n], products[12 + j, n],
                    products[18 + j, n], products[24 + j, n], products[30 + j, n],
                    nothing, np.float32(-np.inf), half[0, j], half[1, j], half[2, j], half[3, j],
                )  # fmt: skip
            for i in range(min(4, height - top)):
                row = out[top + i]
                _transform_four(
                    half[i, 0], half[i, 1], half[i, 2], half[i, 3], half[i, 4], half[i, 5],
                    bias, floor,
                    row[left],
                    row[left + 1] if left + 1 < width else spare[1],
                    row[left + 2] if left + 2 < width else spare[2],
                    row[left + 3] if left + 3 < width else spare[3],
                )  # fmt: skip


@compiled()
def _cell(x, i, j, nothing):
    """Return the values of a cell of x [h, w, c]; `nothing` outside of x."""
    return x[i, j] if 0 <= i < x.shape[0] and 0 <= j < x.shape[1] else nothing


@compiled()
def _transform_six(a, b, c, d, e, f, to_a, to_b, to_c, to_d, to_e, to_f):
    """Write one direction of the transform of a window, for all channels.

    All but the second transform of equal values are exactly 0. Results are therefore equal where all values are, as
    those of direct convolutions, and the first of the equal values of a pooling window is its maximum.
    """
    for k in range(a.size):
        even, odd = e[k] - _FOUR * c[k], d[k] - _FOUR * b[k]
        far, apart = e[k] - c[k], _TWO * (d[k] - b[k])
        to_a[k] = _FOUR * (a[k] - c[k]) + (e[k] - c[k])
        to_b[k] = even + odd
        to_c[k] = even - odd
        to_d[k] = far + apart
        to_e[k] = far - apart
        to_f[k] = _FOUR * (b[k] - d[k]) + (f[k] - d[k])


@compiled()
def _transform_four(a, b, c, d, e, f, bias, floor, to_a, to_b, to_c, to_d):
    """Write one direction of the transform of products plus the bias, for all channels; NaN stays NaN."""
    for k in range(a.size):
        near, difference, far, apart = b[k] + c[k], b[k] - c[k], d[k] + e[k], d[k] - e[k]
        one, two = a[k] + near + far + bias[k], difference + _TWO * apart + bias[k]
        three, four = near + _FOUR * far + bias[k], difference + _EIGHT * apart + f[k] + bias[k]
        to_a[k] = floor if one < floor else one
        to_b[k] = floor if two < floor else two
        to_c[k] = floor if three < floor else three
        to_d[k] = floor if four < floor else four
