"""GPU kernel of `spherical_harmonics.rest_colors`: one launch per view, which reads every coefficient once.

The source runs on NVIDIA and AMD GPUs, and in Triton's interpreter on the CPU (set TRITON_INTERPRET=1 before the first
import). Directions are float64 differences, divided by their largest component before squaring; basis and sum are
float32, like the colors that they are added to.
"""

# Arguments are untyped: Triton compiles one version per argument type.
# mypy: disable-error-code="no-untyped-def, no-untyped-call, untyped-decorator"

import triton
import triton.language as tl

from sgsst_core.constants import SH_C1, SH_C2, SH_C3

#: Gaussians per program.
BLOCK = tl.constexpr(128)
_C1 = tl.constexpr(SH_C1)
_C20, _C21, _C22, _C23, _C24 = (tl.constexpr(factor) for factor in SH_C2)
_C30, _C31, _C32, _C33, _C34, _C35, _C36 = (tl.constexpr(factor) for factor in SH_C3)


@triton.jit
def _term(k: tl.constexpr, factor: tl.constexpr, polynomial, row, valid):
    """Return coefficient k times its basis function, factor * polynomial: [BLOCK, 4], with 0 in the fourth channel."""
    return (polynomial * factor)[:, None] * tl.load(row + 3 * k, mask=valid, other=0.0)


@triton.jit
def rest_colors(
    sh_rest, means, center, out, total, DEGREE: tl.constexpr, COEFFICIENTS: tl.constexpr, BLOCK: tl.constexpr
):  # fmt: skip
    """Compute the sum over bands 1 to DEGREE for BLOCK Gaussians per program.

    Args:
        sh_rest: [N, COEFFICIENTS, 3] float32.
        means: [N, 3] float32 or float64.
        center: [3] float64, camera center.
        out: Output [N, 3] float32.
        total: N.
    """
    i = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    there = i < total
    p = i.to(tl.int64)
    dx = tl.load(means + 3 * p, mask=there, other=0.0).to(tl.float64) - tl.load(center)
    dy = tl.load(means + 3 * p + 1, mask=there, other=0.0).to(tl.float64) - tl.load(center + 1)
    dz = tl.load(means + 3 * p + 2, mask=there, other=0.0).to(tl.float64) - tl.load(center + 2)
    largest = tl.maximum(tl.maximum(tl.abs(dx), tl.abs(dy)), tl.abs(dz))
    largest = tl.where(largest > 0, largest, 1.0)
    x, y, z = (dx / largest).to(tl.float32), (dy / largest).to(tl.float32), (dz / largest).to(tl.float32)
    length = tl.sqrt(x * x + y * y + z * z)  # 1 to sqrt(3), or 0 at the camera center
    length = tl.where(length > 0, length, 1.0)
    x, y, z = x / length, y / length, z / length
    # Triton's block sizes are powers of two, so a masked fourth channel is added to a coefficient's three contiguous
    # values.
    channel = tl.arange(0, 4)[None, :]
    valid = there[:, None] & (channel < 3)
    row = sh_rest + (3 * COEFFICIENTS) * p[:, None] + channel
    colors = _term(0, -_C1, y, row, valid) + _term(1, _C1, z, row, valid) + _term(2, -_C1, x, row, valid)
    if DEGREE >= 2:
        xx, yy, zz = x * x, y * y, z * z
        colors += _term(3, _C20, x * y, row, valid)
        colors += _term(4, _C21, y * z, row, valid)
        colors += _term(5, _C22, 2 * zz - xx - yy, row, valid)
        colors += _term(6, _C23, x * z, row, valid)
        colors += _term(7, _C24, xx - yy, row, valid)
        if DEGREE >= 3:
            colors += _term(8, _C30, y * (3 * xx - yy), row, valid)
            colors += _term(9, _C31, x * y * z, row, valid)
            colors += _term(10, _C32, y * (4 * zz - xx - yy), row, valid)
            colors += _term(11, _C33, z * (2 * zz - 3 * xx - 3 * yy), row, valid)
            colors += _term(12, _C34, x * (4 * zz - xx - yy), row, valid)
            colors += _term(13, _C35, z * (xx - yy), row, valid)
            colors += _term(14, _C36, x * (xx - 3 * yy), row, valid)
    tl.store(out + 3 * p[:, None] + channel, colors, mask=valid)
