"""Constants of the splatting model, each with the reason for its value.

The values are those of gsplat 1.6 and of the original 3DGS, because a scene renders correctly only with the constants
it was trained with. They are compiled into kernels: edit this file to change one, and do not assign to it at run time.
"""

import math
from typing import Any

#: Factors of the real spherical harmonics, in the order and with the signs of 3DGS files (Sloan, "Efficient Spherical
#: Harmonic Evaluation", JCGT 2013). Degree 0: 1 / (2 sqrt(pi)).
SH_C0 = 0.5 / math.sqrt(math.pi)
#: Degree 1: sqrt(3 / (4 pi)).
SH_C1 = math.sqrt(0.75 / math.pi)
#: Degree 2, in the order xy, yz, 2zz - xx - yy, xz, xx - yy.
SH_C2 = (
    math.sqrt(15.0 / math.pi) / 2,
    -math.sqrt(15.0 / math.pi) / 2,
    math.sqrt(5.0 / math.pi) / 4,
    -math.sqrt(15.0 / math.pi) / 2,
    math.sqrt(15.0 / math.pi) / 4,
)
#: Degree 3, in the order y(3xx - yy), xyz, y(4zz - xx - yy), z(2zz - 3xx - 3yy), x(4zz - xx - yy), z(xx - yy),
#: x(xx - 3yy).
SH_C3 = (
    -math.sqrt(17.5 / math.pi) / 4,
    math.sqrt(105.0 / math.pi) / 2,
    -math.sqrt(10.5 / math.pi) / 4,
    math.sqrt(7.0 / math.pi) / 4,
    -math.sqrt(10.5 / math.pi) / 4,
    math.sqrt(105.0 / math.pi) / 4,
    -math.sqrt(17.5 / math.pi) / 4,
)


def spherical_harmonics(x: Any, y: Any, z: Any) -> list[Any]:
    """Return the real spherical harmonics of degree 1 to 3 at unit vectors, given and returned as arrays or tensors."""
    xx, yy, zz = x * x, y * y, z * z
    polynomials = [y, z, x, x * y, y * z, 2 * zz - xx - yy, x * z, xx - yy]
    polynomials += [y * (3 * xx - yy), x * y * z, y * (4 * zz - xx - yy), z * (2 * zz - 3 * xx - 3 * yy)]
    polynomials += [x * (4 * zz - xx - yy), z * (xx - yy), x * (xx - 3 * yy)]
    factors = (-SH_C1, SH_C1, -SH_C1, *SH_C2, *SH_C3)
    return [factor * polynomial for factor, polynomial in zip(factors, polynomials, strict=True)]


#: Degree of spherical harmonics by the number of coefficients per color channel above degree 0.
SH_DEGREES = {0: 0, 3: 1, 8: 2, 15: 3}

#: Files store colors relative to mid-gray, so coefficients of zero are gray.
COLOR_OFFSET = 0.5

#: Variance in square pixels added to both axes of a projected Gaussian, to account for the size of a pixel. Without it,
#: a Gaussian smaller than a pixel could fall between pixel centers.
EPS2D = 0.3

#: Upper limit of alpha: a Gaussian never hides everything behind it, so transmittance stays above zero. gsplat 1.6 and
#: the original use 0.99; gsplat 1.5.3, the version on PyPI, uses 0.999.
ALPHA_MAX = 0.99

#: Minimum alpha, one level of an 8-bit image. Smaller contributions are skipped, which also gives a Gaussian finite
#: support.
ALPHA_MIN = 1.0 / 255.0
LOG2_ALPHA_MIN = math.log2(ALPHA_MIN)

#: The rasterizers compute alpha with powers of two: exp(-(u^2 + w^2) / 2) = 2^-(u'^2 + w'^2) if u' and w' are u and w
#: times this factor.
TO_POWER_OF_TWO = math.sqrt(0.5 * math.log2(math.e))

#: Blending of a pixel stops before its transmittance falls to this value: 1e-4, which two Gaussians of maximum alpha
#: leave. It is written as a product, so that the second of two such Gaussians stops blending in float64 as well as in
#: float32. The literal 1e-4 would not ensure this.
TRANSMITTANCE_MIN = (1.0 - ALPHA_MAX) ** 2

#: Minimum depth of rendered Gaussians in world units, as in the original viewers. gsplat trains with 0.01.
NEAR = 0.2

#: Directions are clamped to this distance beyond the image border, as a fraction of the half field of view, before the
#: perspective is linearized. Without clamping, Gaussians far outside the view would be smeared over the image.
FRUSTUM_MARGIN = 0.3

#: Edge of a raster tile in pixels. 16 neighboring pixels of a row fill one 512-bit or two 256-bit vectors.
RASTER_TILE = 16

#: Maximum shorter side of the coarsest scale in pixels. Halving a larger view down to it leaves 256 to 511 pixels,
#: about the size VGG was trained on (SGSST). A smaller maximum gives several scales to views that are no larger than
#: this.
COARSEST_SHORTER_SIDE = 511
