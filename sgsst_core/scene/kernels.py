"""Numba kernel of `spherical_harmonics.rest_colors`: one pass over the coefficients, on all CPU cores.

It computes in float64 like the tensor functions, but sums in another order. Float32 would hardly be faster, and
accurate to only six digits.
"""

# Arguments are untyped: Numba compiles one version per argument type.
# mypy: disable-error-code="no-untyped-def"

import numba
import numpy as np

from sgsst_core.compiled import compiled
from sgsst_core.constants import SH_C1, SH_C2, SH_C3

_C20, _C21, _C22, _C23, _C24 = SH_C2
_C30, _C31, _C32, _C33, _C34, _C35, _C36 = SH_C3


@compiled()
def _direction(means, i, center):
    """Return the unit vector from the camera center to Gaussian i; zero if it is at the center.

    The offset is scaled first if its squares would overflow or underflow.
    """
    x, y, z = means[i, 0] - center[0], means[i, 1] - center[1], means[i, 2] - center[2]
    largest = max(abs(x), abs(y), abs(z))
    if not largest > 0:
        return 0.0, 0.0, 0.0
    if not 1e-150 < largest < 1e150:
        x, y, z = x / largest, y / largest, z / largest
    inverse = 1 / np.sqrt(x * x + y * y + z * z)
    return x * inverse, y * inverse, z * inverse


@compiled()
def _sum_of_bands(sh_rest, i, x, y, z, degree, out):
    """Compute out[i] = sum over bands 1 to `degree` of sh_rest[i] in direction x, y, z."""
    b0, b1, b2 = -SH_C1 * y, SH_C1 * z, -SH_C1 * x
    if degree == 1:
        for c in range(3):
            out[i, c] = b0 * sh_rest[i, 0, c] + b1 * sh_rest[i, 1, c] + b2 * sh_rest[i, 2, c]
        return
    xx, yy, zz = x * x, y * y, z * z
    b3, b4, b5 = _C20 * x * y, _C21 * y * z, _C22 * (2 * zz - xx - yy)
    b6, b7 = _C23 * x * z, _C24 * (xx - yy)
    b8 = b9 = b10 = b11 = b12 = b13 = b14 = 0.0
    if degree == 3:
        b8, b9 = _C30 * y * (3 * xx - yy), _C31 * x * y * z
        b10, b11 = _C32 * y * (4 * zz - xx - yy), _C33 * z * (2 * zz - 3 * xx - 3 * yy)
        b12, b13, b14 = _C34 * x * (4 * zz - xx - yy), _C35 * z * (xx - yy), _C36 * x * (xx - 3 * yy)
    for c in range(3):
        total = b0 * sh_rest[i, 0, c] + b1 * sh_rest[i, 1, c] + b2 * sh_rest[i, 2, c]
        total += b3 * sh_rest[i, 3, c] + b4 * sh_rest[i, 4, c] + b5 * sh_rest[i, 5, c]
        total += b6 * sh_rest[i, 6, c] + b7 * sh_rest[i, 7, c]
        if degree == 3:
            total += b8 * sh_rest[i, 8, c] + b9 * sh_rest[i, 9, c] + b10 * sh_rest[i, 10, c]
            total += b11 * sh_rest[i, 11, c] + b12 * sh_rest[i, 12, c]
            total += b13 * sh_rest[i, 13, c] + b14 * sh_rest[i, 14, c]
        out[i, c] = total


@compiled(parallel=True)
def rest_colors(sh_rest, means, center, degree, out):
    """Write the sum over bands 1 to `degree` to out [N, 3] float32, for sh_rest [N, K, 3] float32 and means [N, 3]."""
    for i in numba.prange(out.shape[0]):
        x, y, z = _direction(means, i, center)
        _sum_of_bands(sh_rest, i, x, y, z, degree, out)
